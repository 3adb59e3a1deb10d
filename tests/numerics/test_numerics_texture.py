"""Distributions of pyramids within regions, and images that get them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage.exposure import match_histograms

from skindb.numerics.texture import (
    QUANTILES,
    build,
    image_parts,
    level_fractions,
    members,
    part_members,
    part_names,
    part_quantiles,
    quantile_function,
    quantile_levels,
    reconstruct,
    synthesise,
    valid_quantiles,
)

SMALL = {"levels": 3, "orientations": 4}


def quantiles_of(image, mask=None, **options):
    parts = image_parts(image, **(options or SMALL))
    mask = np.ones(image.shape) if mask is None else mask
    return part_quantiles(parts, part_members(mask, parts))


def noise(shape=(64, 64), scale=1.0, seed=0):
    return scale * np.random.default_rng(seed).standard_normal(shape)


def test_part_names__one_for_every_part():
    image = noise((128, 128))
    assert len(part_names()) == len(image_parts(image)) == 31
    np.testing.assert_array_equal(
        image_parts(image)[2 + 4 * 1 + 2], build(image)[1 + 4 * 1 + 2]
    )
    assert part_names()[2 + 4 * 1 + 2] == "level 2, 90 degrees"


@pytest.mark.parametrize("n", [1, 2, 255, 256, 10_000])
def test_quantile_function__is_numpys(n):
    values = noise((n,))
    np.testing.assert_allclose(
        quantile_function(values),
        np.quantile(values, quantile_levels(), method="hazen"),
        atol=1e-12,
    )


def test_part_members__are_those_of_the_fractions():
    parts = image_parts(noise((63, 50)), **SMALL)
    mask = noise((63, 50), seed=1) > 0
    fractions = level_fractions(mask, [part.shape for part in parts])
    for part, index, fraction in zip(
        parts, part_members(mask, parts), fractions, strict=True
    ):
        np.testing.assert_array_equal(part.take(index), part[members(fraction)])


@pytest.mark.parametrize("shape", [(64, 64), (63, 50), (17, 128)])
def test_level_shares__keep_the_area_of_a_region(shape):
    mask = np.zeros(shape)
    mask[shape[0] // 4 : shape[0] // 2, shape[1] // 4 :] = 1
    shapes = [part.shape for part in image_parts(noise(shape), **SMALL)]
    shares = level_fractions(mask, shapes)
    assert [share.shape for share in shares] == shapes
    # an entry of the coarsest level is 1/8 of the shorter side here
    for share in shares:
        assert share.mean() == pytest.approx(mask.mean(), abs=0.1)
    np.testing.assert_array_equal(shares[0], mask)


def test_part_quantiles__of_a_region_alone():
    """Values that are outside of the region and far from it change nothing within."""
    image = noise((128, 128))
    mask = np.zeros((128, 128))
    mask[:, :48] = 1
    other = image.copy()
    other[:, 90:100] += 5
    same = level_fractions(mask, [part.shape for part in image_parts(image, levels=2)])
    for a, b, share in zip(
        image_parts(image, 2), image_parts(other, 2), same, strict=True
    ):
        # at this distance, the ripples of the bands are below 2 % of the step
        np.testing.assert_allclose(
            quantile_function(a[share > 0.5]),
            quantile_function(b[share > 0.5]),
            atol=0.1,
        )


def test_valid_quantiles__nearest_monotone_function_of_the_same_mean():
    row = np.sort(noise((QUANTILES,))) + 0.3 * noise((QUANTILES,), seed=1)
    found = valid_quantiles(np.stack([row, np.sort(row), np.full(QUANTILES, np.nan)]))
    assert (np.diff(found[0]) >= 0).all()
    assert found[0].mean() == pytest.approx(row.mean(), abs=1e-12)
    np.testing.assert_array_equal(found[1], np.sort(row))
    assert np.isnan(found[2]).all()


def test_synthesise__no_shift_returns_the_image():
    image = noise()
    found = synthesise(
        image,
        [np.ones(image.shape)],
        np.zeros((1, 15, QUANTILES)),
        rng=np.random.default_rng(0),
        **SMALL,
    )
    np.testing.assert_array_equal(found.image, image)
    assert found.trace == (0.0,)


def test_synthesise__gray_values_alone_are_those_of_scikit_image():
    """Without a pyramid, one iteration is the matching of histograms."""
    image = noise((200, 200))
    wanted = np.exp(0.5 * noise((200, 200), seed=3))
    shift = np.zeros((1, 3, QUANTILES))
    shift[0] = quantiles_of(wanted, levels=0, orientations=1) - quantiles_of(
        image, levels=0, orientations=1
    )
    found = synthesise(
        image,
        [np.ones(image.shape)],
        shift,
        iterations=1,
        levels=0,
        orientations=1,
        rng=Still(),
    )
    inside = slice(2, -2)  # the quantile functions end half a level before the ends
    np.testing.assert_allclose(
        quantile_function(found.image)[inside],
        quantile_function(match_histograms(image, wanted))[inside],
        atol=0.02,
    )


class Still:
    """Random numbers that are all 0: no noise."""

    def standard_normal(self, shape):
        return np.zeros(shape)


def test_synthesise__a_texture_takes_the_distributions_of_another():
    """White noise gets the spectrum of blurred noise: Heeger and Bergen's own example."""
    rng = np.random.default_rng(0)
    wanted = gaussian_filter(rng.standard_normal((128, 128)), (1, 4), mode="wrap")
    image = rng.standard_normal((128, 128)) * wanted.std()
    shift = (quantiles_of(wanted) - quantiles_of(image))[None]
    found = synthesise(image, [np.ones(image.shape)], shift, rng=rng, **SMALL)
    left = np.abs(quantiles_of(found.image) - quantiles_of(wanted)).mean(axis=1)
    before = np.abs(shift[0]).mean(axis=1)
    assert (left < 0.2 * before + 0.02 * wanted.std()).all()
    assert found.trace[-1] < 0.1 * found.trace[0]


