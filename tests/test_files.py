"""Files: tables as comma-separated values, and the cache on disk."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skindb.cache import MAX_ENTRIES, cached_arrays
from skindb.files import cache_folder, csv_text

FORMULAS = [
    "=1+1",
    "+1+cmd|' /C calc'!A0",
    "-1+1",
    "@SUM(A1)",
    "\t=1+1",
    "\r=1",
    "\n=1",
    "  =1+1",
    '=HYPERLINK("http://x")',
    "\uff1d1+1",
    "\uff0b1",
    "\uff0d1",
    "\uff20A1",
    "-",
    "+",
    "-0.5x",
    "--1",
    "-inf",
    "+1 555 0100",
    "-0,5",
]
SOURCES = ("skindb.cache",)


def read(text):
    return list(csv.reader(io.StringIO(text, newline="")))


def test_csv_text__quotes_formulas_in_cells_and_header():
    for text in FORMULAS:
        assert read(csv_text([text], [[text]])) == [[f"'{text}"]] * 2


def test_csv_text__leaves_numbers_and_plain_text():
    row = [
        "-0.5",
        "+3",
        "-1e-3",
        "-.5",
        "age:older",
        "a=b",
        "'x'",
        "S-1",
        'a, "b"\nc',
        "größe",
    ]
    assert read(csv_text(row, [row])) == [row, row]


def test_csv_text__numbers_have_all_digits_and_missing_ones_are_empty():
    row = [
        -1 / 3,
        np.float64(-2 / 3),
        np.float32(-1 / 3),
        -4,
        np.int64(-5),
        True,
        np.bool_(False),
        np.nan,
        None,
        "x",
    ]
    with np.printoptions(legacy="1.13"):  # as colour-science sets, with twelve digits
        written = read(csv_text([f"c{i}" for i in range(10)], [row]))[1]
    assert [float(cell) for cell in written[:5]] == row[:5]
    assert written[5:] == ["True", "False", "", "", "x"]
    found = pd.read_csv(
        io.StringIO(csv_text(["a", "b"], [[np.nan, -0.5], [None, "-0.5"]]))
    )
    assert found.a.isna().all()
    assert found.b.tolist() == [-0.5, -0.5]


@given(
    st.lists(
        st.lists(
            st.text(st.characters(exclude_categories=["Cs"])), min_size=3, max_size=3
        ),
        max_size=5,
    )
)
def test_csv_text__every_cell_is_safe_and_found_again(rows):
    for before, after in zip(
        rows, read(csv_text(["a", "b", "c"], rows))[1:], strict=True
    ):
        for text, cell in zip(before, after, strict=True):
            assert cell in (text, f"'{text}")
            starts = cell[:1] + cell.strip()[:1]
            assert not {*starts} & {*"=@"}
            assert not {*starts} & {*"+-"} or float(cell) is not None


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
