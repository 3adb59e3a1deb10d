from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from skindb.calibration.profile_statistics import compare_azimuths
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
