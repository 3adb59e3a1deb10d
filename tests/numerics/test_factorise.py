"""NMF on planted problems, and its canonical form."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.numerics.factorise import nmf


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


def test_nmf__metric_of_identity_changes_nothing():
    X, _ = _planted(3)
    plain = nmf(X, 3, rng=np.random.default_rng(1))
    metric = nmf(X, 3, metric=np.eye(X.shape[1]), rng=np.random.default_rng(1))
    np.testing.assert_allclose(plain.H, metric.H, atol=0.02)


def test_nmf__bad_input():
    with pytest.raises(ValueError, match="non-negative"):
        nmf(-np.ones((4, 4)), 2, rng=np.random.default_rng(0))
    with pytest.raises(ValueError, match="k = 9"):
        nmf(np.ones((4, 4)), 9, rng=np.random.default_rng(0))
    np.testing.assert_allclose(nmf(np.zeros((4, 4)), 2, rng=np.random.default_rng(0)).H, 0.25)
