"""The steerable pyramid: exact for every size, oriented as planted, and equal to that
of pyrtools.
"""

from __future__ import annotations

import numpy as np
import pytest

from skindb.numerics.pyramid import build, reconstruct

SIZES = [(64, 64), (65, 64), (37, 101), (1, 9), (2, 2), (3, 200), (128, 50), (255, 257)]


@pytest.mark.parametrize("shape", SIZES)
def test_build__reconstructs_any_size(shape):
    for orientations in [1, 2, 3, 4, 6]:
        image = np.random.default_rng(shape).normal(size=shape) + 3
        for levels in {0, 1, max(shape).bit_length() - 1}:
            pyramid = build(image, levels, orientations)
            assert len(pyramid.parts()) == 2 + levels * orientations
            np.testing.assert_allclose(
                reconstruct(pyramid), image, atol=1e-12 * np.ptp(image) + 1e-14
            )
            single = build(image.astype(np.float32), levels, orientations)
            assert {part.dtype for part in single.parts()} == {np.dtype(np.float32)}
            np.testing.assert_allclose(
                reconstruct(single), image, atol=1e-6 * np.abs(image).max()
            )


@pytest.mark.parametrize("shape", [(64, 64), (37, 101)])
def test_build__is_a_tight_frame(shape):
    """Energy is kept: each part counts by the number of entries of the image over its own."""
    image = np.random.default_rng(0).normal(size=shape)
    parts = build(image, 4).parts()
    energy = sum((part**2).mean() for part in parts)
    assert energy == pytest.approx((image**2).mean(), rel=1e-12)


def test_build__a_wave_is_in_the_band_of_its_scale_and_direction():
    for number in range(4):
        for level in range(3):
            rows, columns = np.mgrid[:256, :256]
            frequency = 0.25 / 2**level
            angle = np.pi * number / 4
            wave = np.cos(
                2 * np.pi * frequency * (columns * np.cos(angle) + rows * np.sin(angle))
            )
            energy = np.array(
                [[(band**2).mean() for band in own] for own in build(wave, 5).bands]
            )
            assert np.unravel_index(energy.argmax(), energy.shape) == (level, number)


def test_build__is_that_of_pyrtools():
    pyrtools = pytest.importorskip("pyrtools")
    image = np.random.default_rng(1).normal(size=(128, 128)).cumsum(axis=0)
    own = build(image, 4)
    other = pyrtools.pyramids.SteerablePyramidFreq(image, height=4, order=3)
    pairs = [
        (own.high, other.pyr_coeffs["residual_highpass"]),
        (own.low, other.pyr_coeffs["residual_lowpass"]),
    ]
    pairs += [
        (own.bands[k][q], other.pyr_coeffs[k, q]) for k in range(4) for q in range(4)
    ]
    # theirs grow with the level, and are looked up in tables
    for mine, theirs in pairs:
        scale = float((mine * theirs).sum() / (mine * mine).sum())
        np.testing.assert_allclose(
            theirs, scale * mine, atol=5e-3 * np.abs(theirs).max()
        )


@pytest.mark.parametrize(
    ("image", "levels", "orientations"),
    [
        (np.zeros((8, 8)), 4, 4),
        (np.zeros((8, 8)), 1, 0),
        (np.zeros((8, 8)), -1, 4),
        (np.zeros((8, 8, 3)), 1, 4),
        (np.zeros((0, 8)), 0, 4),
        (np.full((8, 8), np.nan), 1, 4),
    ],
)
def test_build__refuses_what_it_cannot_decompose(image, levels, orientations):
    with pytest.raises(ValueError, match=r"levels of|two dimensions"):
        build(image, levels, orientations)


def test_build__of_a_constant_has_only_a_low_pass_residual():
    pyramid = build(np.full((40, 30), 7.0), 4)
    assert max(float(np.abs(part).max()) for part in pyramid.parts()[:-1]) < 1e-14
    np.testing.assert_allclose(pyramid.low, 7.0, rtol=1e-14)


def test_with_parts__puts_images_back():
    pyramid = build(np.random.default_rng(3).normal(size=(33, 20)), 3)
    again = pyramid.with_parts(pyramid.parts())
    assert all(
        np.array_equal(a, b)
        for a, b in zip(again.parts(), pyramid.parts(), strict=True)
    )
