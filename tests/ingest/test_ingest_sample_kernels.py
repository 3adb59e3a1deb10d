from __future__ import annotations

import numpy as np

from skindb.calibration._merge_kernels import DARK, OK, SATURATED
from skindb.geometry.atlas import bilinear
from skindb.ingest._sample_kernels import (
    NONE,
    MergedView,
    PointLight,
    gather,
    pixel_counts,
    pixel_spans,
    view_levels,
)

LIGHT = np.array([10.0, -20.0, 300.0])
AXIS = np.array([0.0, 0.1, -1.0]) / np.hypot(1, 0.1)
INTENSITY = (2e5, 1e5, 3e4)


def sampled(
    radiance,
    flag,
    pixels,
    *,
    falloff=0.0,
    wanted=None,
    far=None,
):
    """Samples of points near the origin, as floats, and the outcome of them."""
    n = len(pixels)
    position = np.zeros((n, 3)) if far is None else far
    out = np.zeros((3, n), np.uint16)
    outcome = np.zeros(n, np.uint8)
    gather(
        MergedView(np.asarray(radiance, np.float32), flag),
        np.ones(n, bool) if wanted is None else wanted,
        np.asarray(pixels, np.float32),
        position,
        np.tile([0.0, 0, 1], (n, 1)),
        PointLight(LIGHT, AXIS, falloff, np.array(INTENSITY)),
        out,
        outcome,
    )
    return out.view(np.float16).T, outcome


def factor(position=(0.0, 0.0, 0.0)):
    return ((np.asarray(position) - LIGHT) ** 2).sum(-1)[..., None] / INTENSITY


def test_gather__bilinear_as_the_texture_lookup():
    rng = np.random.default_rng(1)
    image = rng.random((12, 17, 3))
    flag = np.zeros((12, 17), np.uint8)
    flag[4:7, 5:8], flag[9:12, 11:15] = SATURATED, DARK
    pixels = rng.uniform(-1, 18, (4000, 2)).astype(np.float32)
    pixels[:40] = np.round(pixels[:40]) + 0.5  # neighbours of weight 0
    pixels[0] = np.nan
    lost = np.where(
        (flag == SATURATED)[..., None],
        np.nan,
        np.concatenate([image, (flag == DARK)[..., None]], -1),
    )
    want = bilinear(lost.astype(np.float32), pixels)
    got, outcome = sampled(image, flag, pixels)
    known = outcome == OK
    assert known.sum() > 1000
    # float32 pixels, one rounding to a half float of 11 bits, and sums of another order at a tie
    np.testing.assert_allclose(
        got[known], (want[:, :3] * factor())[known], rtol=2**-11 * 1.01, atol=1e-6
    )
    assert np.isnan(got[~known]).all()
    outside = ~((pixels >= 0) & (pixels <= (17, 12))).all(1)
    np.testing.assert_array_equal(outcome == NONE, outside)
    np.testing.assert_array_equal(outcome == SATURATED, np.isnan(want[:, 3]) & ~outside)
    np.testing.assert_array_equal(outcome == DARK, want[:, 3] > 0.999)


def test_gather__a_constant_stays():
    rng = np.random.default_rng(3)
    image = np.full((90, 90, 3), 0.37, np.float32)
    flag = np.zeros((90, 90), np.uint8)
    pixels = rng.uniform(40, 50, (200, 2))
    far = rng.uniform(-100, 100, (200, 3))
    got, _ = sampled(image, flag, pixels, far=far)
    np.testing.assert_array_equal(
        got, (image[0, 0].astype(np.float64) * factor(far)).astype(np.float16)
    )


def test_gather__falloff_and_what_is_not_wanted():
    image = np.ones((8, 8, 3))
    flag = np.zeros((8, 8), np.uint8)
    n = 5
    # the third is behind the light
    far = np.array([[0, 0, 0], [40, 5, 3], [0, 0, 400], [1, 1, 1], [2, 2, 2.0]])
    wanted = np.array([True, True, True, True, False])
    got, outcome = sampled(
        image,
        flag,
        np.full((n, 2), 4.0),
        falloff=3.0,
        wanted=wanted,
        far=far,
    )
    assert outcome.tolist() == [OK, OK, NONE, OK, NONE]
    way = far - LIGHT
    cosine = way @ AXIS / np.linalg.norm(way, axis=1)
    want = factor(far) / cosine[:, None] ** 3
    np.testing.assert_allclose(got[:2], want[:2], rtol=2**-11 * 1.01)


