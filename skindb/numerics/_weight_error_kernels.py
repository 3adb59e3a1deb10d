"""Compiled standard errors of the weights of mixtures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from skindb.jit import fast_kernel, kernel
from skindb.numerics._nnls_kernels import factor, solve
from skindb.numerics._reflectance_kernels import ONE, ZERO, gram, slopes


@fast_kernel
def _scores(
    y: Any,
    weight: Any,
    perceptual: bool,
    floor: float,
    scattered: Any,
    drift: Any,
    work: Any,
) -> None:
    """Write to `work`, per row at the solution, the slopes, the right side due to
    drift, and the squared scores.
    """
    n = y.shape[0]
    channels = np.float32(scattered.shape[0])
    least = np.float32(floor)
    total = work.total
    a = work.slope
    t = work.aim
    square = work.trial
    for i in range(n):
        t[i], a[i] = ZERO, ONE
    if perceptual:
        slopes(
            y, least, work.square, work.inverse, work.square_bits, work.inverse_bits, a
        )
    for i in range(n):
        a[i] *= weight[i]
    for c in range(scattered.shape[0]):
        f = np.float32(drift[c])
        light = scattered[c]
        for i in range(n):
            t[i] += f * light[i]
    for i in range(n):
        score = a[i] * (total[i] - channels * y[i])
        t[i] *= a[i]
        a[i] *= channels
        square[i] = score * score


@kernel
def weight_covariance(
    rows: Any,
    y: Any,
    weight: Any,
    perceptual: bool,
    floor: float,
    scattered: Any,
    drift: Any,
    x: Any,
    out: Any,
    work: Any,
) -> None:
    """Covariance (m, m) of the positive weights, directly after `fit_one` with a square
    lift; NaN for the others.

    `weight` (n,) are the weights of the rows in that fit.

    The covariance has two parts: a sandwich estimate from the residuals of whole rows
    (White 1980), which is valid for noise of any size that the channels may share; and
    the shift of the weights that is caused by a fraction `drift` of the light
    `scattered` (channels, n).
    """
    m = x.shape[0]
    n = y.shape[0]
    G = work.reduced_gram
    b = work.reduced_right
    H = work.gram
    L = work.active_set.factor
    block = work.block
    out[:] = np.nan
    active = np.empty(m, np.int64)
    k = 0
    for j in range(m):
        if x[j] > 0.0:
            active[k] = j
            k += 1
    if k == 0 or n <= k:
        return
    _scores(y, weight, perceptual, floor, scattered, drift, work)
    gram(rows, n, work.slope, work.aim, G, b, block)
    length = np.ones(m)
    push = np.zeros(m)
    inverse = np.zeros((m, m))
    z = np.empty(m)
    for j in range(m):
        length[j] = 1.0 / math.sqrt(G[j, j]) if G[j, j] > 0.0 else 0.0
    for i in range(m):
        for j in range(m):
            H[i, j] = G[i, j] * length[i] * length[j]
    if factor(H, active, 0, k, L) >= 0:
        return  # collinear columns: all their mixtures fit equally well
    for p in range(k):
        push[:] = 0.0
        push[active[p]] = 1.0
        solve(L, push, active, k, z)
        for c in range(k):
            inverse[p, c] = z[c] * length[active[p]] * length[active[c]]
    for j in range(m):
        push[j] = b[j]
    gram(rows, n, work.trial, work.aim, G, b, block)
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
        # collinear up to the rounding of the Gram matrix
        if not out[active[p], active[p]] > 0.0:
            out[:] = np.nan
