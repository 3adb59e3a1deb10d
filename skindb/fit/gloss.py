"""Gloss that the surfels of a capture with few samples share: too few tell the strength
of a lobe, the normal and R_d apart for a surfel by itself.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.fit.albedo import estimate_diffuse_reflectance
from skindb.fit.lumitexels import (
    GEOMETRY,
    block_of,
    directions,
    noise_inputs,
    take_noise,
)
from skindb.fit.normals import estimate_normals
from skindb.fit.surface import noise_floor
from skindb.geometry.interreflection import tangent_frames
from skindb.optics.fresnel import fresnel_transmittance
from skindb.parameters import SCAN_ERROR_DEGREES
from skindb.reflectance._lumitexel_kernels import (
    MIN_COSINE_SURFACE,
    MIN_SAMPLES_GLOSS,
    MIN_SAMPLES_LAMBERT,
    MIN_SAMPLES_LOBES,
)
from skindb.reflectance.joint import (
    SHARED_WIDTH,
    UNKNOWN_GLOSS,
    Gloss,
    JointFit,
    refine_block,
)
from skindb.reflectance.lobes import GRADED_ROUGHNESS, SURFACE_INDEX, evaluate_lobe
from skindb.reflectance.model import MIN_LOBE_WIDTH, Comparison
from skindb.types import Array

# Strength of the lobe over the median R_d. The first was chosen on four faces of Extended
# Yale B; of five up to it, it is also the best for the four others and, at this width, for
# the cat of DiLiGenT (docs/validation.md). Under few lights held-out samples tell
# little: another strength must predict them better by `MIN_GAIN`, as for a matt surface or a
# smooth one above an ideal matt body (planted skin: by 0.16 to 0.6).
STRENGTHS = (16.0, 4.0, 1.0, 0.25)
MIN_GAIN = 0.125
SPREAD = 0.5  # standard deviation over the mean
MAX_DEVICES = 64  # lights times cameras; surfels with few samples are rare under more
SURFELS = 2000  # of which those with few samples are used, at most
USED = 300


def estimate_gloss(
    lumitexels: xr.Dataset,
    *,
    eta: float = 1.3,
    scan_error: float = SCAN_ERROR_DEGREES,
) -> Gloss:
    """Prior of the lobe of surfels with few samples, which `refine_jointly` takes.

    Parameters
    ----------
    lumitexels
        Samples with geometry and `surfel_normal`.
    eta, scan_error
        As in `estimate_normals`.

    Returns
    -------
    Gloss
        Wide around 0 for captures of more than 64 lights times cameras, or without any
        surfel that has 4 to 11 samples.
    """
    devices = lumitexels.sizes["light"] * lumitexels.sizes["camera"]
    if not MIN_SAMPLES_GLOSS <= devices <= MAX_DEVICES:
        return UNKNOWN_GLOSS
    names = (*GEOMETRY, "surfel_normal", "noise_floor", *noise_inputs(lumitexels))
    names += ("shot_noise",) if "shot_noise" in lumitexels else ()
    part = lumitexels[list(dict.fromkeys(names))]
    part = part.isel(surfel=_spread(part.sizes["surfel"], SURFELS)).compute()
    finite = np.isfinite(part["reflectance_sample"].values).all(axis=3).sum(axis=(1, 2))
    few = np.flatnonzero((finite >= MIN_SAMPLES_GLOSS) & (finite < MIN_SAMPLES_LOBES))
    if not few.size:
        return UNKNOWN_GLOSS
    part = part.isel(surfel=few[_spread(few.size, USED)])
    part = part.merge(estimate_normals(part, eta=eta, scan_error=scan_error))
    part = part.merge(estimate_diffuse_reflectance(part, eta=eta))
    diffuse = part["diffuse_reflectance"].values
    if not np.isfinite(diffuse).any():
        return UNKNOWN_GLOSS
    level = float(np.nanmedian(diffuse))
    priors = [Gloss(level * s, level * s * SPREAD) for s in STRENGTHS]
    errors = [_left_out_error(part, prior, eta, scan_error) for prior in priors]
    best = int(np.argmin(errors))
    better = errors[best] < (1 - MIN_GAIN) * errors[0]
    return priors[best if better else 0]


def _spread(size: int, count: int) -> Array:
    """At most `count` indices, evenly spaced."""
    return np.unique(np.linspace(0, size - 1, min(count, size)).astype(np.int64))


def _left_out_error(
    part: xr.Dataset, prior: Gloss, eta: float, scan_error: float
) -> float:
    """Median relative error of the samples of lights that are held out in turn."""
    prior = prior._replace(samples=MIN_SAMPLES_LAMBERT)
    arrays = {str(name): part[name].values for name in part.data_vars}
    comparison = Comparison(
        "perceptual", eta, noise_floor(part), min_width=MIN_LOBE_WIDTH
    )
    error = []
    for light in range(part.sizes["light"]):
        sample = arrays["reflectance_sample"].copy()
        sample[:, light] = np.nan
        refined = refine_block(
            block_of(arrays | {"reflectance_sample": sample}, take_noise(part)),
            comparison,
            scan_normal=arrays["surfel_normal"],
            scan_error=float(np.deg2rad(scan_error) / np.sqrt(2)),
            gloss=prior,
        )
        predicted = _predicted(refined, part, light, eta)
        measured = arrays["reflectance_sample"][:, light].mean(axis=2)
        sum_of_both = np.maximum(predicted + np.abs(measured), 1e-9)
        error.append(np.abs(predicted - measured) / sum_of_both)
    return float(np.nanmedian(error))


def _predicted(refined: JointFit, part: xr.Dataset, light: int, eta: float) -> Array:
    """Mean of the channels (n, camera) of the samples of a light; NaN for grazing ones."""
    position = part["surfel_position"].values
    wi = directions(position, part["light_position"].values[light : light + 1])
    wo = directions(position, part["camera_position"].values)
    axes = tangent_frames(refined.normal)
    wi = np.einsum("nak,nlk->nla", axes, wi)
    wo = np.einsum("nak,nck->nca", axes, wo)
    steep = (wi[..., 2] > MIN_COSINE_SURFACE) & (wo[..., 2] > MIN_COSINE_SURFACE)
    passed = [
        fresnel_transmittance(np.clip(w[..., 2], MIN_COSINE_SURFACE, 1), eta)
        for w in (wi, wo)
    ]
    roughness = float(GRADED_ROUGHNESS[SHARED_WIDTH])
    value = evaluate_lobe(wi, wo, roughness, SURFACE_INDEX)
    value *= refined.strength[:, SHARED_WIDTH, None]
    value += passed[0] * passed[1] * refined.diffuse.mean(axis=1)[:, None] / np.pi
    return np.asarray(np.where(steep, wi[..., 2] * value, np.nan))
