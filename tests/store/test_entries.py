"""Blocks of the cache of records: few, rewritten seldom, and nothing of withdrawn subjects."""

from __future__ import annotations

import gc
from contextlib import suppress
from unittest import mock

import pytest
from stored import commit

import skindb
from skindb.errors import InputError
from skindb.store import entries
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


def test_blocks_to_merge__few_blocks_and_few_rows_written_again():
    blocks = {}
    written = 0
    most_blocks = 0
    takes = 3000
    for number in range(takes):
        row = ("model", f"P{number}", 1)
        merged = entries.blocks_to_merge(blocks, 1)
        rows = [row, *(key for name in merged for key in blocks.pop(name))]
        blocks[str(number)] = rows
        written += len(rows)
        most_blocks = max(most_blocks, len(blocks))
    assert sum(map(len, blocks.values())) == takes
    assert most_blocks <= 9
    assert written < 14 * takes


def test_save__a_commit_leaves_large_blocks_alone(db):
    for number in range(8):
        commit(db.root, take=f"E{number}", **SCOPE)
    db.table()
    [large] = _blocks(db)
    content = large.read_bytes()
    for generation in (2, 3):
        commit(db.root, take="A1", **SCOPE)
        assert db.table().capture_generation["A1"] == generation
        assert large.read_bytes() == content
        assert len(_blocks(db)) == 2


def test_erase__removes_only_the_blocks_with_the_subject(db):
    with mock.patch.object(entries, "MAX_BLOCK_ROWS", 2):
        db.table()
    kept = [file for file in _blocks(db) if b"B2" not in file.read_bytes()]
    assert len(kept) == 1
    erase(db.place, "B2")
    assert _blocks(db) == kept
    with mock.patch.object(Log, "_read", autospec=True, side_effect=Log._read) as read:
        assert list(db.table().index) == ["A1", "C3", "D4"]
    assert [call.args[0].take for call in read.call_args_list] == ["A1"]
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


def test_read_blocks__that_another_query_merges_meanwhile(db):
    db.table()
    [key] = entries.block_keys(db.place, "catalogue")
    listings = [[f"catalogue/{'0' * 64}.json", key], [key]]
    with mock.patch.object(entries, "block_keys", side_effect=listings):
        [rows] = entries.read_blocks(db.place).values()
    assert [row.record.take for row in rows] == ["A1", "B2", "C3", "D4"]


def test_verify__while_a_query_writes_a_block(db):
    erase(db.place, "B2")
    for number in range(8):
        commit(db.root, take=f"E{number}", **SCOPE)
    db.table()
    new_takes = ["F1"]

    def listed(place, folder):
        keys = block_keys(place, folder)
        if folder == "catalogue" and new_takes:
            commit(db.root, take=new_takes.pop(), **SCOPE)
            db.table()
        return keys

    block_keys = entries.block_keys
    with mock.patch.object(entries, "block_keys", listed):
        assert db.verify() == []
    assert len(_blocks(db)) == 2


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
