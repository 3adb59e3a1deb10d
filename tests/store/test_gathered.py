"""Blocks of tables of many takes: a cache that shows what the versions hold, and that
holds nothing of withdrawn subjects.
"""

from __future__ import annotations

import os
from unittest import mock

import numpy as np
import pytest
import xarray as xr

from skindb.errors import InputError
from skindb.schema import dataset
from skindb.store import Database, cohort, gathered
from skindb.store.erasure import erase

REGIONS = {"B1": "ab", "B2": "b", "B3": "abc", "B4": "c", "B5": "ab"}


def _commit(db, subject, value):
    about = {"subject": subject, "take": subject, "consent_scope": ["statistics"]}
    regions = [*REGIONS[subject]]
    area = np.full(len(regions), value)
    tables = dataset({"region_area": area}, coords={"region": regions})
    with db.stage("model", subject) as stage:
        stage.write({"surfels": dataset({"surfel_area": area})}, tables=tables)
        stage.commit(about)


@pytest.fixture
def db(tmp_path, monkeypatch):
    """Five takes in blocks of two."""
    return _database(tmp_path / "db", monkeypatch)


def _database(url, monkeypatch):
    monkeypatch.setattr(cohort, "FEW_TAKES", 1)
    monkeypatch.setattr(gathered, "GATHERED_TAKES", 2)
    db = Database(url)
    for number, subject in enumerate(REGIONS):
        _commit(db, subject, number + 0.5)
    return db


def _values(db):
    """Tables of all takes as a new process reads them."""
    gathered._opened.cache_clear()
    gathered._tables.cache_clear()
    return db.cohort("tables").compute(scheduler="synchronous")


def _without_blocks(db):
    with mock.patch.object(cohort, "FEW_TAKES", 100):
        return _values(db)


def _blocks(db):
    return sorted((db.root / "gathered").glob("*"))


def test_blocks__hold_what_the_versions_hold(db):
    want = _without_blocks(db)
    assert not _blocks(db)
    xr.testing.assert_identical(_values(db), want)
    assert len(_blocks(db)) == 3
    with mock.patch.object(gathered, "_read", side_effect=AssertionError):
        xr.testing.assert_identical(_values(db), want)
    assert db.verify() == []
    assert db.garbage() == []


def test_blocks__a_refit_makes_only_its_own_block_again(db):
    _values(db)
    first = {*_blocks(db)}
    _commit(db, "B3", 9.0)
    with mock.patch.object(gathered, "_read", side_effect=gathered._read) as tables:
        values = _values(db)
    assert sorted(call.args[0].take for call in tables.call_args_list) == ["B3", "B4"]
    assert float(values["region_area"].sel(take="B3", region="a")) == 9.0
    assert len({*_blocks(db)} - first) == 1


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "of other versions"])
def test_blocks__in_doubt_are_made_from_the_versions(db, damage):
    want = _values(db)
    blocks = _blocks(db)
    contents = [file.read_bytes() for file in blocks]
    for file, content, other in zip(
        blocks, contents, contents[1:] + contents[:1], strict=True
    ):
        middle = len(content) // 2
        flipped = (
            content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]
        )
        wrong = {
            "flip": flipped,
            "cut": content[:-1],
            "empty": b"",
            "of other versions": other,
        }
        file.write_bytes(wrong[damage])
    xr.testing.assert_identical(_values(db), want)
    assert [file.read_bytes() for file in blocks] == contents


def test_erase__removes_every_block_with_the_subject(db):
    _values(db)
    blocks = {file: file.read_bytes() for file in _blocks(db)}
    damaged, *_ = [file for file, content in blocks.items() if b"B5" not in content]
    holding = [
        file for file, content in blocks.items() if "B5".encode("utf-32-le") in content
    ]
    assert len(holding) == 1
    damaged = next(file for file in blocks if file not in holding)
    damaged.write_bytes(b"unknown")
    erase(db.place, "B5")
    assert {*blocks} - {*_blocks(db)} == {*holding, damaged}
    assert "B5" not in _values(db)["take"].values
    # a block that comes back is found and removed
    holding[0].write_bytes(blocks[holding[0]])
    assert [holding[0].name in str(fault) for fault in db.verify()] == [True]
    db.clean()
    assert holding[0] not in _blocks(db)
    assert db.verify() == []


def test_verify__while_a_block_is_removed(db):
    erase(db.place, "B5")
    _values(db)
    first = _blocks(db)[0]
    children = type(db.place).children

    def listed(place, key, **options):
        names = children(place, key, **options)
        if key == "gathered" and not options:
            first.unlink(missing_ok=True)
        return names

    with mock.patch.object(type(db.place), "children", listed):
        assert db.verify() == []
    assert not first.exists()


def test_erase__a_block_that_is_being_made_is_not_written(db):
    packed = gathered._packed

    def withdrawn_meanwhile(key, block):
        if "B2" in block["take"].values:
            erase(db.place, "B2")
        return packed(key, block)

    with mock.patch.object(gathered, "_packed", withdrawn_meanwhile):
        _values(db)
    for file in _blocks(db):
        assert "B2".encode("utf-32-le") not in file.read_bytes()
    assert db.verify() == []


def test_erase__tables_in_memory_make_no_block(db):
    """A process that read the tables before the withdrawal writes none of them after it."""
    gathered._opened.cache_clear()
    before = db.cohort("tables")
    _without_blocks(db)  # is now in memory
    erase(db.place, "B2")
    with pytest.raises(InputError, match="model of B2"):
        before.compute(scheduler="synchronous")
    for file in _blocks(db):
        assert "B2".encode("utf-32-le") not in file.read_bytes()
    assert db.verify() == []


def _age(file):
    os.utime(file, (0, 0))


def test_clean__removes_the_blocks_of_a_month_ago(db):
    want = _values(db)
    blocks = _blocks(db)
    assert db.garbage() == []
    _age(blocks[0])
    foreign = blocks[0].with_name("notes.txt")
    foreign.write_text("x")
    _age(foreign)
    assert [item.key for item in db.clean()] == [f"gathered/{blocks[0].name}"]
    foreign.unlink()
    assert _blocks(db) == blocks[1:]
    gathered._opened.cache_clear()
    xr.testing.assert_identical(_values(db), want)
    assert _blocks(db) == blocks


def test_blocks__an_added_take_changes_one_block(db, monkeypatch):
    monkeypatch.setitem(REGIONS, "B30", "a")  # between B3 and B4, in their block
    _values(db)
    first = {*_blocks(db)}
    _commit(db, "B30", 9.0)
    _values(db)
    assert len({*_blocks(db)} - first) == 1


@pytest.mark.slow
def test_blocks__in_a_bucket(new_database, monkeypatch):
    db = _database(new_database("localbucket"), monkeypatch)
    want = _without_blocks(db)
    assert db.place.children("gathered") == []
    for _ in range(2):
        xr.testing.assert_identical(_values(db), want)
        assert len(db.place.children("gathered")) == 3
    erase(db.place, "B5")
    assert len(db.place.children("gathered")) == 2
    xr.testing.assert_identical(_values(db)["region_area"], want["region_area"][:-1])
    assert db.verify() == []
