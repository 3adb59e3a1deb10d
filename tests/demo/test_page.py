"""page: one self-contained page, text escaped, pictures readable, tables that can be saved."""

from __future__ import annotations

import base64
import csv
import io
import re

import imagecodecs
import numpy as np

from skindb.demo import page

TABLE = page.Table("names", ["name", "x"], [["<i>", 0.123456], ['a, "b"', np.nan]])


def test_page__self_contained_and_escaped():
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    text = page.page(
        "T & T",
        "lead",
        [("First", [page.row([page.picture(image, "a < b")]), page.table(TABLE)])],
    )
    assert "http" not in text
    assert "<i>" not in text
    assert "0.123<" in text
    assert ">-<" in text
    assert 'alt="a &lt; b"' in text
    png = base64.b64decode(re.search(r"base64,([^\"]+)", text)[1])
    np.testing.assert_array_equal(imagecodecs.png_decode(png), image)


def test_downloads__hold_all_digits():
    link = page.downloads([TABLE])
    assert 'download="names.csv"' in link
    saved = base64.b64decode(re.search(r"base64,([^\"]+)", link)[1]).decode()
    header, *rows = csv.reader(io.StringIO(saved))
    assert header == TABLE.header
    assert [rows[0][0], float(rows[0][1])] == TABLE.rows[0]
    assert rows[1] == ['a, "b"', ""]  # missing


def test_table__columns_keep_their_values():
    one = page.Table("t", ["a", "b", "c"], [[1, 2, 3], [4, 5, 6]]).columns(["c", "a"])
    assert one.rows == [[3, 1], [6, 4]]
    assert one.renamed(["C", "A"]).header == ["C", "A"]


def test_cell__is_short_and_readable():
    values = (175952, np.int64(23), 0.012345, 1234.5, np.nan, "a", True)
    assert [page.cell(value) for value in values] == [
        "175,952",
        "23",
        "0.0123",
        "1,234",
        "-",
        "a",
        "True",
    ]
