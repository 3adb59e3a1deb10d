"""Energy of the surface: the part of its reflection that looks like diffuse light.

Highlights show one part of what the surface of skin reflects. The rest is even and white,
so that no photograph distinguishes it from diffuse light, and estimates of R_d include it.
What the surface reflects in total is known from measured skin: what highlights do not show
of it is subtracted from R_d, and stored as `even_reflection`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from scipy.special import erfcx

from skindb.fit.lumitexels import directions, polarisation
from skindb.optics.diffusion import dipole_s
from skindb.optics.fresnel import circular_reversal
from skindb.parameters import (
    SURFACE_ENERGY,
    SURFACE_ENERGY_ELSEWHERE,
    FitParameters,
)
from skindb.reflectance._separation_kernels import MAX_GLOSS_CROSSED
from skindb.schema import FitStatus, dataset, variables
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D
from skindb.types import lengths

# Quantile of R_d in blue over the surfels, which bounds even reflection: moles and brows
# reflect little else. The darkest hundredth may be wrong by noise and shadows.
DARKEST = 0.01
# Standard deviations by which the highlights may exceed the prior of the total. They show
# half to nine tenths of it; above one deviation (lotion, coloured lobes) R_d was wrong by
# 0.026, with either sign.
MAX_DEVIATIONS = 1.0
# Error of R_d relative to it, by lobes of other shapes: R_d was 1.7 to 2.6 % too low in
# proportion in four captures without other errors.
PROPORTIONAL_ERROR = 0.02
# Fraction of what the highlights lack that R_d contains: the nearly even lobes of the joint
# fit take the rest. 0.4 to 0.9 in blue in four captures. On 24 others
# the mean bias of R_d in blue is 0 with it, and 3 % without (docs/results).
JOINT_FRACTION = 0.5
SMALLEST_ERROR = 1e-9  # of a prior that is stated to be exact
# error of what highlights do not show without a prior of the total: highlights of bare
# skin show the half of it, more or less
UNKNOWN_ERROR = SURFACE_ENERGY["normal"][0] / 2


class Energy(NamedTuple):
    """Fraction of light that the surface reflects in total, over people."""

    mean: float
    error: float


def energy_prior(condition: str, parameters: FitParameters) -> Energy | None:
    """The prior for a take in this condition; None if it is unknown."""
    mean, error = SURFACE_ENERGY.get(condition, SURFACE_ENERGY_ELSEWHERE)
    if parameters.surface_energy == "unknown":
        return None
    if parameters.surface_energy != "condition":
        mean = parameters.surface_energy
    if parameters.surface_energy_error != "condition":
        error = parameters.surface_energy_error
    return Energy(mean, error)


def crossed_gloss(lumitexels: xr.Dataset, eta: float) -> float | None:
    """Mean fraction of the light from the surface that crossed polarisers pass, seen from
    the middle of the surfels; None if no light and camera are crossed.
    """
    both = polarisation(lumitexels)
    if not both.size:
        return None
    middle = lumitexels["surfel_position"].values.mean(axis=0, keepdims=True)
    lights, cameras = (
        directions(middle, lumitexels[f"{device}_position"].values)[0]
        for device in ("light", "camera")
    )
    cosine = lengths(lights[:, None] + cameras) / 2  # of theta_d
    gloss = 1 - both * circular_reversal(cosine, eta)
    crossed = gloss[gloss <= MAX_GLOSS_CROSSED]
    return float(crossed.mean()) if crossed.size else None


def _expected_rest(prior: Energy, seen: float) -> float:
    """Mean of the total minus what was seen, for a normal distribution of the total above
    it.
    """
    error = max(prior.error, SMALLEST_ERROR)
    deviation = (seen - prior.mean) / error
    hazard = np.sqrt(2 / np.pi) / erfcx(deviation / np.sqrt(2))  # density over tail
    return float(prior.mean + error * hazard - seen)


def without_even_reflection(
    fitted: xr.Dataset,
    prior: Energy | None,
    leak: float | None = None,
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Subtract from R_d what the surface reflects evenly and without colour.

    Parameters
    ----------
    fitted
        Variables of the surfels after the fit of the surface, with `surfel_area`.
    prior
        From `energy_prior`.
    leak
        From `crossed_gloss`; if it is given, R_d contains only this fraction of the even
        reflection, and nothing is subtracted.

    Returns
    -------
    fitted
        With `even_reflection`, half of what the mean `surface_reflectance` of the fitted
        surfels lacks of the total, given that the total exceeds it (the nearly even
        lobes of the joint fit took the other half from R_d), but at most what the darkest
        surfels reflect in blue, and with the standard deviation of the prior as its
        error. It is subtracted from R_d, and `dipole_s` follows. Without a prior, or if
        the highlights contradict it, nothing is subtracted. Its error and 0.02 R_d are
        added to the total error of R_d, in quadrature.
    summary
        Attribute `surface_energy` of the model: prior, what the highlights show, and
        whether they contradict it, which they do above one standard deviation.
    """
    good = fitted[variables.FIT_STATUS].values == FitStatus.FITTED
    good &= np.isfinite(fitted[variables.SURFACE_REFLECTANCE].values)
    area = fitted[variables.SURFEL_AREA].values[good]
    diffuse = fitted[variables.DIFFUSE_REFLECTANCE].values
    eta = float(fitted[variables.REFRACTIVE_INDEX])
    surface = fitted[variables.SURFACE_REFLECTANCE].values[good]
    seen = float(np.average(surface, weights=area)) if good.any() else np.nan
    summary = {"highlights": seen}
    even, error = 0.0, UNKNOWN_ERROR
    if leak is not None:
        error *= leak
    elif prior is not None and good.any():
        contradicted = seen > prior.mean + MAX_DEVIATIONS * prior.error
        summary |= prior._asdict() | {"contradicted": contradicted}
        if not contradicted:
            largest = float(np.quantile(diffuse[good, 2], DARKEST))
            even = min(JOINT_FRACTION * _expected_rest(prior, seen), largest)
            error = prior.error
    lower = np.clip(diffuse - even, SMALLEST_R_D, LARGEST_R_D)
    parts = (
        fitted[variables.DIFFUSE_REFLECTANCE_TOTAL_ERROR].values,
        error,
        PROPORTIONAL_ERROR * lower,
    )
    moved = dataset(
        {
            variables.DIFFUSE_REFLECTANCE: lower,
            variables.DIFFUSE_REFLECTANCE_TOTAL_ERROR: np.sqrt(
                sum(part**2 for part in parts)
            ),
            variables.DIPOLE_S: dipole_s(lower, eta=eta)[0],
            variables.EVEN_REFLECTION: even,
            variables.EVEN_REFLECTION_ERROR: error,
        }
    )
    return fitted.assign(moved), summary
