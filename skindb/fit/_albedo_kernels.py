"""Diffuse reflectance from reflectance samples, as numbers; methods and sources in `skindb.fit.albedo`."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.fit._arrays import Array, cosines, directions, in_batches, quantile_finite, unit
from skindb.optics.diffuse import dipole_s
from skindb.optics.fresnel import fresnel_transmittance

GRAZING = 0.25  # cosine to light or camera below which F_t and the pixel's footprint change too fast
LEAST = 10  # samples
LARGEST_TURN = 0.25  # rad; of a normal, for its error in R_d: no sample above the grazing limit falls below the horizon
LOW, LOWER = 0.10, 0.02  # quantiles of the method "quantile", and their normal deviates
Z_LOW, Z_LOWER = -1.2816, -2.0537
# As unlike each other as six of the embedded materials can be, from narrow to all but diffuse. How broad the broadest
# is decides between two errors: broad ones take light from R_d, without them R_d takes what a surface reflects evenly.
# These balance the two on captures with and without such a floor (notes of `estimate_diffuse_reflectance`).
LOBES = ("black-fabric", "green-plastic", "beige-fabric", "white-paint", "pearl-paint", "fruitwood-241")
# Total error of "separated": 93 to 96 % of the values of six independent captures with known truth within 1.96 of it.
# The second is the even white reflection of the measured materials that no photograph tells from diffuse light.
NOISE_SHARE, MODEL_ERROR = 2.0, 0.014
SMALL, LARGE = 1e-4, 0.9999  # estimates outside are clamped here, and flagged by the surface fit


def diffuse_reflectances(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    normal_error: Array | None = None,
    *,
    method: str,
    eta: float,
    discard: int,
) -> tuple[Array, Array, Array, Array]:
    """(n, 3) R_d clamped to [SMALL, LARGE], its standard and total error, and dipole s; NaN where it cannot be had."""
    turn = np.zeros(len(sample)) if normal_error is None else np.nan_to_num(np.deg2rad(normal_error, dtype=np.float64))

    def batch(sample: Array, position: Array, normal: Array, turn: Array) -> tuple[Array, Array]:
        to_light, to_camera = directions(position, light), directions(position, camera)
        normal, sample = normal.astype(np.float64), sample.astype(np.float32)
        if method == "separated":
            return separated(sample, normal, turn, to_light, to_camera, eta)
        ratio, weight = _ratios(sample, normal, to_light, to_camera, eta)
        return stable_minimum(ratio, weight, discard) if method == "minimum" else low_quantile(ratio)

    estimate, error = in_batches(batch, (sample, position, normal, turn))
    clamped = np.clip(estimate, SMALL, LARGE)
    total = np.hypot(NOISE_SHARE * error, MODEL_ERROR if method == "separated" else np.nan)
    return clamped, error, total, dipole_s(clamped, eta=eta)[0]


def _ratios(sample: Array, normal: Array, to_light: Array, to_camera: Array, eta: float) -> tuple[Array, Array]:
    """Ratios pi f_r / (F_t F_t) of every sample (n, l c, 3), NaN where grazing, and a weight falling towards it."""
    lit, seen = cosines(normal, to_light), cosines(normal, to_camera)
    lit, seen = (np.where(c > GRAZING, c, np.nan) for c in (lit, seen))
    # F_t of NaN is a number: the floor stands in for it, the NaN comes from the cosine
    per_light = np.pi / (lit * fresnel_transmittance(np.fmax(lit, GRAZING), eta))
    per_camera = seen / (seen * fresnel_transmittance(np.fmax(seen, GRAZING), eta))
    ratio = sample * (per_light[:, :, None] * per_camera[:, None]).astype(np.float32)[..., None]
    n, pairs = len(sample), lit.shape[1] * seen.shape[1]  # -1 would not do for no surfels
    weight = (lit[:, :, None] * seen[:, None]).reshape(n, pairs)
    return ratio.reshape(n, pairs, 3), weight


def stable_minimum(ratio: Array, weight: Array, discard: int) -> tuple[Array, Array]:
    """The paper's rule (eq. 6): ratios raised by up to a fifth towards grazing, the `discard` smallest left out.

    The error is half the distance to the next values on either side of as many ranks.
    """
    order = np.argsort(ratio * (1.2 - 0.2 * weight[..., None]), axis=1)
    count = np.isfinite(ratio).sum(1, keepdims=True)
    enough = count[:, 0] >= max(LEAST, 2 * discard + 2)

    def at(rank: int) -> Array:
        place = np.take_along_axis(order, np.full_like(count, min(rank, ratio.shape[1] - 1)), 1)
        return np.where(enough, np.take_along_axis(ratio, place, 1)[:, 0], np.nan)

    return at(discard), np.abs(at(2 * discard + 1) - at(0)) / 2


def low_quantile(ratio: Array) -> tuple[Array, Array]:
    """Tenth percentile, moved up by what normal noise of the spread seen below it would have taken away."""
    count = np.isfinite(ratio).sum(1)
    low, lower = quantile_finite(ratio, LOW, 1), quantile_finite(ratio, LOWER, 1)
    noise = (low - lower) / (Z_LOW - Z_LOWER)
    enough = count >= LEAST
    # the variance of a quantile: p (1 - p) / (n density^2), density of the normal at it
    error = noise * np.sqrt(LOW * (1 - LOW) / np.maximum(count, 1)) / 0.1755
    return np.where(enough, low - Z_LOW * noise / 2, np.nan), np.where(enough, error, np.nan)


@cache
def surface_lobes() -> tuple[NDArray[np.float32], Any]:
    """Tables (nh, nd, np, 6) of `LOBES` without their diffuse part, and their grid."""
    from skindb.optics.abc_low2012 import PARAMETERS
    from skindb.optics.brdf_table import DEFAULT_GRID, tabulate
    from skindb.optics.dictionary import evaluate_abc

    rows = np.array([PARAMETERS[name] for name in LOBES], np.float64)
    rows[:, :3] = 0
    return tabulate(lambda wi, wo: evaluate_abc(rows, wi, wo), DEFAULT_GRID), DEFAULT_GRID


def separated(
    sample: Array, normal: Array, normal_error: Array, to_light: Array, to_camera: Array, eta: float
) -> tuple[Array, Array]:
    """R_d by telling diffuse from surface reflection in colour and in shape; see `estimate_diffuse_reflectance`."""
    from skindb.numerics.robust import robust_nonnegative, robust_slopes, shift
    from skindb.optics.rows import basis_rows

    table, grid = surface_lobes()
    lit, seen = cosines(normal, to_light), cosines(normal, to_camera)
    whole = np.isfinite(sample[..., 0] + sample[..., 1] + sample[..., 2])  # three times as fast as all(-1)
    usable = whole & (lit > GRAZING)[:, :, None] & (seen > GRAZING)[:, None]
    usable &= (usable.sum((1, 2)) >= LEAST)[:, None, None]
    rows, offsets, index = basis_rows(table, grid, normal, to_light, to_camera, usable)
    i, o, s = index[:, 0], index[:, 1], np.repeat(np.arange(len(sample)), np.diff(offsets))
    value = sample[s, i, o].astype(np.float64)

    def diffuse(lit: Array, seen: Array) -> Array:
        through = lit * fresnel_transmittance(lit, eta) / np.pi
        return np.asarray(through[s, i] * fresnel_transmittance(seen, eta)[s, o])

    shape = diffuse(lit, seen)
    mean = value.mean(1)
    tint, tint_error = robust_slopes(offsets, shape, value - mean[:, None])
    # darker samples than the floor [sr^-1] are not known to a share of themselves
    common = robust_nonnegative(offsets, shape, rows, mean, floor=0.01)
    estimate = tint + common.weight[:, None]
    variance = tint_error**2 + common.error[:, None] ** 2
    if not normal_error.any():
        return estimate, np.sqrt(variance)
    # delta method: what a turn of the normal by its error does to the rows, along either tangent
    own, square = shift(common, offsets, shape, rows), np.bincount(s, shape * shape, len(sample))
    for turned in _turned(normal, normal_error):
        lobes = basis_rows(table, grid, turned, to_light, to_camera, usable)[0]
        body = diffuse(cosines(turned, to_light), cosines(turned, to_camera))
        moved = shift(common, offsets, body, lobes) - own
        slope = np.bincount(s, shape * (body - shape), len(sample)) / np.maximum(square, 1e-12)
        variance += (moved[:, None] + tint * slope[:, None]) ** 2
    return estimate, np.sqrt(variance)


def _turned(normal: Array, error: Array) -> Iterator[Array]:
    """Normals (n, 3) turned by error / sqrt(2) [rad] along two tangents at right angles: the RMS angle is of both."""
    angle = np.clip(error, 0, LARGEST_TURN)[:, None] / np.sqrt(2)
    helper = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = unit(np.cross(normal, helper))
    for tangent in (first, np.cross(normal, first)):
        yield np.cos(angle) * normal + np.sin(angle) * tangent
