"""Compiled robust fits of one small linear model per segment; see `skindb.numerics.robust`."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
TUKEY = 4.685  # 95 % efficiency for normal noise
CUT = 128  # samples at a time: 9 columns of them fit the first cache
FLAT = 0.3  # mean slope of the influence function over mean weight, 0.86 for normal noise: below, it is not trusted


@nb.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _tukey(u: float) -> float:
    return (1.0 - u) * (1.0 - u) if u < 1.0 else 0.0


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def slopes(offsets: Any, x: Any, y: Any, steps: int, slope: Any, error: Any) -> None:
    """Slope (n, k) of each column of y (total, k) on x (total,) through the origin, and its standard error."""
    longest = 0
    for s in range(offsets.shape[0] - 1):
        longest = max(longest, offsets[s + 1] - offsets[s])
    weight, residual = np.empty(longest), np.empty(longest)
    for s in range(offsets.shape[0] - 1):
        lo, count = offsets[s], offsets[s + 1] - offsets[s]
        if count == 0:
            continue
        for k in range(y.shape[1]):
            weight[:] = 1.0
            norm = scale = total = 0.0
            for step in range(steps):
                norm = right = absolute = total = 0.0
                for i in range(count):
                    wx = weight[i] * x[lo + i]
                    norm += wx * x[lo + i]
                    right += wx * y[lo + i, k]
                norm = max(norm, 1e-12)
                found = right / norm
                for i in range(count):
                    residual[i] = y[lo + i, k] - found * x[lo + i]
                    absolute += weight[i] * abs(residual[i])
                    total += weight[i]
                scale = 1.2533 * absolute / max(total, 1e-12)
                slope[s, k] = found
                if step < steps - 1:
                    for i in range(count):
                        weight[i] = _tukey((residual[i] / max(TUKEY * scale, 1e-12)) ** 2)
            meat = bend = 0.0
            for i in range(count):
                u = (residual[i] / max(TUKEY * scale, 1e-12)) ** 2
                # with x squared: noise that grows with x is bent most where x weighs most
                bend += (1.0 - u) * (1.0 - 5.0 * u) * x[lo + i] ** 2 if u < 1.0 else 0.0
                meat += (weight[i] * residual[i] * x[lo + i]) ** 2
            bend = max(bend / norm, FLAT)
            error[s, k] = math.sqrt(meat * count / max(count - 1.0, 1.0)) / (bend * norm)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def normal_equations(offsets: Any, shape: Any, lobes: Any, y: Any, weight: Any, gram: Any, right: Any) -> None:
    """Gram (n, m, m) and right side (n, m) of columns [shape, lobes] under weights (total,).

    Samples are turned into columns, `CUT` at a time: then every product runs in vector registers.
    """
    m = lobes.shape[1] + 1
    column, weighted = np.empty((m + 1, CUT)), np.empty(CUT)  # the last column is y
    for s in range(offsets.shape[0] - 1):
        G, b = gram[s], right[s]
        G[:], b[:] = 0.0, 0.0
        for lo in range(offsets[s], offsets[s + 1], CUT):
            count = min(CUT, offsets[s + 1] - lo)
            for i in range(count):
                column[0, i], column[m, i] = shape[lo + i], y[lo + i]
                for a in range(1, m):
                    column[a, i] = lobes[lo + i, a - 1]
            for a in range(m):
                for i in range(count):
                    weighted[i] = weight[lo + i] * column[a, i]
                for c in range(a, m + 1):
                    total = 0.0
                    for i in range(count):
                        total += weighted[i] * column[c, i]
                    if c < m:
                        G[a, c] += total
                    else:
                        b[a] += total
        for a in range(m):
            for c in range(a):
                G[a, c] = G[c, a]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def reweigh(
    offsets: Any, shape: Any, lobes: Any, y: Any, x: Any, floor: float, least: float,
    keep: Any, weight: Any, meat: Any, bend: Any,
) -> None:  # fmt: skip
    """Tukey weights `keep` of errors relative to the prediction; weights and their squares times residuals."""
    longest = 0
    for s in range(offsets.shape[0] - 1):
        longest = max(longest, offsets[s + 1] - offsets[s])
    level, residual = np.empty(longest), np.empty(longest)
    for s in range(offsets.shape[0] - 1):
        lo, count = offsets[s], offsets[s + 1] - offsets[s]
        absolute = total = slope = kept = 0.0
        for i in range(count):
            predicted = x[s, 0] * shape[lo + i]
            for a in range(lobes.shape[1]):
                predicted += x[s, a + 1] * lobes[lo + i, a]
            level[i] = max(predicted, floor)
            residual[i] = (y[lo + i] - predicted) / level[i]
            absolute += keep[lo + i] * abs(residual[i])
            total += keep[lo + i]
        scale = 1.2533 * absolute / max(total, 1e-12) + least
        for i in range(count):
            u = (residual[i] / (TUKEY * scale)) ** 2
            keep[lo + i] = _tukey(u)
            kept += keep[lo + i]
            slope += (1.0 - u) * (1.0 - 5.0 * u) if u < 1.0 else 0.0
            weight[lo + i] = keep[lo + i] / level[i] ** 2
            meat[lo + i] = (keep[lo + i] * residual[i] / level[i]) ** 2
        bend[s] = max(slope / max(kept, 1e-12), FLAT)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def pulls(offsets: Any, shape: Any, lobes: Any, weight: Any, first: Any, pull: Any) -> None:
    """Derivative (total,) of the weight of `shape` by each sample, from a row (n, m) of the inverse Gram matrix."""
    for s in range(offsets.shape[0] - 1):
        for i in range(offsets[s], offsets[s + 1]):
            total = first[s, 0] * shape[i]
            for a in range(lobes.shape[1]):
                total += first[s, a + 1] * lobes[i, a]
            pull[i] = total * weight[i]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def moved(offsets: Any, shape: Any, lobes: Any, x: Any, pull: Any, out: Any) -> None:
    """Sum (n,) of the pulls of predictions shape x0 + lobes x."""
    for s in range(offsets.shape[0] - 1):
        total = 0.0
        for i in range(offsets[s], offsets[s + 1]):
            predicted = x[s, 0] * shape[i]
            for a in range(lobes.shape[1]):
                predicted += x[s, a + 1] * lobes[i, a]
            total += pull[i] * predicted
        out[s] = total
