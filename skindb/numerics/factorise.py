"""Non-negative factors of BRDF weights (Weyrich et al. 2005, sections 7 and 10.1), and
principal components of a few long vectors.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from functools import partial

import numpy as np

from skindb.numerics.nnls import solve_nnls
from skindb.threads import c_contiguous
from skindb.types import Array, float64

MAX_SWEEPS = 200  # alternating over W and H; TOLERANCE ends most runs earlier
TOLERANCE = 1e-8  # decrease of the squared error per sweep, relative to |X|^2
MAX_PASSES = 30  # over all blocks; each pass reads all data
# relative decrease of the error by a pass, below which no further pass is made
MIN_FALL_PER_PASS = 1e-3
SWEEPS_PER_PASS = 5  # over all rows of H between two passes; their cost is negligible
# entries per vector that are held in double precision at a time: 23 MB for 174 vectors
BLOCK = 1 << 14


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
    mapper: Callable[..., Iterable[tuple[float, Array]]] = map,
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
    mapper
        Function with the interface of `map` that runs the starts, possibly in parallel.
    """
    X = float64(weights)
    fits = X.ndim == 2 and 1 <= k <= min(X.shape)
    if not fits or not np.isfinite(X).all() or (X < 0).any():
        raise ValueError(
            f"weights {X.shape} must be finite and non-negative, and k = {k} within both sides"
        )
    if not X.any():
        return Factorisation(np.full((k, X.shape[1]), 1.0 / X.shape[1]), 0.0, 0.0)
    # takes as long to import as all that a picture needs, which has no factors
    from sklearn.exceptions import ConvergenceWarning

    A = None if metric is None else (metric + metric.T) / 2
    starts = [None, *(int(rng.integers(2**31)) for _ in range(seeds))]
    # around all starts, because filters apply to the process, not to a thread
    with warnings.catch_warnings():
        # the error is returned instead
        warnings.simplefilter("ignore", ConvergenceWarning)
        results = list(mapper(partial(_from_start, X, k, A), starts))
    errors = [error for error, _ in results]
    H = results[int(np.argmin(errors))][1]
    spread = max(errors) - min(errors)
    return Factorisation(_canonical(H, X.mean(axis=0)), min(errors), spread)


def _from_start(
    X: Array, k: int, A: Array | None, seed: int | None
) -> tuple[float, Array]:
    """Relative error and H (k, m) from one start."""
    X = c_contiguous(X)
    W, H = _in_coefficients(X, k, seed)
    if A is None:
        return relative_error(X, H, np.eye(X.shape[1])), H
    A = c_contiguous(A)
    H = _in_metric(X, W, H, A)
    return relative_error(X, H, A), H


def _in_coefficients(X: Array, k: int, seed: int | None) -> tuple[Array, Array]:
    """W and H that minimise |X - W H|, started from singular vectors, or at random if a
    seed is given.
    """
    from sklearn.decomposition import NMF  # as above

    # single precision is three times faster, and its rounding is far below the error
    level = X.mean()
    scaled = (X / level).astype(np.float32)
    # the singular vectors also start from random ones, which need a seed
    init = "nndsvda" if seed is None else "random"
    model = NMF(k, init=init, max_iter=MAX_SWEEPS, random_state=seed or 0)
    W = model.fit_transform(scaled)
    return W.astype(float) * level, model.components_.astype(float)


def _in_metric(X: Array, W: Array, H: Array, A: Array) -> Array:
    """H after block descent on tr((X - W H) A (X - W H)'), exact in each column of W
    and then each row of H.
    """
    XA = X @ A
    level = float((X * XA).sum())
    previous = np.inf
    for _ in range(MAX_SWEEPS):
        gram = H @ A @ H.T
        rhs = XA @ H.T
        for j in np.flatnonzero(np.diag(gram) > 0):
            step = (rhs[:, j] - W @ gram[:, j]) / gram[j, j]
            W[:, j] = np.maximum(W[:, j] + step, 0.0)
        inner = W.T @ W
        cross = W.T @ X
        H = _next_rows(H, inner, cross, A)
        square = _squared_error(level, inner, cross, H, A)
        if previous - square < TOLERANCE * level:
            break
        previous = square
    return H


def _squared_error(
    square: float, inner: Array, cross: Array, H: Array, A: Array
) -> float:
    """tr((X - W H) A (X - W H)') for tr(X A X'), W'W (k, k) and W'X (k, m)."""
    explained = float((cross @ A * H).sum())
    return square - 2 * explained + float((inner @ H @ A * H).sum())


