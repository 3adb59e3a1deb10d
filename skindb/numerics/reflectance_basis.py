"""Bases of non-negative mixtures found from reflectance itself (Weyrich et al. 2005, sections 7 and 10.1).

Weights of many similar BRDFs are not unique, so a factorisation of fitted weights need not hold the reflectance they
stand for. Here the rows of H minimise the residual of the samples: sum over surfels s of |M_s H' w_s - r_s|^2, with w_s
and H non-negative, by alternating non-negative least squares on the surfels' normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.numerics.nnls import solve_nnls

Array = NDArray[np.floating[Any]]
SWEEPS = 60  # of the alternation after every change of size; with 20 planted bases are missed by several per cent
WORST = 0.02  # share of surfels whose mean weights start a new component: one outlier must not
SPACE = 16  # dimensions of the BRDFs' linear space while H is sought (DESIGN.md: 12 to 16 hold 59 BRDFs)


@dataclass(frozen=True)
class Systems:
    """Normal equations of n surfels: all that is left of their samples, 28 kB a surfel at m = 59."""

    gram: Array  # (n, m, m) M'M
    rhs: Array  # (n, m) M'r
    square: Array  # (n,) r'r
    count: Array  # (n,) values in r

    @classmethod
    def of(cls, rows: Array, offsets: NDArray[np.int64], target: Array) -> Systems:
        """From rows (total, m), where each surfel's begin (n + 1,), and samples (total, channels) of the same rows."""
        n, m = len(offsets) - 1, rows.shape[1]
        gram, rhs = np.zeros((n, m, m)), np.zeros((n, m))
        for s, (start, stop) in enumerate(pairwise(offsets)):
            own = rows[start:stop].astype(np.float64)
            gram[s] = target.shape[1] * (own.T @ own)
            rhs[s] = own.T @ target[start:stop].sum(axis=1)
        surfel = np.repeat(np.arange(n), np.diff(offsets))
        square = np.asarray(np.bincount(surfel, (target**2).sum(axis=1), n), np.float64)
        return cls(gram, rhs, square, np.diff(offsets).astype(np.float64) * target.shape[1])

    def within(self, H: Array) -> Systems:
        """The systems in the weights of k mixtures H (k, m)."""
        return Systems(H @ self.gram @ H.T, self.rhs @ H.T, self.square, self.count)

    def __getitem__(self, chosen: Any) -> Systems:
        return Systems(self.gram[chosen], self.rhs[chosen], self.square[chosen], self.count[chosen])

    @staticmethod
    def joined(parts: list[Systems]) -> Systems:
        """Of several takes."""
        return Systems(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Systems)))


def residuals(systems: Systems, H: Array | None = None) -> tuple[Array, Array]:
    """Non-negative weights (n, k) of the mixtures H (k, m), or of all m BRDFs, and squared residuals (n,)."""
    own = systems if H is None else systems.within(H)
    x, _, _, _ = solve_nnls(own.gram, own.rhs)
    fitted = np.einsum("nk,nkl,nl->n", x, own.gram, x) - 2 * np.einsum("nk,nk->n", own.rhs, x)
    return x, np.maximum(systems.square + fitted, 0.0)


def factor_reflectance(systems: Systems, largest: int) -> list[Array]:
    """Bases of 1, 2, ... `largest` mixtures, each H (k, m) non-negative with rows of unit sum.

    Sizes grow one by one, a new component starting at the full weights of the surfels fitted worst; then they shrink
    again, each time by the removal or merging of two components that costs least. Of the two bases of a size the
    better is kept: the way down ends in far better minima than random starts. A last way up mends sizes that came out
    worse than the size below.
    """
    weights, least = residuals(systems)
    small, lift = _compress(systems)
    H = _sweep(small, lift, weights.mean(axis=0, keepdims=True))
    up = [H]
    while len(H) < largest:
        H = _sweep(small, lift, _grown(small, lift, H, weights, least))
        up.append(H)
    best = {largest: H}
    for k in range(largest - 1, 0, -1):
        H = _sweep(small, lift, _cheapest_merge(small, lift, H))
        best[k] = min(up[k - 1], H, key=lambda basis: float(residuals(small, basis @ lift)[1].sum()))
    for k in range(1, largest):  # one more mixture cannot be worse: where the search says so, it goes on from here
        left = [float(residuals(small, best[size] @ lift)[1].sum()) for size in (k, k + 1)]
        if left[1] > left[0]:
            best[k + 1] = _sweep(small, lift, _grown(small, lift, best[k], weights, least))
    return [_unit_sum(best[k]) for k in range(1, largest + 1)]


