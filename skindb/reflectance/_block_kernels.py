"""Compiled fits of mixtures of tables to the samples minus the diffuse term, for
`skindb.reflectance.mixture`.

Rows are formed and solved surfel by surfel, so that those of one surfel, 60 kB at rank
16, stay in the cache until they are solved.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skindb.jit import kernel
from skindb.reflectance._lumitexel_kernels import (
    FITTED,
    OUTLIER_SPREAD,
    PERCEPTUAL,
    JudgedErrors,
    Lumitexel,
    Options,
    add_surface,
    block_memory,
    choose_kind,
    fitted_status,
    held_kinds,
    outliers,
    prepare,
    relative_drift,
    split_diffuse,
    start_fit,
    weigh,
    weigh_outliers,
    write_rows,
)
from skindb.reflectance._mixture_kernels import (
    FitMemory,
    Problem,
    coefficients,
    fit_memory,
    fit_one,
    predict,
    weight_covariance,
)
from skindb.reflectance._turn_kernels import add_turned, turn_memory
from skindb.reflectance.model import Block, SurfaceFit
from skindb.types import Matrix, Tensor32, Vector

KKT_TOLERANCE = 1e-10


class Tables(NamedTuple):
    """The tables that are mixed, of order one."""

    table: Tensor32  # (nh, nd, np, width) padded with zeros
    lift: Matrix  # (r, m) from the space of the tables; square: the identity
    half_width: Vector  # (m,) at half maximum, as an angle of the half vector [rad]


@kernel
def _block_narrow(half_width: Vector, narrowest: float, work: FitMemory) -> None:
    """Block the columns that are narrower than an angle, except the widest."""
    widest = 0.0
    for j in range(half_width.shape[0]):
        widest = max(widest, half_width[j])
    limit = min(narrowest, widest)
    for j in range(half_width.shape[0]):
        work.blocked[j] = half_width[j] < limit


@kernel
def _solve(
    s: int, p: Problem, options: Options, b: Lumitexel, work: FitMemory, out: SurfaceFit
) -> bool:
    """Fit the weights of surfel s; returns whether they converged."""
    x = out.parameters[s]
    x[:] = 0.0
    out.kkt[s], out.iterations[s], converged, out.condition[s] = fit_one(p, x, work)
    if p.perceptual:
        predict(p.rows, p.size, coefficients(p.lift, x), b.surface, work.single)
        weigh_outliers(p.size, options, b, work.root)
        out.kkt[s], more, converged, out.condition[s] = fit_one(p, x, work)
        out.iterations[s] += more
    return converged


@kernel
def _write_covariance(
    s: int,
    p: Problem,
    block: Block,
    errors: JudgedErrors,
    out: SurfaceFit,
    b: Lumitexel,
    work: FitMemory,
) -> None:
    """Covariance of the weights of surfel s by noise and by the error of R_d."""
    drift = np.empty(3)
    relative_drift(block.diffuse[s], errors.diffuse[s], drift)
    for r in range(p.size):
        work.root.total[r] = b.target[0, r] + b.target[1, r] + b.target[2, r]
    spread = OUTLIER_SPREAD if p.perceptual else 1.0
    weight_covariance(
        p,
        b.surface,
        b.scattered,
        drift,
        out.parameters[s],
        spread,
        out.covariance[s],
        work,
    )


@kernel
def _write_held_error(
    s: int,
    kind: int,
    block: Block,
    tables: Tables,
    errors: JudgedErrors,
    out: SurfaceFit,
    b: Lumitexel,
    work: FitMemory,
) -> None:
    """Relative errors of the predictions of held-out samples of one kind."""
    choose_kind(kind, errors.held, b)
    count = write_rows(block.normal[s], tables.table, b)
    split_diffuse(block.diffuse[s], count, b)
    predict(b.rows, count, out.parameters[s], b.surface, work.single)
    error = add_surface(count, b)
    out.held_error[s, kind - 1, 0], out.held_error[s, kind - 1, 1] = error


@kernel
def fit_block(
    block: Block,
    tables: Tables,
    options: Options,
    errors: JudgedErrors,
    out: SurfaceFit,
) -> None:
    """Fit, or only evaluate, every surfel of a block; its errors, held-out samples and
    outliers.

    Errors and held-out samples need a square lift. Every block of samples is read only
    once.
    """
    table = tables.table
    lift = tables.lift
    b = block_memory(block, table.shape[3])
    work = fit_memory(b.pairs.shape[0], table.shape[3], lift.shape[1])
    turning = turn_memory(block.light.shape[0], block.camera.shape[0], table.shape[3])
    kinds = held_kinds(errors.held)
    for s in range(block.position.shape[0]):
        x = out.parameters[s]
        out.status[s] = prepare(s, block, options, b)
        if out.status[s] != FITTED:
            x[:] = np.nan
            continue
        choose_kind(0, errors.held, b)
        count = write_rows(block.normal[s], table, b)
        matt, seen = start_fit(s, count, options, b, out)
        split_diffuse(block.diffuse[s], count, b)
        weigh(s, count, block.noise, options, b)
        problem = Problem(
            b.rows,
            b.target,
            b.weight,
            count,
            lift,
            options.mode == PERCEPTUAL,
            options.floor,
            KKT_TOLERANCE,
        )
        converged = True
        if matt:
            x[:] = 0.0
        elif options.solve:
            _block_narrow(tables.half_width, options.min_width * seen, work)
            converged = _solve(s, problem, options, b, work, out)
        out.status[s] = fitted_status(matt, converged, block.diffuse[s])
        predict(b.rows, count, coefficients(lift, x), b.surface, work.single)
        if out.counts.shape[2] > 0:
            out.outlier[s] = outliers(count, options, b, work.root, out.counts)
        if out.covariance.shape[1] > 0 and not matt:
            _write_covariance(s, problem, block, errors, out, b, work)
            if errors.turn[s] > 0.0:
                add_turned(
                    block.normal[s],
                    errors.turn[s],
                    block.diffuse[s],
                    table,
                    problem,
                    options.eta,
                    x,
                    out.covariance[s],
                    b,
                    work,
                    turning,
                )
        out.residual[s], out.residual_perceptual[s] = add_surface(count, b)
        for kind in range(1, 3):
            if kinds[kind]:
                _write_held_error(s, kind, block, tables, errors, out, b, work)
        if matt:
            x[:] = np.nan
