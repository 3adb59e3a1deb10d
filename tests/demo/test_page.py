"""report: one self-contained page, text escaped, pictures readable."""

from __future__ import annotations

import base64
import re

import imagecodecs
import numpy as np

from skindb.demo import page as report


def test_page__self_contained_and_escaped():
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3), dtype=np.uint8)
    parts = [
        report.row([report.picture(image, "a < b")]),
        report.table(["name", "x"], [["<i>", 0.123456], ["y", np.nan]]),
    ]
    text = report.page("T & T", "lead", [("First", parts)])
    assert "http" not in text
    assert "<i>" not in text
    assert "0.123<" in text
    assert ">-<" in text
    png = base64.b64decode(re.search(r"base64,([^\"]+)", text)[1])
    np.testing.assert_array_equal(imagecodecs.png_decode(png), image)
