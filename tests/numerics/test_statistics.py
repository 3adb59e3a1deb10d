"""Moments compared with NumPy and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from skindb.numerics.inference import effects
from skindb.numerics.statistics import (
    Moments,
    bootstrap_interval,
    detectable_difference,
)


@settings(max_examples=40)
@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=40))
def test_moments__are_those_of_numpy(values):
    x = np.array(values)
    whole = Moments.of(x)
    np.testing.assert_allclose(whole.mean, x.mean(), atol=1e-6)
    np.testing.assert_allclose(whole.variance, x.var(ddof=1), rtol=1e-6, atol=1e-4)
    assert whole.count == len(x)


def test_moments__intervals_are_scipys():
    x = np.random.default_rng(0).normal(size=17)
    moments = Moments.of(x)
    want = stats.t.interval(0.95, 16, x.mean(), stats.sem(x))
    np.testing.assert_allclose(moments.mean_interval(), want)


def test_moments__of_missing_values_and_of_no_values():
    x = np.array([[1.0, np.nan], [3.0, np.nan], [np.nan, 2.0]])
    moments = Moments.of(x)
    np.testing.assert_array_equal(moments.count, [2, 1])
    np.testing.assert_allclose(moments.mean, [2, 2])
    assert np.isnan(moments.variance[1])
    assert np.isnan(moments.mean_interval()[0][1])
    assert np.isnan(Moments.of(x[:0]).variance).all()


def test_bootstrap_interval__of_a_mean():
    x = np.random.default_rng(2).normal(3.0, 1.0, 400)
    low, high = bootstrap_interval(x, np.mean, rng=np.random.default_rng(0))
    want = stats.norm.interval(0.95, x.mean(), stats.sem(x))
    np.testing.assert_allclose([low, high], want, atol=0.02)
    with pytest.raises(ValueError, match="at least one row"):
        bootstrap_interval(x[:0], np.mean, rng=np.random.default_rng(0))


def test_detectable_difference__is_found_as_often_as_stated():
    n = 30
    trials = 2000
    rng = np.random.default_rng(11)
    group = np.arange(n) % 2.0
    error = np.sqrt(4 / n)  # of a difference of means at unit variance
    step = float(detectable_difference(error, n - 2))
    values = rng.normal(size=(n, trials)) + step * group[:, None]
    statistic = effects(values, group).statistic
    power = np.mean(np.abs(statistic) > stats.t.ppf(0.975, n - 2))
    # three standard errors of 2,000 trials, and the t approximation
    assert power == pytest.approx(0.8, abs=0.04)
