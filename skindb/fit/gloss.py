"""Gloss that the surfels of a capture with few samples share: too few tell the strength
of a lobe, the normal and R_d apart for a surfel by itself. The takes of a rig with many
samples know its shape and strength.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr

from skindb.fit.albedo import estimate_in_sequence
from skindb.fit.lumitexels import (
    GEOMETRY,
    POLARISATION,
    block_of,
    directions,
    noise_inputs,
    scan_error,
    take_noise,
)
from skindb.fit.surface import noise_floor
from skindb.geometry.interreflection import tangent_frames
from skindb.optics.fresnel import circular_reversal, fresnel_transmittance
from skindb.parameters import SCAN_ERROR_DEGREES
from skindb.reflectance._lumitexel_kernels import (
    MIN_COSINE_SURFACE,
    MIN_SAMPLES_GLOSS,
    MIN_SAMPLES_LAMBERT,
    MIN_SAMPLES_LOBES,
)
from skindb.reflectance.joint import (
    LOBE_REFLECTANCE,
    UNKNOWN_GLOSS,
    Gloss,
    JointFit,
    refine_block,
)
from skindb.reflectance.lobes import evaluate_graded
from skindb.reflectance.model import MIN_LOBE_WIDTH, Comparison
from skindb.schema import dataset, variables
from skindb.schema.declaration import MIN_SAMPLES_TRUSTED
from skindb.types import Array, IntVector, unit

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
MIN_SURFELS = 30  # with many samples
MIN_FRONTAL = 0.2  # cosine of the angle at the face between a camera and a light
MIN_TAKES_LOBES = 3
# lights that stand for a capture with few samples, and factors of the mean lobes of a rig
FEW_LIGHTS = 8
FACTORS = np.geomspace(0.5, 4.0, 7)


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
        surfel that has 4 to 11 samples. With the lobes of the rig, if the capture has
        them, and they predict held-out samples better than others by an eighth.
    """
    devices = lumitexels.sizes["light"] * lumitexels.sizes["camera"]
    if not MIN_SAMPLES_GLOSS <= devices <= MAX_DEVICES:
        return UNKNOWN_GLOSS
    part = _samples(lumitexels, SURFELS)
    finite = _sample_count(part)
    few = np.flatnonzero((finite >= MIN_SAMPLES_GLOSS) & (finite < MIN_SAMPLES_LOBES))
    if not few.size:
        return UNKNOWN_GLOSS
    part = _estimated(part.isel(surfel=few[_spread(few.size, USED)]), eta, scan_error)
    diffuse = part["diffuse_reflectance"].values
    if not np.isfinite(diffuse).any():
        return UNKNOWN_GLOSS
    level = float(np.nanmedian(diffuse))
    priors = [Gloss(level * s, level * s * SPREAD) for s in STRENGTHS]
    errors = [_left_out_error(part, prior, eta, scan_error) for prior in priors]
    best = int(np.argmin(errors))
    best = best if errors[best] < (1 - MIN_GAIN) * errors[0] else 0
    if variables.LOBE_STRENGTH_APPLIED in lumitexels:
        prior = _shared(lumitexels[variables.LOBE_STRENGTH_APPLIED].values)
        error = _left_out_error(part, prior, eta, scan_error)
        if error < (1 - MIN_GAIN) * errors[best]:
            return prior
    return priors[best]


class TakeGloss(NamedTuple):
    """What a take with many samples knows of the gloss: mean strengths (8,) of its lobes,
    and surfels with one camera, from which `common_lobes` finds their factor.
    """

    lobes: Array
    part: xr.Dataset
    eta: float
    scan_error: float


def take_gloss(lumitexels: xr.Dataset, *, eta: float) -> TakeGloss | None:
    """Gloss of a take; None if few surfels have 16 samples, or one camera fewer lights in
    front.

    Parameters
    ----------
    lumitexels
        Samples with geometry and `surfel_normal`.
    eta
        As in `estimate_normals`.
    """
    part = _samples(lumitexels, SURFELS)
    part = part.isel(surfel=_sample_count(part) >= MIN_SAMPLES_TRUSTED)
    if part.sizes["surfel"] < MIN_SURFELS:
        return None
    part = part.isel(surfel=_spread(part.sizes["surfel"], USED))
    prior = scan_error(lumitexels)
    refined = _refined(_estimated(part, eta, prior), UNKNOWN_GLOSS, eta, prior)
    fitted = np.isfinite(refined.normal_error)
    by_camera = np.isfinite(part["reflectance_sample"].values).sum(axis=(0, 1, 3))
    part = part.isel(camera=[int(by_camera.argmax())])
    light, view = _directions_from_middle(part)
    part = part.isel(light=light @ view > MIN_FRONTAL)
    if fitted.sum() < MIN_SURFELS or part.sizes["light"] < MIN_SAMPLES_TRUSTED:
        return None
    return TakeGloss(refined.strength[fitted].mean(axis=0), part, eta, prior)


def common_lobes(takes: Sequence[TakeGloss | None]) -> xr.Dataset:
    """Strengths of the lobes that the takes of a rig have in common: the medians of their
    means, times the factor with which eight lights predict the others best.

    Returns
    -------
    Dataset
        `rig_lobe_strength`; NaN for fewer than three takes with many samples.
    """
    known = [take for take in takes if take is not None]
    lobes = np.full(len(LOBE_REFLECTANCE), np.nan)
    if len(known) >= MIN_TAKES_LOBES:
        lobes = np.median([take.lobes for take in known], axis=0)
        errors = [
            [_few_lights_error(take, f * lobes) for f in FACTORS] for take in known
        ]
        lobes *= FACTORS[np.sum(errors, axis=0).argmin()]
    return dataset({variables.RIG_LOBE_STRENGTH: lobes})


