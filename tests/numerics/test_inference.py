"""Effects, permutation tests and variance components, compared with statsmodels and
SciPy, and on planted cohorts.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.distance import pdist, squareform
from sklearn.decomposition import PCA

from skindb.numerics import inference
from skindb.numerics.inference import (
    between_groups_p,
    classical_scaling,
    effects,
    paired_effects,
    permutation_p,
    sign_flip_p,
    within_subjects_p,
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


@pytest.mark.slow
def test_permutation_p__is_even_without_an_effect_and_not_misled_by_a_covariate():
    """200 cohorts in which age differs between the groups, and only age has an effect."""
    plain = []
    adjusted = []
    smallest = []
    covered = 0
    for seed in range(200):
        values, group, age, rng = _cohort(seed, confounded=0.8)
        plain.append(permutation_p(values, group, max_draws=199, rng=rng)[0][0])
        p, family, _ = permutation_p(values, group, age, max_draws=199, rng=rng)
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
    p, adjusted, _ = permutation_p(values, x, covariates, max_draws=4000, rng=rng)
    for column in (0, 1, 2, 4):
        rows = np.isfinite(values[:, column])
        alone, _, _ = permutation_p(
            values[rows, column : column + 1],
            x[rows],
            covariates[rows],
            max_draws=4000,
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
            found.append(permutation_p(values, x, max_draws=300, rng=rng)[0][0])
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
def test_permutation_p__as_if_the_values_were_permuted(monkeypatch, kind, covariates):
    """With gaps, constants, no scatter, effects of a million standard deviations; also in tiles."""
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

    def found():
        own = np.random.default_rng(1)
        if kind == "permutation":
            return permutation_p(values, group, held, max_draws=200, rng=own)
        return sign_flip_p(values, max_draws=200, rng=own)

    def of_permuted_values(fit, order, sign):
        return fit.statistics(fit.values[order] * sign[..., None])

    result = found()
    monkeypatch.setattr(inference, "TILE", 7)
    for one, other in zip(result, found(), strict=True):
        np.testing.assert_array_equal(one, other)
    monkeypatch.setattr(
        inference._Regression, "permuted_statistics", of_permuted_values
    )
    for one, other in zip(result, found(), strict=True):
        np.testing.assert_array_equal(one, other)


COHORTS = 200
SHAPE = np.geomspace(1, 0.1, 6)  # spread along each coordinate


def _statistic(x, y):
    step = x.mean(axis=0) - y.mean(axis=0)
    return step @ step / sum(one.var(axis=0, ddof=1).sum() / len(one) for one in (x, y))


def _null(sizes, spreads, seed):
    rng = np.random.default_rng([41, seed])
    groups = [
        s * SHAPE * rng.normal(size=(n, 6)) for n, s in zip(sizes, spreads, strict=True)
    ]
    return np.concatenate(groups), np.repeat(np.arange(len(sizes)), sizes), rng


def test_between_groups_p__is_scipy_s_permutation_test():
    """All 462 splits of five and six subjects."""
    y, group, rng = _null((5, 6), (1, 2), 0)
    y[:5] += 0.6
    (statistic,), (p,), count = between_groups_p(y, group, max_draws=10_000, rng=rng)

    def of_rows(a, b):
        return _statistic(y[np.asarray(a, int)], y[np.asarray(b, int)])

    want = stats.permutation_test(
        (np.arange(5), np.arange(5, 11)),
        of_rows,
        vectorized=False,
        alternative="greater",
        n_resamples=np.inf,
    )
    np.testing.assert_allclose(statistic, want.statistic, rtol=1e-10)
    assert count == 461
    np.testing.assert_allclose(p, want.pvalue, rtol=1e-10)
    order = np.random.default_rng(1).permutation(11)
    assert (
        between_groups_p(y[order] + 7, group[order], max_draws=10_000, rng=rng)[1][0]
        == p
    )


def test_between_groups_p__of_one_coordinate_is_welch_s_t_squared():
    y, group, rng = _null((9, 14), (1, 2), 1)
    (statistic,), (p,), count = between_groups_p(
        y[:, :1], group, max_draws=5000, rng=rng
    )
    want = stats.ttest_ind(y[:9, 0], y[9:, 0], equal_var=False)
    np.testing.assert_allclose(statistic, want.statistic**2, rtol=1e-10)
    assert count == 5000
    assert abs(p - want.pvalue) < 0.03  # 5,000 draws, normal values


def test_within_subjects_p__is_scipy_s_test_of_paired_samples():
    rng = np.random.default_rng(2)
    y = rng.normal(size=(8, 2, 3)) + np.array([0.0, 0.9])[:, None]
    (statistic,), (p,), count = within_subjects_p(y, max_draws=10_000, rng=rng)

    def of_rows(a, b):
        # +1 where a subject is exchanged, else -1
        d = np.asarray(a, int) - np.asarray(b, int)
        d = np.sign(d)[:, None] * (y[:, 0] - y[:, 1])
        return (d.mean(axis=0) ** 2).sum() / (d.var(axis=0, ddof=1).sum() / len(d))

    want = stats.permutation_test(
        (np.zeros(8), np.ones(8)),
        of_rows,
        permutation_type="samples",
        vectorized=False,
        alternative="greater",
        n_resamples=np.inf,
    )
    np.testing.assert_allclose(statistic, want.statistic, rtol=1e-10)
    assert count == 255
    np.testing.assert_allclose(p, want.pvalue, rtol=1e-10)


@pytest.mark.parametrize(
    ("sizes", "spreads"),
    [
        ((20, 20), (1, 1)),
        ((8, 24), (1, 1)),
        ((8, 24), (3, 1)),
        ((8, 24), (1, 3)),
        ((10, 10, 20), (1, 1, 1)),
    ],
)
def test_between_groups_p__is_uniform_where_groups_do_not_differ(sizes, spreads):
    """p of the largest statistic of all pairs; also of groups of unequal sizes and spreads."""
    p = np.array(
        [
            between_groups_p(y, g, max_draws=199, rng=rng)[1].min()
            for y, g, rng in _cohorts(sizes, spreads)
        ]
    )
    assert stats.kstest(p, "uniform").pvalue > 0.001  # fails one seed in a thousand
    assert (p <= 0.05).mean() < 0.10  # 200 cohorts: 5 % and three standard deviations


def _cohorts(sizes, spreads):
    return (_null(sizes, spreads, seed) for seed in range(COHORTS))


def test_within_subjects_p__is_uniform_where_conditions_do_not_differ():
    p = []
    three = []
    for seed in range(COHORTS):
        rng = np.random.default_rng([42, seed])
        y = 3 * rng.normal(size=(12, 1, 6)) + SHAPE * rng.normal(size=(12, 3, 6))
        y[:3, 2] = np.nan  # subjects whose condition is unknown
        p.append(within_subjects_p(y[:, :2], max_draws=199, rng=rng)[1][0])
        three.append(within_subjects_p(y, max_draws=199, rng=rng)[1].min())
    assert stats.kstest(p, "uniform").pvalue > 0.001
    assert stats.kstest(three, "uniform").pvalue > 0.001


def test_between_groups_p__finds_what_is_planted():
    """A step of 1.2 standard deviations along one of six coordinates, 15 and 25
    subjects: 80 % of 100 cohorts.
    """
    found = []
    for seed in range(100):
        y, group, rng = _null((15, 25), (1, 1), seed)
        y[group == 1, 0] += 1.2
        found.append(between_groups_p(y, group, max_draws=199, rng=rng)[1][0] <= 0.05)
    assert np.mean(found) > 0.8


def test_between_groups_p__without_any_scatter():
    """Identical subjects within groups: the largest statistic there is, and the smallest p."""
    y = np.repeat([[0.1, 0.2], [0.3, 0.2]], 4, axis=0)
    (statistic,), (p,), count = between_groups_p(
        y, np.repeat([0, 1], 4), max_draws=1000, rng=np.random.default_rng(0)
    )
    assert statistic == np.inf
    assert (count, p) == (69, 2 / 70)
    same = between_groups_p(
        np.full((8, 2), 0.1),
        np.repeat([0, 1], 4),
        max_draws=1000,
        rng=np.random.default_rng(0),
    )
    assert (same[0][0], same[1][0]) == (0.0, 1.0)


def test_classical_scaling__is_the_principal_component_analysis():
    x = np.random.default_rng(3).normal(size=(20, 5)) * [3, 2, 1, 0.5, 0.1]
    distance = squareform(pdist(x))
    place, explained, error = classical_scaling(distance)
    want = PCA(5).fit(x)
    score = want.transform(x)[:, :2]
    np.testing.assert_allclose(np.abs(place), np.abs(score), atol=1e-10)
    np.testing.assert_allclose(
        explained, want.explained_variance_ratio_[:2], rtol=1e-10
    )
    left = squareform(pdist(score)) - distance
    np.testing.assert_allclose(
        error, np.sqrt((left**2).mean() / (distance**2).mean()), rtol=1e-10
    )
    flat = classical_scaling(squareform(pdist(x[:, :2])))
    assert flat[2] < 1e-12
    one = classical_scaling(np.array([[0.0, 2.0], [2.0, 0.0]]))
    np.testing.assert_allclose(np.abs(one[0]), [[1, 0], [1, 0]], atol=1e-12)


def test_effects__scale_with_the_values_and_statistics_do_not():
    values = np.random.default_rng(0).standard_normal((20, 4))
    group = np.arange(20) % 2.0
    plain = effects(values, group)
    for scale in (1e-30, 1e-12, 1e12, 1e30):
        scaled = effects(scale * values, group)
        np.testing.assert_allclose(scaled.slope, scale * plain.slope, rtol=1e-9)
        np.testing.assert_allclose(scaled.statistic, plain.statistic, rtol=1e-9)


def test_permutation_p__of_groups_a_million_apart_is_at_least_one_draw():
    group = np.arange(12) % 2.0
    values = group[:, None] * 1e6 + np.random.default_rng(0).standard_normal((12, 1))
    p, _, count = permutation_p(
        values, group, max_draws=999, rng=np.random.default_rng(0)
    )
    assert 1 / (count + 1) <= p[0] < 0.02
