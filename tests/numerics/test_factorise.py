"""NMF on planted problems, and its canonical form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls
from sklearn.decomposition import PCA

from skindb.numerics import factorise
from skindb.numerics.factorise import Sums, nmf, principal_axes, refine, relative_error


def _planted(seed: int = 0, n: int = 400, m: int = 12, k: int = 3):
    rng = np.random.default_rng(seed)
    H = np.where(rng.random((k, m)) < 0.4, rng.uniform(0.2, 1, (k, m)), 0)
    H[:, :k] += np.eye(k)
    return rng.gamma(0.7, 1.0, (n, k)) @ H, H


def test_nmf__planted_rank_is_found_exactly():
    X, H = _planted()
    found = nmf(X, 3, rng=np.random.default_rng(1))
    assert found.error < 0.01
    assert nmf(X, 2, rng=np.random.default_rng(1)).error > 0.1
    np.testing.assert_allclose(found.H.sum(axis=1), 1.0)
    cosine = (H / np.linalg.norm(H, axis=1, keepdims=True)) @ (
        found.H / np.linalg.norm(found.H, axis=1, keepdims=True)
    ).T
    assert (cosine.max(axis=1) > 0.97).all()


def test_nmf__two_runs_agree():
    X, _ = _planted(2)
    a, b = (nmf(X, 3, rng=np.random.default_rng(s)).H for s in (1, 2))
    np.testing.assert_allclose(a, b, atol=0.05)


def test_nmf__the_same_generator_gives_the_same_bits():
    """The start by singular vectors needs random numbers too, but does not use the
    global random state.
    """
    X, _ = _planted(2)
    found = []
    for state in (1, 2):
        np.random.seed(state)  # noqa: NPY002  the state that libraries have in common
        found.append(nmf(X, 3, seeds=0, rng=np.random.default_rng(0)).H)
    np.testing.assert_array_equal(*found)


def test_nmf__metric_of_identity_changes_nothing():
    X, _ = _planted(3)
    plain = nmf(X, 3, rng=np.random.default_rng(1))
    metric = nmf(X, 3, metric=np.eye(X.shape[1]), rng=np.random.default_rng(1))
    np.testing.assert_allclose(plain.H, metric.H, atol=0.02)


def _brdfs():
    """59 collinear lobes (200, 59) in 200 directions, and their Gram matrix."""
    angle = np.linspace(0, np.pi / 2, 200)[:, None]
    lobes = np.exp(-((angle / np.linspace(0.08, 1.2, 59)) ** 2)) / np.linspace(
        0.08, 1.2, 59
    )
    return lobes, lobes.T @ lobes


def _error(X, H, lobes):
    """|X - W H| over directions with the best W, by SciPy on the lobes themselves."""
    found = np.stack([nnls((H @ lobes.T).T, lobes @ x)[0] for x in X])
    return np.linalg.norm((X - found @ H) @ lobes.T) / np.linalg.norm(X @ lobes.T)


@pytest.mark.parametrize("in_metric", [False, True])
def test_nmf__error_is_that_of_what_is_returned(in_metric):
    lobes, gram = _brdfs()
    X, _ = _planted(4, n=150, m=59, k=5)
    X *= np.random.default_rng(0).lognormal(0, 0.3, X.shape)
    found = nmf(X, 3, metric=gram if in_metric else None, rng=np.random.default_rng(1))
    # two solvers of the same convex problems: rounding times the condition of the Gram matrix
    assert found.error == pytest.approx(
        _error(X, found.H, lobes if in_metric else np.eye(59)), rel=1e-5
    )


@pytest.mark.parametrize("k", [4, 6, 8])
def test_nmf__in_metric_the_planted_brdfs_are_spanned(k):
    lobes, gram = _brdfs()
    X, H = _planted(5, n=400, m=59, k=k)
    # weights of collinear columns scatter
    X *= np.random.default_rng(0).lognormal(0, 0.2, X.shape)
    plain = nmf(X, k, rng=np.random.default_rng(1))
    runs = [nmf(X, k, metric=gram, rng=np.random.default_rng(s)) for s in (1, 2)]
    # a descent from the same starts
    assert runs[0].error < 0.95 * _error(X, plain.H, lobes)
    for run in runs:
        angle = np.arcsin(np.minimum([_error(h[None], run.H, lobes) for h in H], 1.0))
        # from planted BRDFs to the cone found; twice the measured value
        assert np.degrees(angle.max()) < 1.5
    # what agrees between seeds are the BRDFs each cone spans, not the coefficients
    assert max(_error(h[None], runs[1].H, lobes) for h in runs[0].H) < 0.1


def test_nmf__bad_input():
    with pytest.raises(ValueError, match="non-negative"):
        nmf(-np.ones((4, 4)), 2, rng=np.random.default_rng(0))
    with pytest.raises(ValueError, match="k = 9"):
        nmf(np.ones((4, 4)), 9, rng=np.random.default_rng(0))
    np.testing.assert_allclose(
        nmf(np.zeros((4, 4)), 2, rng=np.random.default_rng(0)).H, 0.25
    )


@pytest.mark.parametrize("in_metric", [False, True])
def test_sums__parts_give_the_error_of_the_whole(in_metric):
    lobes, gram = _brdfs()
    X, H = _planted(6, n=300, m=59, k=4)
    X *= np.random.default_rng(0).lognormal(0, 0.3, X.shape)
    A = gram if in_metric else np.eye(59)
    parts = [Sums.of(X[cut], H, A) for cut in (slice(7), slice(7, 7), slice(7, 300))]
    total = parts[0] + parts[1] + parts[2]
    assert total.count == 300
    np.testing.assert_allclose(total.total, X.sum(axis=0))
    # two solvers of the same convex problems, see above
    assert total.error(H, A) == pytest.approx(
        _error(X, H, lobes if in_metric else np.eye(59)), rel=1e-5
    )
    assert total.mean().error(H, A) == pytest.approx(total.error(H, A))
    assert (parts[1]).mean().error(H, A) == 0.0  # of no take


@pytest.mark.parametrize("in_metric", [False, True])
def test_refine__never_worse_and_level_with_all_in_memory(in_metric):
    """From the factorisation of a tenth of the surfels to that of all; the tolerance of
    the stop is 0.1 %.
    """
    _, gram = _brdfs()
    X, _ = _planted(7, n=600, m=59, k=6)
    X *= np.random.default_rng(0).lognormal(0, 0.3, X.shape)
    A, metric = (gram, gram) if in_metric else (np.eye(59), None)
    start = nmf(X[:60], 5, metric=metric, rng=np.random.default_rng(1)).H
    H, sums, errors = refine(
        start, lambda H: [Sums.of(X[:99], H, A) + Sums.of(X[99:], H, A)], A
    )
    assert (np.diff(errors) < 0).all()
    assert errors[0] == pytest.approx(relative_error(X, start, A), rel=1e-6)
    assert errors[-1] == pytest.approx(relative_error(X, H, A), rel=1e-6)
    assert len(sums) == 1
    np.testing.assert_allclose(H.sum(axis=1), 1.0)
    share = X.mean(axis=0) @ H.T
    assert (np.diff(share) <= 0).all()
    whole = nmf(X, 5, metric=metric, rng=np.random.default_rng(1)).error
    print(errors, whole)
    assert errors[-1] < 1.03 * whole < errors[0]


def test_refine__groups_count_alike():
    """A take of one surfel repeated a thousand times weighs no more than the same surfel once."""
    X, _ = _planted(8)
    A = np.eye(12)
    start = nmf(X, 2, rng=np.random.default_rng(1)).H
    once = refine(start, lambda H: [Sums.of(X[:50], H, A), Sums.of(X[50:], H, A)], A)
    often = refine(
        start,
        lambda H: [Sums.of(X[:50], H, A), Sums.of(np.tile(X[50:], (20, 1)), H, A)],
        A,
    )
    np.testing.assert_allclose(once[2], often[2], rtol=1e-9)
    np.testing.assert_allclose(once[0], often[0], atol=1e-9)


@pytest.mark.parametrize(("n", "d"), [(40, 7), (9, 200), (2, 3), (60, 60)])
@pytest.mark.parametrize("block", [factorise.BLOCK, 5])
def test_principal_axes__are_those_of_scikit_learn(n, d, block, monkeypatch):
    monkeypatch.setattr(factorise, "BLOCK", block)
    rng = np.random.default_rng([n, d])
    x = rng.normal(size=(n, d)) * rng.uniform(0.1, 10, d) + 1e3 * rng.normal(size=d)
    found = principal_axes(x, 5)
    oracle = PCA(min(5, n - 1, d), svd_solver="full").fit(x)
    # inner products square the rounding of means that are 1e3 times the spread
    np.testing.assert_allclose(found.mean, oracle.mean_, rtol=1e-12)
    np.testing.assert_allclose(found.variance, oracle.explained_variance_, rtol=1e-9)
    np.testing.assert_allclose(
        np.abs((found.axes * oracle.components_).sum(axis=1)), 1.0, atol=1e-9
    )
    np.testing.assert_allclose(found.total, x.var(axis=0, ddof=1).sum(), rtol=1e-9)
    assert (
        found.axes[np.arange(len(found.axes)), np.abs(found.axes).argmax(axis=1)] > 0
    ).all()


def test_principal_axes__of_equal_vectors_has_no_component():
    found = principal_axes(np.ones((4, 3), np.float32), 5)
    assert found.axes.shape == (0, 3)
    assert found.total == 0


# extreme inputs

SCALES = (1e-30, 1e-12, 1e12, 1e30)


def _factors(X, k, metric=None):
    factors = nmf(X, k, metric=metric, seeds=1, rng=np.random.default_rng(0))
    assert np.isfinite(factors.H).all()
    assert (factors.H >= 0).all()
    np.testing.assert_allclose(factors.H.sum(axis=1), 1.0, rtol=1e-9)
    return factors


@pytest.mark.parametrize("metric", [None, np.eye(12)], ids=["weights", "metric"])
def test_nmf__rank_one_and_fewer_than_k(metric):
    X, _ = _planted(4, n=200)
    of_rank_two, _ = _planted(4, n=200, k=2)
    assert _factors(of_rank_two, 4, metric).error < 0.02
    np.testing.assert_allclose(
        _factors(X[:1], 1, metric).H, X[:1] / X[:1].sum(), atol=1e-6
    )
    constant = _factors(np.full((30, 12), 0.7), 1, metric)
    np.testing.assert_allclose(constant.H, 1 / 12, rtol=1e-5)
    assert constant.error < 1e-5


@pytest.mark.parametrize("scale", SCALES)
def test_nmf__any_scale(scale):
    X, _ = _planted(4, n=200)
    plain = _factors(X, 3)
    scaled = _factors(X * scale, 3)
    # starts are in single precision
    np.testing.assert_allclose(scaled.H, plain.H, atol=1e-3)
    np.testing.assert_allclose(scaled.error, plain.error, rtol=0.05, atol=1e-4)
    A = np.eye(12) + 0.5
    in_metric = _factors(X, 3, A).H
    np.testing.assert_allclose(_factors(X * scale, 3, A).H, in_metric, atol=1e-3)
    np.testing.assert_allclose(_factors(X, 3, A * scale).H, in_metric, atol=1e-3)


@pytest.mark.parametrize("metric", [None, np.eye(14)], ids=["weights", "metric"])
def test_nmf__unused_rows_and_columns(metric):
    X = np.zeros((210, 14))
    X[:200, :12], _ = _planted(4, n=200)
    factors = _factors(X, 3, metric)
    assert factors.H[:, 12:].max() < 1e-9
    assert factors.error < 0.02


def test_nmf__a_brdf_of_zero_makes_the_metric_singular():
    X, _ = _planted(4, n=200)
    assert _factors(X, 3, np.diag([1.0] * 11 + [0.0])).error < 0.02


def test_nmf__weights_that_are_not_finite_are_refused():
    for value in (np.nan, np.inf):
        X, _ = _planted(4, n=200)
        X[3, 3] = value
        with pytest.raises(ValueError, match="finite and non-negative"):
            nmf(X, 2, rng=np.random.default_rng(0))


def test_nmf__duplicates_divide_the_components():
    X, _ = _planted(4, n=200)
    twice = _factors(np.concatenate([X, X]), 3)
    np.testing.assert_allclose(twice.error, _factors(X, 3).error, atol=5e-3)
    both = _factors(np.concatenate([X, X], axis=1) / 2, 3).H
    np.testing.assert_allclose(both[:, :12], both[:, 12:], atol=5e-3)


def test_principal_axes__rebuild_vectors_of_any_scale():
    for scale in SCALES:
        x = scale * np.random.default_rng(0).standard_normal((6, 500))
        axes = principal_axes(x, 5)
        rebuilt = axes.mean + (x - axes.mean) @ axes.axes.T @ axes.axes
        np.testing.assert_allclose(rebuilt, x, atol=1e-10 * scale)
        np.testing.assert_allclose(axes.axes @ axes.axes.T, np.eye(5), atol=1e-10)
