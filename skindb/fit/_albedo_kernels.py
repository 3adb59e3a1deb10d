"""Diffuse reflectance from reflectance samples, as numbers; methods and sources in `skindb.fit.albedo`."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.fit._arrays import Array, cosines, directions, in_batches, quantile_finite
from skindb.fit._segments import Segments
from skindb.optics.diffuse import dipole_s
from skindb.optics.fresnel import fresnel_transmittance

GRAZING = 0.25  # cosine to light or camera below which F_t and the pixel's footprint change too fast
LEAST = 10  # samples
LOW, LOWER = 0.10, 0.02  # quantiles of the method "quantile", and their normal deviates
Z_LOW, Z_LOWER = -1.2816, -2.0537
TUKEY, STEPS = 4.685, 5
# As unlike each other as six of the embedded materials can be, from narrow to all but diffuse. How broad the broadest
# is decides between two errors: broad ones take light from R_d, without them R_d takes what a surface reflects evenly.
# These balance the two on captures with and without such a floor (notes of `estimate_diffuse_reflectance`).
LOBES = ("black-fabric", "green-plastic", "beige-fabric", "white-paint", "pearl-paint", "fruitwood-241")
SMALL, LARGE = 1e-4, 0.9999  # estimates outside are clamped here, and flagged by the surface fit


def diffuse_reflectances(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    *,
    method: str,
    eta: float,
    discard: int,
) -> tuple[Array, Array, Array]:
    """(n, 3) R_d clamped to [SMALL, LARGE], its standard error, and dipole s; NaN where it cannot be had."""

    def batch(sample: Array, position: Array, normal: Array) -> tuple[Array, Array]:
        to_light, to_camera = directions(position, light), directions(position, camera)
        normal, sample = normal.astype(np.float64), sample.astype(np.float32)
        if method == "separated":
            return separated(sample, normal, to_light, to_camera, eta)
        ratio, weight = _ratios(sample, normal, to_light, to_camera, eta)
        return stable_minimum(ratio, weight, discard) if method == "minimum" else low_quantile(ratio)

    estimate, error = in_batches(batch, (sample, position, normal))
    clamped = np.clip(estimate, SMALL, LARGE)
    return clamped, error, dipole_s(clamped, eta=eta)[0]


def _ratios(sample: Array, normal: Array, to_light: Array, to_camera: Array, eta: float) -> tuple[Array, Array]:
    """Ratios pi f_r / (F_t F_t) of every sample (n, l c, 3), NaN where grazing, and a weight falling towards it."""
    lit, seen = cosines(normal, to_light), cosines(normal, to_camera)
    lit, seen = (np.where(c > GRAZING, c, np.nan) for c in (lit, seen))
    # F_t of NaN is a number: the floor stands in for it, the NaN comes from the cosine
    per_light = np.pi / (lit * fresnel_transmittance(np.fmax(lit, GRAZING), eta))
    per_camera = seen / (seen * fresnel_transmittance(np.fmax(seen, GRAZING), eta))
    ratio = sample * (per_light[:, :, None] * per_camera[:, None]).astype(np.float32)[..., None]
    n = len(sample)
    weight = (lit[:, :, None] * seen[:, None]).reshape(n, -1)
    return ratio.reshape(n, -1, 3), weight


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


def separated(sample: Array, normal: Array, to_light: Array, to_camera: Array, eta: float) -> tuple[Array, Array]:
    """R_d by telling diffuse from surface reflection in colour and in shape; see `estimate_diffuse_reflectance`."""
    from skindb.optics.rows import basis_rows

    table, grid = surface_lobes()
    lit, seen = cosines(normal, to_light), cosines(normal, to_camera)
    usable = np.isfinite(sample).all(-1) & (lit > GRAZING)[:, :, None] & (seen > GRAZING)[:, None]
    usable &= (usable.sum((1, 2)) >= LEAST)[:, None, None]
    rows, offsets, index = basis_rows(table, grid, normal, to_light, to_camera, usable)
    segments = Segments(offsets)
    if not segments.count:
        return np.full((len(sample), 3), np.nan), np.full((len(sample), 3), np.nan)
    i, o, s = index[:, 0], index[:, 1], segments.owner
    value = sample[s, i, o].astype(np.float64)
    through = lit * fresnel_transmittance(lit, eta) / np.pi
    shape = through[s, i] * fresnel_transmittance(seen, eta)[s, o]
    mean = value.mean(1)
    tints = [_robust_slope(segments, shape, value[:, k] - mean) for k in range(3)]
    common, common_error = _common_part(segments, shape, rows.astype(np.float64), mean)
    estimate = np.stack([slope + common for slope, _ in tints], axis=1)
    error = np.stack([np.hypot(deviation, common_error) for _, deviation in tints], axis=1)
    return segments.scatter(estimate), segments.scatter(error)


def _robust_slope(segments: Segments, x: Array, y: Array) -> tuple[Array, Array]:
    """Slope of y on x through the origin per segment, Tukey weights, and its standard error."""
    weight = np.ones_like(x)
    for _ in range(STEPS):
        norm = np.maximum(segments.sum(weight * x * x), 1e-12)
        slope = segments.sum(weight * x * y) / norm
        residual = y - segments.spread(slope) * x
        scale = _scale(segments, residual, weight)
        weight = _tukey(residual, segments.spread(scale))
    return slope, scale / np.sqrt(norm)


def _common_part(segments: Segments, shape: Array, lobes: Array, mean: Array) -> tuple[Array, Array]:
    """Mean over channels of R_d: weights >= 0 of the diffuse shape and the lobes, relative errors, Tukey weights."""
    from skindb.numerics.nnls import solve_nnls

    columns = [shape, *lobes.T]
    size = len(columns)
    gram, right = np.empty((segments.count, size, size)), np.empty((segments.count, size))
    floor = 0.01  # sr^-1: darker samples are not known to a share of themselves
    level, keep = np.maximum(mean, floor), np.ones_like(mean)
    for _ in range(STEPS - 1):
        weight = keep / level**2
        for a in range(size):
            right[:, a] = segments.sum(weight * columns[a] * mean)
            for b in range(a + 1):
                gram[:, a, b] = gram[:, b, a] = segments.sum(weight * columns[a] * columns[b])
        x = solve_nnls(gram, right)[0]
        predicted = sum(segments.spread(x[:, a]) * columns[a] for a in range(size))
        level = np.maximum(predicted, floor)
        residual = (mean - predicted) / level
        scale = _scale(segments, residual, keep) + 0.005
        keep = _tukey(residual, segments.spread(scale))
    idle = x <= 0  # lobes without weight do not share in the uncertainty
    free = np.where(idle[:, :, None] | idle[:, None], 0, gram) + np.eye(size) * np.maximum(idle, 1e-12)[:, None]
    return x[:, 0], scale * np.sqrt(np.linalg.inv(free)[:, 0, 0])


def _scale(segments: Segments, residual: Array, weight: Array) -> Array:
    """Weighted mean absolute residual per segment as a standard deviation."""
    return np.asarray(1.2533 * segments.sum(weight * np.abs(residual)) / np.maximum(segments.sum(weight), 1e-12))


def _tukey(residual: Array, scale: Array) -> Array:
    return np.asarray(np.clip(1 - (residual / np.maximum(TUKEY * scale, 1e-12)) ** 2, 0, 1) ** 2)
