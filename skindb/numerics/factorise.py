"""Non-negative matrix factorisation of BRDF weights (Weyrich et al. 2005, sections 7 and 10.1)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
ITERATIONS = 200


@dataclass(frozen=True)
class Factorisation:
    """W H nearest to X; rows of H have unit sum and are ordered by their share of X, so that two runs agree."""

    H: Array  # (k, m)
    error: float  # |X - W H| / |X| of the best seed, in the metric used
    spread: float  # largest less smallest error over the seeds


def nmf(
    weights: Array, k: int, *, metric: Array | None = None, seeds: int = 3, rng: np.random.Generator
) -> Factorisation:
    """Factor non-negative weights (n, m) ~ W H with H (k, m).

    Parameters
    ----------
    weights
        (n, m) non-negative and finite.
    k
        Components; at most the smaller side of `weights`.
    metric
        (m, m) Gram matrix of the bases: distances between weights become distances between BRDFs. Each row of X is
        carried to reflectance space by the non-negative features A with A'A = metric, factored there, and H is found
        by regressing the weights on W. None measures in coefficient space, the paper's choice.
    seeds
        Random starts after the deterministic one; the best is kept.
    rng
        Of the random starts.
    """
    from sklearn.decomposition import NMF
    from sklearn.exceptions import ConvergenceWarning

    X = np.asarray(weights, np.float64)
    if X.ndim != 2 or not 1 <= k <= min(X.shape) or not np.isfinite(X).all() or (X < 0).any():
        raise ValueError(f"weights {X.shape} must be finite and non-negative, and k = {k} within both sides")
    if not X.any():
        return Factorisation(np.full((k, X.shape[1]), 1.0 / X.shape[1]), 0.0, 0.0)
    features = X if metric is None else X @ _non_negative_root(metric)
    # single precision is three times faster; the error is far above its rounding
    scaled = (features / features.mean()).astype(np.float32)
    level = np.linalg.norm(scaled)
    best: tuple[float, Array] | None = None
    errors = []
    for start in range(seeds + 1):
        model = NMF(
            k, init="nndsvda" if start == 0 else "random", max_iter=ITERATIONS,
            random_state=None if start == 0 else int(rng.integers(2**31)),
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # the error is reported instead
            W = model.fit_transform(scaled)
        errors.append(float(np.linalg.norm(scaled - W @ model.components_) / level))
        if best is None or errors[-1] < best[0]:
            best = (errors[-1], W.astype(np.float64))
    assert best is not None
    H = _regress(best[1], X)
    return Factorisation(_canonical(H, X), best[0], max(errors) - min(errors))


def _non_negative_root(metric: Array) -> Array:
    """(m, m) symmetric root of a Gram matrix of non-negative functions, negatives from rounding cut."""
    values, vectors = np.linalg.eigh(metric)
    return np.maximum((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T, 0.0)


def _regress(W: Array, X: Array) -> Array:
    """Non-negative H that minimises |X - W H| column by column."""
    from skindb.numerics.nnls import solve_nnls

    gram, rhs = W.T @ W, (W.T @ X).T
    solution, _, _, _ = solve_nnls(np.broadcast_to(gram, (len(rhs), *gram.shape)), rhs)
    return np.ascontiguousarray(solution.T)


def _canonical(H: Array, X: Array) -> Array:
    total = H.sum(axis=1, keepdims=True)
    H = np.where(total > 0, H / np.where(total > 0, total, 1.0), 1.0 / H.shape[1])
    share = X.mean(axis=0) @ H.T
    return np.asarray(H[np.argsort(-share, kind="stable")])
