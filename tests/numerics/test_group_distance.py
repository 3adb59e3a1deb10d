"""Distances between groups compared with SciPy and scikit-learn; calibration over null
cohorts, and power.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.distance import pdist, squareform
from sklearn.decomposition import PCA

from skindb.numerics.group_distance import (
    between_groups_p,
    classical_scaling,
    within_subjects_p,
)

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
    (statistic,), (p,), count = between_groups_p(y, group, most=10_000, rng=rng)

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
    assert between_groups_p(y[order] + 7, group[order], most=10_000, rng=rng)[1][0] == p


def test_between_groups_p__of_one_coordinate_is_welch_s_t_squared():
    y, group, rng = _null((9, 14), (1, 2), 1)
    (statistic,), (p,), count = between_groups_p(y[:, :1], group, most=5000, rng=rng)
    want = stats.ttest_ind(y[:9, 0], y[9:, 0], equal_var=False)
    np.testing.assert_allclose(statistic, want.statistic**2, rtol=1e-10)
    assert count == 5000
    assert abs(p - want.pvalue) < 0.03  # 5,000 draws, normal values


def test_within_subjects_p__is_scipy_s_test_of_paired_samples():
    rng = np.random.default_rng(2)
    y = rng.normal(size=(8, 2, 3)) + np.array([0.0, 0.9])[:, None]
    (statistic,), (p,), count = within_subjects_p(y, most=10_000, rng=rng)

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
            between_groups_p(y, g, most=199, rng=rng)[1].min()
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
        p.append(within_subjects_p(y[:, :2], most=199, rng=rng)[1][0])
        three.append(within_subjects_p(y, most=199, rng=rng)[1].min())
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
        found.append(between_groups_p(y, group, most=199, rng=rng)[1][0] <= 0.05)
    assert np.mean(found) > 0.8


def test_between_groups_p__without_any_scatter():
    """Identical subjects within groups: the largest statistic there is, and the smallest p."""
    y = np.repeat([[0.1, 0.2], [0.3, 0.2]], 4, axis=0)
    (statistic,), (p,), count = between_groups_p(
        y, np.repeat([0, 1], 4), most=1000, rng=np.random.default_rng(0)
    )
    assert statistic == np.inf
    assert (count, p) == (69, 2 / 70)
    same = between_groups_p(
        np.full((8, 2), 0.1),
        np.repeat([0, 1], 4),
        most=1000,
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
