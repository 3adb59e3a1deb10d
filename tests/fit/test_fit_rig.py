"""Common gains of the lights of takes, from numbers that are written down."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.fit.rig import common_light_gains


def common(gains):
    gains = np.array(gains, float)
    count = gains.shape[1]
    return common_light_gains(
        gains, lights=list("abcdefghijklm"[:count]), positions=np.eye(count, 3)
    )


def test_common_light_gains__are_medians_of_gains_relative_to_their_median():
    truth = np.array([0.9, 1.0, 1.0, 1.2])
    group = common([truth, 3 * truth, 0.5 * truth, [9, 1, 1, 1]])
    np.testing.assert_allclose(group["rig_light_gain"], truth)
    np.testing.assert_array_equal(group["rig_takes"], 4)


def test_common_light_gains__lights_of_two_takes_keep_1():
    nan = np.nan
    group = common(
        [[1.1, 1, 1, nan], [1.1, 1, 1, 2], [1.1, 1, 1, 2], [nan, nan, nan, nan]]
    )
    np.testing.assert_allclose(group["rig_light_gain"], [1.1, 1, 1, 1])
    np.testing.assert_array_equal(group["rig_takes"], [3, 3, 3, 2])
    unknown = np.isnan(group["rig_light_gain_error"].values)
    np.testing.assert_array_equal(unknown, [False, False, False, True])
    none = common([[1, 1, nan, nan], [nan, nan, 1, 1]])
    assert np.isnan(none["rig_spread"])
    np.testing.assert_array_equal(none["rig_light_gain"], 1)


def test_common_light_gains__errors_and_spreads_are_those_of_normal_values():
    rng = np.random.default_rng(0)
    z, left = [], []
    for _ in range(100):
        planted = rng.normal(0, 0.1, 13)
        group = common(np.exp(planted + rng.normal(0, 0.02, (7, 13))))
        off = np.log(group["rig_light_gain"].values) - planted
        z.append((off - off.mean()) / group["rig_light_gain_error"].values)
        left.append(float(group["rig_spread_left"]))
    # 1,300 values: 1.04 here; the larger of two deviations is used
    assert 0.85 < np.std(z) < 1.15
    # the median of 6 other takes
    assert np.mean(left) == pytest.approx(0.02 * np.sqrt(1 + 1.57 / 6), rel=0.15)


def test_common_light_gains__without_common_gains_the_others_make_it_worse():
    gains = np.exp(np.random.default_rng(1).normal(0, 0.05, (9, 4)))
    group = common(gains)
    assert group["rig_spread_left"] > group["rig_spread"]
