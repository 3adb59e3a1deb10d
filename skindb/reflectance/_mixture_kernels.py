"""Compiled fits of mixtures to reflectance, linear and in cube-root space; see
`skindb.numerics.nnls`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skindb.jit import LANES, fast_kernel, kernel, vector_dots, vector_products
from skindb.numerics._nnls_kernels import (
    ActiveSetMemory,
    active_set_memory,
    invert,
    solve_scaled,
)
from skindb.reflectance._lumitexel_kernels import (
    RootMemory,
    inverse_root,
    root_memory,
    slopes,
    to_roots,
)
from skindb.types import (
    BoolVector,
    Matrix,
    Matrix32,
    Vector,
    Vector32,
)

# Gauss-Newton ends when a step lowers the misfit by less than this fraction
MIN_GAIN = 1e-4
ROWS_PER_SUM = 64  # rows summed in single precision before they are added in double
# for values of order one, so that its square is a normal number
MIN_NOISE_FLOOR = 1e-12
STEPS = 12  # Gauss-Newton steps at most
HALVINGS = 6  # of a step that does not lower the misfit
ZERO, HALF, THIRD, ONE, TWO = (np.float32(c) for c in (0, 1 / 2, 1 / 3, 1, 2))


class FitMemory(NamedTuple):
    """Memory for `fit_one`; each thread needs its own. Vectors hold one number per row
    in single precision.
    """

    root: RootMemory
    slope: Vector32  # weights of the linear problem
    aim: Vector32  # its right side
    predicted: Vector32
    roots: Vector32  # sum over channels of the cube roots of the targets
    reduced_gram: Matrix  # (width, width) in the space of the rows
    reduced_right: Vector  # (width,)
    gram: Matrix  # (m, m)
    right: Vector  # (m,)
    active_set: ActiveSetMemory  # of m columns, for `solve_scaled`
    moved: Vector  # (m,) weights of a step
    block: Matrix32  # (LANES + 1, LANES) sums in vector registers
    single: Vector32  # (width,) coefficients in single precision
    blocked: BoolVector  # (m,) columns whose weight is zero


@kernel
def fit_memory(size: int, width: int, m: int) -> FitMemory:
    """Memory for up to `size` rows."""
    v = np.empty((4, size), np.float32)
    return FitMemory(
        root_memory(size),
        v[0],
        v[1],
        v[2],
        v[3],
        np.empty((width, width)),
        np.empty(width),
        np.empty((m, m)),
        np.empty(m),
        active_set_memory(m),
        np.empty(m),
        np.empty((LANES + 1, LANES), np.float32),
        np.zeros(width, np.float32),
        np.zeros(m, np.bool_),
    )


class Problem(NamedTuple):
    """Samples of one surfel, all of about order one, as mixtures of rows."""

    rows: Matrix32  # (>= n, width)
    target: Matrix32  # (channels, >= n)
    weight: Vector32  # (>= n,)
    size: int  # n
    lift: Matrix  # (r, m) from the space of the rows; a square one is the identity
    perceptual: bool  # in cube-root space
    floor: float  # below which values are compared linearly
    tolerance: float  # largest KKT residual


@kernel
def gram(
    rows: Matrix32,
    n: int,
    a: Vector32,
    t: Vector32,
    G: Matrix,
    b: Vector,
    block: Matrix32,
) -> None:
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
                vector_products(rows, a, t, p, q, begin, end, block)
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
def predict(rows: Matrix32, n: int, c: Vector, y: Vector32, single: Vector32) -> None:
    """Write M c to y[:n]; `single` (width,) receives c in single precision, padded with zeros."""
    for j in range(c.shape[0]):
        single[j] = c[j]
    single[c.shape[0] :] = 0.0
    vector_dots(rows, single, n, y)


@kernel
def coefficients(lift: Matrix, x: Vector) -> Vector:
    """Coefficients in the reduced space; a square lift is the identity."""
    return x if lift.shape[0] == lift.shape[1] else np.dot(lift, x)


@kernel
def _solve_linear(
    p: Problem, x: Vector, work: FitMemory
) -> tuple[float, int, bool, float]:
    """Minimise the linear problem of `work.slope` and `work.aim` over x >= 0 with the
    warm start x.
    """
    gram(
        p.rows,
        p.size,
        work.slope,
        work.aim,
        work.reduced_gram,
        work.reduced_right,
        work.block,
    )
    return solve_equations(p, x, work)


@kernel
def solve_equations(
    p: Problem, x: Vector, work: FitMemory
) -> tuple[float, int, bool, float]:
    """Solve the normal equations `work.reduced_gram` and `reduced_right` for x >= 0 with
    the warm start x.
    """
    r = p.lift.shape[0]
    right = work.right
    if r == right.shape[0]:
        # loops here and below, because copies of arrays take seconds to compile
        for i in range(r):
            right[i] = work.reduced_right[i]
            for j in range(r):
                work.gram[i, j] = work.reduced_gram[i, j]
    else:
        np.dot(
            p.lift.T,
            np.dot(np.ascontiguousarray(work.reduced_gram[:r, :r]), p.lift),
            work.gram,
        )
        np.dot(p.lift.T, work.reduced_right[:r], right)
    for j in range(right.shape[0]):
        if work.blocked[j]:  # as an empty column
            right[j] = 0.0
            x[j] = 0.0
            for i in range(right.shape[0]):
                work.gram[i, j] = 0.0
                work.gram[j, i] = 0.0
    return solve_scaled(
        work.gram, right, x, p.tolerance, 6 * right.shape[0], work.active_set
    )


@kernel
def weigh_rows(p: Problem, x: Vector, work: FitMemory) -> None:
    """Write weights and right side of the linear problem of one surfel.

    In cube-root space, rows are weighted with the squared slopes of the cube root at M x.
    Unlike the distance in cube-root space, this fit is not biased by noise (the cube
    root is concave).
    """
    n = p.size
    channels = np.float32(p.target.shape[0])
    total = work.root.total
    for i in range(n):
        total[i], work.slope[i] = ZERO, ONE
    for c in range(p.target.shape[0]):
        for i in range(n):
            total[i] += p.target[c, i]
    if p.perceptual:
        predict(p.rows, n, coefficients(p.lift, x), work.predicted, work.single)
        slopes(work.predicted[:n], np.float32(p.floor), work.slope)
    for i in range(n):
        work.slope[i] *= p.weight[i]
        work.aim[i] = work.slope[i] * total[i]
        work.slope[i] *= channels


@kernel
def fit_one(p: Problem, x: Vector, work: FitMemory) -> tuple[float, int, bool, float]:
    """Fit one surfel and write the weights to x.

    Channels share the rows, so each row enters once with summed targets. In cube-root
    space, x is the start unless it is zero, and a last step fits linearly with the
    weights found. Returns the KKT residual, the iterations, whether it converged, and
    the condition.
    """
    count = 0
    if p.perceptual:
        count = _fit_roots(p, x, work)
    else:
        x[:] = 0.0
    weigh_rows(p, x, work)
    kkt, last, converged, condition = _solve_linear(p, x, work)
    return kkt, count + last, converged, condition


@fast_kernel
def _misfit(
    y: Vector32, q: Vector32, weight: Vector32, channels: np.float32, roots: Vector32
) -> float:
    """Squared distance in cube-root space, without the terms that do not depend on the
    prediction y; q is from `to_roots`.
    """
    total = 0.0
    for i in range(y.shape[0]):
        r = y[i] * q[i]
        total += weight[i] * r * (channels * r - TWO * roots[i])
    return total


@fast_kernel
def _linearise(
    n: int, weight: Vector32, channels: np.float32, floor: np.float32, work: FitMemory
) -> None:
    """Weights and right side of the linear problem of a Gauss-Newton step in cube-root
    space at `work.predicted`.
    """
    y = work.predicted
    q = work.root.inverse
    for i in range(n):
        square = q[i] * q[i]
        slope = (y[i] * y[i] * THIRD + floor * floor) * square * square
        work.slope[i] = weight[i] * channels * slope * slope
        work.aim[i] = (
            weight[i]
            * slope
            * (channels * slope * y[i] + work.roots[i] - channels * y[i] * q[i])
        )


@fast_kernel
def _sum_channels(p: Problem, floor: np.float32, work: FitMemory) -> None:
    """Write the sums over channels of the targets and of their cube roots."""
    n = p.size
    total = work.root.total
    for i in range(n):
        total[i], work.roots[i] = ZERO, ZERO
    for c in range(p.target.shape[0]):
        target = p.target[c]
        for i in range(n):
            t = target[i]
            total[i] += t
            work.roots[i] += t * inverse_root(t * t + floor * floor)


@kernel
def _step_from_data(p: Problem, floor: np.float32, x: Vector, work: FitMemory) -> int:
    """A first step that linearises at the data; returns the iterations."""
    n = p.size
    channels = np.float32(p.target.shape[0])
    for i in range(n):
        work.predicted[i] = max(work.root.total[i], ZERO) / channels
    to_roots(work.predicted[:n], floor, work.root.inverse)
    _linearise(n, p.weight, channels, floor, work)
    _, count, _, _ = _solve_linear(p, x, work)
    return count


@kernel
def _search_line(
    p: Problem, floor: np.float32, best: float, work: FitMemory
) -> tuple[np.float32, float]:
    """Largest step from `work.predicted` towards `work.root.trial` that lowers the
    misfit, and its misfit; writes its prediction to `work.root.mixed`.

    Predictions are linear in x, so a shorter step needs no solve and stays non-negative.
    """
    n = p.size
    y = work.predicted
    trial = work.root.trial
    mixed = work.root.mixed[:n]
    step = ONE
    value = best
    for _ in range(HALVINGS):
        for i in range(n):
            mixed[i] = y[i] + step * (trial[i] - y[i])
        to_roots(mixed, floor, work.root.inverse)
        value = _misfit(
            mixed,
            work.root.inverse[:n],
            p.weight,
            np.float32(p.target.shape[0]),
            work.roots[:n],
        )
        if value < best:
            break
        step *= HALF
    return step, value


@kernel
def _fit_roots(p: Problem, x: Vector, work: FitMemory) -> int:
    """Minimise the distance in cube-root space by Gauss-Newton with a line search;
    returns the iterations.
    """
    n = p.size
    channels = np.float32(p.target.shape[0])
    floor = np.float32(p.floor)
    y = work.predicted[:n]
    roots = work.roots[:n]
    started = False
    for j in range(x.shape[0]):
        started = started or x[j] > 0.0
    _sum_channels(p, floor, work)
    count = 0
    if not started:
        count = _step_from_data(p, floor, x, work)
    predict(p.rows, n, coefficients(p.lift, x), y, work.single)
    to_roots(y, floor, work.root.inverse)
    level = 0.0
    for i in range(n):
        level += p.weight[i] * roots[i] * roots[i] / channels
    best = _misfit(y, work.root.inverse[:n], p.weight, channels, roots)
    for _ in range(STEPS):
        _linearise(n, p.weight, channels, floor, work)
        for j in range(x.shape[0]):
            work.moved[j] = x[j]
        _, more, _, _ = _solve_linear(p, work.moved, work)
        count += more
        prediction = coefficients(p.lift, work.moved)
        predict(p.rows, n, prediction, work.root.trial, work.single)
        step, value = _search_line(p, floor, best, work)
        if not value < best:
            break
        for i in range(n):
            y[i] = work.root.mixed[i]
        for j in range(x.shape[0]):
            x[j] += step * (work.moved[j] - x[j])
        gain = best - value
        best = value
        if gain < MIN_GAIN * (best + level):
            break
    return int(count)


@fast_kernel
def _scores(
    p: Problem, y: Vector32, scattered: Matrix32, drift: Vector, work: FitMemory
) -> None:
    """Write to `work`, per row at the solution, the slopes, the right side due to
    drift, and the squared scores.
    """
    n = p.size
    channels = np.float32(scattered.shape[0])
    total = work.root.total
    a = work.slope
    t = work.aim
    square = work.root.trial
    for i in range(n):
        t[i], a[i] = ZERO, ONE
    if p.perceptual:
        slopes(y[:n], np.float32(p.floor), a)
    for i in range(n):
        a[i] *= p.weight[i]
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
    problem: Problem,
    y: Vector32,
    scattered: Matrix32,
    drift: Vector,
    x: Vector,
    spread: float,
    out: Matrix,
    work: FitMemory,
) -> None:
    """Covariance (m, m) of the positive weights, directly after `fit_one` with a square
    lift; NaN for the others.

    `y` (n,) is the prediction, and `spread` the factor by which the weights of the rows
    make the first part too small.

    The covariance has two parts: a sandwich estimate from the residuals of whole rows
    (White 1980), which is valid for noise of any size that the channels may share; and
    the shift of the weights that is caused by a fraction `drift` of the light
    `scattered` (channels, n).
    """
    m = x.shape[0]
    n = problem.size
    G = work.reduced_gram
    b = work.reduced_right
    out[:] = np.nan
    active = np.empty(m, np.int64)
    k = 0
    for j in range(m):
        if x[j] > 0.0:
            active[k] = j
            k += 1
    if k == 0 or n <= k:
        return
    _scores(problem, y, scattered, drift, work)
    gram(problem.rows, n, work.slope, work.aim, G, b, work.block)
    inverse = np.zeros((m, m))
    if not invert(G, active, k, work.gram, work.active_set.factor, inverse):
        return  # collinear columns: all their mixtures fit equally well
    shift = np.zeros(m)
    for p in range(k):
        for c in range(k):
            shift[p] += inverse[p, c] * b[active[c]]
    gram(problem.rows, n, work.root.trial, work.aim, G, b, work.block)
    for p in range(k):
        for c in range(k):
            total = 0.0
            for i in range(k):
                for j in range(k):
                    total += inverse[p, i] * G[active[i], active[j]] * inverse[j, c]
            out[active[p], active[c]] = (
                spread * total * n / (n - k) + shift[p] * shift[c]
            )
    for p in range(k):
        # collinear up to the rounding of the Gram matrix
        if not out[active[p], active[p]] > 0.0:
            out[:] = np.nan
