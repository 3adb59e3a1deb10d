"""Secret and entries of withdrawals, and the file outside of a database that notes them."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import stat
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial

import pytest
from stored import commit

from skindb import clock
from skindb.errors import InputError
from skindb.store import Database, MarkerFileWarning, markers
from skindb.store.folder import Folder
from skindb.store.markers import (
    keyed_hash,
    mark_withdrawn,
    read_marker_file,
    read_markers,
    read_withdrawal,
    require_secret,
)

WITHDRAWN_AT = datetime(2026, 3, 10, 12, tzinfo=UTC)


class _Clock(datetime):
    """The clock at the time of the withdrawal."""

    @classmethod
    def now(cls, tz=None):
        return WITHDRAWN_AT


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder whose subject S01 was withdrawn on 10 March."""
    monkeypatch.setattr(clock, "datetime", _Clock)
    found = Folder(tmp_path / "db")
    mark_withdrawn(found, "S01", {"model": 2})
    return found


def test_subject_hash__depends_on_the_secret_and_the_whole_pseudonym(tmp_path):
    one = Folder(tmp_path / "one")
    other = Folder(tmp_path / "other")
    hashes = [
        keyed_hash(require_secret(place), name)
        for place in (one, other)
        for name in ("S01", "S0", "1")
    ]
    assert len(set(hashes)) == 6
    assert keyed_hash(require_secret(one), "S01") == hashes[0]
    assert all(len(text) == 64 for text in hashes)


def test_secret__is_created_once_by_racing_writers(tmp_path):
    with ThreadPoolExecutor(8) as threads:
        hashes = list(
            threads.map(
                lambda _: keyed_hash(require_secret(Folder(tmp_path / "db")), "S01"),
                range(32),
            )
        )
    assert len(set(hashes)) == 1


def test_secret__is_private_and_exists_from_the_first_commit(tmp_path):
    commit(tmp_path / "db")
    assert (tmp_path / "db" / "secret").stat().st_mode & 0o077 == 0
    assert len(json.loads((tmp_path / "db" / "secret").read_text())["secret"]) == 64


def test_markers__are_those_of_the_subject_alone(place):
    read = read_markers(place)
    assert read.is_withdrawn("S01")
    assert not any(map(read.is_withdrawn, ("S0", "S01x", "s01", "", "S01.lotion", "1")))
    mark_withdrawn(place, "S01", {})
    assert read_markers(place) == read  # a second withdrawal changes nothing


def test_markers__contain_no_pseudonym(place):
    for path in place.root.rglob("*"):
        assert "S01" not in path.name
        assert path.is_dir() or b"S01" not in path.read_bytes()


def test_read_markers__without_the_secret_nothing_is_read_or_written(tmp_path):
    """Otherwise a withdrawn subject would not be recognised."""
    db = Database(tmp_path / "db")
    for take in ("S01", "S02"):
        commit(db.root, take=take)
    db.erase("S01")
    secret = db.root / "secret"
    content = secret.read_bytes()
    for damage in (None, b"", b"{}", content.replace(b"0", b"1")):
        secret.unlink(missing_ok=True)
        if damage is not None:
            secret.write_bytes(damage)
        for call in (
            db.takes,
            db.table,
            db.info,
            lambda: db.read("capture", "S02"),
            lambda: commit(db.root, take="S03"),
        ):
            with pytest.raises(
                InputError,
                match=r"secret: must be as it was created.*restore it from a backup",
            ):
                call()
        assert [fault.where for fault in db.verify()] == [str(secret)]
    secret.write_bytes(content)
    assert db.verify() == []


def test_read_withdrawal__says_when_and_what_was_removed(place):
    entry = read_withdrawal(place, "S01")
    assert (entry["withdrawn"][:10], entry["removed"]) == ("2026-03-10", {"model": 2})
    assert read_withdrawal(place, "S02") is None


