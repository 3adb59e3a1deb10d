"""Compiled fits of mixtures of tables to the samples minus the diffuse term, for
`skindb.reflectance.mixture`.

Rows are formed and solved surfel by surfel, so that those of one surfel, 60 kB at rank
16, stay in the cache until they are solved.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from skindb.jit import kernel, unpack
from skindb.reflectance._lumitexel_kernels import (
    CLAMPED,
    FEW,
    FITTED,
    MIN_COSINE_SURFACE,
    NO_FLOOR,
    NOT_CONVERGED,
    PAPER,
    PERCEPTUAL,
    clamped,
    lumitexel_memory,
    mark,
    outliers,
    prepare,
    split_diffuse,
    weigh,
    write_cosines,
    write_rows,
)
from skindb.reflectance._mixture_kernels import (
    coefficients,
    fit_memory,
    fit_one,
    fit_weighted,
    predict,
    relative_errors,
    weight_covariance,
)
from skindb.reflectance._row_kernels import turn_rows
from skindb.schema.declaration import SMALLEST_R_D

KKT_TOLERANCE = 1e-10
SQRT_3 = math.sqrt(3.0)


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
                NOT_CONVERGED if not met else CLAMPED if clamped(d) else FITTED
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
    mark(held, kind, finite, b)
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
def judge_block(
    block: Any, table: Any, lift: Any, options: Any, out: Any, errors: Any
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
            present[errors.held[i, o]] = True
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
            mark(errors.held, np.int64(0), finite, b)
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
        if errors.counts.shape[2] > 0:
            errors.outlier[s] = outliers(count, options, y, b, work, errors.counts)
        if errors.covariance.shape[1] > 0:
            # colour differences do not affect the sum over channels: their common error
            # is at most the smallest one
            shared = min(
                errors.diffuse_error[s, 0],
                errors.diffuse_error[s, 1],
                errors.diffuse_error[s, 2],
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
                errors.covariance[s],
                work,
            )
        for c in range(3):
            for r in range(count):
                b.scattered[c, r] += y[r]
        out.residual[s], out.residual_perceptual[s] = relative_errors(
            b.scattered[:, :count], b.given[:, :count], NO_FLOOR, work
        )
        if errors.covariance.shape[1] > 0 and errors.turn[s] > 0.0:
            _add_turned(
                n,
                d,
                errors.turn[s],
                count,
                table,
                lift,
                options,
                x,
                errors.covariance[s],
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
                    errors.held,
                    y,
                    b,
                    work,
                    errors.held_error[s, kind - 1],
                )


@kernel
def _restore_total(count: int, b: Any, work: Any) -> None:
    """Restore the sum of the targets over channels, which `weight_covariance` needs."""
    for r in range(count):
        work.total[r] = b.target[0, r] + b.target[1, r] + b.target[2, r]
