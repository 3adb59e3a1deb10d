"""Principal components compared with scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.decomposition import PCA

from skindb.numerics import principal
from skindb.numerics.principal import principal_axes


@pytest.mark.parametrize(("n", "d"), [(40, 7), (9, 200), (2, 3), (60, 60)])
@pytest.mark.parametrize("block", [principal.BLOCK, 5])
def test_principal_axes__are_those_of_scikit_learn(n, d, block, monkeypatch):
    monkeypatch.setattr(principal, "BLOCK", block)
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
    np.testing.assert_allclose(
        np.abs(found.score), np.abs(oracle.transform(x)), atol=1e-7
    )
    np.testing.assert_allclose(found.total, x.var(axis=0, ddof=1).sum(), rtol=1e-9)
    left = x - oracle.inverse_transform(oracle.transform(x))
    np.testing.assert_allclose(
        found.residual, np.sqrt((left**2).mean(axis=1)), atol=1e-7
    )
    assert (
        found.axes[np.arange(len(found.axes)), np.abs(found.axes).argmax(axis=1)] > 0
    ).all()


def test_principal_axes__of_equal_vectors_has_no_component():
    found = principal_axes(np.ones((4, 3), np.float32), 5)
    assert found.axes.shape == (0, 3)
    assert found.score.shape == (4, 0)
    assert found.total == 0
    assert (found.residual == 0).all()
