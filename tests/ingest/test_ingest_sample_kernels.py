from __future__ import annotations

import numpy as np
import pytest
from scipy.special import jv

from skindb.calibration._merge_kernels import DARK, OK, SATURATED
from skindb.geometry.atlas import bilinear
from skindb.ingest._sample_kernels import (
    NONE,
    SINGLE,
    MergedView,
    PointLight,
    gather,
    pixel_counts,
    pixel_spans,
    tally,
    view_levels,
)

LIGHT = np.array([10.0, -20.0, 300.0])
AXIS = np.array([0.0, 0.1, -1.0]) / np.hypot(1, 0.1)
INTENSITY = (2e5, 1e5, 3e4)


def sampled(
    radiance,
    flag,
    pixels,
    spread=None,
    *,
    share=None,
    falloff=0.0,
    wanted=None,
    far=None,
    usable=None,
):
    """Samples of points near the origin, as floats, and the outcome of them."""
    n = len(pixels)
    position = np.zeros((n, 3)) if far is None else far
    out = np.zeros((3, n), np.uint16)
    outcome = np.zeros(n, np.uint8)
    gather(
        MergedView(
            np.asarray(radiance, np.float32),
            flag,
            np.full_like(flag, 2) if usable is None else usable,
        ),
        np.ones(n, bool) if wanted is None else wanted,
        np.zeros(0, np.float32) if share is None else share,
        np.asarray(pixels, np.float32),
        np.zeros((0, 3), np.float32)
        if spread is None
        else np.asarray(spread, np.float32),
        position,
        np.tile([0.0, 0, 1], (n, 1)),
        PointLight(LIGHT, AXIS, falloff, np.array(INTENSITY)),
        out,
        outcome,
    )
    return out.view(np.float16).T, outcome


def factor(position=(0.0, 0.0, 0.0)):
    return ((np.asarray(position) - LIGHT) ** 2).sum(-1)[..., None] / INTENSITY


def ellipse(radius, ratio, angle):
    """Variances xx, xy, yy of an ellipse with standard deviations radius and radius * ratio."""
    c = np.cos(angle)
    s = np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    v = turn @ np.diag([radius**2, (radius * ratio) ** 2]) @ turn.T
    return v[0, 0], v[0, 1], v[1, 1]


def twin(image, pixel, spread):
    """The footprint by NumPy over every pixel of the picture."""
    h, w, _ = image.shape
    offset = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1) - pixel
    conic = np.linalg.inv(np.array([[spread[0], spread[1]], [spread[1], spread[2]]]))
    weight = (
        np.maximum(1 - np.einsum("hwi,ij,hwj->hw", offset, conic, offset) / 8, 0) ** 2
    )
    return (weight[..., None] * image).sum((0, 1)) / weight.sum()


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


@pytest.mark.parametrize("radius", [0.45, 0.7, 2.0, 5.0])
def test_gather__footprint_as_the_twin(radius):
    rng = np.random.default_rng(2)
    image = rng.random((64, 70, 3))
    flag = np.zeros((64, 70), np.uint8)
    pixels = rng.uniform(26, 38, (50, 2)).astype(np.float32)
    spread = np.array(
        [ellipse(radius, rng.uniform(0.6, 1), a) for a in rng.uniform(0, 3, 50)],
        np.float32,
    )
    got, outcome = sampled(image, flag, pixels, spread)
    assert (outcome == OK).all()
    want = np.array(
        [
            twin(image, p.astype(np.float64), s)
            for p, s in zip(pixels, spread, strict=True)
        ]
    )
    np.testing.assert_allclose(got, want * factor(), rtol=2**-11 * 1.01)


