"""What implementations of `ReflectanceModel` share: blocks of surfels and empty results in
the form of the kernels, and the diffuse term.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from skindb.jit import sample_bits
from skindb.numerics.statistics import ROUNDING
from skindb.reflectance import _shade_kernels
from skindb.reflectance._lumitexel_kernels import BINS, JudgedErrors, Options
from skindb.reflectance.model import (
    Block,
    Comparison,
    Judgement,
    Lamp,
    Points,
    SurfaceFit,
)
from skindb.reflectance.tables import Table
from skindb.schema import variables
from skindb.types import Array, Float32, contiguous, float64

MODES = ("linear", "perceptual")  # in the order of `_lumitexel_kernels`
# that any model has after a first pass, in the order of `SurfaceFit` after its parameters
FIT_VARIABLES = (
    variables.KKT_RESIDUAL,
    variables.FIT_RESIDUAL,
    variables.FIT_RESIDUAL_PERCEPTUAL,
    variables.FIT_CONDITION,
    variables.FIT_SAMPLES,
    variables.SMALLEST_HALF_ANGLE,
    variables.FIT_ITERATIONS,
    variables.FIT_STATUS,
)
NO_TABLE = np.zeros((2, 2, 1, 0), np.float32)


def kernel_block(block: Block) -> Block:
    """The block in the types for which the kernels are compiled."""
    doubles: dict[str, Any] = {
        name: contiguous(getattr(block, name))
        for name in ("position", "light", "camera", "normal", "diffuse", "polarisation")
    }
    return block._replace(sample=sample_bits(block.sample), **doubles)


def kernel_options(comparison: Comparison, *, solve: bool) -> Options:
    """A comparison for the kernels; without `solve` given parameters are only evaluated."""
    return Options(
        float(comparison.eta),
        MODES.index(comparison.mode),
        float(comparison.noise_floor),
        max(comparison.min_samples, 1),
        solve,
        float(comparison.min_width),
    )


def kernel_errors(block: Block, judgement: Judgement) -> JudgedErrors:
    """The errors of the input of a judgement for the kernels, and the held-out samples."""
    n = len(block.sample)
    diffuse = np.zeros((n, 3))
    if judgement.diffuse_error is not None:
        diffuse = np.nan_to_num(float64(judgement.diffuse_error))
    turn = np.zeros(n)
    if judgement.normal_error is not None:  # the RMS angle is that of two axes
        angle = np.nan_to_num(np.float64(judgement.normal_error))
        turn = np.radians(angle / np.sqrt(2))
    held = np.zeros((0, 0), np.int64) if judgement.held is None else judgement.held
    return JudgedErrors(diffuse, turn, held)


def empty_fit(
    block: Block, judgement: Judgement, size: int, parameters: Array | None = None
) -> SurfaceFit:
    """Results before a fit with `size` parameters, or with given ones."""
    n, lights, cameras = block.sample.shape[:3]
    if parameters is None:
        parameters = np.full((n, size), np.nan)
    columns = 0 if judgement.diffuse_error is None else size
    bins = BINS if judgement.outliers else 0
    kkt, linear, perceptual, condition, half_angle, outlier = np.full((6, n), np.nan)
    return SurfaceFit(
        parameters=np.array(parameters, np.float64, order="C"),
        kkt=kkt,
        residual=linear,
        residual_perceptual=perceptual,
        condition=condition,
        samples=np.zeros(n, np.int32),
        half_angle=half_angle,
        iterations=np.zeros(n, np.int32),
        status=np.zeros(n, np.uint8),
        covariance=np.full((n, columns, columns), np.nan),
        held_error=np.full((n, 2, 2), np.nan),
        outlier=outlier,
        counts=np.zeros((lights, cameras, bins), np.int64),
    )


def gloss_of(reflectance: Array) -> dict[str, Array]:
    """Surface reflectance and glossiness of n surfels from `normal_reflectance` (2, n)."""
    whole, narrow = reflectance
    return {
        variables.SURFACE_REFLECTANCE: whole,
        variables.GLOSSINESS: narrow / np.where(whole > 0, whole, np.nan),
    }


def gloss_columns(
    judged: SurfaceFit, reflectance: Array, gradient: Array
) -> dict[str, Array]:
    """Surface reflectance and glossiness of n surfels with their standard errors.

    Parameters
    ----------
    judged
        Fit with the covariance of its m parameters.
    reflectance
        (2, n) fractions of light along the normal that surfels reflect: all of it, and
        that in the narrow of two lobes.
    gradient
        (2, n or 1, m) derivatives by the parameters.
    """
    gloss = gloss_of(reflectance)
    whole, glossiness = gloss.values()
    by_whole, by_narrow = gradient
    by_narrow = by_narrow - glossiness[:, None] * by_whole
    covariance = np.nan_to_num(judged.covariance)
    variance = np.stack(
        [
            np.einsum("nj,njk,nk->n", slope, covariance, slope)
            for slope in np.broadcast_arrays(by_whole, by_narrow)
        ]
    )
    deviation = np.sqrt(np.where(variance > ROUNDING**2, variance, np.nan))
    return {
        **gloss,
        variables.SURFACE_REFLECTANCE_ERROR: deviation[0],
        variables.GLOSSINESS_ERROR: deviation[1] / whole,
    }


def shade_diffuse(points: Points, lamp: Lamp, *, eta: float) -> Float32:
    """Radiance (n, 3) of the diffuse term alone, see `ReflectanceModel.shade`."""
    none = np.zeros((len(points.position), 0))
    return shade_tables(points._replace(parameters=none), NO_TABLE, lamp, eta=eta)


def shade_tables(points: Points, table: Table, lamp: Lamp, *, eta: float) -> Float32:
    """Radiance (n, 3) of the diffuse term and of mixtures of tables (nh, nd, np, k)."""
    out = np.empty((len(points.position), 3), np.float32)
    _shade_kernels.shade(
        contiguous(points.position),
        contiguous(points.normal),
        contiguous(points.view),
        np.ascontiguousarray(points.diffuse, np.float32),
        np.ascontiguousarray(points.parameters, np.float32),
        np.ascontiguousarray(table, np.float32),
        contiguous(lamp.place),
        np.ascontiguousarray(lamp.lit, np.float32),
        contiguous(lamp.axis),
        float(lamp.falloff),
        float(eta),
        points.parameters.shape[1] > 0,
        out,
    )
    return out
