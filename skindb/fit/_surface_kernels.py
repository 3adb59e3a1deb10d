"""Compiled fits of BRDFs to the samples minus the diffuse term; `skindb.fit.surface`
describes the methods.

They combine the rows of `optics` and the solver of `numerics`, so that the rows of a
surfel, 60 kB at rank 16, stay in the cache until they are solved.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from skindb.fit._lumitexel_kernels import (
    CLAMPED,
    FEW,
    FITTED,
    MODEL_ERROR,
    NO_DIFFUSE,
    NOT_CONVERGED,
    NOT_FINITE,
    choose,
    lumitexel_memory,
    sample_status,
    split_diffuse,
    write_cosines,
    write_directions,
    write_noise,
    write_rows,
)
from skindb.jit import fast_kernel, kernel, median_of, unpack
from skindb.reflectance._mixture_kernels import (
    coefficients,
    fit_memory,
    fit_one,
    fit_weighted,
    predict,
    relative_errors,
    to_roots,
    weight_covariance,
)
from skindb.reflectance._row_kernels import turn_rows
from skindb.schema.status import LARGEST_R_D, SMALLEST_R_D

# to light or camera; below it lights are partly hidden, and pixels cover a large area
MIN_COSINE_SURFACE = 0.1
# below it an error of the normal has a larger effect than a motion of the face
MIN_COSINE_OUTLIER = 0.2
KKT_TOLERANCE = 1e-10
NO_FLOOR = 1e-9  # sr^-1; floor of the cube roots for residuals
LINEAR, PERCEPTUAL, PAPER = range(3)
# scales of the residuals of the surfel: exceeded by normal noise once in two million,
# and by 1.1 to 2.6 % of samples of six clean captures of another renderer (partly
# hidden lights, lobes outside the basis); with 4 scales twice as many would be
# outliers; halved samples are at 25
OUTLIER_SCALES = 5.0
BINS_PER_SCALE = 16  # of the histograms of scaled residuals
# smallest scale relative to the cube root of the surfel's mean: samples within 1.5 % of
# it are not outliers
MIN_ROOT_SCALE = 1e-3
SQRT_3 = math.sqrt(3.0)


class Options(NamedTuple):
    """Options of the fit of a surfel."""

    eta: float
    mode: int
    floor: float  # sr^-1
    least: int  # minimum number of samples
    solve: bool  # otherwise the given weights are only evaluated


class Block(NamedTuple):
    """Inputs of a block of surfels."""

    sample: Any  # (n, lights, cameras, 3)
    position: Any  # (n, 3) mm
    light: Any  # (lights, 3)
    camera: Any  # (cameras, 3)
    normal: Any  # (n, 3)
    diffuse: Any  # (n, 3)
    noise: Any  # a `Noise`


class Fitted(NamedTuple):
    """Results of a fit; NaN where the status says that nothing was fitted."""

    weight: Any  # (n, m)
    kkt: Any  # (n,), as are the following arrays
    residual: Any  # RMS error over RMS of the samples, diffuse light included
    residual_perceptual: Any  # the same in cube-root space
    condition: Any
    samples: Any
    iterations: Any
    status: Any


class Errors(NamedTuple):
    """Further inputs and results of the refit."""

    diffuse_error: Any  # (n, 3) given
    turn: Any  # (n,) given: error of the normal along each axis [rad]
    # (n, m, m) of the weights above 0, NaN for the others; (n, 0, 0) to skip it
    covariance: Any
    # (lights, cameras) 0 fitted, 1 a held-out light, 2 a held-out camera, 3 both
    held: Any
    # (n, 2, 2) relative errors at held-out lights, in held-out cameras; linear and in
    # cube-root space
    held_error: Any
    outlier: Any  # (n,) fraction of the samples
    counts: Any  # (lights, cameras, bins) histograms of scaled residuals


@kernel
def prepare(position: Any, n: Any, d: Any, block: Any, options: Any, b: Any) -> int:
    """Return the status of a surfel before its fit, and write its chosen samples to `b`."""
    status = sample_status(b.values)
    if status != FITTED:
        return status
    if not np.isfinite(position).all():
        return NOT_FINITE
    write_directions(position, block.light, block.camera, b)
    write_cosines(n, options.eta, MIN_COSINE_SURFACE, b)
    if not np.isfinite(n).all():
        return FEW  # no normal: it needs light that is not grazing
    if not np.isfinite(d).all():
        return NO_DIFFUSE
    choose(b)
    return FITTED


@kernel
def _cube_roots(count: int, b: Any) -> None:
    """Convert rows and targets for mode "paper": the table holds cube roots, so that
    only the cosine is converted.
    """
    for r in range(count):
        scale = np.float32(b.lit[b.index[r, 0]] ** (-2.0 / 3.0))
        for q in range(b.rows.shape[1]):
            b.rows[r, q] *= scale
        for c in range(3):
            b.target[c, r] = np.cbrt(b.target[c, r])


@kernel
def _clamped(d: Any) -> bool:
    low = min(d[0], d[1], d[2])
    high = max(d[0], d[1], d[2])
    return bool(low <= np.float32(SMALLEST_R_D) or high >= np.float32(LARGEST_R_D))


@kernel
def weigh(
    surfel: int, count: int, noise: Any, options: Any, b: Any, weight: Any
) -> None:
    """Weights of the rows: 1 where the error of the model dominates, less where the
    noise of the sensor does.

    The noise is that of the diffuse part, as weights by the noisy samples would favour
    some of them.
    """
    if options.mode == PAPER or not write_noise(surfel, count, noise, b):
        for r in range(count):
            weight[r] = 1.0
        return
    mean = 0.0
    least = options.floor * options.floor
    for r in range(count):
        mean += (b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]) / (
            3.0 * count
        )
    mean = max(mean, options.floor)
    own = MODEL_ERROR * mean
    if options.mode == PERCEPTUAL:
        own = MODEL_ERROR / 3.0 * mean * (mean * mean + least) ** (-1.0 / 3.0)
    for r in range(count):
        level = max(
            (b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]) / 3.0, 0.0
        )
        # of the mean of three channels
        variance = (b.noise[0, r] + b.noise[1, r] * level) / 3.0
        if options.mode == PERCEPTUAL:
            slope = (level * level / 3.0 + least) * (level * level + least) ** (
                -4.0 / 3.0
            )
            variance *= slope * slope
        weight[r] = 1.0 / (1.0 + variance / (own * own))


@kernel
def fit_block(block: Any, table: Any, lift: Any, options: Any, out: Any) -> None:
    """Fit, or only evaluate, every surfel of a block by the dictionary."""
    b = lumitexel_memory(block.light.shape[0], block.camera.shape[0], table.shape[3])
    most = b.index.shape[0]
    work = fit_memory(most, table.shape[3], lift.shape[1])
    weight = np.ones(most, np.float32)
    y = np.empty(most, np.float32)
    for s in range(block.position.shape[0]):
        n = block.normal[s]
        d = block.diffuse[s]
        unpack(block.sample[s], b.values)
        out.status[s] = prepare(block.position[s], n, d, block, options, b)
        if out.status[s] != FITTED:
            continue
        count = write_rows(n, table, b)
        out.samples[s] = count
        if count < options.least:
            out.status[s] = FEW
            continue
        split_diffuse(d, count, b)
        weigh(s, count, block.noise, options, b, weight)
        if options.mode == PAPER:
            _cube_roots(count, b)
        x = out.weight[s]
        if options.solve:
            x[:] = 0.0
            out.kkt[s], out.iterations[s], met, out.condition[s] = fit_one(
                b.rows,
                b.target[:, :count],
                weight,
                lift,
                options.mode == PERCEPTUAL,
                options.floor,
                KKT_TOLERANCE,
                x,
                work,
            )
            out.status[s] = (
                NOT_CONVERGED if not met else CLAMPED if _clamped(d) else FITTED
            )
        predict(b.rows, count, coefficients(lift, x), y, work.single)
        for c in range(3):
            for r in range(count):
                b.scattered[c, r] += y[r] ** 3 if options.mode == PAPER else y[r]
        out.residual[s], out.residual_perceptual[s] = relative_errors(
            b.scattered[:, :count], b.given[:, :count], NO_FLOOR, work
        )


@kernel
def _across(a: Any, b: Any, out: Any) -> None:
    """Unit vector perpendicular to two others; loops, since each array operation takes
    seconds to compile.
    """
    for k in range(3):
        out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]
    size = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    for k in range(3):
        out[k] /= size


@kernel
def _add_turned(
    n: Any,
    d: Any,
    turn: float,
    count: int,
    table: Any,
    lift: Any,
    options: Any,
    x: Any,
    out: Any,
    weight: Any,
    b: Any,
    work: Any,
) -> None:
    """Add to the covariance `out` the effect of an error `turn` [rad] of the normal
    about either axis.

    Weights are computed at the four points of the Gauss-Hermite rule with three points
    per axis, which is correct to second order: a lobe that is sampled at its peak loses
    weight for a rotation in any direction.
    """
    small = 0
    for k in range(3):
        small = k if abs(n[k]) < abs(n[small]) else small
    away = np.zeros(3)
    moved = np.empty(x.shape[0])
    away[small] = 1.0
    first = np.empty(3)
    second = np.empty(3)
    turned = np.empty(3)
    _across(n, away, first)
    _across(n, first, second)
    for q in range(4):
        axis = first if q < 2 else second
        angle = SQRT_3 * turn * (1.0 if q % 2 == 0 else -1.0)
        for k in range(3):
            turned[k] = math.cos(angle) * n[k] + math.sin(angle) * axis[k]
        write_cosines(turned, options.eta, 0.0, b)
        split_diffuse(d, count, b)
        turn_rows(
            table, turned, b.to_light, b.to_camera, b.index, count, b.row_memory, b.rows
        )
        for j in range(x.shape[0]):
            moved[j] = x[j]
        fit_weighted(
            b.rows,
            b.target[:, :count],
            weight,
            lift,
            options.mode == PERCEPTUAL,
            options.floor,
            KKT_TOLERANCE,
            moved,
            work,
        )
        for j in range(x.shape[0]):
            for k in range(x.shape[0]):
                out[j, k] += (moved[j] - x[j]) * (moved[k] - x[k]) / 6.0
    write_cosines(n, options.eta, MIN_COSINE_SURFACE, b)


@fast_kernel
def _root_residuals(
    count: int, begin: int, floor: Any, y: Any, b: Any, work: Any
) -> float:
    """Write residuals in cube-root space, averaged over channels, to `work.trial`;
    returns the mean sample.
    """
    third = np.float32(1.0 / 3.0)
    mean = np.float32(0)
    for r in range(count):
        work.total[r] = (
            b.given[0, begin + r] + b.given[1, begin + r] + b.given[2, begin + r]
        ) * third
        body = (
            b.scattered[0, begin + r]
            + b.scattered[1, begin + r]
            + b.scattered[2, begin + r]
        )
        work.mixed[r] = body * third + y[begin + r]
        mean += work.total[r]
    square = work.square[:count]
    inverse = work.inverse[:count]
    to_roots(
        work.total[:count], floor, square, inverse, work.square_bits, work.inverse_bits
    )
    for r in range(count):
        work.trial[r] = work.total[r] * inverse[r]
    to_roots(
        work.mixed[:count], floor, square, inverse, work.square_bits, work.inverse_bits
    )
    for r in range(count):
        work.trial[r] -= work.mixed[r] * inverse[r]
    return np.float64(mean) / max(count, 1)


@kernel
def _outliers(
    count: int, options: Any, y: Any, b: Any, work: Any, counts: Any
) -> float:
    """Fraction of outlying samples, NaN for too few samples; adds to the histograms
    (lights, cameras, bins).
    """
    mean = _root_residuals(count, 0, np.float32(options.floor), y, b, work)
    steep = 0
    last = counts.shape[2] - 1
    for r in range(count):
        above = (
            b.lit[b.index[r, 0]] >= MIN_COSINE_OUTLIER
            and b.seen[b.index[r, 1]] >= MIN_COSINE_OUTLIER
        )
        work.square[r] = abs(work.trial[r]) if above else np.float32(np.inf)
        steep += 1 if above else 0
    if steep < options.least:
        return math.nan
    level = max(mean, options.floor)
    finest = (
        MIN_ROOT_SCALE * level / np.cbrt(level * level + options.floor * options.floor)
    )
    scale = max(1.4826 * median_of(work.square, work.square_bits, count, steep), finest)
    beyond = 0
    per_scale = BINS_PER_SCALE / scale
    for r in range(count):
        if work.square[r] < np.inf:
            place = min(int(work.square[r] * per_scale), last)
            counts[b.index[r, 0], b.index[r, 1], place] += 1
            beyond += place == last
    return beyond / steep


@kernel
def _mark(held: Any, kind: int, finite: Any, b: Any) -> None:
    """Choose the finite samples of one kind."""
    for i in range(held.shape[0]):
        for o in range(held.shape[1]):
            b.usable[i, o] = finite[i, o] and held[i, o] == kind


@kernel
def _held_out(
    kind: int,
    n: Any,
    d: Any,
    x: Any,
    table: Any,
    finite: Any,
    held: Any,
    y: Any,
    b: Any,
    work: Any,
    out: Any,
) -> None:
    """Relative errors (2,) of the predictions of held-out samples of one kind."""
    _mark(held, kind, finite, b)
    count = write_rows(n, table, b)
    split_diffuse(d, count, b)
    predict(b.rows, count, x, y, work.single)
    for c in range(3):
        for r in range(count):
            b.scattered[c, r] += y[r]
    out[0], out[1] = relative_errors(
        b.scattered[:, :count], b.given[:, :count], NO_FLOOR, work
    )


@kernel
def refit_block(
    block: Any, table: Any, lift: Any, options: Any, out: Any, more: Any
) -> None:
    """Fit, or only evaluate, every surfel of a block by a reduced basis; its errors,
    held-out samples and outliers.

    `table` is scaled to order one and the lift (m, m) is the identity. Every block of
    samples is read only once.
    """
    lights = block.light.shape[0]
    cameras = block.camera.shape[0]
    m = out.weight.shape[1]
    b = lumitexel_memory(lights, cameras, table.shape[3])
    most = b.index.shape[0]
    work = fit_memory(most, table.shape[3], m)
    weight = np.ones(most, np.float32)
    y = np.empty(most, np.float32)
    drift = np.empty(3)
    finite = np.empty((lights, cameras), np.bool_)
    present = np.zeros(4, np.bool_)
    for i in range(lights):
        for o in range(cameras):
            present[more.held[i, o]] = True
    for s in range(block.position.shape[0]):
        n = block.normal[s]
        d = block.diffuse[s]
        x = out.weight[s]
        unpack(block.sample[s], b.values)
        if prepare(block.position[s], n, d, block, options, b) != FITTED:
            x[:] = np.nan
            continue
        if not options.solve and not np.isfinite(x).all():
            continue
        if present[1] or present[2]:
            for i in range(lights):
                for o in range(cameras):
                    finite[i, o] = b.usable[i, o]
            _mark(more.held, np.int64(0), finite, b)
        count = write_rows(n, table, b)
        if count < options.least:
            if options.solve:
                x[:] = np.nan
            continue
        split_diffuse(d, count, b)
        weigh(s, count, block.noise, options, b, weight)
        if options.solve:
            x[:] = 0.0
            fit_one(
                b.rows,
                b.target[:, :count],
                weight,
                lift,
                options.mode == PERCEPTUAL,
                options.floor,
                KKT_TOLERANCE,
                x,
                work,
            )
        predict(b.rows, count, x, y, work.single)
        if more.counts.shape[2] > 0:
            more.outlier[s] = _outliers(count, options, y, b, work, more.counts)
        if more.covariance.shape[1] > 0:
            # colour differences do not affect the sum over channels: their common error
            # is at most the smallest one
            shared = min(
                more.diffuse_error[s, 0],
                more.diffuse_error[s, 1],
                more.diffuse_error[s, 2],
            )
            for c in range(3):
                drift[c] = shared / max(d[c], SMALLEST_R_D)
            _restore_total(count, b, work)
            weight_covariance(
                b.rows,
                y[:count],
                weight,
                options.mode == PERCEPTUAL,
                options.floor,
                b.scattered[:, :count],
                drift,
                x,
                more.covariance[s],
                work,
            )
        for c in range(3):
            for r in range(count):
                b.scattered[c, r] += y[r]
        out.residual[s], out.residual_perceptual[s] = relative_errors(
            b.scattered[:, :count], b.given[:, :count], NO_FLOOR, work
        )
        if more.covariance.shape[1] > 0 and more.turn[s] > 0.0:
            _add_turned(
                n,
                d,
                more.turn[s],
                count,
                table,
                lift,
                options,
                x,
                more.covariance[s],
                weight,
                b,
                work,
            )
        for kind in range(1, 3):
            if present[kind]:
                _held_out(
                    kind,
                    n,
                    d,
                    x,
                    table,
                    finite,
                    more.held,
                    y,
                    b,
                    work,
                    more.held_error[s, kind - 1],
                )


@kernel
def _restore_total(count: int, b: Any, work: Any) -> None:
    """Restore the sum of the targets over channels, which `weight_covariance` needs."""
    for r in range(count):
        work.total[r] = b.target[0, r] + b.target[1, r] + b.target[2, r]
