"""Compiled non-negative least squares; see `skindb.numerics.nnls` for the problem and the statuses."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from skindb._vectors import LANES, dots, products

FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
PIVOT = 1e-11  # a column whose share outside the span of the active ones is below this is collinear with them
GAIN = 1e-4  # Gauss-Newton ends when a step lowers the misfit by less than this share of it
CHUNK = 64  # rows summed in single precision before they are added in double
SMALLEST = 1e-12  # of a noise floor beside values of order one: its square is a normal number
MAGIC = np.float32(1419967116.0)  # bits of s^(-1/3) and a third of those of s; right to 4 %
ZERO, HALF, THIRD, ONE, TWO, TWO_NINTHS = (np.float32(c) for c in (0, 1 / 2, 1 / 3, 1, 2, 2 / 9))


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
def inverse_roots(s: Any, out: Any, bits_in: Any, bits_out: Any) -> None:
    """Write s^(-1/3) to `out` for positive float32 s; `bits_*` are int32 views of the same memory.

    A third of the exponent from the bits, then two steps of third order: exact to rounding, and unlike pow in vector
    registers.
    """
    for i in range(s.shape[0]):
        bits_out[i] = np.int32(MAGIC - np.float32(bits_in[i]) * THIRD)
    for i in range(s.shape[0]):
        x = out[i]
        for _ in range(2):
            d = ONE - s[i] * x * x * x
            x += x * d * (THIRD + d * TWO_NINTHS)
        out[i] = x


@nb.njit(cache=True, nogil=True)
def workspace(most: int, width: int, m: int) -> Any:
    """Memory of `fit_one` for up to `most` rows; one a thread."""
    vectors = np.empty((9, most), np.float32)
    bits = vectors[7].view(np.int32), vectors[8].view(np.int32)
    systems = np.empty((width, width)), np.empty(width), np.empty((m, m)), np.empty(m), np.zeros((m + 2, m))
    return vectors, *bits, *systems, np.empty(m), np.empty((LANES + 1, LANES), np.float32), np.zeros(width, np.float32)


@nb.njit(cache=True, nogil=True)
def gram(rows: Any, n: int, a: Any, t: Any, G: Any, b: Any, block: Any) -> None:
    """Write G = M' a M and b = M' t of the first n rows; their width is a multiple of LANES (zeros fill up).

    Sums of CHUNK rows in single precision stay in registers and are added in double: some 1e-8 of rounding.
    """
    width = rows.shape[1]
    G[:], b[:] = 0.0, 0.0
    for begin in range(0, n, CHUNK):
        end = min(begin + CHUNK, n)
        for p in range(0, width, LANES):
            for q in range(p, width, LANES):
                products(rows, a, t, p, q, begin, end, block)
                for k in range(LANES):
                    for j in range(LANES):
                        G[p + k, q + j] += block[k, j]
                if p == 0:
                    for j in range(LANES):
                        b[q + j] += block[LANES, j]
    for p in range(width):
        for q in range(p):
            G[p, q] = G[q, p]


@nb.njit(cache=True, nogil=True)
def predict(rows: Any, n: int, c: Any, y: Any, single: Any) -> None:
    """Write M c to y[:n]; `single` (width,) holds c in single precision, zeros behind it."""
    single[: c.shape[0]] = c
    single[c.shape[0] :] = 0.0
    dots(rows, single, n, y)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def to_roots(y: Any, floor: Any, s: Any, q: Any, bits_in: Any, bits_out: Any) -> None:
    """Write s = y^2 + floor^2 and q = s^(-1/3): y q is the root of y."""
    for i in range(y.shape[0]):
        s[i] = y[i] * y[i] + floor * floor
    inverse_roots(s, q, bits_in, bits_out)


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _misfit(y: Any, q: Any, weight: Any, channels: Any, roots: Any) -> float:
    """Squared distance between roots, less what does not depend on the prediction."""
    total = 0.0
    for i in range(y.shape[0]):
        r = y[i] * q[i]
        total += weight[i] * r * (channels * r - TWO * roots[i])
    return total


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _linearise(y: Any, q: Any, weight: Any, channels: Any, roots: Any, floor: Any, a: Any, t: Any) -> None:
    """Weights and right side of the linear problem whose solution is the Gauss-Newton step on the roots at y."""
    for i in range(y.shape[0]):
        square = q[i] * q[i]
        slope = (y[i] * y[i] * THIRD + floor * floor) * square * square
        a[i] = weight[i] * channels * slope * slope
        t[i] = weight[i] * slope * (channels * slope * y[i] + roots[i] - channels * y[i] * q[i])


@nb.njit(cache=True, nogil=True)
def coefficients(lift: Any, x: Any) -> Any:
    """Coefficients in the reduced space; a square lift is the identity."""
    return x if lift.shape[0] == lift.shape[1] else np.dot(lift, x)


@nb.njit(cache=True, nogil=True)
def _weighted(rows: Any, n: int, a: Any, t: Any, lift: Any, tolerance: float, x: Any, work: Any) -> Any:
    """Minimise the weighted linear problem over x >= 0 from a warm x."""
    Gr, br, G, b, factor = work[3], work[4], work[5], work[6], work[7]
    r = lift.shape[0]
    gram(rows, n, a, t, Gr, br, work[9])
    if r == b.shape[0]:
        G[:] = Gr[:r, :r]
        b[:] = br[:r]
    else:
        G[:] = np.dot(lift.T, np.dot(np.ascontiguousarray(Gr[:r, :r]), lift))
        b[:] = np.dot(lift.T, br[:r])
    return solve_scaled(G, b, x, tolerance, 6 * b.shape[0], factor)


@nb.njit(cache=True, nogil=True)
def fit_one(
    rows: Any, target: Any, weight: Any, lift: Any, perceptual: bool, floor: float, tolerance: float, x: Any, work: Any
) -> Any:
    """Fit one surfel, target (channels, n), everything in single precision and of about order one; x is the answer.

    A square lift is the identity. Channels share the rows, so each row enters once with summed targets. Returns KKT
    residual, iterations, whether it converged, condition.
    """
    n, channels, least = target.shape[1], np.float32(target.shape[0]), np.float32(floor)
    vectors, bits_in, bits_out, new, single = work[0][:, :n], work[1], work[2], work[8], work[10]
    total, a, t, y, trial, roots, mixed = (
        vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[5], vectors[6],
    )  # fmt: skip
    s, q = vectors[7], vectors[8]
    total[:], roots[:], x[:] = ZERO, ZERO, 0.0
    for c in range(target.shape[0]):
        for i in range(n):
            total[i] += target[c, i]
        if perceptual:
            to_roots(target[c], least, s, q, bits_in, bits_out)
            for i in range(n):
                roots[i] += target[c, i] * q[i]
    if not perceptual:
        for i in range(n):
            a[i], t[i] = weight[i] * channels, weight[i] * total[i]
        return _weighted(rows, n, a, t, lift, tolerance, x, work)
    for i in range(n):  # the first step linearises at the data
        y[i] = max(total[i], ZERO) / channels
    to_roots(y, least, s, q, bits_in, bits_out)
    _linearise(y, q, weight, channels, roots, least, a, t)
    kkt, count, met, condition = _weighted(rows, n, a, t, lift, tolerance, x, work)
    predict(rows, n, coefficients(lift, x), y, single)
    to_roots(y, least, s, q, bits_in, bits_out)
    level = 0.0
    for i in range(n):
        level += weight[i] * roots[i] * roots[i] / channels
    best = _misfit(y, q, weight, channels, roots)
    for _ in range(12):
        _linearise(y, q, weight, channels, roots, least, a, t)
        new[:] = x
        kkt, more, met, condition = _weighted(rows, n, a, t, lift, tolerance, new, work)
        count += more
        predict(rows, n, coefficients(lift, new), trial, single)
        step: Any = ONE
        value = best
        for _ in range(6):  # predictions are linear in x: a shorter step costs no solve and stays non-negative
            for i in range(n):
                mixed[i] = y[i] + step * (trial[i] - y[i])
            to_roots(mixed, least, s, q, bits_in, bits_out)
            value = _misfit(mixed, q, weight, channels, roots)
            if value < best:
                break
            step *= HALF
        if not value < best:
            break
        y[:] = mixed
        for j in range(x.shape[0]):
            x[j] += step * (new[j] - x[j])
        gain, best = best - value, value
        if gain < GAIN * (best + level):
            break
    return kkt, count, met, condition


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _squares(found: Any, want: Any, q: Any, roots: Any) -> tuple[float, float, float, float]:
    """Sums of squared differences and values, linear and between roots; `found` q is a root, `roots` those of want."""
    wrong, whole, wrong_root, whole_root = 0.0, 0.0, 0.0, 0.0
    for i in range(want.shape[0]):
        d, e = found[i] - want[i], found[i] * q[i] - roots[i]
        wrong += d * d
        whole += want[i] * want[i]
        wrong_root += e * e
        whole_root += roots[i] * roots[i]
    return wrong, whole, wrong_root, whole_root


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _scores(y: Any, perceptual: bool, floor: float, scattered: Any, drift: Any, work: Any) -> None:
    """Write slopes and pushes of the rows at the answer, squares of their scores and linear scores to `work`."""
    n, channels, least = y.shape[0], np.float32(scattered.shape[0]), np.float32(floor)
    vectors = work[0][:, :n]
    total, a, t, square, straight, s, q = (
        vectors[0], vectors[1], vectors[2], vectors[3], vectors[4], vectors[7], vectors[8],
    )  # fmt: skip
    t[:] = ZERO
    for c in range(scattered.shape[0]):
        f, light = np.float32(drift[c]), scattered[c]
        for i in range(n):
            t[i] += f * light[i]
    if not perceptual:
        for i in range(n):
            a[i], straight[i], square[i] = channels, ZERO, (total[i] - channels * y[i]) ** 2
        return
    roots = vectors[5]
    to_roots(y, least, s, q, work[1], work[2])
    for i in range(n):
        third = q[i] * q[i]
        slope = (y[i] * y[i] * THIRD + least * least) * third * third
        a[i] = channels * slope * slope
        t[i] *= slope * slope
        straight[i] = slope * slope * (total[i] - channels * y[i])
        square[i] = (slope * (roots[i] - channels * y[i] * q[i])) ** 2


@nb.njit(cache=True, nogil=True)
def weight_covariance(
    rows: Any, y: Any, perceptual: bool, floor: float, scattered: Any, drift: Any, x: Any, out: Any, work: Any
) -> None:
    """Covariance (m, m) of the weights above their bound 0, right after `fit_one` of a square lift; NaN for the others.

    Three parts: a sandwich of the residuals of whole rows (White 1980), which holds for noise of any size that the
    channels may share; what shares `drift` of the light `scattered` (channels, n) move the weights by, all at once; and
    the step to the linear fit of the same weights, since roots of noise are biased low (concave).
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
    if _factor(H, active, 0, k, L) >= 0:
        return  # collinear: any mixture of them is as good
    for p in range(k):
        push[:] = 0.0
        push[active[p]] = 1.0
        _solve(L, push, active, k, z)
        for c in range(k):
            inverse[p, c] = z[c] * length[active[p]] * length[active[c]]
    push[:] = b[:m]
    gram(rows, n, work[0][3, :n], work[0][4, :n], G, b, block)
    bent = np.zeros(k)
    for p in range(k):
        z[p] = 0.0
        for c in range(k):
            z[p] += inverse[p, c] * push[active[c]]
            bent[p] += inverse[p, c] * b[active[c]]
    for p in range(k):
        for c in range(k):
            total = 0.0
            for i in range(k):
                for j in range(k):
                    total += inverse[p, i] * G[active[i], active[j]] * inverse[j, c]
            out[active[p], active[c]] = total * n / (n - k) + z[p] * z[c] + bent[p] * bent[c]
    for p in range(k):
        if not out[active[p], active[p]] > 0.0:  # collinear up to the rounding of the Gram matrix
            out[:] = np.nan


