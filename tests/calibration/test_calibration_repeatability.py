from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from skindb.calibration.profile_statistics import level_trend, placement_variance
from skindb.errors import InputError

DISTANCE = 1 + 0.5 * np.arange(28)


def placements(rng, count, *, level=0.05, shape=0.02, noise=0.01):
    value = np.exp(-DISTANCE)[None, :, None] * np.ones((count, 1, 3))
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
