"""Captures of a withdrawn subject: refused, also if the subject is withdrawn meanwhile."""

from __future__ import annotations

import json
import shutil

import pytest
from click.testing import CliRunner
from sphere import write_capture
from traces import contents, traces

from skindb import workflow
from skindb.cli import cli
from skindb.store import Database, WithdrawnError
from skindb.store import lease as lease_module

SUBJECT = "Xqz7"
OPTIONS = {"spacing_mm": 8.0, "photographs": 0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture folder of the subject."""
    found = tmp_path_factory.mktemp("captures") / SUBJECT
    write_capture(found)
    _edit(found, subject=SUBJECT)
    return found


@pytest.fixture(scope="module")
def withdrawn(folder, tmp_path_factory):
    """Folder of a database whose only subject was withdrawn, which is only copied."""
    db = Database(tmp_path_factory.mktemp("made") / "db")
    workflow.ingest_take(db, folder, **OPTIONS)
    workflow.withdraw(db, SUBJECT)
    return db.root


@pytest.fixture
def db(withdrawn, tmp_path):
    """A database whose only subject was withdrawn."""
    return Database(shutil.copytree(withdrawn, tmp_path / "db"))


def _edit(folder, **changes):
    file = folder / "capture.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_ingest__of_a_withdrawn_subject_is_refused_in_one_line(db, folder):
    before = contents(db.root)
    result = CliRunner().invoke(
        cli, ["ingest", str(db.root), str(folder), "--spacing", "8"]
    )
    [line] = str(result.exception).splitlines()
    assert (
        f"{SUBJECT}: captures of a withdrawn subject must not be ingested; "
        "found a withdrawal on 20"
    ) in line
    assert line.endswith("if the subject consented again, give it a new pseudonym")
    after = contents(db.root)
    attempt = "audit/000000/000000003.json"  # the attempt is logged
    assert after.pop(attempt)
    assert after == before


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["check", "visibility", "sample", "write"])
def test_ingest__suspended_while_the_subject_is_withdrawn_leaves_nothing(
    folder, tmp_path, monkeypatch, stage
):
    db = Database(tmp_path / "db")
    workflow.ingest_take(db, folder, **OPTIONS)

    def suspend(name, *_):
        if name == stage and not db.withdrawal(SUBJECT):
            # the lease of this run has expired
            monkeypatch.setattr(lease_module, "_has_ended", lambda *_: True)
            db.erase(SUBJECT)

    with pytest.raises(
        WithdrawnError, match=f"{SUBJECT}: captures of a withdrawn subject must not be"
    ):
        workflow.ingest_take(db, folder, progress=suspend, **OPTIONS)
    assert db.withdrawal(SUBJECT)
    assert traces(db.root, SUBJECT) == []
    assert list((db.root / "tmp").iterdir()) == []
    assert db.verify() == []
