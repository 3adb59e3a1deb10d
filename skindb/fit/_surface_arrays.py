"""The surface fits as functions of arrays: the inputs and outputs of the kernels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skindb.fit._surface_kernels import (
    BINS_PER_SCALE,
    OUTLIER_SCALES,
    Block,
    Errors,
    Fitted,
    Options,
    fit_block,
    refit_block,
)
from skindb.fit.sample_noise import NO_NOISE, TypicalNoise, noise_of
from skindb.jit import sample_bits
from skindb.reflectance.tables import TableGrid, pad_to_lanes
from skindb.types import Array

# in the order of the codes in `_surface_kernels`
MODES = ("linear", "perceptual", "paper")
MAX_LOG_SCALE = np.log(1e9)  # tables within this factor of 1 are used without scaling
GEOMETRIES = 5  # number of arrays between the samples and the noise
# of the histograms of residuals; the last one has no upper limit
BINS = int(OUTLIER_SCALES * BINS_PER_SCALE) + 1


@dataclass(frozen=True)
class Tables:
    """BRDF tables for the kernels: a reduced space and the map to weights. Mode "paper"
    needs their cube roots.
    """

    reduced: NDArray[np.float32]  # (nh, nd, np, r) sr^-1
    grid: TableGrid
    lift: Array  # (r, m); square: the identity
    # `reduced` over `scale`, padded to full vectors
    filled: NDArray[np.float32] = field(init=False, repr=False)
    # (m,) powers of two; 1 except for tables whose squares exceed single precision
    scale: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Pad the table to full vectors."""
        rank, count = self.lift.shape
        largest = np.abs(self.reduced.reshape(-1, rank)).max(axis=0).astype(np.float64)
        if rank != count:
            largest[:] = largest.max()
        extreme = (
            np.isfinite(largest)
            & (largest > 0)
            & (np.abs(np.log(np.maximum(largest, 1e-300))) > MAX_LOG_SCALE)
        )
        scale = np.where(
            extreme, 2.0 ** np.round(np.log2(np.where(extreme, largest, 1.0))), 1.0
        )
        table = (
            np.asarray(self.reduced / scale, np.float32)
            if extreme.any()
            else self.reduced
        )
        # memory-mapped arrays are read-only: all are marked so, as kernels would be
        # compiled twice otherwise
        object.__setattr__(self, "filled", _read_only(pad_to_lanes(table)))
        object.__setattr__(
            self, "lift", _read_only(np.ascontiguousarray(self.lift, np.float64))
        )
        object.__setattr__(
            self, "scale", scale if rank == count else np.full(count, scale[0])
        )


class Weights(NamedTuple):
    """Results of the fit of n surfels; NaN where the status says that nothing was fitted."""

    weight: Array  # (n, m)
    kkt: Array  # (n,), as are the following arrays
    residual: Array  # RMS error over RMS of the samples, diffuse light included
    residual_perceptual: Array  # the same in cube-root space
    condition: Array
    samples: NDArray[Any]
    iterations: NDArray[Any]
    status: NDArray[Any]


class Refit(NamedTuple):
    """Results of `refit_weights` for n surfels."""

    weight: Array  # (n, k)
    residual: Array  # (n,)
    residual_perceptual: Array  # (n,)
    # (n, k, k) of the weights above 0, NaN for the others; (n, 0, 0) without errors
    covariance: Array
    # (n, 2, 2) relative errors at held-out lights and in held-out cameras, linear and
    # in cube roots
    held_error: Array
    outlier: Array  # (n,) fraction of outlying samples
    # (lights, cameras, BINS) histograms of scaled residuals, the sum over the surfels
    counts: NDArray[np.int64]


