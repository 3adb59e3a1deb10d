"""Compiled non-negative least squares; see `skindb.numerics.nnls` for the problem and the statuses."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
PIVOT = 1e-11  # a column whose share outside the span of the active ones is below this is collinear with them


@nb.njit(cache=True, nogil=True)
def _factor(G: Any, active: Any, k: int, L: Any) -> int:
    """Cholesky factor of G on the first k `active` columns; the position of the first bad pivot, or -1."""
    for a in range(k):
        for c in range(a + 1):
            t = G[active[a], active[c]]
            for q in range(c):
                t -= L[a, q] * L[c, q]
            if a == c:
                if t <= PIVOT:
                    return a
                L[a, a] = math.sqrt(t)
            else:
                L[a, c] = t / L[c, c]
    return -1


@nb.njit(cache=True, nogil=True)
def _solve(L: Any, b: Any, active: Any, k: int, z: Any) -> None:
    for a in range(k):
        t = b[active[a]]
        for q in range(a):
            t -= L[a, q] * z[q]
        z[a] = t / L[a, a]
    for a in range(k - 1, -1, -1):
        t = z[a]
        for q in range(a + 1, k):
            t -= L[q, a] * z[q]
        z[a] = t / L[a, a]


@nb.njit(cache=True, nogil=True)
def _gradient(G: Any, b: Any, x: Any, w: Any) -> None:
    m = b.shape[0]
    for j in range(m):
        w[j] = b[j]
    for i in range(m):
        if x[i] != 0.0:
            for j in range(m):
                w[j] -= G[i, j] * x[i]


@nb.njit(cache=True, nogil=True)
def active_set(G: Any, b: Any, x: Any, tolerance: float, limit: int) -> tuple[float, int, bool]:
    """Minimise x G x / 2 - b x, x >= 0, for a Gram matrix of unit diagonal (0 for empty columns), from a warm x.

    Returns the KKT residual relative to max |b|, the iterations and whether the tolerance was met. Lawson and
    Hanson's method on the normal equations (Bro and de Jong 1997); collinear columns stay out.
    """
    m = b.shape[0]
    scale = 0.0
    for j in range(m):
        scale = max(scale, abs(b[j]))
    if scale == 0.0:
        x[:] = 0.0
        return 0.0, 0, True
    L, z, w = np.zeros((m, m)), np.zeros(m), np.zeros(m)
    active, passive, barred = np.zeros(m, np.int64), np.zeros(m, np.bool_), np.zeros(m, np.bool_)
    for j in range(m):
        passive[j] = x[j] > 0.0
    entering, count = -1, 0
    warm = bool(passive.any())
    while count < limit:
        if not warm:
            _gradient(G, b, x, w)
            entering, best = -1, tolerance * scale
            for j in range(m):
                if not passive[j] and not barred[j] and G[j, j] > 0.0 and w[j] > best:
                    entering, best = j, w[j]
            if entering < 0:
                break
            passive[entering] = True
        warm = False
        while True:
            count += 1
            k = 0
            for j in range(m):
                if passive[j]:
                    active[k] = j
                    k += 1
            bad = _factor(G, active, k, L)
            if bad >= 0:  # collinear: bar the newcomer, or in a warm start the column itself
                j = entering if entering >= 0 else active[bad]
                passive[j], barred[j], x[j] = False, True, 0.0
                if entering >= 0:
                    break
                continue
            _solve(L, b, active, k, z)
            step, leaving = 1.0, False
            for a in range(k):
                if z[a] <= 0.0:
                    leaving = True
                    xa = x[active[a]]
                    step = min(step, xa / (xa - z[a]) if xa > z[a] else 0.0)
            if not leaving:
                for a in range(k):
                    if x[active[a]] != z[a]:
                        barred[:] = False  # progress: barred columns may try again
                    x[active[a]] = z[a]
                break
            for a in range(k):
                j = active[a]
                x[j] += step * (z[a] - x[j])
                if z[a] <= 0.0 and x[j] <= 1e-15 * abs(z[a]) + 1e-300:
                    x[j], passive[j] = 0.0, False
                    if j == entering and step == 0.0:
                        barred[j] = True  # rounding let it in: it wants to leave at once
            if count >= limit:
                break
        entering = -1
    _gradient(G, b, x, w)
    worst = 0.0
    for j in range(m):
        worst = max(worst, abs(w[j]) if x[j] > 0.0 else max(w[j], 0.0) if not barred[j] else 0.0)
    return worst / scale, count, worst <= 10.0 * max(tolerance, 1e-12) * scale and count < limit


@nb.njit(cache=True, nogil=True)
def solve_scaled(G: Any, b: Any, x: Any, tolerance: float, limit: int) -> tuple[float, int, bool]:
    """`active_set` after scaling the columns to unit length; G and b are overwritten, x is the warm start."""
    m = b.shape[0]
    length = np.zeros(m)
    for j in range(m):
        length[j] = math.sqrt(G[j, j]) if G[j, j] > 0.0 else 0.0
    for i in range(m):
        for j in range(m):
            G[i, j] = G[i, j] / length[i] / length[j] if length[i] > 0.0 and length[j] > 0.0 else 0.0
        b[i] = b[i] / length[i] if length[i] > 0.0 else 0.0
        x[i] *= length[i]
    result = active_set(G, b, x, tolerance, limit)
    for i in range(m):
        x[i] = x[i] / length[i] if length[i] > 0.0 else 0.0
    return result


@nb.njit(cache=True, nogil=True)
def solve_many(G: Any, b: Any, x: Any, finite: Any, tolerance: float, kkt: Any, count: Any, met: Any) -> None:
    """`solve_scaled` for every problem that is finite."""
    for i in range(b.shape[0]):
        if finite[i]:
            kkt[i], count[i], met[i] = solve_scaled(G[i], b[i], x[i], tolerance, 6 * b.shape[1])


@nb.njit(cache=True, nogil=True, inline="always")
def root(y: float, floor: float) -> float:
    """Cube root, odd, and linear below the noise floor."""
    return y / (y * y + floor * floor) ** (1.0 / 3.0)


@nb.njit(cache=True, nogil=True, inline="always")
def _root_slope(y: float, floor: float) -> float:
    s = y * y + floor * floor
    return (y * y / 3.0 + floor * floor) / s ** (4.0 / 3.0)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _gram(rows: Any, a: Any, t: Any, lift: Any, G: Any, b: Any) -> None:
    """G = lift' (rows' a rows) lift and b = lift' (rows' t) in float64."""
    n, r = rows.shape
    m = lift.shape[1]
    Gr, br = np.zeros((r, r)), np.zeros(r)
    row = np.empty(r)
    for i in range(n):
        for p in range(r):
            row[p] = rows[i, p]
        for p in range(r):
            f = a[i] * row[p]
            br[p] += t[i] * row[p]
            for q in range(p + 1):
                Gr[p, q] += f * row[q]
    for p in range(r):
        for q in range(p):
            Gr[q, p] = Gr[p, q]
    half = np.dot(Gr, lift)
    G[:] = np.dot(lift.T, half)
    for j in range(m):
        s = 0.0
        for p in range(r):
            s += lift[p, j] * br[p]
        b[j] = s


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _predict(rows: Any, lift: Any, x: Any, y: Any) -> None:
    n, r = rows.shape
    c = np.dot(lift, x)
    for i in range(n):
        s = 0.0
        for p in range(r):
            s += rows[i, p] * c[p]
        y[i] = s


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _misfit(y: Any, target: Any, weight: Any, floor: float) -> float:
    total = 0.0
    for i in range(target.shape[0]):
        r = root(y[i], floor)
        for c in range(target.shape[1]):
            e = r - root(target[i, c], floor)
            total += weight[i] * e * e
    return total


@nb.njit(cache=True, nogil=True)
def fit_one(
    rows: Any, target: Any, weight: Any, lift: Any, perceptual: bool, floor: float, tolerance: float, x: Any
) -> tuple[float, int, bool]:
    """Fit one surfel; x is the answer. Channels share the rows, so each row enters once with summed targets."""
    n, channels = target.shape
    m = lift.shape[1]
    G, b = np.empty((m, m)), np.empty(m)
    a, t, y, trial = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    limit = 6 * m
    for i in range(n):
        s = 0.0
        for c in range(channels):
            s += target[i, c]
        a[i], t[i] = weight[i] * channels, weight[i] * s
    _gram(rows, a, t, lift, G, b)
    x[:] = 0.0
    kkt, count, met = solve_scaled(G, b, x, tolerance, limit)
    if not perceptual:
        return kkt, count, met
    _predict(rows, lift, x, y)
    best = _misfit(y, target, weight, floor)
    for _ in range(8):  # Gauss-Newton on the cube roots: each step is a weighted non-negative problem
        for i in range(n):
            slope, here, s = _root_slope(y[i], floor), root(y[i], floor), 0.0
            for c in range(channels):
                s += root(target[i, c], floor) - here
            a[i] = weight[i] * channels * slope * slope
            t[i] = weight[i] * slope * (channels * slope * y[i] + s)
        _gram(rows, a, t, lift, G, b)
        new = x.copy()
        kkt, more, met = solve_scaled(G, b, new, tolerance, limit)
        count += more
        _predict(rows, lift, new, trial)
        step, improved = 1.0, False
        for _ in range(6):  # predictions are linear in x: a shorter step costs no solve and stays non-negative
            mixed = y + step * (trial - y)
            value = _misfit(mixed, target, weight, floor)
            if value < best:
                improved = True
                break
            step *= 0.5
        if not improved:
            break
        x[:] = x + step * (new - x)
        y[:] = mixed
        gain, best = best - value, value
        if gain < 1e-6 * best:
            break
    return kkt, count, met


@nb.njit(cache=True, nogil=True)
def fit_many(
    rows: Any, offsets: Any, target: Any, weight: Any, lift: Any, perceptual: bool, floor: float,
    tolerance: float, least: int, x: Any, kkt: Any, iterations: Any, residual: Any, residual_root: Any, status: Any,
) -> None:  # fmt: skip
    """All surfels of a block; statuses are those of FitStatus."""
    for s in range(offsets.shape[0] - 1):
        lo, hi = offsets[s], offsets[s + 1]
        if hi - lo < least:
            status[s] = 2
            continue
        finite = True
        for i in range(lo, hi):
            finite = finite and np.isfinite(weight[i]) and weight[i] >= 0.0
            for c in range(target.shape[1]):
                finite = finite and np.isfinite(target[i, c])
            for p in range(rows.shape[1]):
                finite = finite and np.isfinite(rows[i, p])
        if not finite:
            status[s] = 6
            continue
        part, want, w = rows[lo:hi], target[lo:hi], weight[lo:hi]
        kkt[s], iterations[s], met = fit_one(part, want, w, lift, perceptual, floor, tolerance, x[s])
        status[s] = 0 if met else 5
        y = np.empty(hi - lo)
        _predict(part, lift, x[s], y)
        error, level, error_root, level_root = 0.0, 0.0, 0.0, 0.0
        for i in range(hi - lo):
            for c in range(want.shape[1]):
                error += (y[i] - want[i, c]) ** 2
                level += want[i, c] ** 2
                r = root(want[i, c], floor)
                error_root += (root(y[i], floor) - r) ** 2
                level_root += r * r
        residual[s] = math.sqrt(error / level) if level > 0.0 else 0.0
        residual_root[s] = math.sqrt(error_root / level_root) if level_root > 0.0 else 0.0
