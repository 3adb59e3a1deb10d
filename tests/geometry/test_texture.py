"""Texture maps compared with loops over texels, SciPy's interpolation, and exact cases."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.spatial import Delaunay

from skindb.geometry.atlas import atlas_values, bilinear, push_pull, rasterise_atlas

FLOAT32 = 1e-6


def triangulation(n: int = 60, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    uv = np.random.default_rng(seed).uniform(0.02, 0.98, (n, 2))
    return uv, Delaunay(uv).simplices.astype(np.int64)


def test_rasterise_atlas__agrees_with_a_point_location():
    uv, f = triangulation()
    face, weight = rasterise_atlas(uv, f, 64)
    j, i = np.meshgrid(np.arange(64), np.arange(64))
    centres = np.stack([(j + 0.5) / 64, (i + 0.5) / 64], axis=-1)
    np.testing.assert_array_equal(face, Delaunay(uv).find_simplex(centres))
    covered = face >= 0
    found = np.einsum("nk,nkc->nc", weight[covered], uv[f[face[covered]]])
    np.testing.assert_allclose(found, centres[covered], atol=FLOAT32)
    np.testing.assert_array_equal(weight[~covered], 0)


def test_rasterise_atlas__leaves_no_crack_on_edges_through_texel_centres():
    n = 17  # corners at texel centres: every edge runs through centres
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    uv = np.stack([(2 * j.ravel() + 0.5) / 34, (2 * i.ravel() + 0.5) / 34], axis=1)
    a = (i * n + j)[:-1, :-1].ravel()
    f = np.concatenate(
        [np.stack([a, a + 1, a + n + 1], 1), np.stack([a, a + n + 1, a + n], 1)]
    )
    face, weight = rasterise_atlas(uv, f, 34)
    assert (face[:33, :33] >= 0).all()
    assert (face[33] == -1).all()
    np.testing.assert_allclose(weight[face >= 0].sum(axis=1), 1, atol=FLOAT32)


def test_rasterise_atlas__lowest_triangle_wins():
    uv, f = triangulation()
    face, _ = rasterise_atlas(uv, np.concatenate([f, f[:, ::-1]]), 40)
    np.testing.assert_array_equal(face, rasterise_atlas(uv, f, 40)[0])


def test_rasterise_atlas__flat_and_outside_triangles_cover_nothing():
    uv = np.array([[0.1, 0.1], [0.9, 0.9], [0.5, 0.5], [1.5, 1.5], [2, 1.5], [2, 2]])
    face, _ = rasterise_atlas(uv, np.array([[0, 1, 2], [3, 4, 5]]), 32)
    assert (face == -1).all()


def linear(at: np.ndarray) -> np.ndarray:
    """Values (..., 2) of a linear field."""
    return np.stack([4 + at[..., 0] - 3 * at[..., 1], 1 + 5 * at[..., 1]], axis=-1)


def centres(size: int) -> np.ndarray:
    return np.stack(np.meshgrid(*2 * [(np.arange(size) + 0.5) / size]), axis=-1)


def test_atlas_values__between_the_corners_of_large_triangles():
    uv, f = triangulation(20)
    trust = np.random.default_rng(1).random(20)
    trust[:6] = 0
    values = linear(uv)
    values[:6] = np.nan
    raster = face, weight = rasterise_atlas(uv, f, 48)
    image, confidence = atlas_values(values, trust, f, raster)
    for i, j in np.ndindex(48, 48):
        share = weight[i, j] * trust[f[face[i, j]]] if face[i, j] >= 0 else np.zeros(3)
        expected = (
            share @ np.nan_to_num(values[f[face[i, j]]]) / share.sum()
            if share.any()
            else np.zeros(2)
        )
        np.testing.assert_allclose(image[i, j], expected, rtol=FLOAT32)
        np.testing.assert_allclose(confidence[i, j], share.sum(), rtol=FLOAT32)


def test_atlas_values__linear_fields_are_exact():
    uv, f = triangulation(9000)
    uv = np.concatenate([uv, [[0, 0], [0, 1], [1, 0], [1, 1]]])
    f = Delaunay(uv).simplices
    image, confidence = atlas_values(
        linear(uv), np.ones(len(uv)), f, rasterise_atlas(uv, f, 32)
    )
    np.testing.assert_allclose(image, linear(centres(32)), rtol=FLOAT32)
    np.testing.assert_allclose(confidence, 1, rtol=FLOAT32)


@pytest.mark.parametrize("shape", [(8, 8), (7, 5), (1, 1), (1, 9), (16, 3)])
def test_push_pull__keeps_what_is_known_and_fills_the_rest(shape):
    rng = np.random.default_rng(0)
    image = rng.uniform(1, 2, (*shape, 3))
    known = rng.random(shape) < 0.3
    known.flat[0] = True
    image[~known] = np.nan
    image = image.astype(np.float32)
    filled = push_pull(image, np.ones(shape))
    np.testing.assert_array_equal(filled[known], image[known])
    assert filled.min() >= np.nanmin(image)
    assert filled.max() <= np.nanmax(image)


@settings(max_examples=30)
@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 1000))
def test_push_pull__constant_stays_constant(height, width, seed):
    rng = np.random.default_rng(seed)
    confidence = rng.random((height, width)) * (rng.random((height, width)) < 0.2)
    confidence[0, -1] = 0.5
    filled = push_pull(np.full((height, width, 1), 0.7), confidence)
    np.testing.assert_array_equal(filled, np.float32(0.7))


def enlarged(coarse: np.ndarray, y: int, x: int) -> np.ndarray:
    """Value of a coarse level at the fine texel (y, x): linear between centres, the
    nearest beyond the last.
    """
    where = [
        np.clip((p + 0.5) / 2 - 0.5, 0, n - 1)
        for p, n in zip((y, x), coarse.shape, strict=False)
    ]
    low = [int(p) for p in where]
    high = [min(p + 1, n - 1) for p, n in zip(low, coarse.shape, strict=False)]
    t, s = (p - q for p, q in zip(where, low, strict=True))
    rows = [
        (1 - s) * coarse[r, low[1]] + s * coarse[r, high[1]] for r in (low[0], high[0])
    ]
    return (1 - t) * rows[0] + t * rows[1]


def pushed_and_pulled(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The published algorithm, texel by texel in double precision."""
    h, w = known.shape
    if h == w == 1:
        return image
    coarse = np.zeros(((h + 1) // 2, (w + 1) // 2, image.shape[2]))
    total = np.zeros(((h + 1) // 2, (w + 1) // 2))
    for y, x in np.ndindex(h, w):
        coarse[y // 2, x // 2] += known[y, x] * image[y, x]
        total[y // 2, x // 2] += known[y, x]
    coarse /= np.where(total > 0, total, 1)[..., None]
    below = pushed_and_pulled(coarse, np.minimum(total, 1))
    filled = np.empty_like(image)
    for y, x in np.ndindex(h, w):
        filled[y, x] = known[y, x] * image[y, x] + (1 - known[y, x]) * enlarged(
            below, y, x
        )
    return filled


@pytest.mark.parametrize("shape", [(16, 16), (21, 13), (1, 6), (9, 1)])
def test_push_pull__agrees_with_loops_over_texels(shape):
    rng = np.random.default_rng(0)
    image = rng.normal(size=(*shape, 3))
    known = rng.random(shape) * (rng.random(shape) < 0.2)
    known[0, 0] = 0.3
    np.testing.assert_allclose(
        push_pull(image, known), pushed_and_pulled(image, known), atol=FLOAT32
    )


def test_push_pull__at_the_border_of_the_face_only_the_face_counts():
    y, x = np.mgrid[:64, :64] - 31.5
    face = np.hypot(x, y) < 25
    ramp = np.where(face, x, 1e6)[..., None]  # values outside must not matter
    filled = push_pull(ramp, face)
    np.testing.assert_array_equal(filled[face], ramp[face])
    beside = ~face & (np.hypot(x, y) < 27)
    # the first ring outside, read by bilinear lookups at the rim, is an average of
    # texels at most 4 away
    assert np.abs(filled[beside, 0] - x[beside]).max() < 4
    assert np.abs(filled).max() <= np.abs(x[face]).max()


def test_push_pull__fills_a_gap_in_a_ramp_smoothly():
    ramp = np.broadcast_to(np.arange(64.0)[:, None, None], (64, 64, 1)).copy()
    hole = ramp.copy()
    hole[20:44, 20:44] = np.nan
    filled = push_pull(hole, np.ones((64, 64)))
    # across 24 unknown texels the fill may lag the ramp, not by more than a quarter of the gap
    assert np.abs(filled - ramp).max() < 6
    assert np.abs(np.diff(filled[..., 0], axis=0)).max() < 4


def test_push_pull__ignores_what_has_no_confidence():
    image = np.full((9, 9, 2), 3.0)
    image[4, 4] = 1e6
    confidence = np.ones((9, 9))
    for nothing in (0.0, np.nan):
        confidence[4, 4] = nothing
        np.testing.assert_array_equal(push_pull(image, confidence), 3.0)


def test_push_pull__nothing_known():
    assert np.isnan(push_pull(np.ones((4, 5, 1)), np.zeros((4, 5)))).all()


def test_maps__take_little_more_memory_than_their_values():
    uv, f = triangulation(3000)
    values = np.ones((len(uv), 10), np.float32)
    push_pull(np.ones((2, 2, 1)), np.ones((2, 2)))
    atlas_values(values, np.ones(len(uv)), f, rasterise_atlas(uv, f, 8))
    tracemalloc.start()
    push_pull(*atlas_values(values, np.ones(len(uv)), f, rasterise_atlas(uv, f, 512)))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # image, filled image, coarser levels (1/3), which values are finite (1/4), raster
    # (4 of 10) and small change
    assert peak < 3.2 * 512**2 * 10 * 4


def test_bilinear__agrees_with_scipy():
    rng = np.random.default_rng(0)
    image = rng.normal(size=(20, 30, 3)).astype(np.float32)
    pixels = rng.uniform(0, 1, (4, 50, 2)) * [30, 20]
    where = [pixels[..., 1] - 0.5, pixels[..., 0] - 0.5]
    expected = np.stack(
        [
            map_coordinates(image[..., c].astype(float), where, order=1, mode="nearest")
            for c in range(3)
        ],
        -1,
    )
    np.testing.assert_allclose(bilinear(image, pixels), expected, atol=FLOAT32)


def test_bilinear__pixel_centres_are_exact():
    image = np.random.default_rng(0).normal(size=(5, 7, 2))
    j, i = np.meshgrid(np.arange(7), np.arange(5))
    np.testing.assert_array_equal(
        bilinear(image, np.stack([j + 0.5, i + 0.5], axis=-1)), image
    )


def test_bilinear__nan_spreads_to_its_neighbours_only():
    image = np.ones((5, 5, 1))
    image[2, 2] = np.nan
    pixels = np.array(
        [[2.5, 2.5], [2.9, 1.6], [1.5, 2.5], [3.5, 3.5], [1.4, 2.5], [1.6, 2.5]]
    )
    assert np.isnan(bilinear(image, pixels)[:, 0]).tolist() == [
        True,
        True,
        False,
        False,
        False,
        True,
    ]


def test_bilinear__nan_outside_the_image():
    pixels = np.array([[0, 0], [5, 4], [-0.01, 1], [1, 4.01], [np.nan, 1], [5.01, 1]])
    found = bilinear(np.ones((4, 5, 1)), pixels)[:, 0]
    assert np.isnan(found).tolist() == [False, False, True, True, True, True]
