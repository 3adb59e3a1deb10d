"""Fits of measured BRDFs to what the diffuse term leaves, as numbers; methods in `skindb.fit.surface`.

A compiled kernel outside optics and numerics: it joins theirs (rows of `optics`, solver of `numerics`) so that the rows
of a surfel, 60 kB at rank 16, never leave the cache between being formed and being solved.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

from skindb.fit._albedo_kernels import LARGE, SMALL
from skindb.fit._arrays import BATCH, Array
from skindb.numerics._reflectance_kernels import (
    coefficients,
    fit_one,
    fit_weighted,
    predict,
    relative_errors,
    workspace,
)
from skindb.numerics._weight_error_kernels import weight_covariance
from skindb.optics._row_kernels import form_rows, row_memory
from skindb.optics._shade_kernels import transmittance
from skindb.optics.brdf_table import TableGrid
from skindb.optics.rows import fill_up
from skindb.schema import FitStatus

Block = NDArray[Any]
GRAZING = 0.1  # cosine to light or camera below which samples are left out: half-hidden discs, mixed pixels
ORDINARY = np.log(1e9)  # tables between its inverse and it are used as they are
TOLERANCE = 1e-10  # of the KKT residual
PLAIN = 1e-9  # sr^-1; floor of the roots that residuals are measured between: none
MODES = {"linear": 0, "perceptual": 1, "paper": 2}
FITTED, UNSEEN, FEW, NO_DIFFUSE, CLAMPED, NOT_CONVERGED, NOT_FINITE = (int(status) for status in FitStatus)


@dataclass(frozen=True)
class Tables:
    """BRDF tables as the kernels use them: a reduced space and the way back. Mode "paper" needs their cube roots."""

    reduced: NDArray[np.float32]  # (nh, nd, np, r) sr^-1
    grid: TableGrid
    lift: Array  # (r, m); square: the identity
    filled: NDArray[np.float32] = field(init=False, repr=False)  # `reduced` over `scale`, in whole vectors
    scale: Array = field(
        init=False, repr=False
    )  # (m,) powers of two; 1 but for tables whose squares floats cannot hold

    def __post_init__(self) -> None:
        """Fill up the table."""
        rank, count = self.lift.shape
        largest = np.abs(self.reduced.reshape(-1, rank)).max(axis=0).astype(np.float64)
        if rank != count:
            largest[:] = largest.max()
        extreme = np.isfinite(largest) & (largest > 0) & (np.abs(np.log(np.maximum(largest, 1e-300))) > ORDINARY)
        scale = np.where(extreme, 2.0 ** np.round(np.log2(np.where(extreme, largest, 1.0))), 1.0)
        table = np.asarray(self.reduced / scale, np.float32) if extreme.any() else self.reduced
        object.__setattr__(self, "filled", fill_up(table))
        object.__setattr__(self, "scale", scale if rank == count else np.full(count, scale[0]))


class Weights(NamedTuple):
    """What is known of n surfels; NaN where the status says that nothing was fitted."""

    weight: Array  # (n, m)
    kkt: Array  # (n,) as the following
    residual: Array  # RMS error over RMS of the samples, diffuse light included
    residual_perceptual: Array  # the same between cube roots
    condition: Array
    samples: NDArray[np.int32]
    iterations: NDArray[np.int32]
    status: NDArray[np.uint8]
    covariance: Array  # (n, m, m) of the weights above 0, NaN for the others; (n, 0, 0) where it was not asked for


def surface_weights(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    diffuse: Array,
    *,
    tables: Tables,
    eta: float,
    mode: str,
    noise_floor: float,
    min_samples: int,
    weight: Array | None = None,
    diffuse_error: Array | None = None,
    normal_error: Array | None = None,
) -> Weights:
    """Weights of n surfels, or with `weight` (n, m) only how well these explain the samples.

    With `diffuse_error` (n, 3), standard errors of `diffuse`, their covariance too, the lift must be square then; with
    `normal_error` (n,), RMS angles [deg] to the true normals, these count too.
    """
    n, m = len(sample), tables.lift.shape[1]
    x = np.full((n, m), np.nan) if weight is None else np.ascontiguousarray(weight * tables.scale, np.float64)
    numbers, counts = np.full((4, n), np.nan), np.zeros((2, n), np.int32)
    status, wanted = np.zeros(n, np.uint8), 0 if diffuse_error is None else m
    covariance = np.full((n, wanted, wanted), np.nan)
    error = np.zeros((n, 3)) if diffuse_error is None else np.nan_to_num(diffuse_error.astype(np.float64))
    turn = (
        np.zeros(n) if normal_error is None else np.radians(np.nan_to_num(normal_error.astype(np.float64)) / np.sqrt(2))
    )
    light, camera = light.astype(np.float64), camera.astype(np.float64)
    for i in range(0, n, BATCH):
        part = slice(i, min(i + BATCH, n))
        fit_block(
            _bits(sample[part]), position[part].astype(np.float64), light, camera,
            normal[part].astype(np.float64), diffuse[part].astype(np.float64), tables.filled,
            np.ascontiguousarray(tables.lift), float(eta), MODES[mode], float(noise_floor), max(min_samples, 1),
            weight is None, x[part], numbers[:, part], counts[:, part], status[part], error[part],
            turn[part], covariance[part],
        )  # fmt: skip
    kkt, linear, perceptual, condition = numbers
    x /= tables.scale
    if wanted:
        covariance /= np.multiply.outer(tables.scale, tables.scale)
    return Weights(x, kkt, linear, perceptual, condition, counts[0], counts[1], status, covariance)


def _bits(sample: Array) -> NDArray[Any]:
    """Half floats as their bits, which `value` turns into numbers one by one; others as single floats."""
    half = sample.dtype == np.float16
    return np.ascontiguousarray(sample).view(np.uint16) if half else np.ascontiguousarray(sample, np.float32)


@intrinsic
def _half(_typing: Any, bits: Any) -> Any:
    """The half float with these bits as a single float, by the processor."""

    def codegen(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.fpext(builder.bitcast(arguments[0], ir.HalfType()), ir.FloatType())

    return types.float32(bits), codegen


def value(sample, i, o, c):  # type: ignore[no-untyped-def]  # numba wants both signatures alike
    """One sample of a surfel; compiled to what its type needs."""
    return sample[i, o, c]


@overload(value, inline="always")
def _value(sample, i, o, c):  # type: ignore[no-untyped-def]  # noqa: ARG001
    if sample.dtype == types.uint16:
        return lambda sample, i, o, c: _half(sample[i, o, c])
    return lambda sample, i, o, c: sample[i, o, c]


@nb.njit(cache=True, nogil=True)
def _unit_towards(target: Any, p: Any, out: Any) -> None:
    for i in range(target.shape[0]):
        x, y, z = target[i, 0] - p[0], target[i, 1] - p[1], target[i, 2] - p[2]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x * scale, y * scale, z * scale


@nb.njit(cache=True, nogil=True)
def _finite(v: Any) -> bool:
    return bool(np.isfinite(v[0]) and np.isfinite(v[1]) and np.isfinite(v[2]))


@nb.njit(cache=True, nogil=True)
def _through(n: Any, towards: Any, eta: float, cosine: Any, share: Any) -> None:
    """Cosines of directions, and the share of light that the boundary lets through; 0 below GRAZING."""
    for i in range(towards.shape[0]):
        c = n[0] * towards[i, 0] + n[1] * towards[i, 1] + n[2] * towards[i, 2]
        above = c > GRAZING and c < 2.0  # NaN is neither
        cosine[i] = c if above else 0.0
        share[i] = transmittance(c, eta) if above else 0.0


@nb.njit(cache=True, nogil=True)
def _usable(sample: Any, lit: Any, seen: Any, out: Any) -> int:
    """Mask of usable samples; what is wrong with all of them as a status: UNSEEN, NOT_FINITE or FITTED."""
    status = UNSEEN
    for i in range(sample.shape[0]):
        for o in range(sample.shape[1]):
            a, b, c = value(sample, i, o, 0), value(sample, i, o, 1), value(sample, i, o, 2)  # type: ignore[no-untyped-call]
            finite = np.isfinite(a) and np.isfinite(b) and np.isfinite(c)
            if not finite and (np.isinf(a) or np.isinf(b) or np.isinf(c)):
                return NOT_FINITE
            if status == UNSEEN and (finite or not (np.isnan(a) and np.isnan(b) and np.isnan(c))):
                status = FITTED
            out[i, o] = finite and lit[i] > 0.0 and seen[o] > 0.0
    return status


@nb.njit(cache=True, nogil=True)
def _targets(
    sample: Any, d: Any, index: Any, enters: Any, leaves: Any, given: Any, scattered: Any, target: Any
) -> None:
    """Samples, their diffuse part and what it leaves, channel after channel, of the rows of one surfel."""
    for r in range(index.shape[0]):
        i, o = index[r, 0], index[r, 1]
        scattered[2, r] = enters[i] * leaves[o]
        for c in range(3):
            given[c, r] = value(sample, i, o, c)  # type: ignore[no-untyped-call]
    for c in range(3):
        share = np.float32(d[c])
        for r in range(index.shape[0]):
            scattered[c, r] = scattered[2, r] * share
            target[c, r] = given[c, r] - scattered[c, r]


@nb.njit(cache=True, nogil=True)
def _cube_roots(rows: Any, target: Any, index: Any, lit: Any) -> None:
    """Rows and targets of mode "paper": the table holds cube roots, so the cosine's root is what is left to change."""
    for r in range(index.shape[0]):
        scale = np.float32(lit[index[r, 0]] ** (-2.0 / 3.0))
        for q in range(rows.shape[1]):
            rows[r, q] *= scale
        for c in range(3):
            target[c, r] = np.cbrt(target[c, r])


