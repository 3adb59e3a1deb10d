"""Compiled separation of diffuse from surface reflection, surfel by surfel; the method
is in `skindb.reflectance.separation`.

Sums over samples run in single precision and in vector registers; systems of equations are double.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skindb.jit import (
    LANES,
    all_finite,
    fast_kernel,
    inline_kernel,
    kernel,
    largest_finite,
    scale_to_one,
    unpack,
    vector_dots,
    vector_products,
)
from skindb.numerics._nnls_kernels import (
    ActiveSetMemory,
    active_set_memory,
    invert,
    solve_scaled,
)
from skindb.reflectance._lumitexel_kernels import (
    MIN_COSINE_SURFACE,
    MIN_SAMPLES_GLOSS,
    MIN_SAMPLES_LAMBERT,
    MODEL_ERROR,
    UNSEEN,
    Lumitexel,
    block_memory,
    choose,
    cosine_between,
    sample_status,
    surface_factor,
    tangents,
    write_cosines,
    write_directions,
    write_gloss,
    write_noise,
    write_rows,
)
from skindb.reflectance._shade_kernels import transmittance
from skindb.reflectance.model import Block
from skindb.types import (
    IntMatrix32,
    Matrix,
    Matrix32,
    Tensor32,
    Vector,
    Vector32,
)

# to light or camera; below it F_t and the footprint of a pixel change too fast
MIN_COSINE_ALBEDO = 0.25
# of crossed samples, to be used alone
MIN_SAMPLES_ALBEDO = 10
# of crossed polarisers, relative to depolarised light: theta_d up to 39 degrees
MAX_GLOSS_CROSSED = 0.3
TUKEY = 4.685  # 95 % efficiency for normal noise
# standard deviation over mean absolute deviation of normal noise
MEAN_TO_SIGMA = 1.2533
# mean slope of the influence function over mean weight, 0.86 for normal noise; reliable
# above this
MIN_BEND = 0.3
# sr^-1; the errors of darker samples are not proportional to their value
NOISE_FLOOR_ALBEDO = 0.01
MIN_RELATIVE_SCALE = 0.005  # differences by rounding must not produce outliers
# number of reweighting steps
SLOPE_STEPS = 5
LOBE_STEPS = 4
ROWS_PER_SUM = 64  # rows summed in single precision before they are added in double
# columns of the rows: lobes, then the diffuse shape, then padding
LOBES = 6
SHAPE = 6
COLUMNS = 8
MAX_SAMPLE = 1e6  # sr^-1
MIN_SINE = 1e-3  # of the angle of the half vector; the lobes are flat below it
ZERO = np.float32(0)
ONE = np.float32(1)


class Separation(NamedTuple):
    """Buffers for `separate`; one set per thread."""

    shape: Vector32  # (rows,) cos(theta_i) F_t F_t / pi
    mean: Vector32  # (rows,) mean of the channels
    tint: Vector32  # (rows,) a channel minus the mean
    keep: Vector32  # (rows,) Tukey weights
    weight: Vector32  # (rows,) weights of the linear problem
    aim: Vector32  # (rows,) weighted target
    residual: Vector32  # (rows,)
    predicted: Vector32  # (rows,)
    level: Vector32  # (rows,) scale of the residuals
    pull: Vector32  # (rows,) derivative of R_d with respect to each sample
    mixture: Vector32  # (2 COLUMNS,) weights of the columns in single precision
    gram: Matrix  # (COLUMNS, COLUMNS)
    scaled: Matrix  # (COLUMNS, COLUMNS)
    right: Vector  # (COLUMNS,)
    x: Vector  # (COLUMNS,)
    active_set: ActiveSetMemory  # of COLUMNS columns, for `solve_scaled`
    block: Matrix32  # (LANES + 1, LANES)


@kernel
def separation_memory(samples: int) -> Separation:
    """Buffers for up to this many samples of a surfel."""
    v = np.empty((10, samples), np.float32)
    return Separation(
        v[0],
        v[1],
        v[2],
        v[3],
        v[4],
        v[5],
        v[6],
        v[7],
        v[8],
        v[9],
        np.zeros(2 * COLUMNS, np.float32),
        np.empty((COLUMNS, COLUMNS)),
        np.empty((COLUMNS, COLUMNS)),
        np.empty(COLUMNS),
        np.zeros(COLUMNS),
        active_set_memory(COLUMNS),
        np.empty((LANES + 1, LANES), np.float32),
    )


@fast_kernel
def robust_slope(
    x: Vector32, y: Vector32, weight: Vector32, residual: Vector32, n: int
) -> tuple[float, float]:
    """Slope of y on x through the origin by Tukey weights, and its standard error
    (Huber's sandwich).

    On return, `weight` holds the change of the slope by the residual of each sample.
    """
    for i in range(n):
        weight[i] = ONE
    slope = 0.0
    norm = 1.0
    inverse = ZERO
    for step in range(SLOPE_STEPS):
        xx = ZERO
        xy = ZERO
        for i in range(n):
            wx = weight[i] * x[i]
            xx += wx * x[i]
            xy += wx * y[i]
        norm = max(np.float64(xx), 1e-12)
        slope = np.float64(xy) / norm
        single_slope = np.float32(slope)
        absolute = ZERO
        total = ZERO
        for i in range(n):
            residual[i] = y[i] - single_slope * x[i]
            absolute += weight[i] * abs(residual[i])
            total += weight[i]
        scale = MEAN_TO_SIGMA * np.float64(absolute) / max(np.float64(total), 1e-12)
        inverse = np.float32(1.0 / max(TUKEY * scale, 1e-12) ** 2)
        if step < SLOPE_STEPS - 1:
            for i in range(n):
                u = ONE - residual[i] * residual[i] * inverse
                weight[i] = u * u if u > ZERO else ZERO
    meat = ZERO
    bend = ZERO
    for i in range(n):
        u = residual[i] * residual[i] * inverse
        # with x squared, as noise that grows with x is downweighted most where x has
        # the largest weight
        bend += (
            ((ONE - u) * (ONE - np.float32(5) * u) if u < ONE else ZERO) * x[i] * x[i]
        )
        score = weight[i] * residual[i] * x[i]
        meat += score * score
        weight[i] = score
    steep = max(np.float64(bend) / norm, MIN_BEND) * norm
    for i in range(n):
        weight[i] *= np.float32(1.0 / steep)
    return slope, math.sqrt(np.float64(meat) * n / max(n - 1.0, 1.0)) / steep


@kernel
def _normal_equations(rows: Matrix32, n: int, s: Separation) -> None:
    """Write M' w M and M' (w y) of the first COLUMNS columns to `s.gram` and `s.right`."""
    s.gram[:] = 0.0
    s.right[:] = 0.0
    for begin in range(0, n, ROWS_PER_SUM):
        vector_products(
            rows, s.weight, s.aim, 0, 0, begin, min(begin + ROWS_PER_SUM, n), s.block
        )
        for j in range(COLUMNS):
            for k in range(COLUMNS):
                s.gram[j, k] += s.block[j, k]
            s.right[j] += s.block[COLUMNS, j]


@fast_kernel
def _weigh(n: int, noise: Matrix32, s: Separation) -> tuple[float, float]:
    """Tukey weights of the relative residuals; returns the sums of the weights and of
    the influence function's slope.

    Residuals are relative to the prediction, or to the noise where that exceeds
    MODEL_ERROR of the prediction.
    """
    floor = np.float32(NOISE_FLOOR_ALBEDO)
    absolute = ZERO
    total = ZERO
    # the mean of three channels has a third of the variance
    factor = np.float32(1.0 / (3.0 * MODEL_ERROR**2))
    for i in range(n):
        level = s.predicted[i] if s.predicted[i] > floor else floor
        s.level[i] = ONE / np.sqrt(
            level * level + factor * (noise[0, i] + noise[1, i] * level)
        )
        s.residual[i] = (s.mean[i] - s.predicted[i]) * s.level[i]
        absolute += s.keep[i] * abs(s.residual[i])
        total += s.keep[i]
    scale = (
        MEAN_TO_SIGMA * np.float64(absolute) / max(np.float64(total), 1e-12)
        + MIN_RELATIVE_SCALE
    )
    inverse = np.float32(1.0 / (TUKEY * scale) ** 2)
    weights = ZERO
    slope = ZERO
    for i in range(n):
        u = s.residual[i] * s.residual[i] * inverse
        inside = u < ONE
        keep = (ONE - u) * (ONE - u) if inside else ZERO
        slope += (ONE - u) * (ONE - np.float32(5) * u) if inside else ZERO
        weights += keep
        s.keep[i] = keep
        s.weight[i] = keep * s.level[i] * s.level[i]
        s.aim[i] = s.weight[i] * s.mean[i]
    return np.float64(weights), np.float64(slope)


@fast_kernel
def _pull(n: int, s: Separation) -> float:
    """Convert projections of the rows in `s.predicted` to pulls; returns the sum of
    squared pulls times residuals.
    """
    meat = ZERO
    for i in range(n):
        s.pull[i] = s.predicted[i] * s.weight[i]
        moved = s.pull[i] * s.residual[i] / s.level[i]
        meat += moved * moved
    return np.float64(meat)


@kernel
def _predict(
    rows: Matrix32, n: int, x: Vector, begin: int, s: Separation, out: Vector32
) -> None:
    """Write the mixture of the COLUMNS columns from `begin` on."""
    s.mixture[:] = ZERO
    for j in range(COLUMNS):
        s.mixture[begin + j] = x[j]
    vector_dots(rows, s.mixture, n, out)


@kernel
def fit_shape(
    rows: Matrix32, n: int, noise: Matrix32, s: Separation
) -> tuple[float, float]:
    """Weight of the diffuse shape in the mean channel by robust non-negative least
    squares, and its standard error.

    `noise` (2, n) is the variance of a channel at reflectance 0 and its slope; zeros
    where it is unknown. On return, `s.x` holds the weights of all columns, `s.pull` the
    derivative of the result by each sample, and `s.aim` the change of the result by the
    residual of each sample.
    """
    floor = np.float32(NOISE_FLOOR_ALBEDO)
    for i in range(n):
        level = max(s.mean[i], floor)
        s.keep[i] = ONE
        s.weight[i] = ONE / (level * level)
        s.aim[i] = s.weight[i] * s.mean[i]
    s.x[:] = 0.0
    total = 1.0
    slope = 1.0
    for _ in range(LOBE_STEPS):
        _normal_equations(rows, n, s)
        solve_scaled(s.gram, s.right, s.x, 1e-10, 6 * COLUMNS, s.active_set)
        _predict(rows, n, s.x, 0, s, s.predicted)
        total, slope = _weigh(n, noise, s)
    active = np.empty(COLUMNS, np.int64)
    k = 0
    place = -1
    for j in range(COLUMNS):
        if s.x[j] > 0.0:  # columns without weight do not contribute to the uncertainty
            place = k if j == SHAPE else place
            active[k] = j
            k += 1
    if place < 0:
        s.pull[:n] = ZERO
        s.aim[:n] = ZERO
        return 0.0, 0.0
    _normal_equations(rows, n, s)
    inverse = np.empty((COLUMNS, COLUMNS))
    if not invert(s.gram, active, k, s.scaled, s.active_set.factor, inverse):
        s.pull[:n] = ZERO
        s.aim[:n] = ZERO
        return s.x[SHAPE], math.nan
    s.right[:] = 0.0
    for p in range(k):
        s.right[active[p]] = inverse[place, p]
    _predict(rows, n, s.right, 0, s, s.predicted)
    meat = _pull(n, s)
    bend = max(slope / max(total, 1e-12), MIN_BEND)
    for i in range(n):
        s.aim[i] = s.pull[i] * s.residual[i] / (s.level[i] * np.float32(bend))
    return s.x[SHAPE], math.sqrt(meat * n / max(n - k, 1)) / bend


@kernel
def _slide(axes: Matrix, eta: float, towards: Matrix, cosine: Vector) -> Matrix:
    """Effect (devices, 4) of a rotation of the normal by one radian towards two axes
    (2, 3): for each, change of the cosine and relative change of F_t.
    """
    moved = np.zeros((cosine.shape[0], 4))
    for i in range(cosine.shape[0]):
        if cosine[i] > 0.0:
            steep = _relative_slope(cosine[i], eta)
            for q in range(2):
                for k in range(3):
                    moved[i, 2 * q] += axes[q, k] * towards[i, k]
                moved[i, 2 * q + 1] = moved[i, 2 * q] * steep
    return moved


@inline_kernel
def _relative_slope(c: float, eta: float) -> float:
    """Derivative of the logarithm of F_t with respect to the cosine."""
    high = min(c + 1e-4, 1.0)
    low = c - 1e-4
    return float(
        (transmittance(high, eta) / transmittance(low, eta) - 1.0) / (high - low)
    )


@kernel
def _add_by_device(
    index: IntMatrix32, moved: Vector32, n: int, by_light: Vector, by_camera: Vector
) -> None:
    """Add the change of the result by each residual to the sums of its light and of its camera."""
    for r in range(n):
        by_light[index[r, 0]] += moved[r]
        by_camera[index[r, 1]] += moved[r]


@kernel
def _variance_of_sums(sums: Vector) -> float:
    """Variance of a result from the summed changes per device; devices without samples have 0."""
    count = 0
    square = 0.0
    for i in range(sums.shape[0]):
        if sums[i] != 0.0:
            count += 1
            square += sums[i] * sums[i]
    return square * count / (count - 1.0) if count > 1 else 0.0


@fast_kernel
def _turn_effect(
    n: Vector, eta: float, count: int, b: Lumitexel, s: Separation
) -> Matrix:
    """Effect of rotations of the normal by one radian on the common part, and relative
    effect on the channels' slopes, (2 axes, 2).

    First order: the pulls of the samples times the change of their prediction by the
    mixture of lobes in `s.x`; phi_d hardly affects lobes of isotropic materials.
    """
    axes = tangents(n)
    light = _slide(axes, eta, b.to_light, b.lit)
    camera = _slide(axes, eta, b.to_camera, b.seen)
    mixed = s.predicted
    bent = s.level  # derivative of the mixture with respect to theta_h
    weight = s.x[SHAPE]
    s.x[SHAPE] = 0.0
    _predict(b.rows, count, s.x, 0, s, mixed)
    _predict(b.rows, count, s.x, COLUMNS, s, bent)
    square = 0.0
    out = np.zeros((2, 2))
    for r in range(count):
        i = b.pairs[r, 0]
        o = b.pairs[r, 1]
        # cosine and sine of theta_h times the length of wi + wo
        along = b.lit[i] + b.seen[o]
        square_length = 2.0 + 2.0 * cosine_between(i, o, b)
        across = math.sqrt(
            max(square_length - along * along, MIN_SINE * MIN_SINE * square_length)
        )
        tilt = bent[r] / across
        shape = s.shape[r]
        square += shape * shape
        for q in range(2):
            closer = light[i, 2 * q] / b.lit[i]
            body = shape * (closer + light[i, 2 * q + 1] + camera[o, 2 * q + 1])
            bend = tilt * (light[i, 2 * q] + camera[o, 2 * q])
            out[q, 0] += s.pull[r] * (weight * body + mixed[r] * closer - bend)
            out[q, 1] += shape * body
    for q in range(2):
        out[q, 1] /= max(square, 1e-12)
    return out


@kernel
def _separate_channels(
    count: int, b: Lumitexel, s: Separation, estimate: Vector
) -> tuple[Vector, Vector, Vector]:
    """Write R_d (3,); returns the slopes of the channels minus their mean (3,), and the
    variances for independent samples and for errors by device (3,).
    """
    tint = np.empty(3)
    variance = np.empty(3)
    shared = np.empty(3)
    by_light = np.zeros((3, b.lit.shape[0]))
    by_camera = np.zeros((3, b.seen.shape[0]))
    for c in range(3):
        for r in range(count):
            s.tint[r] = b.sample[c, r] - s.mean[r]
        tint[c], spread = robust_slope(s.shape, s.tint, s.weight, s.residual, count)
        variance[c] = spread * spread
        _add_by_device(b.pairs, s.weight, count, by_light[c], by_camera[c])
    common, spread = fit_shape(b.rows, count, b.noise, s)
    for c in range(3):
        estimate[c] = tint[c] + common
        variance[c] += spread * spread
        _add_by_device(b.pairs, s.aim, count, by_light[c], by_camera[c])
        by_device = (
            _variance_of_sums(by_light[c])
            + _variance_of_sums(by_camera[c])
            - variance[c]
        )
        shared[c] = max(by_device, variance[c])
    return tint, variance, shared


@kernel
def _choose_crossed(b: Lumitexel) -> None:
    """Keep only the chosen samples behind crossed polarisers, if they are enough."""
    limit = np.float32(MAX_GLOSS_CROSSED)
    count = 0
    for i in range(b.gloss.shape[0]):
        for o in range(b.gloss.shape[1]):
            count += int(b.finite[i, o] and b.gloss[i, o] <= limit)
    limit = limit if count >= MIN_SAMPLES_ALBEDO else np.float32(np.inf)
    for i in range(b.gloss.shape[0]):
        for o in range(b.gloss.shape[1]):
            b.usable[i, o] = b.finite[i, o] and b.gloss[i, o] <= limit


@kernel
def separate(
    surfel: int,
    block: Block,
    turn: Vector,
    eta: float,
    table: Tensor32,
    b: Lumitexel,
    s: Separation,
    estimate: Vector,
    error: Vector,
    total: Vector,
) -> float:
    """R_d (3,), its standard error for independent samples, and that for errors by
    device; NaN for too few samples.

    `turn` (2,) is the error of the normal [rad] for either standard error. An error of
    a light or camera affects all of its samples, so that the variance follows from sums
    of their residuals: variance by lights + variance by cameras - variance by samples,
    and not less than the last (Cameron, Gelbach and Miller 2011). Crossed samples alone
    are used if there are enough. Returns the mean factor of the surface part.
    """
    n = block.normal[surfel]
    write_cosines(n, eta, MIN_COSINE_ALBEDO, b)
    if choose(b) < MIN_SAMPLES_GLOSS:  # grazing samples are better than none
        write_cosines(n, eta, MIN_COSINE_SURFACE, b)
        if choose(b) < MIN_SAMPLES_LAMBERT:
            return 1.0
    _choose_crossed(b)
    count = write_rows(n, table, b)
    write_noise(surfel, count, block.noise, b)
    for r in range(count):
        s.shape[r] = b.enters[b.pairs[r, 0]] * b.leaves[b.pairs[r, 1]]
        s.mean[r] = (b.sample[0, r] + b.sample[1, r] + b.sample[2, r]) / np.float32(3)
        if count < MIN_SAMPLES_GLOSS:
            b.rows[r, :] = 0.0
        b.rows[r, SHAPE] = s.shape[r]
    tint, variance, shared = _separate_channels(count, b, s, estimate)
    if turn[1] > 0.0:
        moved = _turn_effect(n, eta, count, b, s)
        for q in range(2):
            for c in range(3):
                by_turn = (moved[q, 0] + tint[c] * moved[q, 1]) ** 2
                variance[c] += turn[0] ** 2 * by_turn
                shared[c] += turn[1] ** 2 * by_turn
    for c in range(3):
        error[c] = math.sqrt(variance[c])
        total[c] = math.sqrt(shared[c])
    gloss = 0.0
    for r in range(count):
        gloss += surface_factor(r, b)
    return gloss / count


@kernel
def separate_block(
    block: Block,
    turn: Matrix,
    table: Tensor32,
    eta: float,
    estimate: Matrix,
    error: Matrix,
    total: Matrix,
    gloss: Vector,
) -> None:
    """`separate` of every surfel of a block; the results are NaN and 1 before."""
    b = block_memory(block, 2 * COLUMNS)
    s = separation_memory(b.pairs.shape[0])
    for i in range(block.position.shape[0]):
        unpack(block.sample[i], b.values)
        if sample_status(b.values) == UNSEEN or not all_finite(block.normal[i]):
            continue
        # squares of values far outside the range of reflectance would overflow
        power = scale_to_one(b.values) if largest_finite(b.values) > MAX_SAMPLE else 1.0
        write_directions(block.position[i], block.light, block.camera, b)
        write_gloss(block.polarisation, eta, b)
        gloss[i] = separate(
            i, block, turn[i], eta, table, b, s, estimate[i], error[i], total[i]
        )
        for c in range(3):
            estimate[i, c] /= power
            error[i, c] /= power
            total[i, c] /= power
