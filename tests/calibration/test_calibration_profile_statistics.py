"""Isotropy of the tissue, and repeatability of placements."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from skindb.calibration.profile_statistics import (
    compare_azimuths,
    level_trend,
    placement_variance,
)
from skindb.errors import InputError

DISTANCE = 1 + 0.5 * np.arange(28)
AZIMUTH = 2 * np.pi * np.arange(16) / 16


def profiles(rng, *, stretch=0.0, direction=0.7, noise=0.01, tilt=0.0):
    """Profiles whose decay varies by `stretch` along two opposite azimuths; contact
    differs by 10 %.
    """
    decay = 0.9 * (
        1 - stretch * np.cos(2 * (AZIMUTH - direction)) + tilt * np.cos(AZIMUTH)
    )
    value = np.exp(-decay[:, None] * DISTANCE) / DISTANCE**2
    value = value[..., None] * np.exp(0.1 * rng.standard_normal((16, 1, 3)))
    return value * (1 + noise * rng.standard_normal(value.shape)), noise * value


def test_compare_azimuths__of_isotropic_tissue_has_even_p_values():
    p = [
        compare_azimuths(*profiles(np.random.default_rng(s)), DISTANCE, AZIMUTH).p_value
        for s in range(100)
    ]
    # 300 draws; refused once in 1000 by chance
    assert stats.kstest(np.ravel(p), "uniform").pvalue > 0.001


def test_compare_azimuths__finds_the_direction_and_strength_of_anisotropy():
    z = []
    for seed in range(30):
        found = compare_azimuths(
            *profiles(np.random.default_rng(seed), stretch=0.05), DISTANCE, AZIMUTH
        )
        assert (found.p_value < 1e-6).all()
        np.testing.assert_allclose(found.direction, 0.7, atol=0.05)
        z.append((found.anisotropy - 1.05 / 0.95) / found.anisotropy_error)
    # 90 z-scores: their deviation is known to 7 %, their mean to 0.1
    assert abs(np.std(z) - 1) < 0.3
    assert abs(np.mean(z)) < 0.5


def test_compare_azimuths__tells_a_tilted_probe_from_anisotropy():
    found = compare_azimuths(
        *profiles(np.random.default_rng(5), tilt=0.05), DISTANCE, AZIMUTH
    )
    np.testing.assert_allclose(found.shift, 0.045, atol=0.003)
    assert (found.amplitude < 0.003).all()


def test_compare_azimuths__refuses_what_tells_nothing():
    value, error = profiles(np.random.default_rng(6))
    with pytest.raises(InputError, match="6 azimuths or more"):
        compare_azimuths(value[:4], error[:4], DISTANCE, AZIMUTH[:4])
    for bad in (np.zeros_like(value), np.full_like(value, np.nan)):
        with pytest.raises(InputError, match="times their error at 3 distances"):
            compare_azimuths(bad, error, DISTANCE, AZIMUTH)


PLACEMENT_DISTANCE = 1 + 0.5 * np.arange(28)


def placements(rng, count, *, level=0.05, shape=0.02, noise=0.01):
    value = np.exp(-PLACEMENT_DISTANCE)[None, :, None] * np.ones((count, 1, 3))
    value = value * np.exp(
        level * rng.standard_normal((count, 1, 3))
        + shape * rng.standard_normal((count, 28, 3))
    )
    return value * (1 + noise * rng.standard_normal(value.shape)), noise * value


def test_placement_variance__separates_level_shape_and_measurement():
    found = [
        placement_variance(*placements(np.random.default_rng(s), 8)) for s in range(60)
    ]
    level = np.sqrt(np.mean([f.level**2 for f in found]))
    shape = np.sqrt(np.mean([f.shape**2 for f in found]))
    # 180 variances of 7 degrees of freedom: 4 % of the deviation 3 sigma 8.5 %
    assert level == pytest.approx(0.05, rel=0.12)
    assert shape == pytest.approx(0.02, rel=0.05)


def test_placement_variance__does_not_take_scatter_of_fibres_for_contact():
    found = [
        placement_variance(
            *placements(np.random.default_rng(s), 8, level=0.01, shape=0.05)
        )
        for s in range(60)
    ]
    # the scatter of 28 fibres alone would make 0.0138 of it; variances below zero count
    # as zero, which adds 4 %
    assert np.sqrt(np.mean([f.level**2 for f in found])) == pytest.approx(0.01, rel=0.2)


def test_placement_variance__of_equal_placements_is_zero():
    value = np.exp(-PLACEMENT_DISTANCE)[None, :, None] * np.ones((4, 1, 3))
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