@nb.njit(cache=True, nogil=True)
def _form(sample: Any, n: Any, d: Any, eta: float, to_light: Any, to_camera: Any, table: Any, scratch: Any) -> Any:
    """Rows and targets of one surfel with this normal; what `_usable` says, and how many."""
    lit, seen, enters, leaves, usable, index, memory, rows, channels = scratch
    _through(n, to_light, eta, lit, enters)
    _through(n, to_camera, eta, seen, leaves)
    status = _usable(sample, lit, seen, usable)
    if status != FITTED:
        return status, 0
    count = form_rows(table, n, to_light, to_camera, usable, memory, rows, index)
    for i in range(len(lit)):
        enters[i] *= lit[i] / np.pi
    part = index[:count]
    _targets(sample, d, part, enters, leaves, channels[:3, :count], channels[3:6, :count], channels[6:, :count])
    return status, count


@nb.njit(cache=True, nogil=True)
def _across(a: Any, b: Any, out: Any) -> None:
    """Unit vector across two others; loops, since each operation on whole arrays takes seconds to compile."""
    for k in range(3):
        out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]
    size = np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    for k in range(3):
        out[k] /= size


@nb.njit(cache=True, nogil=True)
def _add_turned(
    sample: Any, n: Any, turn: float, d: Any, eta: float, to_light: Any, to_camera: Any, table: Any, lift: Any,
    perceptual: bool, floor: float, least: int, x: Any, out: Any, scratch: Any, ones: Any, work: Any,
) -> None:  # fmt: skip
    """Add to the covariance `out` what a normal uncertain by `turn` [rad] about either axis moves the weights by.

    Weights at the four points of the Gauss-Hermite rule of three points an axis, right to the second order: a lobe that
    is met at its peak loses weight whichever way the normal turns.
    """
    small = 0
    for k in range(3):
        small = k if abs(n[k]) < abs(n[small]) else small
    away, moved = np.zeros(3), np.empty(x.shape[0])
    away[small] = 1.0
    first, second, turned = np.empty(3), np.empty(3), np.empty(3)
    _across(n, away, first)
    _across(n, first, second)
    for q in range(4):
        axis = first if q < 2 else second
        angle = np.sqrt(3.0) * turn * (1.0 if q % 2 == 0 else -1.0)
        for k in range(3):
            turned[k] = np.cos(angle) * n[k] + np.sin(angle) * axis[k]
        _, count = _form(sample, turned, d, eta, to_light, to_camera, table, scratch)
        if count < least:
            continue
        for j in range(x.shape[0]):
            moved[j] = x[j]
        fit_weighted(scratch[7], scratch[8][6:, :count], ones, lift, perceptual, floor, TOLERANCE, moved, work)
        for j in range(x.shape[0]):
            for k in range(x.shape[0]):
                out[j, k] += (moved[j] - x[j]) * (moved[k] - x[k]) / 6.0


