"""Compiled errors of the weights of mixtures."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from skindb.numerics._nnls_kernels import factor, solve
from skindb.numerics._reflectance_kernels import FAST, ONE, ZERO, gram, slopes


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _scores(y: Any, perceptual: bool, floor: float, scattered: Any, drift: Any, work: Any) -> None:
    """Write slopes and pushes of the rows at the answer and squares of their scores to `work`."""
    n, channels, least = y.shape[0], np.float32(scattered.shape[0]), np.float32(floor)
    vectors = work[0]
    total, a, t, square = vectors[0, :n], vectors[1, :n], vectors[2, :n], vectors[3, :n]
    t[:], a[:] = ZERO, ONE
    if perceptual:
        slopes(y, least, vectors[7, :n], vectors[8, :n], work[1], work[2], a)
    for c in range(scattered.shape[0]):
        f, light = np.float32(drift[c]), scattered[c]
        for i in range(n):
            t[i] += f * light[i]
    for i in range(n):
        score = a[i] * (total[i] - channels * y[i])
        t[i] *= a[i]
        a[i] *= channels
        square[i] = score * score


@nb.njit(cache=True, nogil=True)
def weight_covariance(
    rows: Any, y: Any, perceptual: bool, floor: float, scattered: Any, drift: Any, x: Any, out: Any, work: Any
) -> None:
    """Covariance (m, m) of the weights above their bound 0, right after `fit_one` of a square lift; NaN for the others.

    Two parts: a sandwich of the residuals of whole rows (White 1980), which holds for noise of any size that the
    channels may share; and what shares `drift` of the light `scattered` (channels, n) move the weights by, all at once.
    """
    m, n = x.shape[0], y.shape[0]
    G, b, H, L, block = work[3], work[4], work[5], work[7], work[9]
    out[:] = np.nan
    active, k = np.empty(m, np.int64), 0
    for j in range(m):
        if x[j] > 0.0:
            active[k] = j
            k += 1
    if k == 0 or n <= k:
        return
    _scores(y, perceptual, floor, scattered, drift, work)
    gram(rows, n, work[0][1, :n], work[0][2, :n], G, b, block)
    length, push, inverse, z = np.ones(m), np.zeros(m), np.zeros((m, m)), np.empty(m)
    for j in range(m):
        length[j] = 1.0 / math.sqrt(G[j, j]) if G[j, j] > 0.0 else 0.0
    for i in range(m):
        for j in range(m):
            H[i, j] = G[i, j] * length[i] * length[j]
    if factor(H, active, 0, k, L) >= 0:
        return  # collinear: any mixture of them is as good
    for p in range(k):
        push[:] = 0.0
        push[active[p]] = 1.0
        solve(L, push, active, k, z)
        for c in range(k):
            inverse[p, c] = z[c] * length[active[p]] * length[active[c]]
    for j in range(m):
        push[j] = b[j]
    gram(rows, n, work[0][3, :n], work[0][2, :n], G, b, block)
    for p in range(k):
        z[p] = 0.0
        for c in range(k):
            z[p] += inverse[p, c] * push[active[c]]
    for p in range(k):
        for c in range(k):
            total = 0.0
            for i in range(k):
                for j in range(k):
                    total += inverse[p, i] * G[active[i], active[j]] * inverse[j, c]
            out[active[p], active[c]] = total * n / (n - k) + z[p] * z[c]
    for p in range(k):
        if not out[active[p], active[p]] > 0.0:  # collinear up to the rounding of the Gram matrix
            out[:] = np.nan
