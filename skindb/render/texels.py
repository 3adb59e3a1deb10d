"""How far each surfel, and each texel of a map, is to be trusted, and why."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from skindb.errors import Fault, InputError
from skindb.schema import FitStatus, TexelStatus
from skindb.schema.status import MAX_CONDITION_TRUSTED, MIN_SAMPLES_TRUSTED

Codes = NDArray[np.uint8]
STATUS = {FitStatus.FITTED: TexelStatus.MEASURED} | dict.fromkeys(
    (FitStatus.DIFFUSE_CLAMPED, FitStatus.NOT_CONVERGED, FitStatus.OBSTRUCTED), TexelStatus.DOUBTFUL_FIT
)
TRUST = np.array([1.0, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0], np.float32)  # by code


def surfel_texels(fitted: xr.Dataset) -> Codes:
    """(n,) codes of `TexelStatus`; condition and samples count where the model has them (edited ones have not)."""
    status = fitted["fit_status"].values
    code = np.full(status.shape, TexelStatus.FILLED, np.uint8)
    for member, value in STATUS.items():
        code[status == member] = value
    for name, doubt in (("fit_samples", TexelStatus.FEW_SAMPLES), ("fit_condition", TexelStatus.ILL_CONDITIONED)):
        if name in fitted:
            values = fitted[name].values
            wrong = values < MIN_SAMPLES_TRUSTED if name == "fit_samples" else values > MAX_CONDITION_TRUSTED
            code[wrong & (code < TexelStatus.FILLED)] = doubt
    for name in ("shading_normal", "diffuse_reflectance", "basis_weight"):
        code[~np.isfinite(fitted[name].values).all(axis=1)] = TexelStatus.FILLED
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
    found = np.where(open_to_border[piece], TexelStatus.OUTSIDE, TexelStatus.OPENING).astype(np.uint8)
    on = ~empty
    found[on] = code[triangles[face[on], weight[on].argmax(axis=1)]]
    return found
