"""Further rules for R_d, the paper's minimum and a low quantile, and the lobes of the
separation.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.fit._albedo_kernels import MIN_COSINE_ALBEDO, MIN_SAMPLES_ALBEDO
from skindb.fit._arrays import cosines, directions, quantile_finite
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.abc_low2012 import PARAMETERS, evaluate_abc
from skindb.reflectance.tables import DEFAULT_GRID, TableGrid, tabulate
from skindb.types import Array

# quantiles of the method "quantile", and their normal deviates
LOW = 0.10
LOWER = 0.02
Z_LOW = -1.2816
Z_LOWER = -2.0537
# The six most different embedded materials, from narrow to nearly diffuse. The width of
# the broadest one trades two errors: broad lobes take light from R_d, and without them
# R_d includes the even reflection of the surface. These balance the two on captures
# with and without such reflection (notes of `estimate_diffuse_reflectance`).
LOBES = (
    "black-fabric",
    "green-plastic",
    "beige-fabric",
    "white-paint",
    "pearl-paint",
    "fruitwood-241",
)


@cache
def surface_lobes() -> tuple[NDArray[np.float32], TableGrid]:
    """Tables (nh, nd, np, 6) of `LOBES` without their diffuse part, and their grid."""
    rows = np.array([PARAMETERS[name] for name in LOBES], np.float64)
    rows[:, :3] = 0
    return tabulate(
        lambda wi, wo: evaluate_abc(rows, wi, wo), DEFAULT_GRID
    ), DEFAULT_GRID


@cache
def lobe_table() -> NDArray[np.float32]:
    """Tables (nh, nd, np, 16) for the kernel: six lobes, two zeros, their derivatives
    by theta_h [rad], two zeros.
    """
    table, grid = surface_lobes()
    steep = np.gradient(table.astype(np.float64), grid.theta_h, axis=0)
    gap = np.zeros((*table.shape[:3], 2))
    joined = np.ascontiguousarray(
        np.concatenate([table, gap, steep, gap], axis=-1), np.float32
    )
    # as for all tables, so that kernels are compiled once
    joined.flags.writeable = False
    return joined


def ratios(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    eta: float,
) -> tuple[Array, Array]:
    """Ratios pi f_r / (F_t F_t) of all samples (n, l c, 3), NaN at grazing angles, and
    weights that decrease there.
    """
    normal = normal.astype(np.float64)
    samples = sample.astype(np.float32)
    lit, seen = (
        cosines(normal, directions(position, targets)) for targets in (light, camera)
    )
    lit, seen = (np.where(c > MIN_COSINE_ALBEDO, c, np.nan) for c in (lit, seen))
    # F_t is evaluated at the limit instead of NaN; the cosine carries the NaN
    per_light = np.pi / (
        lit * fresnel_transmittance(np.fmax(lit, MIN_COSINE_ALBEDO), eta)
    )
    per_camera = seen / (
        seen * fresnel_transmittance(np.fmax(seen, MIN_COSINE_ALBEDO), eta)
    )
    ratio = (
        samples
        * (per_light[:, :, None] * per_camera[:, None]).astype(np.float32)[..., None]
    )
    # -1 would be ambiguous without surfels
    n = len(sample)
    pairs = lit.shape[1] * seen.shape[1]
    weight = (lit[:, :, None] * seen[:, None]).reshape(n, pairs)
    return ratio.reshape(n, pairs, 3), weight


def stable_minimum(ratio: Array, weight: Array, discard: int) -> tuple[Array, Array]:
    """The paper's rule (eq. 6): ratios are raised by up to a fifth at grazing angles,
    the `discard` smallest ignored.

    The error is half the distance between the values that lie `discard` ranks above and below.
    """
    order = np.argsort(ratio * (1.2 - 0.2 * weight[..., None]), axis=1)
    count = np.isfinite(ratio).sum(1, keepdims=True)
    enough = count[:, 0] >= max(MIN_SAMPLES_ALBEDO, 2 * discard + 2)

    def at(rank: int) -> Array:
        place = np.take_along_axis(
            order, np.full_like(count, min(rank, ratio.shape[1] - 1)), 1
        )
        return np.where(enough, np.take_along_axis(ratio, place, 1)[:, 0], np.nan)

    return at(discard), np.abs(at(2 * discard + 1) - at(0)) / 2


def low_quantile(ratio: Array) -> tuple[Array, Array]:
    """Tenth percentile, raised by half of its bias under normal noise, whose spread is
    estimated below it.
    """
    count = np.isfinite(ratio).sum(1)
    low = quantile_finite(ratio, LOW, 1)
    lower = quantile_finite(ratio, LOWER, 1)
    noise = (low - lower) / (Z_LOW - Z_LOWER)
    enough = count >= MIN_SAMPLES_ALBEDO
    # the variance of a quantile: p (1 - p) / (n density^2), density of the normal at it
    error = noise * np.sqrt(LOW * (1 - LOW) / np.maximum(count, 1)) / 0.1755
    return np.where(enough, low - Z_LOW * noise / 2, np.nan), np.where(
        enough, error, np.nan
    )


def rule_reflectance(
    sample: Array, *geometry: Any, method: str, eta: float, discard: int
) -> tuple[Array, Array]:
    """R_d (n, 3) by one of the two rules, and its error; `geometry` is position, light,
    camera and normal.
    """
    position, light, camera, normal = geometry
    ratio, weight = ratios(sample, position, light, camera, normal, eta)
    return (
        stable_minimum(ratio, weight, discard)
        if method == "minimum"
        else low_quantile(ratio)
    )