@pytest.mark.parametrize("radius", [1.0, 3.0, 20.0])
def test_gather__footprint_of_a_sinusoid(radius):
    """Closed form: the mean of cos over (1 - (r / R)^2)^2 is 48 J3(kR) / (kR)^3, with
    R^2 = 8 radius^2.

    The transform of (1 - r^2)^p on the unit disc is 2^p p! J_{p+1}(k) / k^{p+1}; over
    its value at k = 0, for p = 2.
    """
    size = int(8 * radius) + 12
    k = 1.3 / radius
    centre = np.array([size / 2 + 0.2, size / 2 - 0.3])
    column = np.arange(size) + 0.5
    wave = np.broadcast_to(
        (2 + np.cos(k * (column - centre[0])))[None, :, None], (size, size, 3)
    )
    got, _ = sampled(
        wave,
        np.zeros((size, size), np.uint8),
        centre[None],
        [[radius**2, 0, radius**2]],
    )
    want = 2 + 48 * jv(3, np.sqrt(8) * 1.3) / (np.sqrt(8) * 1.3) ** 3
    # the grid of pixels
    assert got[0, 0] / factor()[0] == pytest.approx(
        want, rel=2e-3 if radius < 2 else 1e-3
    )
    # and near that of the Gaussian it stands for
    assert np.exp(-(1.3**2) / 2) == pytest.approx(want - 2, abs=0.06)


def test_gather__a_constant_stays():
    rng = np.random.default_rng(3)
    image = np.full((90, 90, 3), 0.37, np.float32)
    flag = np.zeros((90, 90), np.uint8)
    pixels = rng.uniform(40, 50, (200, 2))
    spread = np.array(
        [ellipse(r, rng.uniform(0.1, 1), r) for r in rng.uniform(0.5, 8, 200)]
    )
    spread[:, [0, 2]] += 0.2
    far = rng.uniform(-100, 100, (200, 3))
    assert np.isfinite(spread).all()
    for one in (None, spread, np.where(pixels[:, :1] > 45, spread, np.nan)):
        got, _ = sampled(image, flag, pixels, one, far=far)
        np.testing.assert_array_equal(
            got, (image[0, 0].astype(np.float64) * factor(far)).astype(np.float16)
        )


def test_gather__flags_in_the_footprint():
    image = np.ones((30, 30, 3))
    flag = np.zeros((30, 30), np.uint8)
    pixels = [[15.5, 15.5]] * 2
    spread = [[0.2, 0, 0.2], [4.0, 0, 4.0]]
    flag[15, 20] = SATURATED  # five pixels off: inside 2 sqrt 8 only
    got, outcome = sampled(image, flag, pixels, spread)
    assert outcome.tolist() == [OK, SATURATED]
    assert np.isnan(got[1]).all()
    flag[:] = DARK
    flag[15, 20] = OK
    assert sampled(image, flag, pixels, spread)[1].tolist() == [DARK, OK]
    # half of it outside
    assert sampled(image, flag, [[3.0, 15.0]], [[4.0, 0, 4.0]])[1].tolist() == [NONE]


def test_gather__light_share_falloff_and_what_is_not_wanted():
    image = np.ones((8, 8, 3))
    flag = np.zeros((8, 8), np.uint8)
    n = 5
    # the third is behind the light
    far = np.array([[0, 0, 0], [40, 5, 3], [0, 0, 400], [1, 1, 1], [2, 2, 2.0]])
    share = np.array([0.5, 1, 1, 0, 1], np.float32)
    wanted = np.array([True, True, True, True, False])
    got, outcome = sampled(
        image,
        flag,
        np.full((n, 2), 4.0),
        share=share,
        falloff=3.0,
        wanted=wanted,
        far=far,
    )
    assert outcome.tolist() == [OK, OK, NONE, NONE, NONE]
    way = far - LIGHT
    cosine = way @ AXIS / np.linalg.norm(way, axis=1)
    want = factor(far) / cosine[:, None] ** 3 / share[:, None].clip(0.1)
    np.testing.assert_allclose(got[:2], want[:2], rtol=2**-11 * 1.01)


def test_gather__half_floats_end():
    image = np.array([[[1e9, 1.0, np.nan]]])
    got, outcome = sampled(image, np.zeros((1, 1), np.uint8), [[0.5, 0.5]])
    assert outcome.tolist() == [OK]
    assert np.isnan(got[0, [0, 2]]).all()
    assert np.isfinite(got[0, 1])


