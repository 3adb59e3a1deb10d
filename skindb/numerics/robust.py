"""Robust fits of one small linear model per segment of samples: Tukey weights, errors from the residuals (Huber)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.numerics.nnls import solve_nnls

Array = NDArray[np.floating[Any]]
Offsets = NDArray[np.int64]


def robust_slopes(offsets: Offsets, x: Array, y: Array, *, steps: int = 5) -> tuple[Array, Array]:
    """Slope through the origin of every column of y on x, per segment.

    Parameters
    ----------
    offsets
        (n + 1,) where each segment begins.
    x, y
        (total,) and (total, k).
    steps
        Of reweighting.

    Returns
    -------
    slope, error
        (n, k) and their standard errors; NaN for empty segments.
    """
    from skindb.numerics import _robust_kernels  # compiled at first use only

    slope, error = (np.full((len(offsets) - 1, y.shape[1]), np.nan) for _ in range(2))
    x, y = np.ascontiguousarray(x, np.float64), np.ascontiguousarray(y, np.float64)
    _robust_kernels.slopes(np.asarray(offsets, np.int64), x, y, steps, slope, error)
    return slope, error


@dataclass(frozen=True)
class NonnegativeFit:
    """What `robust_nonnegative` finds; NaN for empty segments."""

    weight: Array  # (n,) of `shape`
    error: Array  # (n,) its standard error given which lobes have weight
    x: Array  # (n, 1 + m) every weight
    pull: Array  # (total,) what a sample raised by one adds to the weight of `shape`


def robust_nonnegative(
    offsets: Offsets, shape: Array, lobes: NDArray[np.float32], y: Array, *, floor: float, steps: int = 4
) -> NonnegativeFit:
    """Weight of `shape` in y = x0 shape + lobes @ x, x >= 0, per segment, with errors relative to the prediction.

    Parameters
    ----------
    offsets
        (n + 1,) where each segment begins.
    shape, lobes, y
        (total,), (total, m) and (total,).
    floor
        Predictions below it count as it.
    steps
        Of reweighting.
    """
    from skindb.numerics import _robust_kernels  # compiled at first use only

    n, size = len(offsets) - 1, lobes.shape[1] + 1
    offsets, count = np.asarray(offsets, np.int64), np.diff(offsets)
    shape, y, lobes = np.asarray(shape, np.float64), np.asarray(y, np.float64), np.ascontiguousarray(lobes, np.float32)
    gram, outer, right = np.empty((n, size, size)), np.empty((n, size, size)), np.empty((n, size))
    x: Array = np.zeros((n, size))
    keep, meat, bend = np.ones(len(y)), np.empty(len(y)), np.empty(n)
    weight = 1 / np.maximum(y, floor) ** 2
    for _ in range(steps):
        _robust_kernels.normal_equations(offsets, shape, lobes, y, weight, gram, right)
        x = solve_nnls(gram, right)[0]
        # half a per cent: samples that agree to rounding must not be told apart
        _robust_kernels.reweigh(offsets, shape, lobes, y, x, floor, 0.005, keep, weight, meat, bend)
    _robust_kernels.normal_equations(offsets, shape, lobes, y, weight, gram, right)
    _robust_kernels.normal_equations(offsets, shape, lobes, y, meat, outer, right)
    idle = x <= 0  # columns without weight do not share in the uncertainty
    fixed = idle[:, :, None] | idle[:, None]
    free = np.where(fixed, 0, gram) + np.eye(size) * np.maximum(idle, 1e-12)[:, None]
    first = np.linalg.inv(free)[:, 0]
    variance = np.einsum("na,nab,nb->n", first, np.where(fixed, 0, outer), first) / bend**2
    variance *= count / np.maximum(count - (~idle).sum(1), 1)
    pull = np.empty(len(y))
    _robust_kernels.pulls(offsets, shape, lobes, weight, np.where(idle, 0, first), pull)
    known = count > 0
    error = np.where(known, np.sqrt(np.maximum(variance, 0)), np.nan)
    return NonnegativeFit(np.where(known, x[:, 0], np.nan), error, x, pull)


def shift(fit: NonnegativeFit, offsets: Offsets, shape: Array, lobes: NDArray[np.float32]) -> Array:
    """(n,) what the weight of `shape` gains where the truth has these columns instead of those fitted, at first order.

    The weights stay; it is the sum of what the changed predictions pull, less that of the fit's own columns, so only
    differences between two calls mean anything.
    """
    from skindb.numerics import _robust_kernels  # compiled at first use only

    out = np.empty(len(offsets) - 1)
    lobes = np.ascontiguousarray(lobes, np.float32)
    _robust_kernels.moved(np.asarray(offsets, np.int64), np.asarray(shape, np.float64), lobes, fit.x, fit.pull, out)
    return out
