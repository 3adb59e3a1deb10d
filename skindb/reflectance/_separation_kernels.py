"""Compiled separation of diffuse from surface reflection, surfel by surfel; the method
is in `skindb.reflectance.separation`.

Sums over samples run in single precision and in vector registers; systems of equations are double.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skindb.jit import (
    LANES,
    dots,
    fast_kernel,
    inline_kernel,
    kernel,
    largest_finite,
    products,
    scale_to_one,
    unpack,
)
from skindb.numerics._nnls_kernels import (
    ActiveSetMemory,
    active_set_memory,
    factor,
    solve,
    solve_scaled,
)
from skindb.reflectance._lumitexel_kernels import (
    MIN_COSINE_SURFACE,
    MIN_SAMPLES_GLOSS,
    MIN_SAMPLES_LAMBERT,
    MODEL_ERROR,
    UNSEEN,
    Lumitexel,
    choose,
    lumitexel_memory,
    sample_status,
    surface_factor,
    write_cosines,
    write_directions,
    write_gloss,
    write_noise,
    write_rows,
)
from skindb.reflectance._shade_kernels import transmittance
from skindb.reflectance.model import Noise
from skindb.types import (
    IntMatrix32,
    IntVector,
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
        products(
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
    dots(rows, s.mixture, n, out)


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
    if not _shape_row(active, k, s):
        s.pull[:n] = ZERO
        s.aim[:n] = ZERO
        return s.x[SHAPE], math.nan
    weights = s.x.copy()
    _predict(rows, n, s.right, 0, s, s.predicted)
    meat = _pull(n, s)
    s.x[:] = weights
    bend = max(slope / max(total, 1e-12), MIN_BEND)
    for i in range(n):
        s.aim[i] = s.pull[i] * s.residual[i] / (s.level[i] * np.float32(bend))
    return s.x[SHAPE], math.sqrt(meat * n / max(n - k, 1)) / bend


@kernel
def _shape_row(active: IntVector, k: int, s: Separation) -> bool:
    """Write the row of the diffuse shape of the inverse Gram matrix of the active
    columns to `s.right`.
    """
    length = np.ones(COLUMNS)
    z = np.empty(COLUMNS)
    for p in range(k):
        j = active[p]
        length[j] = 1.0 / math.sqrt(s.gram[j, j]) if s.gram[j, j] > 0.0 else 0.0
    for i in range(COLUMNS):
        for j in range(COLUMNS):
            s.gram[i, j] *= length[i] * length[j]
    if factor(s.gram, active, 0, k, s.active_set.factor) >= 0:
        return False
    unit = np.zeros(COLUMNS)
    unit[SHAPE] = 1.0
    solve(s.active_set.factor, unit, active, k, z)
    s.right[:] = 0.0
    for p in range(k):
        s.right[active[p]] = z[p] * length[active[p]] * length[SHAPE]
    return True


@kernel
def _tangents(n: Vector, first: Vector, second: Vector) -> None:
    """Two unit vectors perpendicular to n and to each other."""
    small = 0
    for k in range(3):
        small = k if abs(n[k]) < abs(n[small]) else small
    for k in range(3):
        p = (k + 1) % 3
        q = (k + 2) % 3
        first[k] = n[p] * (1.0 if q == small else 0.0) - n[q] * (
            1.0 if p == small else 0.0
        )
    size = math.sqrt(first[0] * first[0] + first[1] * first[1] + first[2] * first[2])
    for k in range(3):
        first[k] /= size
    for k in range(3):
        p = (k + 1) % 3
        q = (k + 2) % 3
        second[k] = n[p] * first[q] - n[q] * first[p]


@kernel
def _slide(
    axes: Matrix, eta: float, b: Lumitexel, light: Matrix, camera: Matrix
) -> None:
    """Effect of a rotation of the normal by one radian towards two axes (2, 3): light
    (lights, 6), camera (cameras, 4).

    For each axis: change of the cosine, relative change of cos F_t (of F_t for
    cameras), and for lights of the cosine.
    """
    for i in range(b.lit.shape[0]):
        c = b.lit[i]
        if c > 0.0:
            steep = _relative_slope(c, eta)
            for q in range(2):
                t = (
                    axes[q, 0] * b.to_light[i, 0]
                    + axes[q, 1] * b.to_light[i, 1]
                    + axes[q, 2] * b.to_light[i, 2]
                )
                light[i, 3 * q] = t
                light[i, 3 * q + 1] = t / c + t * steep
                light[i, 3 * q + 2] = t / c
    for o in range(b.seen.shape[0]):
        c = b.seen[o]
        if c > 0.0:
            steep = _relative_slope(c, eta)
            for q in range(2):
                t = (
                    axes[q, 0] * b.to_camera[o, 0]
                    + axes[q, 1] * b.to_camera[o, 1]
                    + axes[q, 2] * b.to_camera[o, 2]
                )
                camera[o, 2 * q] = t
                camera[o, 2 * q + 1] = t * steep


@inline_kernel
def _relative_slope(c: float, eta: float) -> float:
    """Derivative of the logarithm of F_t with respect to the cosine."""
    high = min(c + 1e-4, 1.0)
    low = c - 1e-4
    return float(
        (transmittance(high, eta) / transmittance(low, eta) - 1.0) / (high - low)
    )


@fast_kernel
def _turn_effect(
    light: Matrix, camera: Matrix, n: int, b: Lumitexel, s: Separation, out: Matrix
) -> None:
    """Effect of rotations of the normal by one radian on the common part, and relative
    effect on the channels' slopes.

    First order: the pulls of the samples times the change of their prediction; out is
    (2 axes, 2). `s.predicted` and `s.level` are the mixture of lobes and its derivative
    with respect to theta_h; phi_d hardly affects lobes of isotropic materials.
    """
    mixed = s.predicted
    bent = s.level
    weight = s.x[SHAPE]
    square = 0.0
    out[:] = 0.0
    for r in range(n):
        i = b.pairs[r, 0]
        o = b.pairs[r, 1]
        wi_wo = (
            b.to_light[i, 0] * b.to_camera[o, 0]
            + b.to_light[i, 1] * b.to_camera[o, 1]
            + b.to_light[i, 2] * b.to_camera[o, 2]
        )
        # cosine and sine of theta_h times the length of wi + wo
        along = b.lit[i] + b.seen[o]
        square_length = 2.0 + 2.0 * wi_wo
        across = math.sqrt(
            max(square_length - along * along, MIN_SINE * MIN_SINE * square_length)
        )
        tilt = bent[r] / across
        shape = s.shape[r]
        pull = s.pull[r]
        square += shape * shape
        for q in range(2):
            body = shape * (light[i, 3 * q + 1] + camera[o, 2 * q + 1])
            lobes = mixed[r] * light[i, 3 * q + 2] - tilt * (
                light[i, 3 * q] + camera[o, 2 * q]
            )
            out[q, 0] += pull * (weight * body + lobes)
            out[q, 1] += shape * body
    for q in range(2):
        out[q, 1] /= max(square, 1e-12)


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


@kernel
def _normal_effect(
    n: Vector, eta: float, count: int, b: Lumitexel, s: Separation
) -> Matrix:
    """`_turn_effect` (2 axes, 2) of the mixture of lobes in `s.x`."""
    axes = np.empty((2, 3))
    moved = np.empty((2, 2))
    _tangents(n, axes[0], axes[1])
    light = np.empty((b.lit.shape[0], 6))
    camera = np.empty((b.seen.shape[0], 4))
    lobes = s.x.copy()
    lobes[SHAPE] = 0.0
    _predict(b.rows, count, lobes, 0, s, s.predicted)
    _predict(b.rows, count, lobes, COLUMNS, s, s.level)
    _slide(axes, eta, b, light, camera)
    _turn_effect(light, camera, count, b, s, moved)
    return moved


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
    count = 0
    for i in range(b.gloss.shape[0]):
        for o in range(b.gloss.shape[1]):
            b.usable[i, o] = b.finite[i, o] and b.gloss[i, o] <= MAX_GLOSS_CROSSED
            count += int(b.usable[i, o])
    if count < MIN_SAMPLES_ALBEDO:
        for i in range(b.gloss.shape[0]):
            for o in range(b.gloss.shape[1]):
                b.usable[i, o] = b.finite[i, o]


@kernel
def separate(
    n: Vector,
    turn: Vector,
    eta: float,
    table: Tensor32,
    noise: Noise,
    surfel: int,
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
    estimate[:] = np.nan
    error[:] = np.nan
    total[:] = np.nan
    write_cosines(n, eta, MIN_COSINE_ALBEDO, b)
    if choose(b) < MIN_SAMPLES_GLOSS:  # grazing samples are better than none
        write_cosines(n, eta, MIN_COSINE_SURFACE, b)
        if choose(b) < MIN_SAMPLES_LAMBERT:
            return 1.0
    _choose_crossed(b)
    count = write_rows(n, table, b)
    write_noise(surfel, count, noise, b)
    for r in range(count):
        s.shape[r] = b.enters[b.pairs[r, 0]] * b.leaves[b.pairs[r, 1]]
        s.mean[r] = (b.sample[0, r] + b.sample[1, r] + b.sample[2, r]) / np.float32(3)
        if count < MIN_SAMPLES_GLOSS:
            b.rows[r, :] = 0.0
        b.rows[r, SHAPE] = s.shape[r]
    tint, variance, shared = _separate_channels(count, b, s, estimate)
    if turn[1] > 0.0:
        moved = _normal_effect(n, eta, count, b, s)
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
    sample: NDArray[Any],
    position: Matrix,
    light: Matrix,
    camera: Matrix,
    normal: Matrix,
    turn: Matrix,
    table: Tensor32,
    noise: Noise,
    polarisation: Matrix,
    eta: float,
    estimate: Matrix,
    error: Matrix,
    total: Matrix,
    gloss: Vector,
) -> None:
    """`separate` of every surfel of a block."""
    polarised = polarisation.shape[0] > 0
    b = lumitexel_memory(light.shape[0], camera.shape[0], 2 * COLUMNS, polarised)
    s = separation_memory(light.shape[0] * camera.shape[0])
    for i in range(position.shape[0]):
        unpack(sample[i], b.values)
        if sample_status(b.values) == UNSEEN or not np.isfinite(normal[i]).all():
            estimate[i] = np.nan
            error[i] = np.nan
            total[i] = np.nan
            continue
        # squares of values far outside the range of reflectance would overflow
        power = scale_to_one(b.values) if largest_finite(b.values) > MAX_SAMPLE else 1.0
        write_directions(position[i], light, camera, b)
        write_gloss(polarisation, eta, b)
        gloss[i] = separate(
            normal[i],
            turn[i],
            eta,
            table,
            noise,
            i,
            b,
            s,
            estimate[i],
            error[i],
            total[i],
        )
        for c in range(3):
            estimate[i, c] /= power
            error[i, c] /= power
            total[i, c] /= power