def _next_rows(H: Array, inner: Array, cross: Array, A: Array) -> Array:
    """H after minimising over its rows one after another, for W'W (k, k) and W'X (k, m)."""
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
        return Sums(*(getattr(self, name) + getattr(other, name) for name in _SUMS))

    def mean(self) -> Sums:
        """Sums per row of X, so that takes have equal weight whatever their number of surfels."""
        n = max(self.count, 1)
        return Sums(*(getattr(self, name) / n for name in _SUMS))

    def error(self, H: Array, A: Array) -> float:
        """|X - W H| / |X|, from differences of sums, so that values below 1e-7 are rounding."""
        if self.square <= 0:
            return 0.0
        residual = _squared_error(self.square, self.inner, self.cross, H, A)
        return float(np.sqrt(max(residual, 0.0) / self.square))


_SUMS = [field.name for field in fields(Sums)]


def refine(
    H: Array, groups: Callable[[Array], Sequence[Sums]], A: Array
) -> tuple[Array, Sequence[Sums], Array]:
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
    sums = groups(H)
    mean = _mean(sums)
    errors = [mean.error(H, A)]
    while len(errors) <= MAX_PASSES:
        rows = H
        for _ in range(SWEEPS_PER_PASS):
            rows = _next_rows(rows, mean.inner, mean.cross, A)
        row_sums = groups(rows)
        row_mean = _mean(row_sums)
        error = row_mean.error(rows, A)
        if not error < errors[-1]:  # rounding
            break
        H = rows
        sums = row_sums
        mean = row_mean
        errors.append(error)
        if errors[-2] - error < MIN_FALL_PER_PASS * error:
            break
    return _canonical(H, mean.total), sums, np.array(errors)


def _mean(groups: Sequence[Sums]) -> Sums:
    total = groups[0].mean()
    for group in groups[1:]:
        total = total + group.mean()
    return total.mean()


def relative_error(X: Array, H: Array, A: Array) -> float:
    """|X - W H| / |X| in the metric A (m, m) with the best non-negative W."""
    residual = X - _best_weights(X @ A, H, A) @ H
    square = max(float((residual @ A * residual).sum()), 0.0)
    return float(np.sqrt(square / float((X @ A * X).sum())))


def _best_weights(XA: Array, H: Array, A: Array) -> Array:
    """Weights W >= 0 (n, k) with W H nearest to X in the metric A, from X A (n, m)."""
    gram = H @ A @ H.T
    return solve_nnls(np.broadcast_to(gram, (len(XA), *gram.shape)), XA @ H.T)[0]


def _canonical(H: Array, mean: Array) -> Array:
    """H with rows of unit sum, ordered by their contribution to the mean of X (m,)."""
    H = unit_sum(H)
    contribution = mean @ H.T
    return H[np.argsort(-contribution, kind="stable")]


def unit_sum(H: Array) -> Array:
    """Rows (k, m) over their sums; even ones in place of 0."""
    total = H.sum(axis=1, keepdims=True)
    return np.where(total > 0, H / np.where(total > 0, total, 1.0), 1.0 / H.shape[1])


@dataclass(frozen=True)
class Components:
    """Mean and principal axes of vectors."""

    mean: Array  # (d,)
    # (c, d) of unit norm, by decreasing variance; the largest entry of each is positive
    axes: Array
    variance: Array  # (c,) unbiased variance of the scores
    total: float  # sum of the variances of all entries


def principal_axes(vectors: Sequence[Array], max_components: int) -> Components:
    """Principal components of vectors (n, d), n at least 2, from the eigenvectors of
    their inner products.

    Vectors are read block by block, so that no second copy of them is needed.
    Components whose variance is below 1e-12 of the largest are rounding and are
    dropped.

    Parameters
    ----------
    vectors
        (n, d) finite, of any precision, as one array or as n.
    max_components
        Maximum number of components; never more than n - 1.
    """
    n = len(vectors)
    d = len(vectors[0])
    blocks = [slice(start, start + BLOCK) for start in range(0, d, BLOCK)]
    mean = np.empty(d)
    inner = np.zeros((n, n))
    for block in blocks:
        x = np.stack([vector[block] for vector in vectors]).astype(float)
        mean[block] = x.mean(axis=0)
        x -= mean[block]
        inner += x @ x.T
    values, places = np.linalg.eigh(inner)
    values = values[::-1][: min(max_components, n - 1)]
    rank = int((values > max(float(values[0]), 0.0) * 1e-12).sum())
    places = places[:, ::-1][:, :rank]
    length = np.sqrt(values[:rank])
    axes = np.empty((rank, d))
    for block in blocks:
        x = np.stack([vector[block] for vector in vectors]) - mean[block]
        axes[:, block] = (places / length).T @ x
    largest = np.abs(axes).argmax(axis=1)
    sign = np.where(axes[np.arange(rank), largest] < 0, -1.0, 1.0)
    return Components(
        mean,
        axes * sign[:, None],
        variance=values[:rank] / (n - 1),
        total=float(np.trace(inner)) / (n - 1),
    )