def surface_weights(
    *arrays: Array,
    tables: Tables,
    eta: float,
    mode: str,
    noise_floor: float,
    noise: TypicalNoise = NO_NOISE,
    min_samples: int,
    weight: Array | None = None,
) -> Weights:
    """Weights of n surfels by the dictionary, or the residuals of given weights `weight` (n, m).

    Samples below `noise_floor` [sr^-1] are compared linearly; samples whose `noise`
    exceeds the error of models have less weight. `arrays` are samples (n, lights,
    cameras, 3), positions (n, 3), lights (l, 3), cameras (c, 3), normals (n, 3) and R_d
    (n, 3), and, if the noise of each sample is known, the arrays of `noise_inputs`
    instead of `noise`.
    """
    out = _fitted(len(arrays[0]), tables, weight)
    options = Options(
        float(eta),
        MODES.index(mode),
        float(noise_floor),
        max(min_samples, 1),
        weight is None,
    )
    fit_block(_block(arrays, noise), tables.filled, tables.lift, options, out)
    out.weight[...] /= tables.scale
    return Weights(*out)


def refit_weights(
    *arrays: Array,
    tables: Tables,
    eta: float,
    mode: str,
    noise_floor: float,
    noise: TypicalNoise = NO_NOISE,
    min_samples: int,
    weight: Array | None = None,
    diffuse_error: Array | None = None,
    normal_error: Array | None = None,
    held: NDArray[np.int64] | None = None,
    outliers: bool = False,
) -> Refit:
    """Weights of n surfels by a reduced basis (square lift), or the residuals of given
    weights `weight` (n, k).

    Parameters
    ----------
    *arrays
        As in `surface_weights`.
    tables, eta, mode, noise_floor, noise, min_samples, weight
        As in `surface_weights`; not "paper".
    diffuse_error, normal_error
        (n, 3) standard errors of R_d and (n,) RMS angles to the true normals [degree].
        The covariance of the weights is computed if `diffuse_error` is given.
    held
        (lights, cameras) 0 for samples that are fitted, 1 under held-out lights, 2 in
        held-out cameras, 3 for both.
    outliers
        Whether to find outlying samples.
    """
    sample = arrays[0]
    n, lights, cameras = sample.shape[:3]
    m = tables.lift.shape[1]
    out = _fitted(n, tables, weight)
    wanted = 0 if diffuse_error is None else m
    turn = (
        np.zeros(n)
        if normal_error is None
        else np.radians(np.nan_to_num(np.float64(normal_error)) / np.sqrt(2))
    )
    more = Errors(
        diffuse_error=np.zeros((n, 3))
        if diffuse_error is None
        else np.nan_to_num(diffuse_error.astype(np.float64)),
        turn=turn,
        covariance=np.full((n, wanted, wanted), np.nan),
        held=np.zeros((lights, cameras), np.int64) if held is None else held,
        held_error=np.full((n, 2, 2), np.nan),
        outlier=np.full(n, np.nan),
        counts=np.zeros((lights, cameras, BINS if outliers else 0), np.int64),
    )
    options = Options(
        float(eta),
        MODES.index(mode),
        float(noise_floor),
        max(min_samples, 1),
        weight is None,
    )
    refit_block(_block(arrays, noise), tables.filled, tables.lift, options, out, more)
    out.weight[...] /= tables.scale
    if wanted:
        more.covariance[...] /= np.multiply.outer(tables.scale, tables.scale)
    found = (out.weight, out.residual, out.residual_perceptual, more.covariance)
    return Refit(*found, more.held_error, more.outlier, more.counts)


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view


def _block(arrays: tuple[Array, ...], noise: TypicalNoise) -> Block:
    sample, *others = arrays
    position, light, camera, normal, diffuse = (
        np.ascontiguousarray(a, np.float64) for a in others[:GEOMETRIES]
    )
    known = noise_of(others[GEOMETRIES:], noise)
    return Block(sample_bits(sample), position, light, camera, normal, diffuse, known)


def _fitted(n: int, tables: Tables, weight: Array | None) -> Fitted:
    m = tables.lift.shape[1]
    x: Any = (
        np.full((n, m), np.nan)
        if weight is None
        else np.ascontiguousarray(weight * tables.scale, np.float64)
    )
    kkt, residual, perceptual, condition = (np.full(n, np.nan) for _ in range(4))
    samples, iterations = (np.zeros(n, np.int32) for _ in range(2))
    return Fitted(
        x,
        kkt,
        residual,
        perceptual,
        condition,
        samples,
        iterations,
        np.zeros(n, np.uint8),
    )