def test_gather__half_floats_end():
    image = np.array([[[1e9, 1.0, np.nan]]])
    got, outcome = sampled(image, np.zeros((1, 1), np.uint8), [[0.5, 0.5]])
    assert outcome.tolist() == [OK]
    assert np.isnan(got[0, [0, 2]]).all()
    assert np.isfinite(got[0, 1])


def test_touched__are_the_spans_of_the_pixels_that_gather_takes():
    """Twin: every pixel of the picture is spoiled in turn, and the samples that notice
    are counted.
    """
    rng = np.random.default_rng(4)
    image = rng.random((14, 19, 3))
    flag = np.zeros((14, 19), np.uint8)
    pixels = rng.uniform([-2, -2], [21, 16], (60, 2)).astype(np.float32)
    pixels[0], pixels[1] = np.nan, (19, 14)
    wanted = rng.random(60) < 0.2
    spans = pixel_spans(wanted, pixels, 14, 19)
    _, whole = sampled(image, flag, pixels, wanted=wanted)
    taken = np.zeros(flag.shape, bool)
    for pixel in np.ndindex(flag.shape):
        spoiled = flag.copy()
        spoiled[pixel] = SATURATED
        taken[pixel] = (
            sampled(image, spoiled, pixels, wanted=wanted)[1] != whole
        ).any()
    inside = (np.arange(19) >= spans[:, :1]) & (np.arange(19) < spans[:, 1:])
    assert taken.any()
    assert not (taken & ~inside).any()
    # neighbours of weight 0 are inside as well: little more than what is taken
    between = (
        np.maximum.accumulate(taken, axis=1)
        & np.maximum.accumulate(taken[:, ::-1], axis=1)[:, ::-1]
    )
    assert inside.sum() <= between.sum() + 3 * wanted.sum()


def test_pixel_counts__inverse_of_the_squared_weights_of_every_pixel():
    """The weights are what `gather` answers to a picture with a single lit pixel."""
    rng = np.random.default_rng(12)
    height = 9
    width = 11
    pixels = np.concatenate(
        [rng.uniform(0, (width, height), (30, 2)), [[0.2, 0.1], [5.5, 4.5], [-1, 3]]]
    )
    pixels = pixels.astype(np.float32)
    wanted = np.arange(len(pixels)) != 4
    square = np.zeros(len(pixels))
    for v, u in np.ndindex(height, width):
        image = np.zeros((height, width, 3))
        image[v, u] = 1
        got, outcome = sampled(
            image, np.zeros((height, width), np.uint8), pixels, wanted=wanted
        )
        square += np.where(outcome == OK, got[:, 0] / factor()[0], np.nan) ** 2
    found = np.empty(len(pixels), np.float32)
    pixel_counts(wanted, pixels, height, width, found)
    assert np.isfinite(found).sum() > 15
    np.testing.assert_allclose(found, 1 / square, rtol=2e-3)  # half floats


def test_view_levels__as_numpy():
    rng = np.random.default_rng(3)
    for count in (1, 2, 7, 8):
        samples = rng.normal(1, 3, (3, 20)).astype(np.float16)
        outcome = np.full(20, NONE, np.uint8)
        outcome[:count] = OK
        usable = samples[:, :count].astype(float)
        levels = view_levels(samples.view(np.uint16), outcome, 2.0)
        bright = (usable > 2).any(axis=0).mean()
        assert levels == (count, (usable > 0).any(), np.median(usable), bright)
    samples[:] = np.nan
    assert view_levels(samples.view(np.uint16), outcome, 2.0) == (8, True, np.inf, 1)
    samples[:] = -1
    samples[:, :2] = -0.0
    assert view_levels(samples.view(np.uint16), outcome, 2.0) == (8, False, -1, 0)
