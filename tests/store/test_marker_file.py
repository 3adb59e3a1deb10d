"""The file outside of a database that notes withdrawals and consents."""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest
from stored import commit

from skindb.store import Database, MarkerFileWarning
from skindb.store.marker_file import note_withdrawals, read_marker_file
from skindb.store.markers import require_secret

SUBJECT = "Xqz7"


@pytest.fixture
def db(tmp_path):
    db = Database(tmp_path / "db")
    for take in (SUBJECT, "B"):
        commit(db.root, take=take, n=2, consent_scope=["fit"])
    return db


def _notes(db):
    return read_marker_file(db.place.marker_file(), require_secret(db.place))


def test_marker_file__notes_withdrawals_readmissions_and_consents(db):
    db.record_consent(SUBJECT, ["fit"])
    db.record_consent("B", [])
    db.record_consent("B", ["fit", "export"])
    assert sorted(one["consent"] for one in _notes(db).consents.values()) == [
        ["fit"],
        ["fit", "export"],
    ]
    db.erase(SUBJECT)
    notes = _notes(db)
    assert [one["consent"] for one in notes.consents.values()] == [["fit", "export"]]
    assert [*notes.entries] == [
        f"withdrawn/{name}" for name in db.place.sizes("withdrawn")
    ]
    db.readmit(SUBJECT, db.withdrawal(SUBJECT).date)
    assert len(_notes(db).entries) == 2
    file = db.place.marker_file()
    assert SUBJECT.encode() not in file.read_bytes()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    size = file.stat().st_size
    db.complete_erasures()
    assert file.stat().st_size == size  # each line once


def test_marker_file__can_be_a_link_to_another_disk(db, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    db.place.marker_file().symlink_to(other / "faces.markers")
    db.erase(SUBJECT)
    assert len(_notes(db).entries) == 1
    assert (other / "faces.markers").is_file()


def test_marker_file__that_was_lost_is_written_again(db):
    db.erase(SUBJECT)
    before = _notes(db)
    db.place.marker_file().unlink()
    db.complete_erasures()
    assert _notes(db) == before


def test_marker_file__continues_after_a_line_that_was_cut_off(db):
    db.erase(SUBJECT)
    before = db.place.marker_file().read_bytes()
    for size in range(1, len(before), 7):
        db.place.marker_file().write_bytes(before[:size])
        note_withdrawals(db.place)
        assert db.place.marker_file().read_bytes() == before


def test_marker_file__that_cannot_be_written_is_a_warning(db, tmp_path, monkeypatch):
    rule = (
        "withdrawals and consents must be noted outside the database, so that a "
        "restore repeats them"
    )
    db.place.marker_file().mkdir()
    with pytest.warns(MarkerFileWarning, match=rule):
        db.record_consent("B", ["fit"])
    assert db.consent("B") == ["fit"]
    db.place.marker_file().rmdir()
    os.mkfifo(db.place.marker_file())
    with pytest.warns(
        MarkerFileWarning, match="found something that is not a regular file"
    ):
        db.erase(SUBJECT)
    assert db.takes() == ["B"]
    db.place.marker_file().unlink()
    monkeypatch.setattr(os, "pwrite", lambda *_: 0)
    with pytest.warns(
        MarkerFileWarning, match="found No space left on device; free some space there"
    ):
        db.complete_erasures()
    monkeypatch.undo()
    db.complete_erasures()
    assert len(_notes(db).entries) == 1


def test_marker_file__is_unlocked_although_a_copy_of_its_descriptor_is_open(
    db, monkeypatch
):
    """Such as that of a process that was forked meanwhile."""
    copies = []
    monkeypatch.setattr(os, "fsync", lambda number: copies.append(os.dup(number)))
    db.erase(SUBJECT)
    with db.place.marker_file().open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    for number in copies:
        os.close(number)


def test_marker_file__of_another_database_is_kept(db, tmp_path):
    other = Database(tmp_path / "other")
    commit(other.root, n=2)
    other.erase("A1")
    content = other.place.marker_file().read_bytes()
    shutil.copy(other.place.marker_file(), db.place.marker_file())
    with pytest.warns(
        MarkerFileWarning,
        match=r"found a line that is damaged, or of another database; give the right",
    ):
        db.erase(SUBJECT)
    assert db.place.marker_file().read_bytes() == content


def test_marker_file__of_many_writers_has_each_line_once(db):
    subjects = [f"S{number}" for number in range(8)]
    for subject in subjects:
        commit(db.root, take=subject, n=2)
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(partial(_consent, db.url), subjects))
    assert len(_notes(db).consents) == 8
    assert len(db.place.marker_file().read_bytes().splitlines()) == 9


def _consent(url, subject):
    Database(url).record_consent(subject, ["fit"])
