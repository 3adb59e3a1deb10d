"""Fibre spots, flat field, azimuths and repeated placements of a simulated probe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, stats

from skindb.errors import InputError
from skindb.ingest.fibre_spots import Spots, fibre_gain, find_fibres, match_fibres
from skindb.ingest.isotropy import compare_azimuths
from skindb.ingest.repeatability import level_trend, placement_variance

DISTANCE = 1 + 0.5 * np.arange(28)
AZIMUTH = 2 * np.pi * np.arange(16) / 16


def fibre_picture(rng, noise=0.005):
    """28 discs, drawn at 8 times the resolution, of differing brightness."""
    centre = np.array([[30 + 22.3 * (i % 7), 28 + 25.7 * (i // 7)] for i in range(28)]) + rng.uniform(-2, 2, (28, 2))
    radius, fine = rng.uniform(6.0, 7.0, 28), 8
    row, column = (np.mgrid[: 140 * fine, : 200 * fine] + 0.5) / fine
    picture = np.zeros(row.shape)
    for (x, y), r in zip(centre, radius, strict=True):
        picture[(column - x) ** 2 + (row - y) ** 2 < r * r] = rng.uniform(0.6, 1.0)
    small = ndimage.gaussian_filter(picture.reshape(140, fine, 200, fine).mean(axis=(1, 3)), 0.5)
    order = np.lexsort(centre.T[::-1])
    return small + noise * rng.standard_normal(small.shape), Spots(centre[order], radius[order])


def test_find_fibres__finds_centres_and_radii():
    picture, truth = fibre_picture(np.random.default_rng(1))
    found = find_fibres(picture, count=28)
    compared = match_fibres(found, truth)
    # noise of 0.5 % over 130 px: 0.01 px of the centre and 0.05 % of the area; the middle's percentile adds 0.5 %
    assert np.abs(compared.offset).max() < 0.05
    assert np.abs(compared.radius_ratio - 1).max() < 0.01


@pytest.mark.parametrize(
    ("picture", "match"),
    [
        (np.zeros((50, 50)), "28 separate spots; found 0"),
        (np.ones((50, 50)), "28 separate spots; found 0"),
        (np.full((50, 50), np.nan), "must be finite"),
        (np.zeros((50, 50, 3)), "the shape"),
    ],
)
def test_find_fibres__refuses_a_picture_without_fibres(picture, match):
    with pytest.raises(InputError, match=match):
        find_fibres(picture, count=28)


def test_match_fibres__finds_each_in_any_order_and_refuses_shifts():
    _, truth = fibre_picture(np.random.default_rng(2))
    order = np.random.default_rng(3).permutation(28)
    found = match_fibres(Spots(truth.centre[order] + 0.5, truth.radius[order]), truth)
    np.testing.assert_allclose(found.offset, 0.5)
    assert (order[found.order] == np.arange(28)).all()
    with pytest.raises(InputError, match="within its radius"):
        match_fibres(replace(truth, centre=truth.centre + 8), truth)
    with pytest.raises(InputError, match="as many fibres"):
        match_fibres(Spots(truth.centre[:5], truth.radius[:5]), truth)


def test_fibre_gain__knows_its_error():
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.8, 1.2, (28, 3))
    truth /= truth.mean(axis=0)
    z = []
    for _ in range(40):
        level = rng.uniform(0.5, 2.0, (12, 1, 1))
        found = fibre_gain(level * truth * (1 + 0.004 * rng.standard_normal((12, 28, 3))))
        z.append((found.gain - truth) / found.error)
    # Student's t of 11 degrees of freedom has a deviation of 1.106; the means of 28 fibres take 2 % off
    assert abs(np.std(z) - 1.09) < 0.05
    for bad in (np.zeros((5, 28, 3)), np.full((5, 28, 3), np.nan), np.ones((1, 28, 3))):
        with pytest.raises(InputError, match="flat field of the fibres"):
            fibre_gain(bad)


def profiles(rng, *, stretch=0.0, direction=0.7, noise=0.01, tilt=0.0):
    """Profiles whose decay varies by `stretch` along two opposite azimuths; contact differs by 10 %."""
    decay = 0.9 * (1 - stretch * np.cos(2 * (AZIMUTH - direction)) + tilt * np.cos(AZIMUTH))
    value = np.exp(-decay[:, None] * DISTANCE) / DISTANCE**2
    value = value[..., None] * np.exp(0.1 * rng.standard_normal((16, 1, 3)))
    return value * (1 + noise * rng.standard_normal(value.shape)), noise * value


def test_compare_azimuths__of_isotropic_tissue_has_even_p_values():
    p = [compare_azimuths(*profiles(np.random.default_rng(s)), DISTANCE, AZIMUTH).p_value for s in range(100)]
    # 300 draws; refused once in 1000 by chance
    assert stats.kstest(np.ravel(p), "uniform").pvalue > 0.001


def test_compare_azimuths__finds_the_direction_and_strength_of_anisotropy():
    z = []
    for seed in range(30):
        found = compare_azimuths(*profiles(np.random.default_rng(seed), stretch=0.05), DISTANCE, AZIMUTH)
        assert (found.p_value < 1e-6).all()
        np.testing.assert_allclose(found.direction, 0.7, atol=0.05)
        z.append((found.anisotropy - 1.05 / 0.95) / found.anisotropy_error)
    assert abs(np.std(z) - 1) < 0.3  # 90 z-scores: their deviation is known to 7 %, their mean to 0.1
    assert abs(np.mean(z)) < 0.5


def test_compare_azimuths__tells_a_tilted_probe_from_anisotropy():
    found = compare_azimuths(*profiles(np.random.default_rng(5), tilt=0.05), DISTANCE, AZIMUTH)
    np.testing.assert_allclose(found.shift, 0.045, atol=0.003)
    assert (found.amplitude < 0.003).all()


def test_compare_azimuths__refuses_what_tells_nothing():
    value, error = profiles(np.random.default_rng(6))
    with pytest.raises(InputError, match="6 azimuths or more"):
        compare_azimuths(value[:4], error[:4], DISTANCE, AZIMUTH[:4])
    for bad in (np.zeros_like(value), np.full_like(value, np.nan)):
        with pytest.raises(InputError, match="times their error at 3 distances"):
            compare_azimuths(bad, error, DISTANCE, AZIMUTH)


def placements(rng, count, *, level=0.05, shape=0.02, noise=0.01):
    value = np.exp(-DISTANCE)[None, :, None] * np.ones((count, 1, 3))
    value = value * np.exp(level * rng.standard_normal((count, 1, 3)) + shape * rng.standard_normal((count, 28, 3)))
    return value * (1 + noise * rng.standard_normal(value.shape)), noise * value


def test_placement_variance__separates_level_shape_and_measurement():
    found = [placement_variance(*placements(np.random.default_rng(s), 8)) for s in range(60)]
    level = np.sqrt(np.mean([f.level**2 for f in found]))
    shape = np.sqrt(np.mean([f.shape**2 for f in found]))
    # 180 variances of 7 degrees of freedom: 4 % of the deviation 3 sigma 8.5 %
    assert level == pytest.approx(0.05, rel=0.12)
    assert shape == pytest.approx(0.02, rel=0.05)


def test_placement_variance__of_equal_placements_is_zero():
    value = np.exp(-DISTANCE)[None, :, None] * np.ones((4, 1, 3))
    found = placement_variance(value, 0.01 * value)
    np.testing.assert_allclose(found.level, 0, atol=1e-12)
    assert (found.shape == 0).all()
    np.testing.assert_allclose(found.mean, value[0], rtol=1e-12)


def test_placement_variance__refuses_what_tells_nothing():
    value, error = placements(np.random.default_rng(7), 5)
    with pytest.raises(InputError, match="3 or more placements"):
        placement_variance(value[:2], error[:2])
    with pytest.raises(InputError, match="at least two fibres"):
        placement_variance(np.full_like(value, np.nan), error)


def test_level_trend__agrees_with_scipy_and_flags_drift():
    rng = np.random.default_rng(8)
    hour = np.linspace(0, 2, 9)
    levels = 0.01 * rng.standard_normal((9, 3)) + hour[:, None] * [0.0, 0.0, 0.05]
    found = level_trend(levels, hour)
    oracle = [stats.linregress(hour, levels[:, c]) for c in range(3)]
    np.testing.assert_allclose(found.slope, [o.slope for o in oracle])
    np.testing.assert_allclose(found.error, [o.stderr for o in oracle])
    np.testing.assert_allclose(found.p_value, [o.pvalue for o in oracle])
    assert found.flag.tolist() == [False, False, True]
    with pytest.raises(InputError, match="that varies"):
        level_trend(levels, np.zeros(9))
    assert not level_trend(np.zeros((9, 3)), hour).flag.any()