def test_verify__names_damaged_entries(place):
    mark_withdrawn(place, "S02", {})
    db = Database(place.root)
    assert db.verify() == []
    first, second = (
        place.root / f"withdrawn/{keyed_hash(require_secret(place), subject)}.json"
        for subject in ("S01", "S02")
    )
    content = second.read_text()
    for damage in ("{", content.replace("2026-", "2025-"), first.read_text()):
        second.write_text(damage)
        (fault,) = db.verify()
        assert fault.where == str(second)
        assert fault.rule == "an entry of a withdrawal must be as it was created"


SUBJECT = "Xqz7"


@pytest.fixture
def db(tmp_path):
    db = Database(tmp_path / "db")
    for take in (SUBJECT, "B"):
        commit(db.root, take=take, n=2, consent_scope=["fit"])
    return db


def _notes(db):
    return read_marker_file(db.place.marker_file(), require_secret(db.place))


def test_marker_file__notes_withdrawals_and_consents(db):
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
    assert len(_notes(db).entries) == 1
    file = db.place.marker_file()
    assert SUBJECT.encode() not in file.read_bytes()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    size = file.stat().st_size
    db.complete_erasures()
    assert file.stat().st_size == size  # each note once


def test_marker_file__can_be_a_link_to_another_disk(db, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    db.place.marker_file().symlink_to(other / "faces.markers")
    db.erase(SUBJECT)
    assert len(_notes(db).entries) == 1
    assert (other / "faces.markers").is_file()


def test_marker_file__of_two_links_has_one_lock(place, tmp_path, monkeypatch):
    folders = []
    monkeypatch.setattr(
        fcntl, "flock", lambda number, _: folders.append(os.fstat(number).st_ino)
    )
    for name in "ab":
        file = tmp_path / name / "db.markers"
        file.parent.mkdir()
        file.symlink_to(tmp_path / "markers")
        monkeypatch.setattr(type(place), "marker_file", lambda _, file=file: file)
        markers.note_withdrawals(place)
    assert {*folders} == {tmp_path.stat().st_ino}


def test_marker_file__that_was_lost_is_written_again(db):
    db.erase(SUBJECT)
    before = _notes(db)
    db.place.marker_file().unlink()
    db.complete_erasures()
    assert _notes(db) == before


def test_marker_file__of_a_killed_writer_is_the_one_before(db, monkeypatch):
    db.record_consent("B", ["fit"])
    before = db.place.marker_file().read_bytes()

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(markers, "flush_path", killed)
        with pytest.raises(KeyboardInterrupt):
            db.erase(SUBJECT)
    assert db.place.marker_file().read_bytes() == before
    db.complete_erasures()
    assert len(_notes(db).entries) == 1


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
    with pytest.warns(MarkerFileWarning, match="found a named pipe"):
        db.erase(SUBJECT)
    assert db.takes() == ["B"]
    db.place.marker_file().unlink()

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(markers, "private_file", full)
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
    flock = fcntl.flock

    def copied(number, operation):
        copies.append(os.dup(number))
        flock(number, operation)

    monkeypatch.setattr(fcntl, "flock", copied)
    db.erase(SUBJECT)
    folder = os.open(db.place.marker_file().parent, os.O_RDONLY)
    flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    for number in (*copies, folder):
        os.close(number)


def test_marker_file__of_another_database_is_kept(db, tmp_path):
    other = Database(tmp_path / "other")
    commit(other.root, n=2)
    other.erase("A1")
    content = other.place.marker_file().read_bytes()
    shutil.copy(other.place.marker_file(), db.place.marker_file())
    with pytest.warns(
        MarkerFileWarning,
        match=r"found content that is damaged, or of another database; give the right",
    ):
        db.erase(SUBJECT)
    assert db.place.marker_file().read_bytes() == content


def test_marker_file__of_many_writers_has_every_note(db):
    subjects = [f"S{number}" for number in range(8)]
    for subject in subjects:
        commit(db.root, take=subject, n=2)
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(partial(_consent, db.url), subjects))
    assert len(_notes(db).consents) == 8


def _consent(url, subject):
    Database(url).record_consent(subject, ["fit"])
