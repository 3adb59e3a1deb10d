"""Compiled effect of an error of the normal on the weights of a mixture: refits with turned
normals, in which only some of the samples are computed anew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skindb.jit import fast_kernel, kernel
from skindb.reflectance._lumitexel_kernels import (
    Lumitexel,
    add_scatter,
    transmission,
    turned_normals,
)
from skindb.reflectance._mixture_kernels import (
    FitMemory,
    Problem,
    gram,
    solve_equations,
    weigh_rows,
)
from skindb.reflectance._row_kernels import CHUNK, interpolate_rows, ways
from skindb.types import IntMatrix32, Matrix, Matrix32, Tensor32, Vector, Vector32

# In linear space, rows with the half vector within 20 degrees of the normal are all
# computed anew, and of the others at least 64, at most one of 8. Of surfels with 1,140
# samples these are a fourth, and 90 % of the stated errors of four weights are within 2 %
# of those with all rows (of 59 weights, -8 to +19 %), for an error of the normal of 0.5
# degrees, 5 % noise, and a basis that does not fit. In cube-root space, dark rows far from
# the normal have the largest weights; one of 8 gave errors of up to 2.5 times as much, so
# that all are computed
NEAR_SINE_SQUARE = np.float32(np.sin(np.radians(20.0)) ** 2)
FAR_ROWS = 64
MAX_SPACING = 8
# multiples of both fall evenly between 0 and 2^16 for the lights of each camera, and for
# the cameras of each light: 2^16 over the plastic number, and over its square
LIGHT_STEP, CAMERA_STEP = 49471, 37345
THIRD, ONE = np.float32(1.0 / 3.0), np.float32(1.0)


class TurnMemory(NamedTuple):
    """Memory for `add_turned`; each thread needs its own."""

    normals: Matrix  # (4, 3)
    lit: Vector  # (lights,) as in `Lumitexel`, for a turned normal
    seen: Vector
    enters: Vector
    leaves: Vector
    sine: Vector32  # (rows,) squared sine between the half vector and the normal
    # (rows,) number of rows that each chosen one stands for, 0 for the others
    stands_for: Vector32
    pairs: IntMatrix32  # of chosen rows, as the following arrays
    way: Matrix32
    rows: Matrix32
    mean: Vector32  # of the channels of the samples
    target: Matrix32  # (1, rows) minus the diffuse part for a turned normal
    weight: Vector32
    gram: Matrix  # (width, width) of the rows that keep their values
    right: Vector  # (width,)


@kernel
def turn_memory(lights: int, cameras: int, width: int) -> TurnMemory:
    """Memory for up to `width` columns of rows."""
    size = lights * cameras
    return TurnMemory(
        np.empty((4, 3)),
        np.empty(lights),
        np.empty(cameras),
        np.empty(lights),
        np.empty(cameras),
        np.empty(size, np.float32),
        np.empty(size, np.float32),
        np.empty((size, 2), np.int32),
        ways(size),
        np.empty((size, width), np.float32),
        np.empty(size, np.float32),
        np.empty((1, size), np.float32),
        np.empty(size, np.float32),
        np.empty((width, width)),
        np.empty(width),
    )


@fast_kernel
def _write_sines(n: Vector, way: Vector32, sine: Vector32) -> None:
    """Write the squared sine between the normal and the half vectors of up to CHUNK rows."""
    nx = np.float32(n[0])
    ny = np.float32(n[1])
    nz = np.float32(n[2])
    for q in range(sine.shape[0]):
        hx = way[q] + way[3 * CHUNK + q]
        hy = way[CHUNK + q] + way[4 * CHUNK + q]
        hz = way[2 * CHUNK + q] + way[5 * CHUNK + q]
        up = nx * hx + ny * hy + nz * hz
        sine[q] = ONE - up * up / (hx * hx + hy * hy + hz * hz)


@kernel
def _choose_rows(
    n: Vector, count: int, perceptual: bool, b: Lumitexel, t: TurnMemory
) -> int:
    """Copy the rows that are computed anew; returns their number."""
    for begin in range(0, count, CHUNK):
        end = min(begin + CHUNK, count)
        _write_sines(n, b.row_memory.way[begin // CHUNK], t.sine[begin:end])
    spacing = 1 if perceptual else min(max(count // FAR_ROWS, 1), MAX_SPACING)
    chosen = 0
    for r in range(count):
        near = t.sine[r] < NEAR_SINE_SQUARE
        t.stands_for[r] = ONE if near else np.float32(spacing)
        place = b.pairs[r, 0] * LIGHT_STEP + b.pairs[r, 1] * CAMERA_STEP
        if not near and (place & 0xFFFF) * spacing >= 0x10000:
            t.stands_for[r] = np.float32(0)
            continue
        way = b.row_memory.way[r // CHUNK]
        copy = t.way[chosen // CHUNK]
        for k in range(7):
            copy[k * CHUNK + chosen % CHUNK] = way[k * CHUNK + r % CHUNK]
        t.pairs[chosen, 0], t.pairs[chosen, 1] = b.pairs[r, 0], b.pairs[r, 1]
        t.mean[chosen] = (b.sample[0, r] + b.sample[1, r] + b.sample[2, r]) * THIRD
        t.weight[chosen] = b.weight[r] * t.stands_for[r]
        chosen += 1
    return chosen


@kernel
def _keep_others(count: int, b: Lumitexel, work: FitMemory, t: TurnMemory) -> None:
    """Write the normal equations of the others, whose values change with those of the
    chosen rows that stand for them: minus these, times how many they stand for.
    """
    for r in range(count):
        share = (ONE - t.stands_for[r]) * THIRD
        work.aim[r] = share * work.slope[r] * work.root.total[r] * THIRD
        work.root.trial[r] = share * work.slope[r]
    gram(b.rows, count, work.root.trial, work.aim, t.gram, t.right, work.block)


@kernel
def add_turned(
    normal: Vector,
    turn: float,
    diffuse: Vector,
    table: Tensor32,
    problem: Problem,
    eta: float,
    x: Vector,
    covariance: Matrix,
    b: Lumitexel,
    work: FitMemory,
    t: TurnMemory,
) -> None:
    """Add to the covariance of the weights x the effect of an error `turn` [rad] of the
    normal about either axis, directly after `weight_covariance`.

    Each of four turned normals changes the normal equations by the difference that it
    makes to the chosen rows. In linear space, half vectors near the normal matter most; the
    difference of the others is small and smooth, so that few stand for all.
    """
    chosen = _choose_rows(normal, problem.size, problem.perceptual, b, t)
    if chosen < problem.size:
        _keep_others(problem.size, b, work, t)
    else:
        t.gram[:] = 0.0
        t.right[:] = 0.0
    part = Problem(
        t.rows,
        t.target,
        t.weight,
        chosen,
        problem.lift,
        problem.perceptual,
        problem.floor,
        problem.tolerance,
    )
    body = (diffuse[0] + diffuse[1] + diffuse[2]) / 3.0
    turned_normals(normal, turn, t.normals)
    for q in range(4):
        n = t.normals[q]
        transmission(n, b.to_light, eta, 0.0, t.lit, t.enters)
        transmission(n, b.to_camera, eta, 0.0, t.seen, t.leaves)
        for r in range(chosen):
            i = t.pairs[r, 0]
            scattered = body / np.pi * t.lit[i] * t.enters[i] * t.leaves[t.pairs[r, 1]]
            t.target[0, r] = t.mean[r] - np.float32(scattered)
        interpolate_rows(table, n, chosen, t.way, b.row_memory, t.rows)
        weigh_rows(part, x, work)
        gram(
            t.rows,
            chosen,
            work.slope,
            work.aim,
            work.reduced_gram,
            work.reduced_right,
            work.block,
        )
        for j in range(x.shape[0]):
            work.moved[j] = x[j]
            work.reduced_right[j] += t.right[j]
            for k in range(x.shape[0]):
                work.reduced_gram[j, k] += t.gram[j, k]
        solve_equations(part, work.moved, work)
        add_scatter(work.moved, x, covariance)
