"""Non-negative matrix factorisation of BRDF weights (Weyrich et al. 2005, sections 7 and 10.1)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import NMF
from sklearn.exceptions import ConvergenceWarning

from skindb.numerics.nnls import solve_nnls
from skindb.threads import c_contiguous
from skindb.types import Array

MAX_SWEEPS = 200  # alternating over W and H; TOLERANCE ends most runs earlier
TOLERANCE = 1e-8  # decrease of the squared error per sweep, relative to |X|^2
MAX_PASSES = 30  # over all blocks; each pass reads all data
# relative decrease of the error by a pass, below which no further pass is made
MIN_FALL_PER_PASS = 1e-3
SWEEPS_PER_PASS = 5  # over all rows of H between two passes; their cost is negligible


@dataclass(frozen=True)
class Factorisation:
    """W H nearest to X; rows of H have unit sum and are ordered by their contribution
    to X, so that runs agree.
    """

    H: Array  # (k, m)
    # |X - W H| / |X| of the best seed in the metric used, with the best W for this H
    error: float
    spread: float  # largest minus smallest error over the seeds


def nmf(
    weights: Array,
    k: int,
    *,
    metric: Array | None = None,
    seeds: int = 3,
    rng: np.random.Generator,
    each: Callable[..., Iterable[tuple[float, Array]]] = map,
) -> Factorisation:
    """Factor non-negative weights (n, m) ~ W H with H (k, m).

    Parameters
    ----------
    weights
        (n, m) non-negative and finite.
    k
        Number of components, at most the smaller side of `weights`.
    metric
        (m, m) Gram matrix A of the bases: minimise tr((X - W H) A (X - W H)'), so that
        distances between weights are distances between BRDFs. None measures in
        coefficient space, the paper's choice.
    seeds
        Number of random starts in addition to the deterministic one; the best result is kept.
    rng
        Random generator for the starts.
    each
        Function with the interface of `map` that runs the starts, possibly in parallel.
    """
    X = np.asarray(weights, np.float64)
    if (
        X.ndim != 2
        or not 1 <= k <= min(X.shape)
        or not np.isfinite(X).all()
        or (X < 0).any()
    ):
        raise ValueError(
            f"weights {X.shape} must be finite and non-negative, and k = {k} within both sides"
        )
    if not X.any():
        return Factorisation(np.full((k, X.shape[1]), 1.0 / X.shape[1]), 0.0, 0.0)
    starts = [None, *(int(rng.integers(2**31)) for _ in range(seeds))]
    # around all starts, because filters apply to the process, not to a thread
    with warnings.catch_warnings():
        # the error is returned instead
        warnings.simplefilter("ignore", ConvergenceWarning)
        found = list(
            each(
                partial(
                    _from_start,
                    X,
                    k,
                    None if metric is None else (metric + metric.T) / 2,
                ),
                starts,
            )
        )
    errors = [error for error, _ in found]
    return Factorisation(
        _canonical(found[int(np.argmin(errors))][1], X.mean(axis=0)),
        min(errors),
        max(errors) - min(errors),
    )


def _from_start(
    X: Array, k: int, A: Array | None, seed: int | None
) -> tuple[float, Array]:
    """Relative error and H (k, m) from one start."""
    X = c_contiguous(X)
    A = None if A is None else c_contiguous(A)
    W, H = _in_coefficients(X, k, seed)
    if A is None:
        return relative_error(X, H, np.eye(X.shape[1])), H
    H = _in_metric(X, W, H, A)
    return relative_error(X, H, A), H


def _in_coefficients(X: Array, k: int, seed: int | None) -> tuple[Array, Array]:
    """W and H that minimise |X - W H|, started from singular vectors, or at random if a
    seed is given.
    """
    # single precision is three times faster, and its rounding is far below the error
    level = X.mean()
    scaled = (X / level).astype(np.float32)
    # the singular vectors also start from random ones: without a seed, from the global generator
    init = "nndsvda" if seed is None else "random"
    model = NMF(
        k, init=init, max_iter=MAX_SWEEPS, random_state=0 if seed is None else seed
    )
    W = model.fit_transform(scaled)
    return W.astype(np.float64) * level, model.components_.astype(np.float64)


def _in_metric(X: Array, W: Array, H: Array, A: Array) -> Array:
    """H after block descent on tr((X - W H) A (X - W H)'), exact in each column of W
    and then each row of H.
    """
    XA = X @ A
    level = float((X * XA).sum())
    last = np.inf
    for _ in range(MAX_SWEEPS):
        gram = H @ A @ H.T
        rhs = XA @ H.T
        for j in np.flatnonzero(np.diag(gram) > 0):
            W[:, j] = np.maximum(
                W[:, j] + (rhs[:, j] - W @ gram[:, j]) / gram[j, j], 0.0
            )
        inner = W.T @ W
        cross = W.T @ X
        H = _next_rows(H, inner, cross, A)
        square = (
            level - 2 * float((cross @ A * H).sum()) + float((inner @ H @ A * H).sum())
        )
        if last - square < TOLERANCE * level:
            break
        last = square
    return H


def _next_rows(H: Array, inner: Array, cross: Array, A: Array) -> Array:
    """H after minimising over its rows one after another, given W'W (k, k) and W'X (k, m)."""
    H = H.copy()
    for j in np.flatnonzero(np.diag(inner) > 0):  # an unused component is undetermined
        # min over h >= 0 of (h - z)' A (h - z): least squares with Gram matrix A
        z = H[j] + (cross[j] - inner[j] @ H) / inner[j, j]
        H[j] = solve_nnls(A[None], (A @ z)[None], warm=H[j][None])[0][0]
    return H


@dataclass(frozen=True)
class Sums:
    """Sufficient statistics of a block of X for H, with the best W for H; the sums of
    blocks can be added.
    """

    inner: Array  # (k, k) W'W
    cross: Array  # (k, m) W'X
    total: Array  # (m,) sum of X
    square: float  # tr(X A X')
    count: float  # rows of X

    @classmethod
    def of(cls, X: Array, H: Array, A: Array) -> Sums:
        """Sums of a block (n, m) in the metric A (m, m)."""
        XA = X @ A
        W = _best_weights(XA, H, A)
        return cls(W.T @ W, W.T @ X, X.sum(axis=0), float((X * XA).sum()), len(X))

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.inner + other.inner,
            self.cross + other.cross,
            self.total + other.total,
            self.square + other.square,
            self.count + other.count,
        )

    def mean(self) -> Sums:
        """Sums per row of X, so that takes have equal weight whatever their number of surfels."""
        n = max(self.count, 1)
        return Sums(
            self.inner / n,
            self.cross / n,
            self.total / n,
            self.square / n,
            self.count / n,
        )

    def error(self, H: Array, A: Array) -> float:
        """|X - W H| / |X|, from differences of sums, so that values below 1e-7 are rounding."""
        left = (
            self.square
            - 2 * float((self.cross @ A * H).sum())
            + float((self.inner @ H @ A * H).sum())
        )
        return float(np.sqrt(max(left, 0.0) / self.square)) if self.square > 0 else 0.0


def refine(
    H: Array, groups: Callable[[Array], Sequence[Sums]], A: Array
) -> tuple[Array, Sequence[Sums], NDArray[np.float64]]:
    """Refine H (k, m) by passes over data that do not fit into memory, until the error
    stops decreasing.

    Parameters
    ----------
    H
        Start, from the factorisation of a sample.
    groups
        H -> sums of every group of rows (take), which have equal weight; reads all data once.
    A
        (m, m) metric.

    Returns
    -------
    H, sums, errors
        H in canonical form; the sums of the groups, of which only those of X remain
        valid for this H; relative errors before the first pass and after each, never
        increasing.
    """
    found = groups(H)
    errors = [_mean(found).error(H, A)]
    while len(errors) <= MAX_PASSES:
        mean = _mean(found)
        rows = H
        for _ in range(SWEEPS_PER_PASS):
            rows = _next_rows(rows, mean.inner, mean.cross, A)
        sums = groups(rows)
        error = _mean(sums).error(rows, A)
        if not error < errors[-1]:  # rounding
            break
        H = rows
        found = sums
        errors.append(error)
        if errors[-2] - error < MIN_FALL_PER_PASS * error:
            break
    return _canonical(H, _mean(found).total), found, np.array(errors)


def _mean(groups: Sequence[Sums]) -> Sums:
    total = groups[0].mean()
    for group in groups[1:]:
        total = total + group.mean()
    return total.mean()


def relative_error(X: Array, H: Array, A: Array) -> float:
    """|X - W H| / |X| in the metric A (m, m) with the best non-negative W."""
    left = X - _best_weights(X @ A, H, A) @ H
    return float(
        np.sqrt(max(float((left @ A * left).sum()), 0.0) / float((X @ A * X).sum()))
    )


def _best_weights(XA: Array, H: Array, A: Array) -> Array:
    """Weights W >= 0 (n, k) with W H nearest to X in the metric A, given X A (n, m)."""
    gram = H @ A @ H.T
    W, _, _, _ = solve_nnls(np.broadcast_to(gram, (len(XA), *gram.shape)), XA @ H.T)
    return W


def _canonical(H: Array, mean: Array) -> Array:
    """H with rows of unit sum, ordered by their contribution to the mean of X (m,)."""
    total = H.sum(axis=1, keepdims=True)
    H = np.where(total > 0, H / np.where(total > 0, total, 1.0), 1.0 / H.shape[1])
    share = mean @ H.T
    return np.asarray(H[np.argsort(-share, kind="stable")])
