"""Steps in vectors by hand against NumPy; single precision, sums of up to 64 terms."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest

from skindb._vectors import LANES, blend, dots, products

ROUNDING = 1e-6  # of sums of single floats relative to their largest terms


@nb.njit
def _blend(table, places, weights, rows, row):
    blend(table, (places[0], places[1], places[2]), (weights[0], weights[1], weights[2]), rows, row)


@nb.njit
def _products(rows, weight, given, left, right, begin, end, out):
    products(rows, weight, given, left, right, begin, end, out)


@nb.njit
def _dots(rows, factors, count, out):
    dots(rows, factors, count, out)


@pytest.mark.parametrize("width", [LANES, 3 * LANES])
def test_blend__is_the_weighted_sum_and_touches_one_row(width):
    rng = np.random.default_rng(width)
    table, weights = rng.normal(size=(7, width)).astype(np.float32), rng.normal(size=3).astype(np.float32)
    places, rows = np.array([6, 0, 3]), np.full((4, width), 9, np.float32)
    _blend(table, places, weights, rows, 2)
    np.testing.assert_allclose(rows[2], weights @ table[places], atol=ROUNDING * 10)
    assert (rows[[0, 1, 3]] == 9).all()


def test_products__of_a_range_of_rows_with_other_columns():
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(80, 3 * LANES)).astype(np.float32)
    weight, given = rng.random(80).astype(np.float32), rng.normal(size=80).astype(np.float32)
    out = np.full((LANES + 1, LANES), 5, np.float32)
    for _ in range(2):  # the sums begin at zero every time
        _products(rows, weight, given, 8, 16, 5, 69, out)
    part, w = rows[5:69].astype(float), weight[5:69]
    np.testing.assert_allclose(out[:LANES], (part[:, 8:16] * w[:, None]).T @ part[:, 16:], atol=64 * ROUNDING)
    np.testing.assert_allclose(out[LANES], given[5:69] @ part[:, 16:], atol=64 * ROUNDING)
    _products(rows, weight, given, 0, 0, 7, 7, out)
    assert (out == 0).all()


def test_dots__of_the_first_rows_only():
    rng = np.random.default_rng(2)
    rows, factors = rng.normal(size=(9, 2 * LANES)).astype(np.float32), rng.normal(size=2 * LANES).astype(np.float32)
    out = np.full(9, 7, np.float32)
    _dots(rows, factors, 6, out)
    np.testing.assert_allclose(out[:6], rows[:6].astype(float) @ factors, atol=16 * ROUNDING)
    assert (out[6:] == 7).all()
