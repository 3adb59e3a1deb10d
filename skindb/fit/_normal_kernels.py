"""Normals from reflectance samples, as numbers; methods and sources in `skindb.fit.normals`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skindb.fit._arrays import Array, cosines, directions, in_batches, mean_finite, median_finite, quantile_finite, unit
from skindb.optics.fresnel import fresnel_transmittance

GRAZING = 0.2  # cosine to the camera below which a pixel mixes what lies behind the silhouette
HORIZON = 0.1  # cosine to the light below which the linear model fails (half-hidden disc, terminator)
SHADE = 0.25  # quantile over cameras: below the highlights, above the darkest outliers
INDEPENDENT = 8  # lights; against 150 the scan's prior would be lost: 95 % of errors fall from 7.4 to 4.3 degrees
TUKEY, ITERATIONS = 4.685, 12  # 95 % efficiency for normal noise; converges in 6 to 10


@dataclass(frozen=True)
class View:
    """One batch of surfels: what they show, and from where."""

    sample: Array  # (n, l, c, 3) sr^-1, NaN where not usable
    to_light: Array  # (n, l, 3)
    to_camera: Array  # (n, c, 3)
    scan: Array  # (n, 3) normal of the scan
    eta: float
    prior: float  # standard deviation of the scan's normal [rad]


def normals(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    scan: Array,
    *,
    method: str,
    eta: float,
    scan_error: float,
) -> tuple[Array, Array]:
    """(n, 3) normals by `method` and (n,) angle [degree] between the peak and the photometric estimate."""

    def batch(sample: Array, position: Array, scan: Array) -> tuple[Array, Array]:
        to_light, to_camera = directions(position, light), directions(position, camera)
        first = unit(scan.astype(np.float64))
        seen = cosines(first, to_camera) > GRAZING
        usable = np.where(seen[:, None, :, None], sample.astype(np.float32), np.nan)
        return _estimate(View(usable, to_light, to_camera, first, eta, np.deg2rad(scan_error)), method)

    return in_batches(batch, (sample, position, scan))


def _estimate(view: View, method: str) -> tuple[Array, Array]:
    peak = peak_normals(view)
    white, white_spread = _photometric(view, *_shading(view))
    tinted, tinted_spread = _photometric(view, *_tint(view))
    # inverse variance: each residual relative to the signal; skin without colour leaves all to the first
    both = sum(np.nan_to_num(n / s[:, None] ** 2) for n, s in ((white, white_spread), (tinted, tinted_spread)))
    combined = unit(np.asarray(both))
    chosen = {"peak": peak, "photometric": white, "chromatic": tinted, "combined": combined}[method]
    cosine = np.clip(np.einsum("nk,nk->n", peak, combined), -1, 1)
    return chosen, np.degrees(np.arccos(cosine))


def peak_normals(view: View) -> Array:
    """The paper's rule (section 6): half way between each camera and its direction of maximum reflectance.

    The darkest channel has the least diffuse light under the highlight. Its four brightest lights are weighted by
    their excess over the fifth, the cameras by how far the brightest stands out.
    """
    dark = np.where(np.isfinite(view.sample).all(-1), view.sample.min(-1), -np.inf)  # (n, l, c)
    if dark.shape[1] < 5:
        return np.full(view.scan.shape, np.nan)
    place = np.argpartition(-dark, 4, axis=1)[:, :5]
    bright = np.take_along_axis(dark, place, axis=1)
    fifth = bright.min(axis=1, keepdims=True)
    usable = np.isfinite(fifth[:, 0])  # (n, c)
    excess = np.where(usable[:, None], bright - np.where(np.isfinite(fifth), fifth, 0), 0)
    towards = np.take_along_axis(view.to_light[:, :, None], place[..., None], axis=1)
    maximum = unit(np.einsum("nqc,nqck->nck", excess, towards))
    half = np.nan_to_num(unit(maximum + view.to_camera))
    level = median_finite(np.where(np.isfinite(dark), dark, np.nan), 1)
    contrast = np.where(usable, bright.max(axis=1) / np.maximum(level, 1e-6) - 1, 0)
    return _robust_mean(half, np.nan_to_num(np.maximum(contrast, 0)))


def _robust_mean(vectors: Array, weight: Array) -> Array:
    """Mean direction (n, 3) of (n, c, 3), each by the inverse of its angle to the mean, outliers left out."""
    mean = unit(np.einsum("nc,nck->nk", weight, vectors))
    for _ in range(8):
        angle = np.degrees(np.arccos(np.clip(np.einsum("nck,nk->nc", vectors, mean), -1, 1)))
        spread = np.maximum(1.4826 * median_finite(np.where(weight > 0, angle, np.nan), 1), 2.0)[:, None]
        kept = np.where(angle < 2.5 * spread, weight / np.maximum(angle, 1.0), 0)
        mean = unit(np.einsum("nc,nck->nk", kept, vectors))
    return mean


def _to_surface(view: View) -> Array:
    """(n, 1, c) transmittance towards each camera."""
    return np.asarray(fresnel_transmittance(np.maximum(cosines(view.scan, view.to_camera), GRAZING), view.eta)[:, None])


def _shading(view: View) -> tuple[Array, Array]:
    """(n, l) low quantile over cameras of the mean channel (free of highlights), and cameras behind it."""
    shade = view.sample.mean(-1) / _to_surface(view)
    return quantile_finite(shade, SHADE, 2), np.isfinite(shade).sum(2)


def _tint(view: View) -> tuple[Array, Array]:
    """(n, l) median over cameras of the colour difference that white light does not have (Zickler et al. 2008)."""
    mean = mean_finite(view.sample, (1, 2))
    tint = np.nan_to_num(unit(mean - mean.mean(-1, keepdims=True)))
    shade = np.einsum("nlck,nk->nlc", view.sample, tint) / _to_surface(view)
    return median_finite(shade, 2), np.isfinite(shade).sum(2)


def _photometric(view: View, shade: Array, count: Array) -> tuple[Array, Array]:
    """Robust photometric stereo: shade = F_t(n.l) g.l for one g per surfel; returns g/|g| and residual over |g|.

    Tukey weights leave out shadows and what is left of highlights. The scan's normal enters as a prior on the
    direction of g: it decides where few lights or mixed pixels leave the direction open.
    """
    normal, to_light = view.scan, view.to_light
    across = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    usable = np.isfinite(shade) & (count > 0)
    weight, spread, size = usable * 1.0, np.zeros(len(normal)), np.ones(len(normal))
    for step in range(ITERATIONS):
        cosine = cosines(normal, to_light)
        lit = usable & (cosine > HORIZON)
        through = np.where(lit, fresnel_transmittance(np.maximum(cosine, HORIZON), view.eta), 0)
        value = np.where(lit, shade, 0)
        weight = weight * lit
        matrix = np.einsum("nl,nlj,nlk->njk", weight * through**2, to_light, to_light)
        right = np.einsum("nl,nlk->nk", weight * through * value, to_light)
        if step:
            # what spoils one light spoils its neighbours: however many there are, they count as INDEPENDENT
            share = np.maximum(lit.sum(1) / INDEPENDENT, 1) * (spread / np.maximum(size * view.prior, 1e-9)) ** 2
            matrix += share[:, None, None] * across
        # a ridge far below the data: surfels without light solve to zero, hence to a NaN normal
        ridge = 1e-6 * np.trace(matrix, axis1=1, axis2=2) + 1e-12
        matrix += ridge[:, None, None] * np.eye(3)
        g = np.linalg.solve(matrix, right[..., None])[..., 0]
        size = np.linalg.norm(g, axis=1)
        normal = unit(g)
        residual = value - through * np.einsum("nk,nlk->nl", g, to_light)
        spread = 1.4826 * np.nan_to_num(median_finite(np.where(lit, np.abs(residual), np.nan), 1)) + 0.01 * size
        weight = np.clip(1 - (residual / np.maximum(TUKEY * spread, 1e-12)[:, None]) ** 2, 0, 1) ** 2
    return normal, spread / np.where(size > 0, size, np.nan)
