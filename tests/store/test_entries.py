"""Blocks of the cache of records: few, rewritten seldom, and nothing of withdrawn subjects."""

from __future__ import annotations

import gc
from contextlib import suppress
from unittest import mock

import pytest
from stored import commit

import skindb
from skindb.errors import InputError
from skindb.store import entries, snapshot
from skindb.store.erasure import erase
from skindb.store.log import Log

SCOPE = {"consent_scope": ["fit", "statistics"]}


@pytest.fixture
def db(tmp_path):
    for subject in ("A1", "B2", "C3", "D4"):
        commit(tmp_path / "db", take=subject, **SCOPE, subject=subject)
    return skindb.open(str(tmp_path / "db"))


def _blocks(db):
    return sorted((db.root / "catalogue").iterdir())


def _block(db, take):
    return db.root / entries.block_of(take)


def test_save__a_commit_changes_the_block_of_its_take_only(db):
    for number in range(8):
        commit(db.root, take=f"E{number}", **SCOPE)
    db.table()
    others = {
        file: file.stat().st_ino for file in _blocks(db) if file != _block(db, "A1")
    }
    assert len(others) > 2
    for generation in (2, 3):
        commit(db.root, take="A1", **SCOPE)
        assert db.table().capture_generation["A1"] == generation
        assert {file: file.stat().st_ino for file in others} == others


def test_save__of_two_queries_keeps_a_block_whole(db):
    """The entries of one are missing, and read again."""
    one, other = (skindb.open(db.url) for _ in range(2))
    content = entries.block_content

    def slower(key, rows):
        with mock.patch.object(snapshot, "block_content", content):
            other.table()
        return content(key, rows)

    with mock.patch.object(snapshot, "block_content", slower):
        one.table()
    commit(db.root, take="A1", **SCOPE)
    assert db.table().capture_generation["A1"] == 2
    assert db.verify() == []


def test_erase__removes_only_the_blocks_with_the_subject(db):
    db.table()
    kept = [file for file in _blocks(db) if b"B2" not in file.read_bytes()]
    together = {
        take
        for take in ("A1", "C3", "D4")
        if entries.block_of(take) == entries.block_of("B2")
    }
    assert len(kept) == len(_blocks(db)) - 1 > 0
    erase(db.place, "B2")
    assert _blocks(db) == kept
    with mock.patch.object(Log, "_read", autospec=True, side_effect=Log._read) as read:
        assert list(db.table().index) == ["A1", "C3", "D4"]
    assert {call.args[0].take for call in read.call_args_list} == together
    assert not [file for file in _blocks(db) if b"B2" in file.read_bytes()]
    assert db.verify() == []


def test_save__foreign_files_are_left_to_verify(db):
    foreign = db.root / "catalogue/notes.txt"
    foreign.parent.mkdir()
    foreign.write_text("B2")
    db.table()
    commit(db.root, take="A1", **SCOPE)
    db.table()
    assert foreign.exists()
    assert ["notes.txt" in str(fault) for fault in db.verify()] == [True]
    erase(db.place, "B2")
    assert not foreign.exists()


def test_read_blocks__that_a_withdrawal_removes_meanwhile(db):
    db.table()
    keys = entries.block_keys(db.place, "catalogue")
    listings = [["catalogue/x.block", *keys], keys]
    with mock.patch.object(entries, "block_keys", side_effect=listings):
        blocks = entries.read_blocks(db.place)
    rows = [row for block in blocks.values() for row in block]
    assert sorted(row.record.take for row in rows) == ["A1", "B2", "C3", "D4"]


def test_erase__an_unknown_subject_beside_a_block_that_cannot_be_read(db):
    (db.root / "catalogue").mkdir()
    (db.root / "catalogue/notes.txt").write_text("Z9")
    with pytest.raises(InputError, match="Z9: the database must hold the subject"):
        erase(db.place, "Z9")


@pytest.mark.parametrize("is_enabled", [True, False])
def test_collection_paused__leaves_the_state_of_the_process(is_enabled):
    was_enabled = gc.isenabled()
    (gc.enable if is_enabled else gc.disable)()
    try:
        with suppress(ValueError), entries.collection_paused():
            assert not gc.isenabled()
            raise ValueError
        assert gc.isenabled() == is_enabled
    finally:
        (gc.enable if was_enabled else gc.disable)()