@nb.njit(cache=True, nogil=True)
def relative_errors(found: Any, want: Any, floor: float, work: Any) -> tuple[float, float]:
    """RMS error over RMS of `want`, both (channels, n), linear and between roots; NaN where there is nothing."""
    n, least = want.shape[1], np.float32(floor)
    bits_in, bits_out, s, q, given = work[1], work[2], work[0][7, :n], work[0][8, :n], work[0][6, :n]
    sums = np.zeros(4)
    for c in range(want.shape[0]):
        to_roots(want[c], least, s, q, bits_in, bits_out)
        for i in range(n):
            given[i] = want[c, i] * q[i]
        to_roots(found[c], least, s, q, bits_in, bits_out)
        part = _squares(found[c], want[c], q, given)
        for k in range(4):
            sums[k] += part[k]
    if sums[1] > 0.0:
        return math.sqrt(sums[0] / sums[1]), math.sqrt(sums[2] / sums[3])
    return math.nan, math.nan


@nb.njit(cache=True, nogil=True)
def _power(value: float) -> float:
    """The power of two next above |value|; 1 for zero. Scaling by it loses nothing."""
    return math.ldexp(1.0, math.frexp(value)[1]) if value > 0.0 else 1.0


@nb.njit(cache=True, nogil=True)
def _to_order_one(
    part: Any, want: Any, w: Any, whole: bool, rows: Any, target: Any, weight: Any, lengths: Any
) -> float:
    """Copies of one surfel's rows, targets and weights scaled to order one; the targets' scale.

    Columns have a scale each in `lengths`, or one for all where `whole` (a lift mixes them).
    """
    for p in range(part.shape[1]):
        lengths[p] = np.abs(part[:, p]).max()
    if whole:
        lengths[:] = lengths.max()
    for p in range(part.shape[1]):
        lengths[p] = _power(lengths[p])
        for i in range(part.shape[0]):
            rows[i, p] = part[i, p] / lengths[p]
    scale, heaviest = _power(np.abs(want).max()), _power(w.max())
    for i in range(part.shape[0]):
        weight[i] = w[i] / heaviest
        for c in range(want.shape[1]):
            target[c, i] = want[i, c] / scale
    return scale


