"""Tables as CSV: they are read back as they were, and no cell is a formula to a spreadsheet."""

from __future__ import annotations

import csv
import io

import numpy as np
import pandas as pd
from hypothesis import given
from hypothesis import strategies as st

from skindb.files import csv_text

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