def _few_lights_error(take: TakeGloss, lobes: Array) -> float:
    """Logarithm of the median relative error of all but eight spread lights, by these."""
    part = take.part
    light, view = _directions_from_middle(part)
    chosen = [int((light @ view).argmax())]
    while len(chosen) < FEW_LIGHTS:
        chosen.append(int((light @ light[chosen].T).max(axis=1).argmin()))
    few = _estimated(part.isel(light=chosen), take.eta, take.scan_error)
    refined = _refined(few, _shared(lobes), take.eta, take.scan_error)
    others = np.setdiff1d(np.arange(len(light)), chosen)
    error = _errors(refined, part, others, take.eta)
    return float(np.log(np.nanmedian(error))) if np.isfinite(error).any() else 0.0


def _directions_from_middle(part: xr.Dataset) -> tuple[Array, Array]:
    """Unit directions to the lights (light, 3) and to the first camera (3,)."""
    middle = part["surfel_position"].values.mean(axis=0)
    light = unit(part["light_position"].values - middle)
    return light, unit(part["camera_position"].values[0] - middle)


def _shared(lobes: Array) -> Gloss:
    """Prior of these lobes."""
    return Gloss(1.0, SPREAD, lobes=tuple(lobes.tolist()))


def _samples(lumitexels: xr.Dataset, surfels: int) -> xr.Dataset:
    """Some of the surfels, in memory, with what estimates need."""
    names = (*GEOMETRY, "surfel_normal", "noise_floor", *noise_inputs(lumitexels))
    part = lumitexels[list(dict.fromkeys(names))]
    return part.isel(surfel=_spread(part.sizes["surfel"], surfels)).compute()


def _sample_count(part: xr.Dataset) -> Array:
    """Number of samples (surfel,)."""
    finite = np.isfinite(part["reflectance_sample"].values).all(axis=3)
    return np.asarray(finite.sum(axis=(1, 2)))


def _spread(size: int, count: int) -> Array:
    """At most `count` indices, evenly spaced."""
    return np.unique(np.linspace(0, size - 1, min(count, size)).astype(np.int64))


def _estimated(part: xr.Dataset, eta: float, scan_error: float) -> xr.Dataset:
    """The surfels with estimates of the normal and of R_d."""
    return part.merge(estimate_in_sequence(part, eta=eta, scan_error=scan_error))


def _refined(part: xr.Dataset, prior: Gloss, eta: float, scan_error: float) -> JointFit:
    """The joint fit of surfels with estimates."""
    arrays = {str(name): part[name].values for name in part.data_vars}
    return refine_block(
        block_of(arrays, take_noise(part)),
        Comparison("perceptual", eta, noise_floor(part), min_width=MIN_LOBE_WIDTH),
        scan_normal=arrays["surfel_normal"],
        scan_error=float(np.deg2rad(scan_error) / np.sqrt(2)),
        gloss=prior,
    )


def _left_out_error(
    part: xr.Dataset, prior: Gloss, eta: float, scan_error: float
) -> float:
    """Median relative error of the samples of lights that are held out in turn."""
    prior = prior._replace(samples=MIN_SAMPLES_LAMBERT)
    lights = np.arange(part.sizes["light"])
    error = []
    for light in lights:
        rest = part.copy(deep=True)
        rest["reflectance_sample"][:, light] = np.nan
        refined = _refined(rest, prior, eta, scan_error)
        error.append(_errors(refined, part, lights[light : light + 1], eta))
    return float(np.nanmedian(error))


def _errors(
    refined: JointFit, part: xr.Dataset, lights: IntVector, eta: float
) -> Array:
    """Relative errors (n, light, camera) of predicted samples, of the mean of the
    channels; NaN for grazing ones.
    """
    part = part.isel(light=lights)
    position = part["surfel_position"].values
    axes = tangent_frames(refined.normal)
    wi = directions(position, part["light_position"].values)
    wi = np.einsum("nak,nlk->nla", axes, wi)[:, :, None]
    wo = directions(position, part["camera_position"].values)
    wo = np.einsum("nak,nck->nca", axes, wo)[:, None]
    steep = (wi[..., 2] > MIN_COSINE_SURFACE) & (wo[..., 2] > MIN_COSINE_SURFACE)
    passed = [
        fresnel_transmittance(np.clip(w[..., 2], MIN_COSINE_SURFACE, 1), eta)
        for w in (wi, wo)
    ]
    value = np.einsum("nlcj,nj->nlc", evaluate_graded(wi, wo), refined.strength)
    if all(name in part for name in POLARISATION):
        both = np.outer(*(part[name].values for name in POLARISATION))
        apart = np.linalg.norm(wi + wo, axis=-1) / 2  # cosine of theta_d
        value *= 1 - both * circular_reversal(apart, eta)
    value += passed[0] * passed[1] * refined.diffuse.mean(axis=1)[:, None, None] / np.pi
    predicted = np.where(steep, wi[..., 2] * value, np.nan)
    measured = part["reflectance_sample"].values.mean(axis=3)
    sum_of_both = np.maximum(predicted + np.abs(measured), 1e-9)
    return np.asarray(np.abs(predicted - measured) / sum_of_both)
