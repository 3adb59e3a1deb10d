"""Compiled fits of mixtures to reflectance, linear and in cube-root space; see
`skindb.numerics.nnls`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from skindb.jit import LANES, dots, fast_kernel, kernel, products
from skindb.numerics._nnls_kernels import active_set_memory, factor, solve, solve_scaled

# Gauss-Newton ends when a step lowers the misfit by less than this fraction
MIN_GAIN = 1e-4
ROWS_PER_SUM = 64  # rows summed in single precision before they are added in double
# for values of order one, so that its square is a normal number
MIN_NOISE_FLOOR = 1e-12
# bits of s^(-1/3) plus a third of the bits of s; accurate to 4 %
MAGIC = np.float32(1419967116.0)
ZERO, HALF, THIRD, ONE, TWO, TWO_NINTHS = (
    np.float32(c) for c in (0, 1 / 2, 1 / 3, 1, 2, 2 / 9)
)


@fast_kernel
def inverse_roots(s: Any, out: Any, bits_in: Any, bits_out: Any) -> None:
    """Write s^(-1/3) to `out` for positive float32 s; `bits_*` are int32 views of the same memory.

    A start from a third of the exponent bits, then two iterations of third order:
    accurate to rounding, and unlike `pow` it runs in vector registers.
    """
    for i in range(s.shape[0]):
        bits_out[i] = np.int32(MAGIC - np.float32(bits_in[i]) * THIRD)
    for i in range(s.shape[0]):
        x = out[i]
        for _ in range(2):
            d = ONE - s[i] * x * x * x
            x += x * d * (THIRD + d * TWO_NINTHS)
        out[i] = x


class FitMemory(NamedTuple):
    """Memory for `fit_one`; each thread needs its own. Vectors hold one number per row
    in single precision.
    """

    total: Any  # sum of the targets over channels
    slope: Any  # weights of the linear problem
    aim: Any  # its right side
    predicted: Any
    trial: Any  # prediction of a step
    roots: Any  # sum over channels of the cube roots of the targets
    mixed: Any  # prediction of a shorter step
    square: Any  # squared values plus the squared noise floor
    inverse: Any  # `square` to the power -1/3
    square_bits: Any  # the same memory as int32
    inverse_bits: Any
    reduced_gram: Any  # (width, width) in the space of the rows
    reduced_right: Any  # (width,)
    gram: Any  # (m, m)
    right: Any  # (m,)
    active_set: Any  # of m columns, for `solve_scaled`
    new: Any  # (m,) weights of a step
    block: Any  # (LANES + 1, LANES) sums in vector registers
    single: Any  # (width,) coefficients in single precision


@kernel
def fit_memory(most: int, width: int, m: int) -> Any:
    """Memory for up to `most` rows."""
    v = np.empty((9, most), np.float32)
    return FitMemory(
        v[0],
        v[1],
        v[2],
        v[3],
        v[4],
        v[5],
        v[6],
        v[7],
        v[8],
        v[7].view(np.int32),
        v[8].view(np.int32),
        np.empty((width, width)),
        np.empty(width),
        np.empty((m, m)),
        np.empty(m),
        active_set_memory(m),
        np.empty(m),
        np.empty((LANES + 1, LANES), np.float32),
        np.zeros(width, np.float32),
    )


@kernel
def gram(rows: Any, n: int, a: Any, t: Any, G: Any, b: Any, block: Any) -> None:
    """Write G = M' a M and b = M' t of the first n rows, whose width is a multiple of
    LANES (padded with zeros).

    Sums of ROWS_PER_SUM rows in single precision stay in registers and are added in
    double, with a rounding error of about 1e-8.
    """
    width = rows.shape[1]
    G[:], b[:] = 0.0, 0.0
    for begin in range(0, n, ROWS_PER_SUM):
        end = min(begin + ROWS_PER_SUM, n)
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


@kernel
def predict(rows: Any, n: int, c: Any, y: Any, single: Any) -> None:
    """Write M c to y[:n]; `single` (width,) receives c in single precision, padded with zeros."""
    for j in range(c.shape[0]):
        single[j] = c[j]
    single[c.shape[0] :] = 0.0
    dots(rows, single, n, y)


@fast_kernel
def to_roots(y: Any, floor: Any, s: Any, q: Any, bits_in: Any, bits_out: Any) -> None:
    """Write s = y^2 + floor^2 and q = s^(-1/3); y q is the value of y in cube-root space."""
    for i in range(y.shape[0]):
        s[i] = y[i] * y[i] + floor * floor
    inverse_roots(s, q, bits_in, bits_out)


@fast_kernel
def _misfit(y: Any, q: Any, weight: Any, channels: Any, roots: Any) -> float:
    """Squared distance in cube-root space, without the terms that do not depend on the
    prediction.
    """
    total = 0.0
    for i in range(y.shape[0]):
        r = y[i] * q[i]
        total += weight[i] * r * (channels * r - TWO * roots[i])
    return total


@fast_kernel
def _linearise(
    y: Any, q: Any, weight: Any, channels: Any, roots: Any, floor: Any, a: Any, t: Any
) -> None:
    """Weights and right side of the linear problem of a Gauss-Newton step in cube-root
    space at y.
    """
    for i in range(y.shape[0]):
        square = q[i] * q[i]
        slope = (y[i] * y[i] * THIRD + floor * floor) * square * square
        a[i] = weight[i] * channels * slope * slope
        t[i] = (
            weight[i]
            * slope
            * (channels * slope * y[i] + roots[i] - channels * y[i] * q[i])
        )


@kernel
def coefficients(lift: Any, x: Any) -> Any:
    """Coefficients in the reduced space; a square lift is the identity."""
    return x if lift.shape[0] == lift.shape[1] else np.dot(lift, x)


@kernel
def _weighted(rows: Any, n: int, lift: Any, tolerance: float, x: Any, work: Any) -> Any:
    """Minimise the linear problem of `work.slope` and `work.aim` over x >= 0 with the
    warm start x.
    """
    r = lift.shape[0]
    right = work.right
    gram(
        rows, n, work.slope, work.aim, work.reduced_gram, work.reduced_right, work.block
    )
    if r == right.shape[0]:
        # loops here and below, because copies of arrays take seconds to compile
        for i in range(r):
            right[i] = work.reduced_right[i]
            for j in range(r):
                work.gram[i, j] = work.reduced_gram[i, j]
    else:
        np.dot(
            lift.T,
            np.dot(np.ascontiguousarray(work.reduced_gram[:r, :r]), lift),
            work.gram,
        )
        np.dot(lift.T, work.reduced_right[:r], right)
    return solve_scaled(
        work.gram, right, x, tolerance, 6 * right.shape[0], work.active_set
    )


@fast_kernel
def slopes(
    y: Any, floor: Any, s: Any, q: Any, bits_in: Any, bits_out: Any, out: Any
) -> None:
    """Write the squared slope of the cube root at y: the weight of a squared difference
    at y in cube-root space.
    """
    to_roots(y, floor, s, q, bits_in, bits_out)
    for i in range(y.shape[0]):
        square = q[i] * q[i]
        slope = (y[i] * y[i] * THIRD + floor * floor) * square * square
        out[i] = slope * slope


@kernel
def fit_weighted(
    rows: Any,
    target: Any,
    weight: Any,
    lift: Any,
    perceptual: bool,
    floor: float,
    tolerance: float,
    x: Any,
    work: Any,
) -> Any:
    """Fit one surfel linearly with the warm start x, target (channels, n).

    If `perceptual`, rows are weighted with the squared slopes of the cube root at M x.
    Unlike the distance in cube-root space, this fit is not biased by noise (the cube
    root is concave). Returns the KKT residual, the iterations, whether it converged,
    and the condition.
    """
    n = target.shape[1]
    channels = np.float32(target.shape[0])
    least = np.float32(floor)
    for i in range(n):
        work.total[i], work.slope[i] = ZERO, ONE
    for c in range(target.shape[0]):
        for i in range(n):
            work.total[i] += target[c, i]
    if perceptual:
        predict(rows, n, coefficients(lift, x), work.predicted, work.single)
        slopes(
            work.predicted[:n],
            least,
            work.square,
            work.inverse,
            work.square_bits,
            work.inverse_bits,
            work.slope,
        )
    for i in range(n):
        work.slope[i] *= weight[i]
        work.aim[i] = work.slope[i] * work.total[i]
        work.slope[i] *= channels
    return _weighted(rows, n, lift, tolerance, x, work)


@kernel
def fit_one(
    rows: Any,
    target: Any,
    weight: Any,
    lift: Any,
    perceptual: bool,
    floor: float,
    tolerance: float,
    x: Any,
    work: Any,
) -> Any:
    """Fit one surfel, target (channels, n), and write the weights to x; all in single
    precision and of about order one.

    A square lift is the identity. Channels share the rows, so each row enters once with
    summed targets. In cube-root space, x is the start unless it is zero, and a last
    step fits linearly with the weights found. Returns the KKT residual, the iterations,
    whether it converged, and the condition.
    """
    count = 0
    if perceptual:
        count = _fit_roots(rows, target, weight, lift, floor, tolerance, x, work)
    else:
        x[:] = 0.0
    # a variable, so that the function is compiled only once: each constant would have
    # its own compiled version
    kkt, more, met, condition = fit_weighted(
        rows, target, weight, lift, perceptual, floor, tolerance, x, work
    )
    return kkt, count + more, met, condition


@kernel
def _fit_roots(
    rows: Any,
    target: Any,
    weight: Any,
    lift: Any,
    floor: float,
    tolerance: float,
    x: Any,
    work: Any,
) -> int:
    """Minimise the distance in cube-root space by Gauss-Newton with a line search;
    returns the iterations.
    """
    n = target.shape[1]
    channels = np.float32(target.shape[0])
    least = np.float32(floor)
    y = work.predicted[:n]
    trial = work.trial[:n]
    mixed = work.mixed[:n]
    roots = work.roots[:n]
    s = work.square[:n]
    q = work.inverse[:n]
    bits_in = work.square_bits
    bits_out = work.inverse_bits
    a = work.slope[:n]
    t = work.aim[:n]
    total = work.total[:n]
    started = False
    for j in range(x.shape[0]):
        started = started or x[j] > 0.0
    total[:], roots[:] = ZERO, ZERO
    for c in range(target.shape[0]):
        to_roots(target[c], least, s, q, bits_in, bits_out)
        for i in range(n):
            total[i] += target[c, i]
            roots[i] += target[c, i] * q[i]
    count = 0
    if not started:
        for i in range(n):  # the first step linearises at the data
            y[i] = max(total[i], ZERO) / channels
        to_roots(y, least, s, q, bits_in, bits_out)
        _linearise(y, q, weight, channels, roots, least, a, t)
        _, count, _, _ = _weighted(rows, n, lift, tolerance, x, work)
    predict(rows, n, coefficients(lift, x), y, work.single)
    to_roots(y, least, s, q, bits_in, bits_out)
    level = 0.0
    for i in range(n):
        level += weight[i] * roots[i] * roots[i] / channels
    best = _misfit(y, q, weight, channels, roots)
    for _ in range(12):
        _linearise(y, q, weight, channels, roots, least, a, t)
        for j in range(x.shape[0]):
            work.new[j] = x[j]
        _, more, _, _ = _weighted(rows, n, lift, tolerance, work.new, work)
        count += more
        predict(rows, n, coefficients(lift, work.new), trial, work.single)
        step: Any = ONE
        value = best
        # predictions are linear in x, so a shorter step needs no solve and stays
        # non-negative
        for _ in range(6):
            for i in range(n):
                mixed[i] = y[i] + step * (trial[i] - y[i])
            to_roots(mixed, least, s, q, bits_in, bits_out)
            value = _misfit(mixed, q, weight, channels, roots)
            if value < best:
                break
            step *= HALF
        if not value < best:
            break
        for i in range(n):
            y[i] = mixed[i]
        for j in range(x.shape[0]):
            x[j] += step * (work.new[j] - x[j])
        gain = best - value
        best = value
        if gain < MIN_GAIN * (best + level):
            break
    return int(count)


@fast_kernel
def _squares(
    found: Any, want: Any, q: Any, roots: Any
) -> tuple[float, float, float, float]:
    """Sums of squared differences and of squared values, linear and in cube-root space.

    In cube-root space the prediction is `found` q and the target is `roots`.
    """
    wrong = 0.0
    whole = 0.0
    wrong_root = 0.0
    whole_root = 0.0
    for i in range(want.shape[0]):
        d = found[i] - want[i]
        e = found[i] * q[i] - roots[i]
        wrong += d * d
        whole += want[i] * want[i]
        wrong_root += e * e
        whole_root += roots[i] * roots[i]
    return wrong, whole, wrong_root, whole_root


@kernel
def relative_errors(
    found: Any, want: Any, floor: float, work: Any
) -> tuple[float, float]:
    """RMS error over RMS of `want`, both (channels, n), linear and in cube-root space;
    NaN if `want` is zero.
    """
    n = want.shape[1]
    least = np.float32(floor)
    s = work.square[:n]
    q = work.inverse[:n]
    given = work.mixed[:n]
    bits_in = work.square_bits
    bits_out = work.inverse_bits
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


@kernel
def _power(value: float) -> float:
    """Next power of two above |value|, 1 for zero; scaling by it is exact."""
    return math.ldexp(1.0, math.frexp(value)[1]) if value > 0.0 else 1.0


@kernel
def _to_order_one(
    part: Any,
    want: Any,
    w: Any,
    whole: bool,
    rows: Any,
    target: Any,
    weight: Any,
    lengths: Any,
) -> float:
    """Copy one surfel's rows, targets and weights, scaled to order one; returns the
    scale of the targets.

    `lengths` receives the scale of each column, or the same scale for all if `whole`
    (when a lift mixes the columns).
    """
    for p in range(part.shape[1]):
        lengths[p] = np.abs(part[:, p]).max()
    if whole:
        lengths[:] = lengths.max()
    for p in range(part.shape[1]):
        lengths[p] = _power(lengths[p])
        for i in range(part.shape[0]):
            rows[i, p] = part[i, p] / lengths[p]
    scale = _power(np.abs(want).max())
    heaviest = _power(w.max())
    for i in range(part.shape[0]):
        weight[i] = w[i] / heaviest
        for c in range(want.shape[1]):
            target[c, i] = want[i, c] / scale
    return scale


@kernel
def fit_many(
    rows: Any,
    offsets: Any,
    target: Any,
    weight: Any,
    lift: Any,
    perceptual: bool,
    floor: float,
    tolerance: float,
    least: int,
    x: Any,
    kkt: Any,
    iterations: Any,
    residual: Any,
    residual_root: Any,
    status: Any,
) -> None:
    """Fit all surfels of a block; statuses are those of FitStatus."""
    most = 1
    square = lift.shape[0] == lift.shape[1]
    for s in range(offsets.shape[0] - 1):
        most = max(most, offsets[s + 1] - offsets[s])
    width = (lift.shape[0] + LANES - 1) // LANES * LANES
    channels = target.shape[1]
    work = fit_memory(most, width, lift.shape[1])
    y = np.empty(most, np.float32)
    single = np.zeros(width, np.float32)
    scaled = np.zeros((most, width), np.float32)
    aim = np.empty((channels, most), np.float32)
    heavy = np.empty(most, np.float32)
    lengths = np.empty(lift.shape[0])
    found = np.empty((channels, most), np.float32)
    for s in range(offsets.shape[0] - 1):
        lo = offsets[s]
        hi = offsets[s + 1]
        n = hi - lo
        if n < least:
            status[s] = 2
            continue
        part = rows[lo:hi]
        want = target[lo:hi]
        w = weight[lo:hi]
        if not (
            np.isfinite(part).all()
            and np.isfinite(want).all()
            and np.isfinite(w).all()
            and w.min() >= 0.0
        ):
            status[s] = 6
            continue
        scale = _to_order_one(part, want, w, not square, scaled, aim, heavy, lengths)
        level = max(floor / scale, MIN_NOISE_FLOOR)
        x[s] = 0.0
        kkt[s], iterations[s], met, _ = fit_one(
            scaled, aim[:, :n], heavy, lift, perceptual, level, tolerance, x[s], work
        )
        status[s] = 0 if met else 5
        predict(scaled, n, coefficients(lift, x[s]), y, single)
        for c in range(channels):
            found[c, :n] = y[:n]
        residual[s], residual_root[s] = relative_errors(
            found[:, :n], aim[:, :n], level, work
        )
        for j in range(x.shape[1]):
            x[s, j] *= scale / (lengths[j] if square else lengths[0])


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
