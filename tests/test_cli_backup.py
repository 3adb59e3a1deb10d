"""Backups, restores and withdrawals from backups on the command line."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
from test_cli import _run
from traces import traces

sys.path.insert(0, str(Path(__file__).parent / "store"))
from stored import commit

from skindb.store import Database, Lease
from skindb.store.bucket import place_at

SUBJECT = "Xqz7"


@pytest.fixture
def db(tmp_path):
    """A database of captures and models of two subjects, and a release."""
    db = Database(tmp_path / "db")
    for number, take in enumerate((SUBJECT, "B")):
        capture = commit(db.root, 1.0 + number, take, consent_scope=["fit"], n=2)
        commit(
            db.root,
            3.0 + number,
            take,
            "model",
            n=2,
            inputs=[capture.as_input()],
            consent_scope=["fit"],
        )
    db.create_release("r1")
    return db


@pytest.fixture
def dest(tmp_path):
    return str(tmp_path / "backup")


def _done(*args):
    done = _run(*map(str, args))
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.splitlines()


def _refused(*args):
    done = _run(*map(str, args))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    return line


def test_backup_and_restore__print_what_they_did(db, dest, tmp_path):
    first, files = _done("backup", db.root, dest)
    assert first == "state 1: 5 versions"
    assert files.endswith("MB), 0 present, 0 removed")
    again = json.loads("\n".join(_done("backup", db.root, dest, "--verify", "--json")))
    assert (again["number"], again["copied"]) == (2, 1)  # the entry of the audit log
    listed = _done("restore", dest, "--list")
    assert [line.split()[:2] for line in listed] == [["state", "1"], ["state", "2"]]
    copy = tmp_path / "copy"
    [line] = _done("restore", dest, copy, "--at", 1, "--markers", f"{db.root}.markers")
    assert line.startswith("state 1 of 2")
    assert re.search(r": 5 versions, 0\.[01] MB$", line)
    assert _done("verify", copy) == ["Every version is intact."]
    assert Database(copy).takes("model") == ["B", SUBJECT]
    entries, faults = Database(copy).audit()
    assert faults == []
    assert [(entry.action, entry.counts["takes"]) for entry in entries] == [
        ("backup", 2),
        ("restore", 2),
    ]


def test_restore__prints_what_the_marker_file_changed(db, dest, tmp_path):
    _done("backup", db.root, dest)
    commit(db.root, 9.0, "C", consent_scope=["fit"], n=2)
    _done("consent", db.root, "B", "--scope", "none")
    _done("consent", db.root, "C", "--scope", "none")
    _done("withdraw", db.root, SUBJECT, "--yes")
    lines = _done("restore", dest, tmp_path / "copy", "--markers", f"{db.root}.markers")
    assert lines[1:] == [
        "not restored, because of withdrawals: 3 versions",
        "results to be computed again by skindb refresh: 1",
        "later records of consent, repeated: 1",
        "later records of consent of subjects who are not in this state: 1; "
        "record them again when their captures are ingested",
    ]
    assert traces(tmp_path / "copy", SUBJECT) == []
    assert Database(tmp_path / "copy").consent("B") == []
    _, risk, *_ = _done("restore", dest, tmp_path / "all", "--without-markers")
    assert risk == (
        "subjects who were withdrawn after this state are in the database again: "
        "withdraw them again"
    )


def test_restore__of_a_lost_database_uses_the_file_beside_it(db, dest):
    _done("backup", db.root, dest)
    _done("withdraw", db.root, SUBJECT, "--yes")
    db.place.remove("log")
    for name in db.names():
        db.place.remove(name)
    _done("restore", dest, db.root)
    assert db.takes("model") == ["B"]
    assert db.verify() == []


def test_backup__is_refused_in_one_line(db, dest, tmp_path):
    assert "the database must exist; found nothing" in _refused(
        "backup", tmp_path / "none", dest
    )
    assert "must be a backup; found another folder" in _refused(
        "restore", db.root, tmp_path / "x", "--without-markers"
    )
    assert "must be a backup; found nothing" in _refused(
        "restore", tmp_path / "none", "--list"
    )
    _done("backup", db.root, dest)
    assert "a restore needs an empty or missing folder" in _refused(
        "restore", dest, db.root
    )
    assert "--without-markers to accept this risk" in _refused(
        "restore", dest, tmp_path / "x"
    )
    for command in ("info", "verify", "clean"):
        assert (
            "must be a complete database; found a backup; run skindb restore"
            in _refused(command, dest)
        )
    for options in ([], [tmp_path / "x", "--markers", "f", "--without-markers"]):
        assert _run("restore", dest, *map(str, options)).returncode == 2
    place = place_at(dest)
    place.is_unlocked = True
    with Lease(place, "backup", ("release",), command="skindb backup"):
        assert "only one run at a time may work on it; found skindb backup" in _refused(
            "backup", db.root, dest
        )


def test_backup__names_damage_and_exits_with_1(db, dest, tmp_path):
    _done("backup", db.root, dest)
    digest = db.place.digests(
        f"{db.record('model', 'B').path}/surfels/surfel_area/c/0"
    ).whole
    file = Path(dest) / "files" / digest[:2] / digest
    file.write_bytes(b"x")
    for command in (
        ("backup", db.root, dest, "--verify"),
        ("restore", dest, tmp_path / "a", "--without-markers"),
    ):
        line = _refused(*command)
        assert line.startswith(
            f"skindb: {file}: a file of a backup must be as it was written; found different content"
        )
    assert "surfels/surfel_area/c/0" in _refused("verify", tmp_path / "a")


def test_withdraw__reaches_backups_that_are_given(db, dest, tmp_path):
    _done("backup", db.root, dest)
    other = tmp_path / "other.json"  # of another subject
    other.touch()
    call = ("withdraw", db.root, SUBJECT, "--yes", "--report", other)
    assert "a report is not replaced" in _refused(*call)
    lines = _done(
        "withdraw",
        db.root,
        SUBJECT,
        "--yes",
        "--backup",
        dest,
        "--report",
        tmp_path / "report",
    )
    assert any(line.startswith(f"removed from {dest}: ") for line in lines)
    assert traces(Path(dest), SUBJECT) == []
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["erased_backups"] == 1
    assert (
        "backups that were not given to the command, which may still contain the subject"
        in report["not_reached"]
    )


def test_withdraw__reaches_backups_that_are_given_later(db, dest, tmp_path):
    _done("backup", db.root, dest)
    _done("withdraw", db.root, SUBJECT, "--yes")
    assert traces(Path(dest), SUBJECT)
    _done(
        "withdraw",
        db.root,
        SUBJECT,
        "--yes",
        "--backup",
        dest,
        "--report",
        tmp_path / "report",
    )
    assert traces(Path(dest), SUBJECT) == []
    assert json.loads((tmp_path / "report.json").read_text())["removed_versions"] == {
        "capture": 1,
        "model": 1,
        "release": 1,
    }
    assert "nothing is left" in _refused("withdraw", db.root, SUBJECT, "--yes")


def test_withdraw__with_a_wrong_or_damaged_backup(db, dest, tmp_path):
    before = db.takes("model")
    assert "must be a backup" in _refused(
        "withdraw", db.root, SUBJECT, "--yes", "--backup", tmp_path / "none"
    )
    assert db.takes("model") == before
    _done("backup", db.root, dest)
    state = Path(dest) / "states/000001.json"
    state.write_bytes(b"{}")
    line = _refused("withdraw", db.root, SUBJECT, "--yes", "--backup", dest)
    assert f"backup {dest}, from which the subject is not removed yet: {state}" in line
    assert db.takes("model") == ["B"]
    state.unlink()
    _done("withdraw", db.root, SUBJECT, "--yes", "--backup", dest)
    assert traces(Path(dest), SUBJECT) == []
