"""Rows of the linear system compared with table lookups."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.optics.angles import half_difference
from skindb.reflectance import _row_kernels
from skindb.reflectance.dictionary import convolve_disc, embedded_dictionary
from skindb.reflectance.reduction import reduce_dictionary
from skindb.reflectance.rows import basis_rows
from skindb.reflectance.tables import DEFAULT_GRID, TableGrid, lookup

# places in the table to 1e-7 of 30 cells, times the slope of random numbers
SINGLE = 3e-5
ARCTAN = 6e-11  # largest error of the polynomial


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _upper(rng, shape):
    return _unit(rng.normal(size=(*shape, 3)) * [1, 1, 0.3] + [0, 0, 0.9])


def _scene(n=20, lights=9, cameras=5):
    rng = np.random.default_rng(4)
    around = _unit(rng.normal(size=(n, 3)) * 0.4 + [0, 0, 1])
    return (
        around,
        _upper(rng, (n, lights)),
        _upper(rng, (n, cameras)),
        rng.random((n, lights, cameras)) < 0.6,
    )


def test_basis_rows__reproduce_lookup_times_cosine():
    n, light, camera, usable = _scene()
    grid = TableGrid(30, 20, 9)  # random numbers: no symmetry hides a turned phi_d
    table = np.random.default_rng(8).uniform(0.1, 1, (30, 20, 9, 7)).astype(np.float32)
    rows, offsets, index = basis_rows(table, grid, n, light, camera, usable)
    s = np.repeat(np.arange(20), np.diff(offsets))
    wi = light[s, index[:, 0]]
    wo = camera[s, index[:, 1]]
    want = lookup(table, *half_difference(wi, wo, n[s])) * (n[s] * wi).sum(1)[:, None]
    np.testing.assert_allclose(rows, want, rtol=SINGLE)
    assert rows.dtype == np.float32


def test_basis_rows__exactly_the_usable_samples_above_the_horizon_in_order():
    n, light, camera, usable = _scene()
    light[3, 2], n[7], camera[5, 1] = np.nan, np.nan, np.inf
    usable[11] = False
    _, offsets, index = basis_rows(
        embedded_dictionary().table[..., :1], DEFAULT_GRID, n, light, camera, usable
    )
    want = [
        (s, i, o)
        for s in range(20)
        for i in range(9)
        for o in range(5)
        if usable[s, i, o]
        and n[s] @ light[s, i] > 0
        and np.isfinite(camera[s, o]).all()
        and n[s] @ camera[s, o] > 0
    ]
    s = np.repeat(np.arange(20), np.diff(offsets))
    assert np.column_stack([s, index]).tolist() == [list(w) for w in want]


def test_basis_rows__reciprocal():
    """If light and camera are exchanged, the BRDF is the same and the cosine differs."""
    n, light, camera, _ = _scene(50, 1, 1)
    table = embedded_dictionary().table
    every = np.ones((50, 1, 1), bool)
    there, offsets, _ = basis_rows(table, DEFAULT_GRID, n, light, camera, every)
    back, _, _ = basis_rows(table, DEFAULT_GRID, n, camera, light, every)
    s = np.repeat(np.arange(50), np.diff(offsets))
    cos_i, cos_o = ((n[s] * d[s, 0]).sum(1)[:, None] for d in (light, camera))
    assert len(s) > 40
    np.testing.assert_allclose(there / cos_i, back / cos_o, rtol=1e-5)


def _row(table, wi, wo):
    up = np.array([[0.0, 0, 1]])
    usable = np.ones((1, 1, 1), bool)
    grid = TableGrid(*table.shape[:3])
    return basis_rows(table, grid, up, wi[None, None], wo[None, None], usable)[0]


def test_basis_rows__overhead_mirrored_and_grazing_directions():
    rng = np.random.default_rng(8)
    table = rng.uniform(0.1, 1, (24, 20, 8, 2)).astype(np.float32)
    table[0] = 1.0  # where the half vector is the normal
    up = np.array([0.0, 0, 1])
    # light, camera and normal coincide, so phi_d is undefined
    np.testing.assert_allclose(_row(table, up, up), [[1.0, 1.0]], rtol=1e-6)
    mirrored = _row(table, np.array([0.6, 0, 0.8]), np.array([-0.6, 0, 0.8]))
    np.testing.assert_allclose(mirrored, [[0.8, 0.8]], rtol=SINGLE)
    for height in (1e-8, 1e-4, 0.02):
        wi = np.array([np.sqrt(1 - height**2), 0, height])
        wo = np.array([0.6, 0.0, 0.8])
        expected = lookup(table, *half_difference(wi, wo)) * height
        np.testing.assert_allclose(_row(table, wi, wo)[0], expected, rtol=1e-4)


@pytest.mark.parametrize("n", [0, 3])
def test_basis_rows__nothing_usable(n):
    table = embedded_dictionary().table[..., :4]
    shapes = np.zeros((n, 3)), np.zeros((n, 6, 3)), np.zeros((n, 2, 3))
    rows, offsets, index = basis_rows(
        table, DEFAULT_GRID, *shapes, np.ones((n, 6, 2), bool)
    )
    assert rows.shape == (0, 4)
    assert offsets.tolist() == [0] * (n + 1)
    assert index.shape == (0, 2)


def test_basis_rows__any_memory_order_and_precision():
    n, light, camera, usable = _scene()
    table = embedded_dictionary().table[..., :4]
    want = basis_rows(table, DEFAULT_GRID, n, light, camera, usable)
    got = basis_rows(
        np.asfortranarray(table),
        DEFAULT_GRID,
        np.asfortranarray(n),
        light,
        camera[:, :, ::1],
        usable,
    )
    for a, b in zip(got, want, strict=True):
        np.testing.assert_array_equal(a, b)


def test_basis_rows__grid_must_match():
    with pytest.raises(ValueError, match="must have the shape of the grid"):
        basis_rows(
            np.zeros((3, 3, 3, 1), np.float32),
            DEFAULT_GRID,
            *np.zeros((3, 1, 1, 3)),
            np.zeros((1, 1, 1), bool),
        )


def test_fill_rows__releases_the_interpreter_lock():
    assert _row_kernels.fill_rows.targetoptions["nogil"]


def test_fill_rows__a_broken_direction_reads_no_wild_address():
    """The public function excludes such samples, and the kernel itself forms no row for them."""
    table = np.ones((4, 5, 6, 2), np.float32)
    rows = np.zeros((4, 2), np.float32)
    normal = np.array([[0.0, 0, 1]])
    light = np.array([[[np.nan, 0, 1], [np.inf, 0, 1]]])
    every = np.ones((1, 2, 2), bool)
    index = np.zeros((4, 2), np.int32)
    _row_kernels.fill_rows(
        table, normal, light, light, every, np.array([0, 4]), rows, index
    )
    assert (rows == 0).all()


def test_arctangent__as_numpy():
    rng = np.random.default_rng(5)
    y = rng.uniform(0, 1, 2000) ** 4
    x = rng.uniform(-1, 1, 2000) ** 3
    y[:4], x[:4] = [0, 0, 0, 1], [0, 1, -1, 0]
    got = [_row_kernels._arctangent(a, b) for a, b in zip(y, x, strict=True)]
    np.testing.assert_allclose(got, np.arctan2(y, x), atol=ARCTAN)


def test_reduce_dictionary__sixteen_dimensions_hold_every_material():
    """Relative rms over pairs of directions above 6 degrees, as a dome takes them; 0.6
    % and 1.8 % measured.
    """
    dictionary = convolve_disc(embedded_dictionary(), 0.0142)
    reduced, lift = reduce_dictionary(dictionary.table, 16)
    a = _unit(np.random.default_rng(6).normal(size=(2, 8000, 3)))
    a[..., 2] = np.abs(a[..., 2])
    wi, wo = a[:, (a[..., 2] > 0.1).all(0)]
    angles = half_difference(wi, wo)
    want = lookup(dictionary.table, *angles) * wi[:, 2:]
    error = lookup(reduced, *angles) * wi[:, 2:] @ lift - want
    relative = np.linalg.norm(error, axis=0) / np.linalg.norm(want, axis=0)
    assert np.median(relative) < 0.008
    assert relative.max() < 0.03


def test_reduce_dictionary__full_rank_and_dependent_tables():
    table = np.random.default_rng(0).uniform(size=(6, 5, 4, 3)).astype(np.float32)
    same, eye = reduce_dictionary(table, 3)
    assert same is table
    np.testing.assert_array_equal(eye, np.eye(3))
    twice = np.concatenate(
        [table[..., :2], 7 * table[..., :2], np.zeros((6, 5, 4, 1), np.float32)],
        axis=-1,
    )
    reduced, lift = reduce_dictionary(twice, 2)
    np.testing.assert_allclose(reduced @ lift, twice, atol=1e-5)


def test_table_grid__nodes():
    grid = TableGrid(5, 3, 4)
    np.testing.assert_allclose(
        np.sqrt(grid.theta_h / (np.pi / 2)), [0, 0.25, 0.5, 0.75, 1]
    )
    np.testing.assert_allclose(grid.theta_d, [0, np.pi / 4, np.pi / 2])
    np.testing.assert_allclose(grid.phi_d, [0, np.pi / 4, np.pi / 2, 3 * np.pi / 4])


def test_turn_rows__are_the_rows_of_the_other_normal():
    n, light, camera, usable = _scene()
    turned = _unit(n + 0.3 * np.random.default_rng(5).normal(size=n.shape))
    table = np.random.default_rng(8).uniform(0.1, 1, (30, 20, 9, 8)).astype(np.float32)
    memory = _row_kernels.row_memory(5)
    below = 0
    for s in range(len(n)):
        rows = np.empty((45, 8), np.float32)
        index = np.empty((45, 2), np.int32)
        count = _row_kernels.form_rows(
            table, n[s], light[s], camera[s], usable[s], memory, rows, index
        )
        _row_kernels.turn_rows(
            table, turned[s], light[s], camera[s], index, count, memory, rows
        )
        wi = light[s, index[:count, 0]]
        wo = camera[s, index[:count, 1]]
        up = (wi @ turned[s] > 0) & (wo @ turned[s] > 0)
        want = (
            lookup(
                table, *half_difference(wi, wo, np.broadcast_to(turned[s], wi.shape))
            )
            * (wi @ turned[s])[:, None]
        )
        np.testing.assert_allclose(
            rows[:count], np.where(up[:, None], want, 0), rtol=SINGLE
        )
        below += int((~up).sum())
    assert below > 10
