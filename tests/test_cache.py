"""The cache of tables never returns tables of other arguments, of other code, or damaged ones."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from skindb.cache import MAX_ENTRIES, cache_folder, cached_arrays

SOURCES = ("skindb.files",)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("SKINDB_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Maker:
    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"table": np.arange(24.0).reshape(2, 3, 4), "error": np.array(0.5)}


def _get(make, argument=1):
    return cached_arrays("tables", (argument,), sources=SOURCES, make=make)


def test_cached_arrays__are_made_once(folder):
    make = Maker()
    first = _get(make)
    again = _get(make)
    assert make.calls == 1
    for found in (first, again):
        assert found["error"].shape == ()
        np.testing.assert_array_equal(found["table"], make()["table"])
        assert not found["table"].flags.writeable
    assert oct(folder.stat().st_mode)[-3:] == "700"


def test_cached_arrays__other_arguments_are_other_tables(folder):
    make = Maker()
    _get(make, 1)
    _get(make, 1.0000001)
    assert make.calls == 2


@pytest.mark.parametrize("file", ["table.npy", "error.npy", "sums.json"])
@pytest.mark.parametrize("damage", ["flipped", "cut", "removed"])
def test_cached_arrays__damaged_ones_are_made_again(folder, file, damage):
    make = Maker()
    _get(make)
    (path,) = folder.glob(f"*/{file}")
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.chmod(0o600)
    if damage == "removed":
        path.unlink()
    else:
        path.write_bytes(content if damage == "flipped" else content[:-5])
    np.testing.assert_array_equal(_get(make)["table"], make()["table"])
    assert make.calls >= 3
    calls = make.calls
    _get(make)
    assert make.calls == calls  # stored again


def test_cached_arrays__a_folder_that_cannot_be_written_is_no_error(
    tmp_path, monkeypatch
):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SKINDB_CACHE", str(tmp_path / "file" / "cache"))
    make = Maker()
    assert _get(make)["table"].shape == (2, 3, 4)


def test_cached_arrays__only_the_newest_entries_remain(folder):
    make = Maker()
    for i in range(MAX_ENTRIES + 3):
        _get(make, i)
        for age, place in enumerate(
            sorted(folder.glob("tables-*"), key=lambda p: p.stat().st_mtime)
        ):
            os.utime(place, (age, age))
    assert len(list(folder.glob("tables-*"))) == MAX_ENTRIES


def test_cache_folder__an_empty_setting_turns_it_off(monkeypatch):
    monkeypatch.setenv("SKINDB_CACHE", "")
    assert cache_folder() is None
    make = Maker()
    _get(make)
    _get(make)
    assert make.calls == 2