@pytest.mark.parametrize("wide", [False, True])
def test_touched__are_the_spans_of_the_pixels_that_gather_takes(wide):
    """Twin: every pixel of the picture is spoiled in turn, and the samples that notice
    are counted.
    """
    rng = np.random.default_rng(4)
    image = rng.random((14, 19, 3))
    flag = np.zeros((14, 19), np.uint8)
    pixels = rng.uniform([-2, -2], [21, 16], (60, 2)).astype(np.float32)
    pixels[0], pixels[1] = np.nan, (19, 14)
    spread = (
        np.array(
            [ellipse(r, 0.6, a) for r, a in rng.uniform((0.3, 0), (1.2, 3), (60, 2))]
        )
        if wide
        else None
    )
    if wide:
        spread[20:25] = np.nan
    wanted = rng.random(60) < 0.2
    rows = (
        np.zeros((0, 3), np.float32)
        if spread is None
        else np.asarray(spread, np.float32)
    )
    spans = pixel_spans(wanted, pixels, rows, 14, 19)
    _, whole = sampled(image, flag, pixels, spread, wanted=wanted)
    taken = np.zeros(flag.shape, bool)
    for pixel in np.ndindex(flag.shape):
        spoiled = flag.copy()
        spoiled[pixel] = SATURATED
        taken[pixel] = (
            sampled(image, spoiled, pixels, spread, wanted=wanted)[1] != whole
        ).any()
    inside = (np.arange(19) >= spans[:, :1]) & (np.arange(19) < spans[:, 1:])
    assert taken.any()
    assert not (taken & ~inside).any()
    # corners of an ellipse's box, and neighbours of weight 0, are inside as well:
    # little more than what is taken
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
    spread = np.array(
        [ellipse(r, 0.8, r) for r in rng.uniform(0.4, 0.9, len(pixels))], np.float32
    )
    spread[::3] = np.nan
    wanted = np.arange(len(pixels)) != 4
    for one in (np.zeros((0, 3), np.float32), spread):
        square = np.zeros(len(pixels))
        for v, u in np.ndindex(height, width):
            image = np.zeros((height, width, 3))
            image[v, u] = 1
            got, outcome = sampled(
                image, np.zeros((height, width), np.uint8), pixels, one, wanted=wanted
            )
            square += np.where(outcome == OK, got[:, 0] / factor()[0], np.nan) ** 2
        found = np.empty(len(pixels), np.float32)
        pixel_counts(wanted, pixels, one, height, width, found)
        assert np.isfinite(found).sum() > 15
        np.testing.assert_allclose(found, 1 / square, rtol=2e-3)  # half floats


def test_gather__samples_of_a_single_exposure():
    """Single where no pixel that takes part has two exposures; one of weight 0 takes no part."""
    image = np.ones((6, 8, 3))
    flag = np.zeros((6, 8), np.uint8)
    usable = np.ones((6, 8), np.uint8)
    usable[:, 4:] = 2
    pixels = [[2.0, 3.0], [4.0, 3.0], [3.5, 3.0], [5.0, 3.0]]
    got, outcome = sampled(image, flag, pixels, usable=usable)
    assert outcome.tolist() == [SINGLE, OK, SINGLE, OK]
    assert np.isfinite(got).all()
    counts = np.zeros((4, 4), np.int32)
    assert tally(outcome, counts) == 4
    assert counts.tolist() == [[1] * 4, [0] * 4, [0] * 4, [1, 0, 1, 0]]


def test_view_levels__as_numpy():
    rng = np.random.default_rng(3)
    for count in (1, 2, 7, 8):
        samples = rng.normal(1, 3, (3, 20)).astype(np.float16)
        outcome = np.full(20, NONE, np.uint8)
        outcome[:count] = [OK, SINGLE] * (count // 2) + [OK] * (count % 2)
        usable = samples[:, :count].astype(float)
        levels = view_levels(samples.view(np.uint16), outcome, 2.0)
        bright = (usable > 2).any(axis=0).mean()
        assert levels == (count, (usable > 0).any(), np.median(usable), bright)
    samples[:] = np.nan
    assert view_levels(samples.view(np.uint16), outcome, 2.0) == (8, True, np.inf, 1)
    samples[:] = -1
    samples[:, :2] = -0.0
    assert view_levels(samples.view(np.uint16), outcome, 2.0) == (8, False, -1, 0)
