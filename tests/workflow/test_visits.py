"""Sessions of a subject in a condition are visits; the same session is a new version."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner
from planted_pictures import directions, write_pictures, write_table

from skindb import workflow
from skindb.cli import cli
from skindb.errors import InputError
from skindb.ingest.pictures import import_images
from skindb.store import Database
from skindb.workflow.fit import _remove_first_passes

MORNING = "2026-01-01T10:00:00+01:00"
SPRING = "2026-04-01T10:00:00+02:00"
SUMMER = "2026-07-01T10:00:00+02:00"
SPACING_MM = 12.0  # few surfels


@pytest.fixture(scope="module")
def imported(tmp_path_factory) -> Path:
    """A capture folder of a sphere."""
    folder = tmp_path_factory.mktemp("imported")
    lights = directions(5)
    names = write_pictures(folder / "pictures", lights)
    write_table(folder / "pictures/lights.csv", names, lights)
    consent = {"scope": ["fit", "statistics"], "reference": "form 1"}
    import_images(
        folder / "pictures", folder / "S", {"subject": "3", "consent": consent}
    )
    return folder / "S"


@pytest.fixture
def capture(imported, tmp_path):
    """Function that writes a capture folder of a session with further keys."""

    def write(name: str, session: str, **keys: object) -> Path:
        folder = Path(shutil.copytree(imported, tmp_path / name))
        record = json.loads((folder / "capture.json").read_text())
        text = json.dumps(record | {"session": session} | keys)
        (folder / "capture.json").write_text(text)
        return folder

    return write


def ingest(db: Database, folder: Path, **options: object) -> str:
    record = workflow.ingest_take(db, folder, spacing_mm=SPACING_MM, **options)
    assert record.generation == len(db.history("capture", record.take))
    return f"{record.take} {record.generation}"


def test_ingest__another_session_is_the_next_visit(capture, tmp_path):
    db = Database(tmp_path / "db")
    first = capture("a", MORNING)
    assert ingest(db, first) == "3 1"
    assert ingest(db, capture("b", SPRING)) == "3.normal.2 1"
    (note,) = [
        line
        for line in db.record("capture", "3.normal.2").provenance["summary"]["notes"]
        if "session" in line
    ]
    assert note.startswith(f"session {SPRING} is visit 2: no visit is stated")
    assert ingest(db, first) == "3 2"
    # the same moment in another zone
    assert ingest(db, capture("c", "2026-04-01T08:00:00+00:00")) == "3.normal.2 2"
    assert ingest(db, capture("d", SUMMER, condition="lotion")) == "3.lotion 1"
    assert ingest(db, capture("e", MORNING, subject="33")) == "33 1"
    rows = db.table().loc[["3", "3.lotion", "3.normal.2"]]
    assert [*rows["visit"]] == [1, 1, 2]
    assert [*rows["repeat"]] == [1, 1, 1]


def test_ingest__a_stated_visit_is_used(capture, tmp_path):
    db = Database(tmp_path / "db")
    assert ingest(db, capture("a", MORNING, visit=4, repeat=2)) == "3.normal.4.2 1"
    assert ingest(db, capture("b", SUMMER, visit=4, repeat=2)) == "3.normal.4.2 2"
    notes = db.record("capture", "3.normal.4.2").provenance["summary"]["notes"]
    assert f"session {SUMMER} takes the place of session {MORNING}" in str(notes)
    assert ingest(db, capture("c", SPRING)) == "3.normal.5 1"
    with pytest.raises(InputError, match="must be stated once; found 7, and 6"):
        ingest(db, capture("d", SPRING, visit=7), visit=6)
    with pytest.raises(InputError, match="a repeat belongs to a visit; found 2"):
        ingest(db, capture("e", SPRING, repeat=2))


def test_ingest__several_sessions_are_visits_in_the_order_of_time(capture, tmp_path):
    sessions = {"a": SUMMER, "b": MORNING, "c": SPRING}
    folders = [str(capture(name, session)) for name, session in sessions.items()]
    options = ["--spacing", str(SPACING_MM)]
    result = CliRunner().invoke(
        cli, ["ingest", str(tmp_path / "db"), *folders, *options]
    )
    assert result.exit_code == 0, result.output
    db = Database(tmp_path / "db")
    times = {
        take: db.record("capture", take).provenance["session"] for take in db.takes()
    }
    assert times == {"3": MORNING, "3.normal.2": SPRING, "3.normal.3": SUMMER}


def test_remove_first_passes__of_one_take_alone(tmp_path):
    db = Database(tmp_path / "db")
    takes = ("3", "33", "3.lotion", "3.lotion.2", "3.lotion.2.2", "3-3")
    folders = {take: db.scratch() / f"{take}-0123" for take in takes}
    for take, folder in folders.items():
        (folder / "log/model" / take).mkdir(parents=True)
    for removed in ("3.lotion.2", "3"):
        _remove_first_passes(db, removed)
        folders.pop(removed)
        assert not (db.scratch() / f"{removed}-0123").exists()
        assert all(folder.exists() for folder in folders.values())
