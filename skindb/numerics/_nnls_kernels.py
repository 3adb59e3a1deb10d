"""Compiled non-negative least squares; see `skindb.numerics.nnls` for the problem and the statuses."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
PIVOT = 1e-11  # a column whose share outside the span of the active ones is below this is collinear with them
TILE = 4  # columns are worked on in fours
GAIN = 1e-4  # Gauss-Newton ends when a step lowers the misfit by less than this share of it


@nb.njit(cache=True, nogil=True)
def _factor(G: Any, active: Any, begin: int, k: int, L: Any) -> int:
    """Extend the Cholesky factor of G on `active` from position `begin` to k; the first bad pivot, or -1."""
    for a in range(begin, k):
        for c in range(a):
            t = G[active[a], active[c]]
            for q in range(c):
                t -= L[a, q] * L[c, q]
            L[a, c] = t / L[c, c]
        t = G[active[a], active[a]]
        for q in range(a):
            t -= L[a, q] * L[a, q]
        if t <= PIVOT:
            return a
        L[a, a] = math.sqrt(t)
    return -1


@nb.njit(cache=True, nogil=True)
def _solve(L: Any, b: Any, active: Any, k: int, z: Any) -> None:
    """Write to z the inverse of the factored matrix times b on the active columns."""
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
    w[:] = b
    for i in range(m):
        if x[i] != 0.0:
            f = x[i]
            for j in range(m):
                w[j] -= G[i, j] * f


@nb.njit(cache=True, nogil=True)
def _exchange(G: Any, entering: int, active: Any, k: int, L: Any, x: Any, z: Any) -> int:
    """Let a column in that the k active ones span: it takes weight from them until one of them is at zero.

    Along this line the misfit only changes by the newcomer's gradient. Returns the position that left, or -1.
    """
    _solve(L, G[entering], active, k, z)
    leaving, step = -1, math.inf
    for a in range(k):
        if z[a] > 0.0 and x[active[a]] < step * z[a]:
            leaving, step = a, x[active[a]] / z[a]
    if leaving < 0 or step <= 0.0:
        return -1
    for a in range(k):
        x[active[a]] = max(x[active[a]] - step * z[a], 0.0)
    x[active[leaving]] = 0.0
    x[entering] += step
    return leaving


@nb.njit(cache=True, nogil=True)
def _drop(active: Any, position: int, k: int) -> int:
    for a in range(position, k - 1):
        active[a] = active[a + 1]
    return k - 1


@nb.njit(cache=True, nogil=True)
def active_set(G: Any, b: Any, x: Any, tolerance: float, limit: int, work: Any) -> tuple[float, int, bool, float]:
    """Minimise x G x / 2 - b x, x >= 0, for a Gram matrix of unit diagonal (0 for empty columns), from a warm x.

    Lawson and Hanson's method on the normal equations (Bro and de Jong 1997), with a factor that grows by a row a step;
    a column that is collinear with the active ones is exchanged for one of them. Returns the KKT residual over all
    columns relative to max |b|, the iterations, whether the tolerance was met, and the squared ratio of the factor's
    extreme pivots (a lower bound of the active columns' condition). `work` is (m + 2, m).
    """
    m = b.shape[0]
    scale = 0.0
    for j in range(m):
        scale = max(scale, abs(b[j]))
    if scale == 0.0:
        x[:] = 0.0
        return 0.0, 0, True, 1.0
    L, z, w = work[:m], work[m], work[m + 1]
    active, passive, barred = np.empty(m, np.int64), np.zeros(m, np.bool_), np.zeros(m, np.bool_)
    k, valid, count = 0, 0, 0  # active columns, those the factor holds, iterations
    for j in range(m):
        if x[j] > 0.0:
            active[k], passive[j] = j, True
            k += 1
    entering, warm = -1, k > 0
    while count < limit:
        if not warm:
            _gradient(G, b, x, w)
            entering, best = -1, tolerance * scale
            for j in range(m):
                if not passive[j] and not barred[j] and G[j, j] > 0.0 and w[j] > best:
                    entering, best = j, w[j]
            if entering < 0:
                break
            active[k], passive[entering] = entering, True
            k += 1
        warm = False
        while True:
            count += 1
            bad = _factor(G, active, valid, k, L)
            if bad >= 0:
                valid = bad
                j = active[bad]
                if j == entering and bad == k - 1:
                    out = _exchange(G, entering, active, k - 1, L, x, z)
                    if out >= 0:  # of two columns that are alike the better one stays
                        passive[active[out]] = False
                        k, valid = _drop(active, out, k), min(valid, out)
                        if count < limit:
                            continue
                        break
                passive[j], barred[j], x[j] = False, True, 0.0
                k = _drop(active, bad, k)
                if j == entering:
                    break
                continue
            valid = k
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
            for a in range(k - 1, -1, -1):
                j = active[a]
                x[j] += step * (z[a] - x[j])
                if z[a] <= 0.0 and x[j] <= 1e-15 * abs(z[a]) + 1e-300:
                    x[j], passive[j] = 0.0, False
                    if j == entering and step == 0.0:
                        barred[j] = True  # rounding let it in: it wants to leave at once
                    k, valid = _drop(active, a, k), min(valid, a)
            if count >= limit:
                break
        entering = -1
    _gradient(G, b, x, w)
    worst = 0.0
    for j in range(m):
        if G[j, j] > 0.0:
            worst = max(worst, abs(w[j]) if x[j] > 0.0 else w[j])
    low, high = math.inf, 0.0
    for a in range(min(valid, k)):
        low, high = min(low, L[a, a]), max(high, L[a, a])
    condition = (high / low) ** 2 if high > 0.0 else 1.0
    return worst / scale, count, worst <= 10.0 * max(tolerance, 1e-12) * scale and count < limit, condition


@nb.njit(cache=True, nogil=True)
def solve_scaled(G: Any, b: Any, x: Any, tolerance: float, limit: int, work: Any) -> tuple[float, int, bool, float]:
    """`active_set` after scaling the columns to unit length; G and b are overwritten, x is the warm start."""
    m = b.shape[0]
    length = np.zeros(m)
    for j in range(m):
        length[j] = 1.0 / math.sqrt(G[j, j]) if G[j, j] > 0.0 else 0.0
    for i in range(m):
        f = length[i]
        for j in range(m):
            G[i, j] = G[i, j] * f * length[j]
        b[i] *= f
        x[i] = x[i] / f if f > 0.0 else 0.0
    result = active_set(G, b, x, tolerance, limit, work)
    for i in range(m):
        x[i] *= length[i]
    return result


@nb.njit(cache=True, nogil=True)
def solve_many(G: Any, b: Any, x: Any, finite: Any, tolerance: float, kkt: Any, count: Any, met: Any) -> None:
    """`solve_scaled` for every problem that is finite."""
    m = b.shape[1]
    work = np.zeros((m + 2, m))
    for i in range(b.shape[0]):
        if finite[i]:
            kkt[i], count[i], met[i], _ = solve_scaled(G[i], b[i], x[i], tolerance, 6 * m, work)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def inverse_roots(s: Any, out: Any, high_in: Any, high_out: Any) -> None:
    """Write s^(-1/3) to `out` for positive s; `high_*` are (n, 2) int32 views of the same memory (low word, high word).

    A third of the exponent from the high word, then three steps of third order: exact to rounding, and unlike pow in
    vector registers.
    """
    for i in range(s.shape[0]):
        high_out[i, 0] = 0
        high_out[i, 1] = np.int32(1430194685.0 - high_in[i, 1] * (1.0 / 3.0))
    for i in range(s.shape[0]):
        x = out[i]
        for _ in range(3):
            d = 1.0 - s[i] * x * x * x
            x += x * d * (1.0 / 3.0 + d * (2.0 / 9.0))
        out[i] = x


@nb.njit(cache=True, nogil=True)
def workspace(most: int, rank: int, m: int) -> Any:
    """Memory of `fit_one` for up to `most` rows; one a thread."""
    columns = np.empty((9, most))
    words = columns[7].view(np.int32).reshape(most, 2), columns[8].view(np.int32).reshape(most, 2)
    pad = (rank + TILE - 1) // TILE * TILE
    systems = np.empty((pad, pad)), np.empty(rank), np.empty((m, m)), np.empty(m), np.zeros((m + 2, m))
    return columns, *words, *systems, np.empty(m), np.empty((2, most)), np.zeros((pad, most), np.float32)


@nb.njit(cache=True, nogil=True)
def to_columns(rows: Any, columns: Any) -> None:
    """Write the transposed rows to columns[:, :n] in blocks that stay in the nearest cache."""
    n, r = rows.shape
    for low in range(0, n, 16):
        for p in range(r):
            for i in range(low, min(low + 16, n)):
                columns[p, i] = rows[i, p]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _products(w: Any, v: Any, columns: Any, q: int, n: int, g: Any, h: Any) -> None:
    """Products of two weighted columns with four columns from q, in float64: as many sums as there are registers."""
    c0, c1, c2, c3 = columns[q], columns[q + 1], columns[q + 2], columns[q + 3]
    s0 = s1 = s2 = s3 = u0 = u1 = u2 = u3 = 0.0
    for i in range(n):
        x, y = w[i], v[i]
        a, b, c, d = c0[i], c1[i], c2[i], c3[i]
        s0 += x * a
        s1 += x * b
        s2 += x * c
        s3 += x * d
        u0 += y * a
        u1 += y * b
        u2 += y * c
        u3 += y * d
    g[q], g[q + 1], g[q + 2], g[q + 3] = s0, s1, s2, s3
    h[q], h[q + 1], h[q + 2], h[q + 3] = u0, u1, u2, u3


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def gram(columns: Any, n: int, a: Any, t: Any, G: Any, b: Any, pair: Any) -> None:
    """Write G = M' a M and b = M' t of the n rows in `columns`, whose number is a multiple of TILE (zeros fill up)."""
    r = b.shape[0]
    for p in range(0, columns.shape[0], 2):
        for k in range(2):
            column, weighted, s = columns[p + k], pair[k], 0.0
            for i in range(n):
                weighted[i] = a[i] * column[i]
                s += t[i] * column[i]
            if p + k < r:
                b[p + k] = s
        for q in range(0, p + 2, TILE):
            _products(pair[0], pair[1], columns, q, n, G[p], G[p + 1])
    for p in range(r):
        for q in range(p):
            G[q, p] = G[p, q]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def predict(columns: Any, n: int, c: Any, y: Any) -> None:
    """Write M c to y[:n]."""
    y[:n] = 0.0
    for p in range(c.shape[0]):
        column, f = columns[p], c[p]
        for i in range(n):
            y[i] += f * column[i]


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _to_roots(y: Any, floor: float, s: Any, q: Any, high_in: Any, high_out: Any) -> None:
    """Write s = y^2 + floor^2 and q = s^(-1/3): y q is the root of y."""
    for i in range(y.shape[0]):
        s[i] = y[i] * y[i] + floor * floor
    inverse_roots(s, q, high_in, high_out)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _misfit(y: Any, q: Any, weight: Any, channels: int, roots: Any) -> float:
    """Squared distance between roots, less what does not depend on the prediction."""
    total = 0.0
    for i in range(y.shape[0]):
        r = y[i] * q[i]
        total += weight[i] * r * (channels * r - 2.0 * roots[i])
    return total


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _linearise(y: Any, q: Any, weight: Any, channels: int, roots: Any, floor: float, a: Any, t: Any) -> None:
    """Weights and right side of the linear problem whose solution is the Gauss-Newton step on the roots at y."""
    for i in range(y.shape[0]):
        square = q[i] * q[i]
        slope = (y[i] * y[i] * (1.0 / 3.0) + floor * floor) * square * square
        a[i] = weight[i] * channels * slope * slope
        t[i] = weight[i] * slope * (channels * slope * y[i] + roots[i] - channels * y[i] * q[i])


@nb.njit(cache=True, nogil=True)
def coefficients(lift: Any, x: Any) -> Any:
    """Coefficients in the reduced space; a square lift is the identity."""
    return x if lift.shape[0] == lift.shape[1] else np.dot(lift, x)


@nb.njit(cache=True, nogil=True)
def _weighted(n: int, a: Any, t: Any, lift: Any, tolerance: float, x: Any, work: Any) -> Any:
    """Minimise the weighted linear problem over x >= 0 from a warm x."""
    Gr, br, G, b, factor, pair, columns = work[3], work[4], work[5], work[6], work[7], work[9], work[10]
    r = br.shape[0]
    gram(columns, n, a, t, Gr, br, pair)
    if r == b.shape[0]:
        G[:] = Gr[:r, :r]
        b[:] = br
    else:
        G[:] = np.dot(lift.T, np.dot(np.ascontiguousarray(Gr[:r, :r]), lift))
        b[:] = np.dot(lift.T, br)
    return solve_scaled(G, b, x, tolerance, 6 * b.shape[0], factor)


@nb.njit(cache=True, nogil=True)
def fit_one(
    target: Any, weight: Any, lift: Any, perceptual: bool, floor: float, tolerance: float, x: Any, work: Any
) -> Any:
    """Fit one surfel whose rows are in the columns of `work`; x is the answer, a square lift the identity.

    Channels share the rows, so each row enters once with summed targets. Returns KKT residual, iterations, whether it
    converged, condition.
    """
    n, channels = target.shape
    vectors, high_in, high_out, new, columns = work[0][:, :n], work[1], work[2], work[8], work[10]
    total, a, t, y, trial, roots, mixed = (
        vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5], vectors[6],
    )  # fmt: skip
    s, q = vectors[7], vectors[8]
    total[:], roots[:], x[:] = 0.0, 0.0, 0.0
    for c in range(channels):
        for i in range(n):
            trial[i] = target[i, c]
            total[i] += trial[i]
        if perceptual:
            _to_roots(trial, floor, s, q, high_in, high_out)
            for i in range(n):
                roots[i] += trial[i] * q[i]
    if not perceptual:
        for i in range(n):
            a[i], t[i] = weight[i] * channels, weight[i] * total[i]
        return _weighted(n, a, t, lift, tolerance, x, work)
    for i in range(n):  # the first step linearises at the data
        y[i] = max(total[i], 0.0) / channels
    _to_roots(y, floor, s, q, high_in, high_out)
    _linearise(y, q, weight, channels, roots, floor, a, t)
    kkt, count, met, condition = _weighted(n, a, t, lift, tolerance, x, work)
    predict(columns, n, coefficients(lift, x), y)
    _to_roots(y, floor, s, q, high_in, high_out)
    level = 0.0
    for i in range(n):
        level += weight[i] * roots[i] * roots[i] / channels
    best = _misfit(y, q, weight, channels, roots)
    for _ in range(12):
        _linearise(y, q, weight, channels, roots, floor, a, t)
        new[:] = x
        kkt, more, met, condition = _weighted(n, a, t, lift, tolerance, new, work)
        count += more
        predict(columns, n, coefficients(lift, new), trial)
        step, value = 1.0, best
        for _ in range(6):  # predictions are linear in x: a shorter step costs no solve and stays non-negative
            for i in range(n):
                mixed[i] = y[i] + step * (trial[i] - y[i])
            _to_roots(mixed, floor, s, q, high_in, high_out)
            value = _misfit(mixed, q, weight, channels, roots)
            if value < best:
                break
            step *= 0.5
        if not value < best:
            break
        y[:] = mixed
        for j in range(x.shape[0]):
            x[j] += step * (new[j] - x[j])
        gain, best = best - value, value
        if gain < GAIN * (best + level):
            break
    return kkt, count, met, condition


@nb.njit(cache=True, nogil=True)
def relative_errors(found: Any, want: Any, floor: float, work: Any) -> tuple[float, float]:
    """RMS error over RMS of `want`, both (channels, n), linear and between roots; NaN where there is nothing."""
    n = want.shape[1]
    high_in, high_out, s, q, given = work[1], work[2], work[0][7, :n], work[0][8, :n], work[0][6, :n]
    wrong, whole, wrong_root, whole_root = 0.0, 0.0, 0.0, 0.0
    for c in range(want.shape[0]):
        _to_roots(want[c], floor, s, q, high_in, high_out)
        for i in range(n):
            given[i] = want[c, i] * q[i]
        _to_roots(found[c], floor, s, q, high_in, high_out)
        for i in range(n):
            wrong += (found[c, i] - want[c, i]) ** 2
            whole += want[c, i] ** 2
            wrong_root += (found[c, i] * q[i] - given[i]) ** 2
            whole_root += given[i] ** 2
    return (math.sqrt(wrong / whole), math.sqrt(wrong_root / whole_root)) if whole > 0.0 else (math.nan, math.nan)


@nb.njit(cache=True, nogil=True)
def fit_many(
    rows: Any, offsets: Any, target: Any, weight: Any, lift: Any, perceptual: bool, floor: float,
    tolerance: float, least: int, x: Any, kkt: Any, iterations: Any, residual: Any, residual_root: Any, status: Any,
) -> None:  # fmt: skip
    """All surfels of a block; statuses are those of FitStatus."""
    most = 1
    for s in range(offsets.shape[0] - 1):
        most = max(most, offsets[s + 1] - offsets[s])
    work, y = workspace(most, lift.shape[0], lift.shape[1]), np.empty((target.shape[1], most))
    for s in range(offsets.shape[0] - 1):
        lo, hi = offsets[s], offsets[s + 1]
        n = hi - lo
        if n < least:
            status[s] = 2
            continue
        part, want, w = rows[lo:hi], target[lo:hi], weight[lo:hi]
        if not (np.isfinite(part).all() and np.isfinite(want).all() and np.isfinite(w).all() and w.min() >= 0.0):
            status[s] = 6
            continue
        to_columns(part, work[10])
        kkt[s], iterations[s], met, _ = fit_one(want, w, lift, perceptual, floor, tolerance, x[s], work)
        status[s] = 0 if met else 5
        predict(work[10], n, coefficients(lift, x[s]), y[0])
        for c in range(1, target.shape[1]):
            y[c, :n] = y[0, :n]
        residual[s], residual_root[s] = relative_errors(y[:, :n], np.ascontiguousarray(want.T), floor, work)