@nb.njit(cache=True, nogil=True)
def fit_block(
    sample: Any, position: Any, light: Any, camera: Any, normal: Any, diffuse: Any, table: Any, lift: Any,
    eta: float, mode: int, floor: float, least: int, solve: bool, x: Any, numbers: Any, counts: Any, status: Any,
    error: Any, turn: Any, covariance: Any,
) -> None:  # fmt: skip
    """Fit, or only evaluate, every surfel of a block; results as in `Weights`."""
    lights, cameras = len(light), len(camera)
    most = lights * cameras
    to_light, to_camera = np.empty((lights, 3)), np.empty((cameras, 3))
    usable, index = np.zeros((lights, cameras), np.bool_), np.empty((most, 2), np.int32)
    width = table.shape[3]
    rows, channels = np.empty((most, width), np.float32), np.empty((9, most), np.float32)
    ones, y = np.ones(most, np.float32), np.empty(most, np.float32)
    scratch = (
        np.empty(lights), np.empty(cameras), np.empty(lights), np.empty(cameras), usable, index,
        row_memory(cameras), rows, channels,
    )  # fmt: skip
    lit, drift = scratch[0], np.empty(3)
    work = workspace(most, width, lift.shape[1])
    for s in range(len(sample)):
        p, n, d = position[s], normal[s], diffuse[s]
        _unit_towards(light, p, to_light)
        _unit_towards(camera, p, to_camera)
        status[s], count = _form(sample[s], n, d, eta, to_light, to_camera, table, scratch)
        if status[s] == UNSEEN:
            continue
        if status[s] == NOT_FINITE or not _finite(p):
            status[s] = NOT_FINITE
            continue
        if not _finite(n):
            status[s] = FEW  # a normal needs light that is not grazing
            continue
        if not _finite(d):
            status[s] = NO_DIFFUSE
            continue
        counts[0, s] = count
        if count < least:
            status[s] = FEW
            continue
        given, scattered, target = channels[:3, :count], channels[3:6, :count], channels[6:, :count]
        if mode == 2:
            _cube_roots(rows, target, index[:count], lit)
        if solve:
            numbers[0, s], counts[1, s], met, numbers[3, s] = fit_one(
                rows, target, ones, lift, mode == 1, floor, TOLERANCE, x[s], work
            )
            if not met:
                status[s] = NOT_CONVERGED
            elif min(d[0], d[1], d[2]) <= np.float32(SMALL) or max(d[0], d[1], d[2]) >= np.float32(LARGE):
                status[s] = CLAMPED
        predict(rows, count, coefficients(lift, x[s]), y, work[10])
        if covariance.shape[1] > 0:
            # colour differences have no part in the sum over channels: the error they share is at most the smallest
            for c in range(3):
                drift[c] = min(error[s, 0], error[s, 1], error[s, 2]) / max(d[c], SMALL)
            weight_covariance(rows, y[:count], mode == 1, floor, scattered, drift, x[s], covariance[s], work)
        for c in range(3):
            for r in range(count):
                scattered[c, r] += y[r] ** 3 if mode == 2 else y[r]
        numbers[1, s], numbers[2, s] = relative_errors(scattered, given, PLAIN, work)
        if covariance.shape[1] > 0 and turn[s] > 0.0:
            _add_turned(
                sample[s], n, turn[s], d, eta, to_light, to_camera, table, lift, mode == 1, floor, least, x[s],
                covariance[s], scratch, ones, work,
            )  # fmt: skip
