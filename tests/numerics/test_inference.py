"""Effects, permutation tests and variance components, compared with statsmodels and
SciPy, and on planted cohorts.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy import stats

from skindb.numerics import inference
from skindb.numerics.inference import (
    benjamini_hochberg,
    detectable_difference,
    effects,
    paired_effects,
    permutation_p,
    sign_flip_p,
    variance_components,
)


@pytest.fixture(scope="module")
def statsmodels():
    return pytest.importorskip("statsmodels.api")


def _cohort(seed, n=40, quantities=3, slope=0.0, confounded=0.0):
    rng = np.random.default_rng([17, seed])
    age = rng.normal(size=n)
    group = (rng.random(n) < 1 / (1 + np.exp(-3 * confounded * age))).astype(float)
    group[:2] = 0, 1
    values = (
        slope * group[:, None]
        + confounded * age[:, None]
        + rng.normal(size=(n, quantities))
    )
    return values, group, age[:, None], rng


def test_effects__are_those_of_statsmodels(statsmodels):
    values, group, age, _ = _cohort(1, slope=0.5, confounded=0.7)
    values *= 1 + 2 * group[:, None]  # unequal variances
    found = effects(values, group, age)
    for q in range(3):
        whole = statsmodels.OLS(
            values[:, q], np.column_stack([np.ones(40), group, age])
        ).fit()
        oracle = whole.get_robustcov_results("HC3", use_t=True)
        np.testing.assert_allclose(found.slope[q], oracle.params[1], rtol=1e-10)
        np.testing.assert_allclose(found.error[q], oracle.bse[1], rtol=1e-10)
        np.testing.assert_allclose(
            (found.low[q], found.high[q]), oracle.conf_int()[1], rtol=1e-9
        )
        np.testing.assert_allclose(found.statistic[q], oracle.tvalues[1], rtol=1e-10)
        np.testing.assert_allclose(found.spread[q] ** 2, whole.mse_resid, rtol=1e-10)
    assert (found.free == 37).all()


def test_permutation_p__of_all_orders_is_that_of_scipy():
    values, group, _, rng = _cohort(2, n=7, quantities=1, slope=2.0)
    p, adjusted, count = permutation_p(values, group, rng=rng)
    assert count == 5039
    x = values[group == 0, 0]
    y = values[group == 1, 0]

    def statistic(a, b, axis):
        squares = [
            ((g - g.mean(axis=axis, keepdims=True)) ** 2).sum(axis=axis)
            / (g.shape[axis] - 1) ** 2
            for g in (a, b)
        ]
        # HC3 of two groups
        return (a.mean(axis=axis) - b.mean(axis=axis)) / np.sqrt(sum(squares))

    oracle = stats.permutation_test(
        (x, y), statistic, n_resamples=np.inf, vectorized=True, alternative="two-sided"
    )
    # SciPy doubles the smaller tail; if every order counts once, both are fractions of all splits
    splits = len(oracle.null_distribution)
    expected = (
        np.abs(oracle.null_distribution) >= abs(oracle.statistic) * (1 - 1e-9)
    ).sum() / splits
    np.testing.assert_allclose(p, expected, rtol=1e-12)
    np.testing.assert_allclose(adjusted, p)


def test_sign_flip_p__of_all_signs_is_that_of_scipy():
    rng = np.random.default_rng(5)
    differences = rng.normal(0.6, 1, (9, 2))
    p, adjusted, count = sign_flip_p(differences, rng=rng)
    assert count == 511
    for q in range(2):
        t = lambda x, axis: stats.ttest_1samp(x, 0, axis=axis).statistic  # noqa: E731
        oracle = stats.permutation_test(
            (differences[:, q],),
            t,
            permutation_type="samples",
            n_resamples=np.inf,
            vectorized=True,
        )
        np.testing.assert_allclose(p[q], oracle.pvalue, rtol=1e-9)
    assert (adjusted >= p).all()


def test_benjamini_hochberg__is_that_of_scipy():
    p = np.random.default_rng(3).random(50) ** 3
    np.testing.assert_allclose(
        benjamini_hochberg(p), stats.false_discovery_control(p), rtol=1e-12
    )


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


@pytest.mark.parametrize("repeats", ["balanced", "unbalanced"])
@pytest.mark.parametrize("between", [0.0, 0.3, 2.0])
def test_variance_components__are_those_of_statsmodels(statsmodels, repeats, between):
    rng = np.random.default_rng([int(10 * between), len(repeats)])
    subject = np.repeat(
        np.arange(25), 3 if repeats == "balanced" else rng.integers(1, 5, 25)
    )
    values = (
        5
        + rng.normal(0, np.sqrt(between), 25)[subject]
        + rng.normal(0, 1, len(subject))
    )
    mean, people, repeat = variance_components(values, subject)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # for no variance between subjects
        oracle = statsmodels.MixedLM(values, np.ones(len(values)), subject).fit(
            reml=True
        )
    np.testing.assert_allclose(mean, oracle.fe_params[0], rtol=1e-4)
    np.testing.assert_allclose(repeat, oracle.scale, rtol=2e-3)
    np.testing.assert_allclose(people, float(oracle.cov_re[0, 0]), rtol=1e-2, atol=5e-3)


@pytest.mark.slow
def test_permutation_p__is_even_without_an_effect_and_not_misled_by_a_covariate():
    """200 cohorts in which age differs between the groups, and only age has an effect."""
    plain = []
    adjusted = []
    smallest = []
    covered = 0
    for seed in range(200):
        values, group, age, rng = _cohort(seed, confounded=0.8)
        plain.append(permutation_p(values, group, most=199, rng=rng)[0][0])
        p, family, _ = permutation_p(values, group, age, most=199, rng=rng)
        adjusted.append(p[0])
        smallest.append(family.min())
        found = effects(values, group, age)
        covered += int(((found.low <= 0) & (found.high >= 0)).sum())
    assert stats.kstest(adjusted, "uniform").pvalue > 0.01
    assert np.mean(np.array(plain) < 0.05) > 0.5  # misled
    assert np.mean(np.array(smallest) <= 0.05) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 200)
    # 95 % within 3.4 standard errors of 200 cohorts of three quantities
    assert 0.92 <= covered / 600 <= 0.98


def test_effects__an_effect_is_covered_as_often_as_stated():
    covered = 0
    for seed in range(400):
        values, group, age, _ = _cohort(
            seed, n=30, quantities=1, slope=1.0, confounded=0.5
        )
        found = effects(values, group, age)
        covered += int(found.low[0] <= 1.0 <= found.high[0])
    assert 0.92 <= covered / 400 <= 0.98


@pytest.mark.parametrize(
    ("values", "regressor", "covariates", "message"),
    [
        (np.ones((5, 1)), np.ones(5), None, "the same for all subjects"),
        (
            np.ones((5, 1)),
            np.arange(5.0),
            2 * np.arange(5.0)[:, None],
            "combination of the covariates",
        ),
        (np.ones((3, 1)), np.arange(3.0), None, "3 subjects are too few to estimate"),
    ],
)
def test_effects__refuse_what_data_cannot_tell(values, regressor, covariates, message):
    with pytest.raises(ValueError, match=message):
        effects(values, regressor, covariates)


def test_effects__of_a_constant_are_nothing():
    found = effects(np.full((6, 1), 0.1), np.arange(6.0))
    assert abs(found.slope[0]) < 1e-15
    p, _, _ = permutation_p(
        np.full((6, 1), 0.1), np.arange(6.0), rng=np.random.default_rng(0)
    )
    assert p[0] == 1


def _with_gaps(rng, n=24, q=5):
    values = rng.normal(size=(n, q))
    x = np.arange(n) % 2.0
    values[:4, 1], values[3:9, 2], values[2:, 3] = np.nan, np.nan, np.nan
    return values, x, rng.normal(size=(n, 2))


def test_effects__a_quantity_with_gaps_is_that_of_who_has_it():
    values, x, covariates = _with_gaps(np.random.default_rng(5))
    found = effects(values, x, covariates)
    for column in (0, 1, 2, 4):
        rows = np.isfinite(values[:, column])
        alone = effects(values[rows, column : column + 1], x[rows], covariates[rows])
        for name in ("slope", "error", "low", "high", "statistic", "spread", "free"):
            np.testing.assert_allclose(
                getattr(found, name)[column], getattr(alone, name)[0], rtol=1e-12
            )
    assert np.isnan(found.slope[3])  # two subjects


def test_permutation_p__a_quantity_with_gaps_is_that_of_who_has_it():
    rng = np.random.default_rng(6)
    values, x, covariates = _with_gaps(rng)
    values[:, 1] += 0.8 * x
    p, adjusted, _ = permutation_p(values, x, covariates, most=4000, rng=rng)
    for column in (0, 1, 2, 4):
        rows = np.isfinite(values[:, column])
        alone, _, _ = permutation_p(
            values[rows, column : column + 1],
            x[rows],
            covariates[rows],
            most=4000,
            rng=rng,
        )
        # four binomial standard deviations of either estimate
        assert abs(p[column] - alone[0]) < 4 * np.sqrt(2 * 0.25 / 4000)
        assert adjusted[column] >= p[column]
    assert np.isnan(p[3])
    assert np.isnan(adjusted[3])


def test_sign_flip_p__a_quantity_with_gaps_is_that_of_who_has_it():
    rng = np.random.default_rng(7)
    differences = rng.normal(0.4, 1, (9, 2))
    differences[2, 1] = np.nan
    p, _, count = sign_flip_p(differences, rng=rng)
    assert count == 511
    alone, _, _ = sign_flip_p(np.delete(differences[:, 1:], 2, axis=0), rng=rng)
    # every combination of the others comes twice
    np.testing.assert_allclose(p[1], alone[0], rtol=1e-12)


def test_permutation_p__is_even_for_quantities_with_gaps_that_follow_the_regressor():
    """Subjects that lack a quantity belong to one group more often; without an effect,
    p is still uniform.
    """
    rng = np.random.default_rng(8)
    x = np.arange(20) % 2.0
    found = []
    for _ in range(200):
        values = rng.normal(size=(20, 1))
        values[(rng.random(20) < 0.6) & (x == 1), 0] = np.nan
        if np.isfinite(values[x == 1]).sum() >= 2:
            found.append(permutation_p(values, x, most=300, rng=rng)[0][0])
    assert stats.kstest(found, "uniform").pvalue > 0.01


def test_paired_effects__are_those_of_scipy():
    rng = np.random.default_rng(9)
    differences = rng.normal(0.3, 1, (12, 3))
    differences[4, 1] = differences[1:, 2] = np.nan
    found = paired_effects(differences)
    for column in (0, 1):
        own = differences[np.isfinite(differences[:, column]), column]
        interval = stats.ttest_1samp(own, 0).confidence_interval()
        expected = [
            own.mean(),
            interval.low,
            interval.high,
            stats.ttest_1samp(own, 0).statistic,
        ]
        got = [
            getattr(found, name)[column]
            for name in ("slope", "low", "high", "statistic")
        ]
        np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert np.isnan(found.slope[2])


@pytest.mark.parametrize("covariates", [0, 2])
@pytest.mark.parametrize("kind", ["permutation", "flips"])
def test_permutation_p__products_of_matrices_give_the_same(
    monkeypatch, kind, covariates
):
    """With gaps, constants, effects of a million standard deviations, and no scatter at all."""
    rng = np.random.default_rng(0)
    n = 24
    q = 60
    values = rng.standard_normal((n, q))
    group = (np.arange(n) % 3 == 0).astype(float)
    values[3, :20] = np.nan
    values[:, 20], values[:, 21], values[:, 22] = (
        1.0,
        group * 1e6 + rng.standard_normal(n),
        group,
    )
    held = rng.standard_normal((n, covariates)) if covariates else None
    found = []
    for many in (10**9, 10):
        monkeypatch.setattr(inference, "MANY", many)
        own = np.random.default_rng(1)
        found.append(
            permutation_p(values, group, held, most=200, rng=own)
            if kind == "permutation"
            else sign_flip_p(values, most=200, rng=own)
        )
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
