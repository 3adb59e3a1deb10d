"""Every command reports a damaged record of a database in a line with a cure, also with
--json, without traceback.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from test_cli import _run

sys.path.insert(0, str(Path(__file__).parent / "store"))
from stored import commit

COMMANDS = (
    ("verify", "{db}"),
    ("fit", "{db}"),
    ("fit", "{db}", "A1"),
    ("analyze", "{db}", "translucency"),
    ("register", "{db}"),
    ("edit", "{db}", "A1", "--trait", "lotion=1"),
    ("render", "{db}", "--out", "{tmp}/x"),
    ("compare", "{db}", "A1"),
    ("show", "{db}", "A1", "surfel_area", "{tmp}/x.png"),
    ("export", "{db}", "--out", "{tmp}/x"),
)
DAMAGES = {
    "lost": lambda path: path.unlink(),
    "pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "nested": lambda path: path.write_text("[" * 9000 + "]" * 9000),
    "no provenance": lambda path: path.write_text(
        path.read_text().replace("provenance", "provenence")
    ),
}


@pytest.fixture
def db(tmp_path):
    scope = ["fit", "statistics", "export"]
    record = commit(tmp_path / "db", take="A1", consent_scope=scope)
    commit(
        tmp_path / "db",
        take="A1",
        kind="model",
        consent_scope=scope,
        inputs=[record.as_input()],
    )
    commit(tmp_path / "db", take="traits", kind="population")  # an edit reads it first
    return tmp_path / "db"


@pytest.mark.parametrize("damage", DAMAGES)
def test_cli__a_damaged_record_is_a_line_of_every_command(db, tmp_path, damage):
    for kind in ("capture", "model"):
        DAMAGES[damage](db / f"log/{kind}/A1/00000001.json")
    for command in COMMANDS:
        done = _run(*(part.format(db=db, tmp=tmp_path) for part in command), "--json")
        assert done.returncode == 1, (command, done.stdout, done.stderr)
        assert "Traceback" not in done.stderr
        errors = json.loads(done.stdout)["error"]
        assert errors, command
        assert all(one["cure"] and one["found"] for one in errors), (command, errors)
        text = " ".join(one["rule"] for one in errors)
        assert "generation 1 must exist" in text or "must be as committed" in text, (
            command,
            errors,
        )


def test_info__a_damaged_version_hides_no_other(db):
    version = next((db / "data/capture/A1").glob("*.zarr"))
    (version / "zarr.json").write_text("{}")
    commit(db, take="B1")
    for name in ("log", "heads", "data"):
        shutil.rmtree(db / name / "model")  # it has no groups of a model
    done = _run("info", str(db), "-v")
    assert done.returncode == 0, done.stderr
    assert "restore this file from a backup" in done.stdout
    assert "B1" in done.stdout


def test_cli__errors_of_the_system_have_a_cure(db):
    (db / "log").rename(db / "aside")
    (db / "log").mkdir()
    (db / "log/capture").touch()
    done = _run("info", str(db), "--json")
    assert (
        "generation 1 must exist"
        in json.loads(done.stdout)["takes"]["A1"]["capture"]["fault"]
    )