def test_synthesise__regions_move_apart():
    image = noise((96, 96))
    left = np.zeros((96, 96))
    left[:, :48] = 1
    shift = np.zeros((2, 15, QUANTILES))
    shift[0, 0] = shift[0, -1] = 3.0
    found = synthesise(
        image,
        [left, 1 - left],
        shift,
        iterations=3,
        rng=np.random.default_rng(0),
        **SMALL,
    )
    step = found.image - image
    assert step[:, 8:40].mean() == pytest.approx(3.0, abs=0.3)
    assert np.abs(step[:, 56:88].mean()) < 0.3


@pytest.mark.parametrize(
    "case", ["constant", "one texel", "no texel", "odd", "oblong", "huge"]
)
def test_synthesise__extremes_stay_finite(case):
    shape = {"odd": (33, 47), "oblong": (16, 200)}.get(case, (64, 64))
    image = np.zeros(shape) if case == "constant" else noise(shape)
    mask = np.ones(shape)
    if case in ("one texel", "no texel"):
        mask = np.zeros(shape)
        mask[5, 5] = case == "one texel"
    shift = (1e3 if case == "huge" else 1.0) * noise((1, 15, QUANTILES), seed=5)
    found = synthesise(
        image,
        [np.ones(shape)],
        shift,
        measured=[mask],
        iterations=2,
        rng=np.random.default_rng(0),
        **SMALL,
    )
    assert np.isfinite(found.image).all()
    assert found.image.shape == shape


