"""Steps with explicit vectors, and the equivalent plain loops, compared with NumPy in
double precision.
"""

from __future__ import annotations

import os
import subprocess
import sys

import numba as nb
import numpy as np
import pytest

from skindb import jit
from skindb.jit import LANES

ROUNDING = 1e-6  # error of sums in single precision relative to their largest terms
WAYS = ("vector", "plain")


def _compiled(way):
    blend, products, dots, half = (
        getattr(jit, f"{way}_{name}") for name in ("blend", "products", "dots", "half")
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


@pytest.fixture(scope="module", params=WAYS)
def calls(request):
    return _compiled(request.param)


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


PRINT_FIT = """
from planted_skin import make_skin
from skindb.fit import fit_surface
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.schema import dataset
skin = make_skin(surfels=5, lights=40, cameras=6)
planted = {"shading_normal": skin.normal, "diffuse_reflectance": skin.diffuse}
lumitexels = skin.lumitexels.merge(dataset(planted))
surface = Mixture.of_dictionary(embedded_dictionary(), rank=8)
found = fit_surface(lumitexels, surface=surface)
for name in ("dictionary_residual", "dictionary_residual_perceptual"):
    print(*found[name].values.ravel())
"""


@pytest.mark.slow
def test_fit__the_same_without_intrinsics(tmp_path):
    """Rationale: processors without these vector instructions use the plain loops."""
    found = []
    for setting in "01":
        more = {"SKINDB_INTRINSICS": setting, "PYTHONPATH": "tests"}
        if setting == "0":
            more["NUMBA_CACHE_DIR"] = str(tmp_path)
        call = [sys.executable, "-c", PRINT_FIT]
        done = subprocess.run(
            call, env=os.environ | more, capture_output=True, text=True, check=True
        )
        found.append(np.array(done.stdout.split(), float))
    # sums have another order, so that iterations end at other values within their tolerance
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3, atol=1e-6)
