"""How far each surfel, and each texel of a map, is to be trusted, and why."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from skindb.errors import Fault, InputError
from skindb.schema import Explained, FitStatus

Codes = NDArray[np.uint8]
# on the demo's subjects R_d's standard error is 0.75 % in the middle, 1.5 % beyond this condition (1 % of the surfels)
# and 1.6 % with fewer samples than this (1 %); errors under held-out lights do not rise with either
WORST_CONDITION = 1e3
FEWEST_SAMPLES = 16


class Texel(Explained):
    """Where the value of a texel comes from."""

    MEASURED = 0, "measured: the nearest surfel was fitted"
    DOUBTFUL_FIT = 1, "doubtful: the fit clamped the diffuse reflectance or did not converge"
    ILL_CONDITIONED = 2, f"doubtful: the condition of the fit is above {WORST_CONDITION:g}"
    FEW_SAMPLES = 3, f"doubtful: fewer than {FEWEST_SAMPLES} samples"
    FILLED = 4, "filled in from around: the nearest surfel has no fit"
    OPENING = 5, "filled in: an opening of the surface"
    OUTSIDE = 6, "filled in: outside the surface"


STATUS = {FitStatus.FITTED: Texel.MEASURED} | dict.fromkeys(
    (FitStatus.DIFFUSE_CLAMPED, FitStatus.NOT_CONVERGED), Texel.DOUBTFUL_FIT
)
TRUST = np.array([1.0, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0], np.float32)  # by code


def surfel_texels(fitted: xr.Dataset) -> Codes:
    """(n,) codes of `Texel`; condition and samples count where the model has them (edited ones have not)."""
    status = fitted["fit_status"].values
    code = np.full(status.shape, Texel.FILLED, np.uint8)
    for member, value in STATUS.items():
        code[status == member] = value
    for name, doubt in (("fit_samples", Texel.FEW_SAMPLES), ("fit_condition", Texel.ILL_CONDITIONED)):
        if name in fitted:
            values = fitted[name].values
            wrong = values < FEWEST_SAMPLES if name == "fit_samples" else values > WORST_CONDITION
            code[wrong & (code < Texel.FILLED)] = doubt
    for name in ("shading_normal", "diffuse_reflectance", "reduced_weight"):
        code[~np.isfinite(fitted[name].values).all(axis=1)] = Texel.FILLED
    return code


def surfel_confidence(fitted: xr.Dataset) -> NDArray[np.float32]:
    """(n,) 1 for fitted surfels, 0.5 for doubtful ones, 0 for the rest."""
    trust: NDArray[np.float32] = TRUST[surfel_texels(fitted)]
    if not trust.any():
        raise InputError(Fault("fitted[fit_status]", "an export needs fitted surfels", "none", "see the fit's report"))
    return trust


def texel_codes(
    code: Codes, triangles: NDArray[np.integer], face: NDArray[np.int32], weight: NDArray[np.float32]
) -> Codes:
    """(size, size) codes: that of the nearest surfel on the surface; openings are enclosed by it."""
    empty = face < 0
    piece, n = ndimage.label(empty)
    open_to_border = np.zeros(n + 1, bool)
    for border in (piece[0], piece[-1], piece[:, 0], piece[:, -1]):
        open_to_border[border] = True
    found = np.where(open_to_border[piece], Texel.OUTSIDE, Texel.OPENING).astype(np.uint8)
    on = ~empty
    found[on] = code[triangles[face[on], weight[on].argmax(axis=1)]]
    return found