@nb.njit(cache=True, nogil=True)
def fit_many(
    rows: Any, offsets: Any, target: Any, weight: Any, lift: Any, perceptual: bool, floor: float,
    tolerance: float, least: int, x: Any, kkt: Any, iterations: Any, residual: Any, residual_root: Any, status: Any,
) -> None:  # fmt: skip
    """All surfels of a block; statuses are those of FitStatus."""
    most, square = 1, lift.shape[0] == lift.shape[1]
    for s in range(offsets.shape[0] - 1):
        most = max(most, offsets[s + 1] - offsets[s])
    width, channels = (lift.shape[0] + LANES - 1) // LANES * LANES, target.shape[1]
    work, y, single = workspace(most, width, lift.shape[1]), np.empty(most, np.float32), np.zeros(width, np.float32)
    scaled, aim, heavy = (
        np.zeros((most, width), np.float32),
        np.empty((channels, most), np.float32),
        np.empty(most, np.float32),
    )
    lengths, found = np.empty(lift.shape[0]), np.empty((channels, most), np.float32)
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
        scale = _to_order_one(part, want, w, not square, scaled, aim, heavy, lengths)
        level = max(floor / scale, SMALLEST)
        kkt[s], iterations[s], met, _ = fit_one(
            scaled, aim[:, :n], heavy, lift, perceptual, level, tolerance, x[s], work
        )
        status[s] = 0 if met else 5
        predict(scaled, n, coefficients(lift, x[s]), y, single)
        for c in range(channels):
            found[c, :n] = y[:n]
        residual[s], residual_root[s] = relative_errors(found[:, :n], aim[:, :n], level, work)
        for j in range(x.shape[1]):
            x[s, j] *= scale / (lengths[j] if square else lengths[0])
