"""Confidence of surfels and of texels of a map, with its reason."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import ndimage

from skindb.errors import Fault, InputError
from skindb.reflectance.kinds import parameter_variables
from skindb.schema import FitStatus, TexelStatus
from skindb.schema.status import MAX_CONDITION_TRUSTED, MIN_SAMPLES_TRUSTED

Codes = NDArray[np.uint8]
STATUS = {FitStatus.FITTED: TexelStatus.MEASURED} | dict.fromkeys(
    (FitStatus.DIFFUSE_CLAMPED, FitStatus.NOT_CONVERGED, FitStatus.OBSTRUCTED),
    TexelStatus.DOUBTFUL_FIT,
)
# confidence by `TexelStatus`
TRUST = np.array([1.0, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0], np.float32)


def surfel_texels(fitted: xr.Dataset) -> Codes:
    """(n,) codes of `TexelStatus`, which depend on the condition and number of samples
    of fits if these are stored.

    Edited models do not store them.
    """
    status = fitted["fit_status"].values
    code = np.full(status.shape, TexelStatus.FILLED, np.uint8)
    for member, value in STATUS.items():
        code[status == member] = value
    for name, doubt in (
        ("fit_samples", TexelStatus.FEW_SAMPLES),
        ("fit_condition", TexelStatus.ILL_CONDITIONED),
    ):
        if name in fitted:
            values = fitted[name].values
            wrong = (
                values < MIN_SAMPLES_TRUSTED
                if name == "fit_samples"
                else values > MAX_CONDITION_TRUSTED
            )
            code[wrong & (code < TexelStatus.FILLED)] = doubt
    needed = ("shading_normal", "diffuse_reflectance", *parameter_variables(fitted))
    for name in needed:
        finite = np.isfinite(fitted[name].values.reshape(len(code), -1)).all(axis=1)
        code[~finite] = TexelStatus.FILLED
    return code


def surfel_confidence(fitted: xr.Dataset) -> NDArray[np.float32]:
    """(n,) 1 for fitted surfels, 0.5 for doubtful fits, 0 for all others."""
    trust: NDArray[np.float32] = TRUST[surfel_texels(fitted)]
    if not trust.any():
        rule = "at least one surfel must be fitted for an export"
        raise InputError(
            Fault("fitted[fit_status]", rule, "none", "see the report of the fit")
        )
    return trust


def texel_codes(
    code: Codes,
    triangles: NDArray[np.integer],
    face: NDArray[np.int32],
    weight: NDArray[np.float32],
) -> Codes:
    """(size, size) codes of texels: on the surface that of the nearest surfel; openings
    are holes that it encloses.
    """
    empty = face < 0
    piece, n = ndimage.label(empty)
    open_to_border = np.zeros(n + 1, bool)
    for border in (piece[0], piece[-1], piece[:, 0], piece[:, -1]):
        open_to_border[border] = True
    codes = np.where(
        open_to_border[piece], TexelStatus.OUTSIDE, TexelStatus.OPENING
    ).astype(np.uint8)
    on = ~empty
    codes[on] = code[triangles[face[on], weight[on].argmax(axis=1)]]
    return codes
