"""Gloss that the surfels of a capture with few samples share: too few tell the strength
of a lobe, the normal and R_d apart for a surfel by itself. The takes of a rig with many
samples know its shape and strength.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from skindb.fit.albedo import estimate_in_sequence
from skindb.fit.joint import shared_lobes
from skindb.fit.lumitexels import (
    GEOMETRY,
    block_of,
    directions,
    noise_inputs,
    polarisation,
    scan_error,
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
from skindb.schema.label import FACE
from skindb.types import Array, IntVector, Mask, finite_rows, lengths

# Strength of the lobe over the median R_d. The first was chosen on four faces of Extended
# Yale B; of five up to it, it is also the best for the four others and, at this width, for
# the cat of DiLiGenT (docs/results). Under few lights held-out samples tell
# little: another strength must predict them better by `MIN_GAIN`, as for a matt surface or a
# smooth one above an ideal matt body (planted skin: by 0.16 to 0.6).
STRENGTHS = (16.0, 4.0, 1.0, 0.25)
MIN_GAIN = 0.125
SPREAD = 0.5  # standard deviation over the mean
MAX_DEVICES = 64  # lights times cameras; surfels with few samples are rare under more
SURFELS = 2000  # of which those with few samples are used, at most
USED = 300
MIN_SURFELS = 30  # with many samples
MIN_TAKES_LOBES = 3
# strength of the lobes of surfels with few samples over those of free lobes: the one of seven
# with which eight lights predict the others best on nine virtual subjects, and on six others
FEW_OVER_FREE = np.sqrt(2.0)
# of the lobes of a rig in a take; 1 if fewer than `MIN_SURFELS` surfels have few samples, as
# ten chose 2 for virtual skin of factor 1
FACTORS = np.geomspace(0.25, 4.0, 9)


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
    best = _best(errors, default=0)
    if variables.LOBE_STRENGTH_APPLIED not in lumitexels:
        return priors[best]
    factors = FACTORS if few.size >= MIN_SURFELS else [1.0]
    of_rig = [Gloss(f, f * SPREAD, of_rig=True) for f in factors]
    rig_errors = [_left_out_error(part, prior, eta, scan_error) for prior in of_rig]
    nearest = _best(rig_errors, default=len(factors) // 2)
    is_better = rig_errors[nearest] < (1 - MIN_GAIN) * errors[best]
    return of_rig[nearest] if is_better else priors[best]


def _best(errors: Sequence[float], *, default: int) -> int:
    """Index of the smallest error, if it is below that of the default by an eighth."""
    best = int(np.argmin(errors))
    return best if errors[best] < (1 - MIN_GAIN) * errors[default] else default


def take_gloss(
    lumitexels: xr.Dataset, *, eta: float, regions: Mapping[str, Mask]
) -> xr.Dataset:
    """Mean strengths of the lobes of a take, of its face and regions; NaN for those of few
    surfels with 16 samples.

    Parameters
    ----------
    lumitexels
        Samples with geometry and `surfel_normal`.
    eta
        As in `estimate_normals`.
    regions
        Masks (surfel,).
    """
    masks = {FACE: np.ones(lumitexels.sizes["surfel"]), **regions}
    strengths = [
        _mean_lobes(lumitexels.isel(surfel=np.flatnonzero(mask)), eta)
        for mask in masks.values()
    ]
    return dataset(
        {variables.RIG_LOBE_STRENGTH: strengths}, coords={"region": [*masks]}
    )


def _mean_lobes(lumitexels: xr.Dataset, eta: float) -> Array:
    """Mean strengths (8,) of free lobes; NaN for few surfels."""
    part = _samples(lumitexels, SURFELS)
    rows = np.flatnonzero(_sample_count(part) >= MIN_SAMPLES_TRUSTED)
    unknown = np.full(len(LOBE_REFLECTANCE), np.nan)
    if len(rows) < MIN_SURFELS:
        return unknown
    prior = scan_error(lumitexels)
    part = _estimated(part.isel(surfel=rows[_spread(len(rows), USED)]), eta, prior)
    refined = _refined(part, UNKNOWN_GLOSS, eta, prior)
    fitted = np.isfinite(refined.normal_error)
    if fitted.sum() < MIN_SURFELS:
        return unknown
    return refined.strength[fitted].mean(axis=0)


def common_lobes(takes: Sequence[xr.Dataset]) -> xr.Dataset:
    """Strengths of the lobes that the takes of a rig have in common, by region: medians of
    those of `take_gloss`, times `FEW_OVER_FREE`.

    Returns
    -------
    Dataset
        `rig_lobe_strength` of the face and of the regions; NaN for fewer than three takes
        with many samples.
    """
    none = np.full((1, len(LOBE_REFLECTANCE)), np.nan)
    empty = dataset({variables.RIG_LOBE_STRENGTH: none}, coords={"region": [FACE]})
    of_takes = xr.concat([empty, *takes], "take", join="outer")
    median = of_takes.median("take").where(of_takes.count("take") >= MIN_TAKES_LOBES)
    strength = FEW_OVER_FREE * median[variables.RIG_LOBE_STRENGTH].values
    return dataset(
        {variables.RIG_LOBE_STRENGTH: strength},
        coords={"region": median["region"].values},
    )


def _samples(lumitexels: xr.Dataset, surfels: int) -> xr.Dataset:
    """Some of the surfels, in memory, with what estimates need."""
    names = (*GEOMETRY, "surfel_normal", "noise_floor", *noise_inputs(lumitexels))
    part = lumitexels[list(dict.fromkeys(names))]
    return part.isel(surfel=_spread(part.sizes["surfel"], surfels)).compute()


def _sample_count(part: xr.Dataset) -> Array:
    """Number of samples (surfel,)."""
    finite = finite_rows(part["reflectance_sample"].values)
    return finite.sum(axis=(1, 2))


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
        block_of(arrays),
        Comparison("perceptual", eta, noise_floor(part), min_width=MIN_LOBE_WIDTH),
        scan_normal=arrays["surfel_normal"],
        scan_error=float(np.deg2rad(scan_error) / np.sqrt(2)),
        gloss=prior,
        lobes=shared_lobes(arrays, prior),
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
    both = polarisation(part)
    if both.size:
        apart = lengths(wi + wo) / 2  # cosine of theta_d
        value *= 1 - both * circular_reversal(apart, eta)
    value += passed[0] * passed[1] * refined.diffuse.mean(axis=1)[:, None, None] / np.pi
    predicted = np.where(steep, wi[..., 2] * value, np.nan)
    measured = part["reflectance_sample"].values.mean(axis=3)
    sum_of_both = np.maximum(predicted + np.abs(measured), 1e-9)
    return np.abs(predicted - measured) / sum_of_both
