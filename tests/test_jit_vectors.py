"""Steps with explicit vectors compared with NumPy in double precision."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest

from skindb import jit
from skindb.jit import LANES

ROUNDING = 1e-6  # error of sums in single precision relative to their largest terms


@pytest.fixture(scope="module")
def calls():
    blend, products, dots, half = (
        getattr(jit, f"vector_{name}") for name in ("blend", "products", "dots", "half")
    )

    @nb.njit
    def call_blend(table, places, weights, rows, row):
        blend(
            table,
            (places[0], places[1], places[2]),
            (weights[0], weights[1], weights[2]),
            rows,
            row,
        )

    @nb.njit
    def call_products(rows, weight, given, left, right, begin, end, out):
        products(rows, weight, given, left, right, begin, end, out)

    @nb.njit
    def call_dots(rows, factors, count, out):
        dots(rows, factors, count, out)

    @nb.njit
    def call_half(bits, out):
        for i in range(len(bits)):
            out[i] = half(bits[i])

    return {
        "blend": call_blend,
        "products": call_products,
        "dots": call_dots,
        "half": call_half,
    }


@pytest.mark.parametrize("width", [LANES, 3 * LANES])
def test_blend__is_the_weighted_sum_and_touches_one_row(calls, width):
    rng = np.random.default_rng(width)
    table = rng.normal(size=(7, width)).astype(np.float32)
    weights = rng.normal(size=3).astype(np.float32)
    places = np.array([6, 0, 3])
    rows = np.full((4, width), 9, np.float32)
    calls["blend"](table, places * width, weights, rows, 2)
    np.testing.assert_allclose(rows[2], weights @ table[places], atol=ROUNDING * 10)
    assert (rows[[0, 1, 3]] == 9).all()


def test_products__of_a_range_of_rows_with_other_columns(calls):
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(80, 3 * LANES)).astype(np.float32)
    weight = rng.random(80).astype(np.float32)
    given = rng.normal(size=80).astype(np.float32)
    out = np.full((LANES + 1, LANES), 5, np.float32)
    for _ in range(2):  # the sums start at zero in every call
        calls["products"](rows, weight, given, 8, 16, 5, 69, out)
    part = rows[5:69].astype(float)
    w = weight[5:69]
    np.testing.assert_allclose(
        out[:LANES], (part[:, 8:16] * w[:, None]).T @ part[:, 16:], atol=64 * ROUNDING
    )
    np.testing.assert_allclose(
        out[LANES], given[5:69] @ part[:, 16:], atol=64 * ROUNDING
    )
    calls["products"](rows, weight, given, 0, 0, 7, 7, out)
    assert (out == 0).all()


def test_dots__of_the_first_rows_only(calls):
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(9, 2 * LANES)).astype(np.float32)
    factors = rng.normal(size=2 * LANES).astype(np.float32)
    out = np.full(9, 7, np.float32)
    calls["dots"](rows, factors, 6, out)
    np.testing.assert_allclose(
        out[:6], rows[:6].astype(float) @ factors, atol=16 * ROUNDING
    )
    assert (out[6:] == 7).all()


def test_half__every_one(calls):
    bits = np.arange(1 << 16, dtype=np.uint16)
    out = np.empty(1 << 16, np.float32)
    calls["half"](bits, out)
    np.testing.assert_array_equal(out, bits.view(np.float16).astype(np.float32))
