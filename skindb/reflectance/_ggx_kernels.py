"""Compiled fit, judgement and shading of one GGX lobe; `skindb.reflectance.ggx` describes
the model.

A surfel has a strength w and a roughness alpha. For a given alpha the best w is a ratio
of two sums, so that only alpha is searched: on a coarse grid, then by Gauss-Newton steps
in log alpha. The values that depend on the directions alone are computed once.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from skindb.jit import fast_kernel, inline_fast_kernel, kernel, unpack
from skindb.reflectance._lumitexel_kernels import (
    CLAMPED,
    FEW,
    FITTED,
    MIN_COSINE_SURFACE,
    NO_FLOOR,
    NOT_CONVERGED,
    PERCEPTUAL,
    clamped,
    lumitexel_memory,
    mark,
    outliers,
    prepare,
    split_diffuse,
    weigh,
    write_cosines,
)
from skindb.reflectance._mixture_kernels import fit_memory, relative_errors
from skindb.reflectance._shade_kernels import transmittance
from skindb.schema.declaration import SMALLEST_R_D

MIN_ROUGHNESS = 0.05  # narrower lobes fall between the lights of a dome
MAX_ROUGHNESS = 1.0
NO_ROUGHNESS = 0.5  # of surfels whose lobe has no strength
GRID = 10  # values of alpha, evenly spaced in its logarithm, from which steps start
STEPS = 20  # Gauss-Newton steps at most
MAX_STEP = 0.3  # of log alpha
TOLERANCE = 1e-5  # step of log alpha at which the search ends
# relative decrease below which it ends too: weak lobes have a flat minimum
MIN_GAIN_LOBE = 1e-9
REWEIGHTINGS = 3  # in cube-root space
STRENGTH, ROUGHNESS = range(2)  # columns of the parameters
SQRT_3 = math.sqrt(3.0)
LANES = 8  # width of the buffers that the shared kernels expect


class Lobe(NamedTuple):
    """Buffers for the samples of one surfel."""

    light: Any  # (rows,) cosine to the light
    camera: Any  # (rows,) cosine to the camera
    half: Any  # (rows,) squared cosine of the half vector
    fresnel: Any  # (rows,) F cos(theta_i)
    value: Any  # (rows,) cos(theta_i) times the lobe of strength 1
    slope: Any  # (rows,) its derivative by log alpha
    target: (
        Any  # (rows,) mean over the channels of the samples minus their diffuse part
    )
    body: Any  # (rows,) mean diffuse part
    weight: Any  # (rows,) weights of the squared differences


@kernel
def lobe_memory(most: int) -> Any:
    """Buffers for up to `most` samples."""
    v = np.empty((9, most))
    return Lobe(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8])


@inline_fast_kernel
def lobe_value(
    light: float, camera: float, half: float, alpha: float
) -> tuple[float, float]:
    """D G / (4 cos_i cos_o) of GGX with the height-correlated masking of Smith (Heitz
    2014, eq. 71 and 99), and its derivative by log alpha, over the value.
    """
    square = alpha * alpha
    q = half * (square - 1.0) + 1.0
    spread = square / (math.pi * q * q)
    a = math.sqrt(square + (1.0 - square) * light * light)
    b = math.sqrt(square + (1.0 - square) * camera * camera)
    shadow = camera * a + light * b
    bend = square * (
        camera * (1.0 - light * light) / a + light * (1.0 - camera * camera) / b
    )
    steep = 2.0 - 4.0 * square * half / q - bend / shadow
    return 0.5 * spread / shadow, steep


@kernel
def write_samples(b: Any) -> int:
    """Write the indices and values of the chosen samples; returns their number."""
    cameras = b.seen.shape[0]
    count = 0
    for i in range(b.lit.shape[0]):
        for o in range(cameras):
            if b.usable[i, o]:
                b.index[count, 0], b.index[count, 1] = i, o
                for c in range(3):
                    b.given[c, count] = b.values[3 * (i * cameras + o) + c]
                count += 1
    return count


@kernel
def write_geometry(count: int, index: float, b: Any, lobe: Any) -> None:
    """Write what the lobe needs of the directions of the chosen samples; 0 below the
    horizon.
    """
    for r in range(count):
        i = b.index[r, 0]
        o = b.index[r, 1]
        both = 0.0
        for k in range(3):
            both += b.to_light[i, k] * b.to_camera[o, k]
        light = b.lit[i]
        camera = b.seen[o]
        above = light > 0.0 and camera > 0.0
        lobe.light[r] = light if above else 1.0
        lobe.camera[r] = camera if above else 1.0
        lobe.half[r] = min((light + camera) ** 2 / max(2.0 + 2.0 * both, 1e-12), 1.0)
        apart = math.sqrt(max((1.0 + both) / 2.0, 0.0))
        fresnel = 1.0 - transmittance(min(apart, 1.0), index)
        lobe.fresnel[r] = fresnel * light if above else 0.0


@fast_kernel
def _write_values(count: int, alpha: float, lobe: Any) -> None:
    for r in range(count):
        value, steep = lobe_value(lobe.light[r], lobe.camera[r], lobe.half[r], alpha)
        lobe.value[r] = lobe.fresnel[r] * value
        lobe.slope[r] = lobe.value[r] * steep


@fast_kernel
def _sums(count: int, lobe: Any) -> tuple[float, float]:
    """Weighted squares of the lobe, and its products with the targets."""
    square = 0.0
    product = 0.0
    for r in range(count):
        weighted = lobe.weight[r] * lobe.value[r]
        square += weighted * lobe.value[r]
        product += weighted * lobe.target[r]
    return square, product


@kernel
def _decrease(count: int, alpha: float, lobe: Any) -> tuple[float, float]:
    """Decrease of the squared differences by the best lobe of this roughness, and its
    strength.
    """
    _write_values(count, alpha, lobe)
    square, product = _sums(count, lobe)
    if square <= 0.0 or product <= 0.0:
        return 0.0, 0.0
    return product * product / square, product / square


@fast_kernel
def _normal_equations(
    count: int, strength: float, lobe: Any
) -> tuple[float, float, float, float]:
    """Gram matrix (two diagonal elements, one other) of the derivatives by strength and by
    log alpha, and the right side of the latter.
    """
    one = 0.0
    two = 0.0
    cross = 0.0
    right = 0.0
    for r in range(count):
        value = lobe.value[r]
        slope = strength * lobe.slope[r]
        rest = lobe.target[r] - strength * value
        one += lobe.weight[r] * value * value
        two += lobe.weight[r] * slope * slope
        cross += lobe.weight[r] * value * slope
        right += lobe.weight[r] * slope * rest
    return one, two, cross, right


@kernel
def _descend(count: int, x: Any, lobe: Any) -> tuple[int, bool]:
    """Gauss-Newton steps in log alpha from x (2,); returns their number, and whether the
    last one was small.
    """
    best, x[STRENGTH] = _decrease(count, x[ROUGHNESS], lobe)
    low = math.log(MIN_ROUGHNESS)
    high = math.log(MAX_ROUGHNESS)
    for step in range(STEPS):
        if best <= 0.0:
            return step, True
        one, two, cross, right = _normal_equations(count, x[STRENGTH], lobe)
        # the strength is eliminated: its own equation is fulfilled
        curvature = two - cross * cross / max(one, 1e-300)
        move = right / curvature if curvature > 0.0 else 0.0
        start = math.log(x[ROUGHNESS])
        move = min(max(move, -MAX_STEP), MAX_STEP)
        move = min(max(start + move, low), high) - start
        moved = False
        for _ in range(6):
            gain, strength = _decrease(count, math.exp(start + move), lobe)
            if gain >= best:
                moved = gain > best * (1.0 + MIN_GAIN_LOBE)
                best = gain
                x[STRENGTH] = strength
                x[ROUGHNESS] = math.exp(start + move)
                break
            move *= 0.5
        if not moved or abs(move) < TOLERANCE:
            _decrease(count, x[ROUGHNESS], lobe)
            return step + 1, True
    return STEPS, False


@kernel
def _write_weights(
    count: int, options: Any, weight: Any, strength: float, lobe: Any
) -> None:
    """Weights of squared differences: those of the samples, times the squared slope of the
    cube root at the prediction in cube-root space.
    """
    floor = options.floor * options.floor
    for r in range(count):
        lobe.weight[r] = weight[r]
        if options.mode == PERCEPTUAL:
            level = max(lobe.body[r] + strength * lobe.value[r], 0.0)
            root = (level * level / 3.0 + floor) * (level * level + floor) ** (
                -4.0 / 3.0
            )
            lobe.weight[r] *= root * root


@kernel
def _write_targets(count: int, b: Any, lobe: Any) -> None:
    for r in range(count):
        lobe.target[r] = (b.target[0, r] + b.target[1, r] + b.target[2, r]) / 3.0
        lobe.body[r] = (b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]) / 3.0


@kernel
def _solve(count: int, options: Any, weight: Any, x: Any, lobe: Any) -> Any:
    """Fit one surfel: write x (2,); returns the steps and whether they converged."""
    ratio = (MAX_ROUGHNESS / MIN_ROUGHNESS) ** (1.0 / (GRID - 1))
    lobe.value[:count] = 0.0
    _write_weights(count, options, weight, 0.0, lobe)
    best = -1.0
    for k in range(GRID):
        alpha = MIN_ROUGHNESS * ratio**k
        gain, strength = _decrease(count, alpha, lobe)
        if gain > best:
            best = gain
            x[STRENGTH], x[ROUGHNESS] = strength, alpha
    total, met = _descend(count, x, lobe)
    if options.mode == PERCEPTUAL:
        for _ in range(REWEIGHTINGS):
            _write_weights(count, options, weight, x[STRENGTH], lobe)
            steps, met = _descend(count, x, lobe)
            total += steps
    if x[STRENGTH] <= 0.0:
        x[STRENGTH], x[ROUGHNESS] = 0.0, NO_ROUGHNESS
        _write_values(count, NO_ROUGHNESS, lobe)
    return total, met


@kernel
def _certificate(count: int, x: Any, lobe: Any) -> tuple[float, float]:
    """Gradient by log alpha relative to the length of both factors, and condition number
    of the scaled Gram matrix; NaN without a lobe.
    """
    one, two, cross, right = _normal_equations(count, x[STRENGTH], lobe)
    size = 0.0
    for r in range(count):
        size += lobe.weight[r] * lobe.target[r] * lobe.target[r]
    if not (two > 0.0 and one > 0.0 and size > 0.0):
        return 0.0, math.nan
    inside = x[ROUGHNESS] > MIN_ROUGHNESS and x[ROUGHNESS] < MAX_ROUGHNESS
    gradient = abs(right) / math.sqrt(two * size) if inside else 0.0
    along = min(abs(cross) / math.sqrt(one * two), 1.0 - 1e-15)
    return gradient, (1.0 + along) / (1.0 - along)


@kernel
def _write_prediction(count: int, x: Any, b: Any, lobe: Any) -> None:
    """Add the lobe to the diffuse part of the chosen samples in `b.scattered`."""
    _write_values(count, x[ROUGHNESS], lobe)
    for r in range(count):
        for c in range(3):
            b.scattered[c, r] += x[STRENGTH] * lobe.value[r]


@kernel
def fit_ggx(block: Any, index: float, options: Any, out: Any) -> None:
    """Fit every surfel of a block; `out` is a `SurfaceFit`."""
    b = lumitexel_memory(block.light.shape[0], block.camera.shape[0], LANES)
    most = b.index.shape[0]
    work = fit_memory(most, LANES, 2)
    weight = np.ones(most, np.float32)
    lobe = lobe_memory(most)
    for s in range(block.position.shape[0]):
        n = block.normal[s]
        d = block.diffuse[s]
        unpack(block.sample[s], b.values)
        out.status[s] = prepare(block.position[s], n, d, block, options, b)
        if out.status[s] != FITTED:
            continue
        count = write_samples(b)
        out.samples[s] = count
        if count < options.least:
            out.status[s] = FEW
            continue
        split_diffuse(d, count, b)
        weigh(s, count, block.noise, options, b, weight)
        write_geometry(count, index, b, lobe)
        _write_targets(count, b, lobe)
        x = out.parameters[s]
        out.iterations[s], met = _solve(count, options, weight, x, lobe)
        out.status[s] = NOT_CONVERGED if not met else CLAMPED if clamped(d) else FITTED
        out.kkt[s], out.condition[s] = _certificate(count, x, lobe)
        _write_prediction(count, x, b, lobe)
        out.residual[s], out.residual_perceptual[s] = relative_errors(
            b.scattered[:, :count], b.given[:, :count], NO_FLOOR, work
        )


@kernel
def _covariance(count: int, drift: Any, x: Any, b: Any, lobe: Any, out: Any) -> None:
    """Covariance (2, 2) of strength and roughness: a sandwich of the residuals (White
    1980), and the shift by a fraction `drift` (3,) of the diffuse part.
    """
    one, two, cross, _ = _normal_equations(count, x[STRENGTH], lobe)
    determinant = one * two - cross * cross
    if not determinant > 1e-12 * one * two or count <= 2:
        return
    meat = np.zeros((2, 2))
    shift = np.zeros(2)
    for r in range(count):
        value = lobe.value[r]
        slope = x[STRENGTH] * lobe.slope[r]
        score = lobe.weight[r] * (lobe.target[r] - x[STRENGTH] * value)
        moved = 0.0
        for c in range(3):
            moved += lobe.weight[r] * drift[c] * b.scattered[c, r] / 3.0
        meat[0, 0] += score * score * value * value
        meat[0, 1] += score * score * value * slope
        meat[1, 1] += score * score * slope * slope
        shift[0] += moved * value
        shift[1] += moved * slope
    meat[1, 0] = meat[0, 1]
    inverse = np.empty((2, 2))
    inverse[0, 0], inverse[1, 1] = two / determinant, one / determinant
    inverse[0, 1] = -cross / determinant
    inverse[1, 0] = inverse[0, 1]
    spread = np.dot(np.dot(inverse, meat), inverse) * count / (count - 2)
    push = np.dot(inverse, shift)
    scale = (1.0, x[ROUGHNESS])  # of log alpha to alpha
    for j in range(2):
        for k in range(2):
            out[j, k] = scale[j] * scale[k] * (spread[j, k] + push[j] * push[k])


@kernel
def _add_turned(
    n: Any,
    d: Any,
    turn: float,
    count: int,
    index: float,
    options: Any,
    x: Any,
    out: Any,
    b: Any,
    lobe: Any,
) -> None:
    """Add to the covariance the effect of an error `turn` [rad] of the normal about either
    axis, by the rule of `skindb.reflectance._block_kernels`.
    """
    axes = np.empty((2, 3))
    small = 0
    for k in range(3):
        small = k if abs(n[k]) < abs(n[small]) else small
    away = np.zeros(3)
    away[small] = 1.0
    axes[0] = np.cross(n, away)
    axes[0] /= math.sqrt((axes[0] ** 2).sum())
    axes[1] = np.cross(n, axes[0])
    moved = np.empty(2)
    for q in range(4):
        angle = SQRT_3 * turn * (1.0 if q % 2 == 0 else -1.0)
        turned = math.cos(angle) * n + math.sin(angle) * axes[q // 2]
        write_cosines(turned, options.eta, 0.0, b)
        split_diffuse(d, count, b)
        write_geometry(count, index, b, lobe)
        _write_targets(count, b, lobe)
        moved[:] = x
        _descend(count, moved, lobe)
        for j in range(2):
            for k in range(2):
                out[j, k] += (moved[j] - x[j]) * (moved[k] - x[k]) / 6.0
    write_cosines(n, options.eta, MIN_COSINE_SURFACE, b)


@kernel
def judge_ggx(
    block: Any, index: float, options: Any, x: Any, residual: Any, errors: Any
) -> None:
    """Fit, or only evaluate, every surfel of a block; its errors, held-out samples and
    outliers. `residual` (n, 2) is linear and in cube-root space.
    """
    lights = block.light.shape[0]
    cameras = block.camera.shape[0]
    b = lumitexel_memory(lights, cameras, LANES)
    most = b.index.shape[0]
    work = fit_memory(most, LANES, 2)
    weight = np.ones(most, np.float32)
    lobe = lobe_memory(most)
    y = np.empty(most, np.float32)
    drift = np.empty(3)
    finite = np.empty((lights, cameras), np.bool_)
    for s in range(block.position.shape[0]):
        n = block.normal[s]
        d = block.diffuse[s]
        unpack(block.sample[s], b.values)
        if prepare(block.position[s], n, d, block, options, b) != FITTED:
            x[s] = np.nan
            continue
        if not options.solve and not np.isfinite(x[s]).all():
            continue
        finite[:] = b.usable
        mark(errors.held, np.int64(0), finite, b)
        count = write_samples(b)
        if count < options.least:
            if options.solve:
                x[s] = np.nan
            continue
        split_diffuse(d, count, b)
        weigh(s, count, block.noise, options, b, weight)
        write_geometry(count, index, b, lobe)
        _write_targets(count, b, lobe)
        if options.solve:
            _solve(count, options, weight, x[s], lobe)
        else:
            _write_values(count, x[s, ROUGHNESS], lobe)
        for r in range(count):
            y[r] = x[s, STRENGTH] * lobe.value[r]
        if errors.counts.shape[2] > 0:
            errors.outlier[s] = outliers(count, options, y, b, work, errors.counts)
        with_errors = errors.covariance.shape[1] > 0 and x[s, STRENGTH] > 0.0
        if with_errors:
            shared = errors.diffuse_error[s].min()
            for c in range(3):
                drift[c] = shared / max(d[c], SMALLEST_R_D)
            _covariance(count, drift, x[s], b, lobe, errors.covariance[s])
        for c in range(3):
            for r in range(count):
                b.scattered[c, r] += y[r]
        residual[s, 0], residual[s, 1] = relative_errors(
            b.scattered[:, :count], b.given[:, :count], NO_FLOOR, work
        )
        if with_errors and errors.turn[s] > 0.0:
            _add_turned(
                n,
                d,
                errors.turn[s],
                count,
                index,
                options,
                x[s],
                errors.covariance[s],
                b,
                lobe,
            )
        for kind in range(1, 3):
            mark(errors.held, kind, finite, b)
            count = write_samples(b)
            if count > 0:
                split_diffuse(d, count, b)
                write_geometry(count, index, b, lobe)
                _write_prediction(count, x[s], b, lobe)
                linear, roots = relative_errors(
                    b.scattered[:, :count], b.given[:, :count], NO_FLOOR, work
                )
                errors.held_error[s, kind - 1, 0] = linear
                errors.held_error[s, kind - 1, 1] = roots


@kernel
def shade_ggx(
    position: Any,
    normal: Any,
    view: Any,
    parameters: Any,
    place: Any,
    lit: Any,
    axis: Any,
    falloff: float,
    index: float,
    out: Any,
) -> None:
    """Add the lobe to the radiance (n, 3) per unit of the light's radiant intensity."""
    points = lit.shape[1]
    for i in range(position.shape[0]):
        cos_o = 0.0
        for k in range(3):
            cos_o += normal[i, k] * view[i, k]
        if cos_o <= 0.0 or parameters[i, STRENGTH] == 0.0:
            continue
        gloss = 0.0
        for p in range(points):
            square = 0.0
            for k in range(3):
                square += (place[i, p, k] - position[i, k]) ** 2
            scale = 1.0 / math.sqrt(square)
            cos_i = 0.0
            both = 0.0
            along = 0.0
            for k in range(3):
                towards = (place[i, p, k] - position[i, k]) * scale
                cos_i += towards * normal[i, k]
                both += towards * view[i, k]
                along -= towards * axis[k]
            if lit[i, p] <= 0.0 or cos_i <= 0.0:
                continue
            received = lit[i, p] * cos_i / square
            if falloff != 0.0:
                received *= max(along, 0.0) ** falloff
            half = min((cos_i + cos_o) ** 2 / max(2.0 + 2.0 * both, 1e-12), 1.0)
            value, _ = lobe_value(cos_i, cos_o, half, parameters[i, ROUGHNESS])
            apart = min(math.sqrt(max((1.0 + both) / 2.0, 0.0)), 1.0)
            gloss += received * value * (1.0 - transmittance(apart, index))
        for c in range(3):
            out[i, c] += parameters[i, STRENGTH] * gloss / points