def _grown(systems: Systems, lift: Array, H: Array, weights: Array, least: Array) -> Array:
    """H with one more row: the mean weights of the surfels that are fitted worst, compared with every BRDF."""
    excess = residuals(systems, H @ lift)[1] - least
    worst = np.argsort(excess)[-max(1, round(WORST * len(excess))) :]
    return np.concatenate([H, weights[worst].mean(axis=0, keepdims=True)])


def _compress(systems: Systems) -> tuple[Systems, Array]:
    """The systems in the linear space (SPACE) that holds most of the reflectance; lift (m, SPACE): H there is H lift.

    M = M V (V' scaled): V spans the leading eigenvectors of the mean Gram matrix between columns of unit norm.
    """
    mean = systems.gram.mean(axis=0)
    norm = np.sqrt(np.maximum(np.diag(mean), 0.0))
    scale = 1.0 / np.where(norm > 0, norm, 1.0)
    _, vectors = np.linalg.eigh(mean * np.outer(scale, scale))
    leading = vectors[:, ::-1][:, :SPACE]
    return systems.within((scale[:, None] * leading).T), leading / scale[:, None]


def _sweep(systems: Systems, lift: Array, H: Array) -> Array:
    """Alternate weights and rows of H, extrapolating along the last step as long as that lowers the error."""
    kept, least, stride = H, np.inf, 0.5
    for _ in range(SWEEPS):
        x, squares = residuals(systems, H @ lift)
        overshot = squares.sum() > least
        if overshot:
            stride *= 0.3
            x, squares = residuals(systems, kept @ lift)
        else:
            stride = min(1.2 * stride, 3.0)
        least, start = squares.sum(), kept if overshot else H
        found = _rows(systems, lift, start, x)
        H, kept = found if overshot else np.maximum(found + stride * (found - kept), 0.0), found
    return kept


def _rows(systems: Systems, lift: Array, H: Array, x: Array) -> Array:
    """Rows of H (k, m) by NNLS one after another, for given weights x (n, k)."""
    H, own = H.copy(), H @ lift
    for j in np.flatnonzero(x.any(axis=0)):  # nothing says what a component should be that nobody uses
        gram = np.tensordot(x[:, j] ** 2, systems.gram, 1)
        others = x @ own - np.outer(x[:, j], own[j])
        left = systems.rhs - (systems.gram @ others[..., None])[..., 0]
        H[j] = solve_nnls((lift @ gram @ lift.T)[None], (lift @ (x[:, j] @ left))[None])[0][0]
        own[j] = H[j] @ lift
    return H


def _cheapest_merge(systems: Systems, lift: Array, H: Array) -> Array:
    """H with one row less: one removed, or two replaced by their sum as they are used."""
    total = residuals(systems, H @ lift)[0].sum(axis=0)
    few = systems[:: max(1, len(systems.square) // 500)]  # enough to rank candidates
    candidates = [np.delete(H, i, 0) for i in range(len(H))]
    for i in range(len(H)):
        for j in range(i):
            merged = np.delete(H, i, 0)
            merged[j] = total[i] * H[i] + total[j] * H[j]
            candidates.append(merged)
    return min(candidates, key=lambda basis: float(residuals(few, basis @ lift)[1].sum()))


def _unit_sum(H: Array) -> Array:
    total = H.sum(axis=1, keepdims=True)
    return np.where(total > 0, H / np.where(total > 0, total, 1.0), 1.0 / H.shape[1])