def test_synthesise__seeded():
    image = np.zeros((32, 32))
    shift = noise((1, 15, QUANTILES))
    options = {"regions": [np.ones((32, 32))], "shifts": np.sort(shift), **SMALL}
    one, same, other = (
        synthesise(image, rng=np.random.default_rng(s), **options).image
        for s in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.01


def test_members__more_than_half_of_the_most():
    np.testing.assert_array_equal(
        members(np.array([0.0, 0.4, 0.6, 1.0])), [False, False, True, True]
    )
    # a region of few texels
    np.testing.assert_array_equal(
        members(np.array([0.0, 0.1, 0.2])), [False, False, True]
    )
    assert not members(np.zeros(3)).any()


SIZES = [(64, 64), (65, 64), (37, 101), (1, 9), (2, 2), (3, 200), (128, 50), (255, 257)]


@pytest.mark.parametrize("shape", SIZES)
def test_build__reconstructs_any_size(shape):
    for orientations in [1, 2, 3, 4, 6]:
        image = np.random.default_rng(shape).normal(size=shape) + 3
        for levels in {0, 1, max(shape).bit_length() - 1}:
            parts = build(image, levels, orientations)
            assert len(parts) == 2 + levels * orientations
            np.testing.assert_allclose(
                reconstruct(parts, orientations),
                image,
                atol=1e-12 * np.ptp(image) + 1e-14,
            )
            single = build(image.astype(np.float32), levels, orientations)
            assert {part.dtype for part in single} == {np.dtype(np.float32)}
            np.testing.assert_allclose(
                reconstruct(single, orientations),
                image,
                atol=1e-6 * np.abs(image).max(),
            )


@pytest.mark.parametrize("shape", [(64, 64), (37, 101)])
def test_build__is_a_tight_frame(shape):
    """Energy is kept: each part counts by the number of entries of the image over its own."""
    image = np.random.default_rng(0).normal(size=shape)
    parts = build(image, 4)
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
            energy = np.array([(band**2).mean() for band in build(wave, 5)[1:-1]])
            energy = energy.reshape(5, 4)
            assert np.unravel_index(energy.argmax(), energy.shape) == (level, number)


def test_build__is_that_of_pyrtools():
    pyrtools = pytest.importorskip("pyrtools")
    image = np.random.default_rng(1).normal(size=(128, 128)).cumsum(axis=0)
    own = build(image, 4)
    other = pyrtools.pyramids.SteerablePyramidFreq(image, height=4, order=3)
    pairs = [
        (own[0], other.pyr_coeffs["residual_highpass"]),
        (own[-1], other.pyr_coeffs["residual_lowpass"]),
    ]
    pairs += [
        (own[1 + 4 * k + q], other.pyr_coeffs[k, q]) for k in range(4) for q in range(4)
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
    *bands, low = build(np.full((40, 30), 7.0), 4)
    assert max(float(np.abs(part).max()) for part in bands) < 1e-14
    np.testing.assert_allclose(low, 7.0, rtol=1e-14)


# extreme inputs

SCALES = (1e-30, 1e-12, 1e12, 1e30)


def test_build__round_trip_of_any_scale():
    for scale in SCALES:
        image = scale * noise((64, 64))
        np.testing.assert_allclose(
            reconstruct(build(image, levels=4)), image, atol=1e-12 * scale
        )


def test_valid_quantiles__decreasing_ones_keep_their_mean_at_any_scale():
    for scale in SCALES:
        quantiles = scale * noise((3, QUANTILES))
        valid = valid_quantiles(quantiles)
        assert (np.diff(valid) >= 0).all()
        np.testing.assert_allclose(
            valid.mean(axis=1), quantiles.mean(axis=1), atol=1e-12 * scale
        )


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_synthesise__distributions_converge_at_any_scale(scale):
    image = noise((64, 64))
    shift = quantiles_of(gaussian_filter(image.T, 2)) - quantiles_of(image)
    synthesis = synthesise(
        scale * image,
        [np.ones((64, 64))],
        scale * shift[None],
        iterations=2,
        rng=np.random.default_rng(0),
        **SMALL,
    )
    assert np.isfinite(synthesis.image).all()
    assert synthesis.trace[-1] < synthesis.trace[0]


def test_synthesise__noise_makes_a_texture_where_there_is_none():
    synthesis = synthesise(
        np.zeros((64, 64)),
        [np.ones((64, 64))],
        np.sort(noise((1, 15, QUANTILES))),
        iterations=3,
        rng=np.random.default_rng(0),
        **SMALL,
    )
    assert np.isfinite(synthesis.image).all()
    assert synthesis.image.std() > 0.1
