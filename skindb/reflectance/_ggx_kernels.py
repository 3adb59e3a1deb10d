"""Compiled fit and judgement of one GGX lobe; `skindb.reflectance.ggx` describes
the model.

A surfel has a strength w and a roughness alpha. For a given alpha the best w is a ratio
of two sums, so that only alpha is searched: on a coarse grid, then by Gauss-Newton steps
in log alpha. The values that depend on the directions alone are computed once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skindb.jit import fast_kernel, inline_fast_kernel, kernel
from skindb.reflectance._lumitexel_kernels import (
    FITTED,
    MIN_COSINE_SURFACE,
    PERCEPTUAL,
    JudgedErrors,
    Lumitexel,
    Options,
    add_scatter,
    add_surface,
    block_memory,
    choose_kind,
    fitted_status,
    held_kinds,
    lobe_angles,
    outliers,
    prepare,
    relative_drift,
    root_memory,
    split_diffuse,
    start_fit,
    turned_normals,
    weigh,
    write_cosines,
    write_samples,
)
from skindb.reflectance.model import Block, SurfaceFit
from skindb.types import Matrix, Vector

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


class Lobe(NamedTuple):
    """Buffers for the samples of one surfel, (rows,) each."""

    light: Vector  # cosine to the light
    camera: Vector  # cosine to the camera
    half: Vector  # squared cosine of the half vector
    fresnel: Vector  # F cos(theta_i)
    value: Vector  # cos(theta_i) times the lobe of strength 1
    slope: Vector  # its derivative by log alpha
    target: Vector  # mean over the channels of the samples minus their diffuse part
    body: Vector  # mean diffuse part
    weight: Vector  # weights of the squared differences


@kernel
def lobe_memory(size: int) -> Lobe:
    """Buffers for up to `size` samples."""
    v = np.empty((9, size))
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
def write_lobe(d: Vector, count: int, index: float, b: Lumitexel, lobe: Lobe) -> None:
    """Write what a fit of the lobe needs of the chosen samples, for R_d (3,); the lobe is
    0 below the horizon.
    """
    split_diffuse(d, count, b)
    for r in range(count):
        light = b.lit[b.pairs[r, 0]]
        camera = b.seen[b.pairs[r, 1]]
        square, fresnel = lobe_angles(r, index, b)
        above = light > 0.0 and camera > 0.0
        lobe.light[r] = light if above else 1.0
        lobe.camera[r] = camera if above else 1.0
        lobe.half[r] = min((light + camera) ** 2 / max(square, 1e-12), 1.0)
        lobe.fresnel[r] = fresnel * light if above else 0.0
        lobe.target[r] = (b.target[0, r] + b.target[1, r] + b.target[2, r]) / 3.0
        lobe.body[r] = (b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]) / 3.0


@fast_kernel
def _write_values(count: int, alpha: float, lobe: Lobe) -> None:
    for r in range(count):
        value, steep = lobe_value(lobe.light[r], lobe.camera[r], lobe.half[r], alpha)
        lobe.value[r] = lobe.fresnel[r] * value
        lobe.slope[r] = lobe.value[r] * steep


@fast_kernel
def _decrease(count: int, alpha: float, lobe: Lobe) -> tuple[float, float]:
    """Decrease of the squared differences by the best lobe of this roughness, and its
    strength.
    """
    _write_values(count, alpha, lobe)
    square = 0.0
    product = 0.0
    for r in range(count):
        weighted = lobe.weight[r] * lobe.value[r]
        square += weighted * lobe.value[r]
        product += weighted * lobe.target[r]
    if square <= 0.0 or product <= 0.0:
        return 0.0, 0.0
    return product * product / square, product / square


@fast_kernel
def _normal_equations(
    count: int, strength: float, lobe: Lobe
) -> tuple[float, float, float, float]:
    """Gram matrix (two diagonal elements, one other) of the derivatives by strength and by
    log alpha, and the right side of the latter.
    """
    by_strength = 0.0
    by_roughness = 0.0
    cross = 0.0
    right = 0.0
    for r in range(count):
        value = lobe.value[r]
        slope = strength * lobe.slope[r]
        rest = lobe.target[r] - strength * value
        by_strength += lobe.weight[r] * value * value
        by_roughness += lobe.weight[r] * slope * slope
        cross += lobe.weight[r] * value * slope
        right += lobe.weight[r] * slope * rest
    return by_strength, by_roughness, cross, right


@kernel
def _descend(count: int, x: Vector, lobe: Lobe) -> tuple[int, bool]:
    """Gauss-Newton steps in log alpha from x (2,); returns their number, and whether the
    last one was small.
    """
    best, x[STRENGTH] = _decrease(count, x[ROUGHNESS], lobe)
    low = math.log(MIN_ROUGHNESS)
    high = math.log(MAX_ROUGHNESS)
    for step in range(STEPS):
        if best <= 0.0:
            return step, True
        by_strength, by_roughness, cross, right = _normal_equations(
            count, x[STRENGTH], lobe
        )
        # the strength is eliminated: its own equation is fulfilled
        curvature = by_roughness - cross * cross / max(by_strength, 1e-300)
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
    count: int, options: Options, strength: float, b: Lumitexel, lobe: Lobe
) -> None:
    """Weights of squared differences: those of the samples, times the squared slope of the
    cube root at the prediction in cube-root space.
    """
    floor = options.floor * options.floor
    for r in range(count):
        lobe.weight[r] = b.weight[r]
        if options.mode == PERCEPTUAL:
            level = max(lobe.body[r] + strength * lobe.value[r], 0.0)
            root = (level * level / 3.0 + floor) * (level * level + floor) ** (
                -4.0 / 3.0
            )
            lobe.weight[r] *= root * root


@kernel
def _solve(
    count: int, options: Options, x: Vector, b: Lumitexel, lobe: Lobe
) -> tuple[int, bool]:
    """Fit one surfel: write x (2,); returns the steps and whether they converged."""
    ratio = (MAX_ROUGHNESS / MIN_ROUGHNESS) ** (1.0 / (GRID - 1))
    lobe.value[:count] = 0.0
    _write_weights(count, options, 0.0, b, lobe)
    best = -1.0
    for k in range(GRID):
        alpha = MIN_ROUGHNESS * ratio**k
        gain, strength = _decrease(count, alpha, lobe)
        if gain > best:
            best = gain
            x[STRENGTH], x[ROUGHNESS] = strength, alpha
    total, converged = _descend(count, x, lobe)
    if options.mode == PERCEPTUAL:
        for _ in range(REWEIGHTINGS):
            _write_weights(count, options, x[STRENGTH], b, lobe)
            steps, converged = _descend(count, x, lobe)
            total += steps
    if x[STRENGTH] <= 0.0:
        x[STRENGTH], x[ROUGHNESS] = 0.0, NO_ROUGHNESS
        _write_values(count, NO_ROUGHNESS, lobe)
    return total, converged


@kernel
def _certificate(count: int, x: Vector, lobe: Lobe) -> tuple[float, float]:
    """Gradient by log alpha relative to the length of both factors, and condition number
    of the scaled Gram matrix; NaN without a lobe.
    """
    by_strength, by_roughness, cross, right = _normal_equations(
        count, x[STRENGTH], lobe
    )
    size = 0.0
    for r in range(count):
        size += lobe.weight[r] * lobe.target[r] * lobe.target[r]
    if not (by_roughness > 0.0 and by_strength > 0.0 and size > 0.0):
        return 0.0, math.nan
    inside = x[ROUGHNESS] > MIN_ROUGHNESS and x[ROUGHNESS] < MAX_ROUGHNESS
    gradient = abs(right) / math.sqrt(by_roughness * size) if inside else 0.0
    along = min(abs(cross) / math.sqrt(by_strength * by_roughness), 1.0 - 1e-15)
    return gradient, (1.0 + along) / (1.0 - along)


@kernel
def _write_covariance(
    count: int, drift: Vector, x: Vector, b: Lumitexel, lobe: Lobe, out: Matrix
) -> None:
    """Covariance (2, 2) of strength and roughness: a sandwich of the residuals (White
    1980), and the shift by a fraction `drift` (3,) of the diffuse part.
    """
    by_strength, by_roughness, cross, _ = _normal_equations(count, x[STRENGTH], lobe)
    determinant = by_strength * by_roughness - cross * cross
    if not determinant > 1e-12 * by_strength * by_roughness or count <= 2:
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
    inverse[0, 0] = by_roughness / determinant
    inverse[1, 1] = by_strength / determinant
    inverse[0, 1] = -cross / determinant
    inverse[1, 0] = inverse[0, 1]
    # sums are written out, because products of arrays take seconds to compile
    scale = (1.0, x[ROUGHNESS])  # of log alpha to alpha
    more = count / (count - 2)
    for j in range(2):
        for k in range(2):
            spread = 0.0
            for p in range(2):
                for q in range(2):
                    product = more * meat[p, q] + shift[p] * shift[q]
                    spread += inverse[j, p] * product * inverse[k, q]
            out[j, k] = scale[j] * scale[k] * spread


@kernel
def _add_turned(
    s: int,
    count: int,
    block: Block,
    index: float,
    options: Options,
    errors: JudgedErrors,
    out: SurfaceFit,
    b: Lumitexel,
    lobe: Lobe,
) -> None:
    """Add to the covariance the effect of the error of the normal of surfel s."""
    x = out.parameters[s]
    moved = np.empty(2)
    normals = np.empty((4, 3))
    turned_normals(block.normal[s], errors.turn[s], normals)
    for q in range(4):
        write_cosines(normals[q], options.eta, 0.0, b)
        write_lobe(block.diffuse[s], count, index, b, lobe)
        moved[STRENGTH], moved[ROUGHNESS] = x[STRENGTH], x[ROUGHNESS]
        _descend(count, moved, lobe)
        add_scatter(moved, x, out.covariance[s])
    write_cosines(block.normal[s], options.eta, MIN_COSINE_SURFACE, b)


@kernel
def _predict(count: int, x: Vector, b: Lumitexel, lobe: Lobe) -> None:
    """Write the surface part of the chosen samples for x (2,)."""
    _write_values(count, x[ROUGHNESS], lobe)
    for r in range(count):
        b.surface[r] = x[STRENGTH] * lobe.value[r]


@kernel
def fit_ggx(
    block: Block,
    index: float,
    options: Options,
    errors: JudgedErrors,
    out: SurfaceFit,
) -> None:
    """Fit, or only evaluate, every surfel of a block; its errors, held-out samples and
    outliers.
    """
    b = block_memory(block, 0)
    root = root_memory(b.pairs.shape[0])
    lobe = lobe_memory(b.pairs.shape[0])
    drift = np.empty(3)
    kinds = held_kinds(errors.held)
    for s in range(block.position.shape[0]):
        x = out.parameters[s]
        d = block.diffuse[s]
        out.status[s] = prepare(s, block, options, b)
        if out.status[s] != FITTED:
            x[:] = np.nan
            continue
        choose_kind(0, errors.held, b)
        count = write_samples(block.normal[s], b)
        matt, _ = start_fit(s, count, options, b, out)
        write_lobe(d, count, index, b, lobe)
        weigh(s, count, block.noise, options, b)
        converged = True
        if matt:
            x[STRENGTH], x[ROUGHNESS] = 0.0, 1.0
        elif options.solve:
            out.iterations[s], converged = _solve(count, options, x, b, lobe)
            out.kkt[s], out.condition[s] = _certificate(count, x, lobe)
        out.status[s] = fitted_status(matt, converged, d)
        _predict(count, x, b, lobe)
        if matt or not options.solve:
            _write_weights(count, options, x[STRENGTH], b, lobe)
        if out.counts.shape[2] > 0:
            out.outlier[s] = outliers(count, options, b, root, out.counts)
        with_errors = out.covariance.shape[1] > 0 and x[STRENGTH] > 0.0
        if with_errors:
            relative_drift(d, errors.diffuse[s], drift)
            _write_covariance(count, drift, x, b, lobe, out.covariance[s])
        out.residual[s], out.residual_perceptual[s] = add_surface(count, b)
        if with_errors and errors.turn[s] > 0.0:
            _add_turned(s, count, block, index, options, errors, out, b, lobe)
        for kind in range(1, 3):
            if kinds[kind]:
                choose_kind(kind, errors.held, b)
                count = write_samples(block.normal[s], b)
                write_lobe(d, count, index, b, lobe)
                _predict(count, x, b, lobe)
                error = add_surface(count, b)
                out.held_error[s, kind - 1, 0], out.held_error[s, kind - 1, 1] = error
        if matt:
            x[:] = np.nan
