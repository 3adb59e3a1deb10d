"""Diffuse reflectance per surfel (Weyrich et al. 2005, section 6, eq. 4 to 6)."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.elementwise import elementwise
from skindb.fit.energy import UNKNOWN_ERROR
from skindb.fit.lumitexels import (
    GEOMETRY,
    POLARISATION,
    Arrays,
    block_of,
    by_name,
    noise_inputs,
)
from skindb.fit.normals import estimate_normals
from skindb.optics.diffusion import dipole_s
from skindb.parameters import BARE_SKIN
from skindb.reflectance._separation_kernels import (
    MAX_GLOSS_CROSSED,
)
from skindb.reflectance.separation import separate_diffuse
from skindb.schema import check
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D
from skindb.types import Array, Float64

# rad; largest error of a normal: no sample above the grazing limit falls below the
# horizon
LARGEST_TURN = 0.25
# Coloured highlights, which eq. 7 excludes: under the lobes of Marschner et al. (1999),
# whose channels differ by 12 to 23 % from their mean, R_d was wrong by a tenth of what
# the surface reflects (RMS over the channels).
MODEL_ERROR_ALBEDO = 0.1 * BARE_SKIN[0]
NORMAL_ERRORS = ("normal_error", "normal_total_error")


def estimate_diffuse_reflectance(
    lumitexels: xr.Dataset, *, eta: float = 1.3
) -> xr.Dataset:
    """R_d, its standard error and the dipole's s per surfel and channel.

    R_d is separated from the surface by the colours and by non-negative least squares, see
    `skindb.reflectance.separation`.

    Parameters
    ----------
    lumitexels
        Samples with geometry and `shading_normal`; `normal_error`, if present,
        contributes to the error of R_d. If the noise of the samples is known
        (`sample_variance`), their weights are limited accordingly.
    eta
        Refractive index of F_t and of eq. 5.

    Returns
    -------
    Dataset
        `diffuse_reflectance` within [1e-4, 0.9999], `diffuse_reflectance_error`,
        `diffuse_reflectance_total_error`, `dipole_s`; NaN with fewer than three samples.
        Below four above the grazing limit others are used as well. R_d includes what the
        surface reflects evenly and without colour, see `skindb.fit.energy`. The error
        is that of the samples' noise and, at first order, of the normal: 93
        to 97 % of the true values lie within 1.96 of it where the model holds, with
        given and with estimated normals. It ignores that both use the same samples: an
        efficient estimate of the normal is uncorrelated with that of R_d at a fixed
        normal. The total error has two parts in quadrature: the
        error of the samples, as residuals that samples of one light or of one camera
        have in common show it, and of the normal by `normal_total_error`; and 0.004. If
        ten or more samples are behind crossed polarisers, these alone are used, and
        0.004 is scaled by the part of the surface's light that they pass.

    Notes
    -----
    Median relative error of R, G, B on independent captures with known truth [%]:

    ================================== ===============
    surface of the capture             R, G, B
    ================================== ===============
    measured materials, 16 x 150       1.8  2.9  4.0
    the same, subsurface, 8 x 64       1.9  2.8  3.9
    the same, 6 x 32                   2.6  4.1  5.7
    Lafortune lobes, coloured, 8 x 64  1.9  3.8  5.5
    ================================== ===============

    The measured materials reflect 0.02 evenly into all directions: 4 to 8 % of R_d.
    """
    check(lumitexels, (*GEOMETRY, "shading_normal"), where="lumitexels")
    normal_errors = [name for name in NORMAL_ERRORS if name in lumitexels]
    names = tuple(
        dict.fromkeys(
            (*GEOMETRY, "shading_normal", *noise_inputs(lumitexels), *normal_errors)
        )
    )
    return elementwise(
        by_name(block_reflectance, names),
        lumitexels,
        over="surfel",
        inputs=names,
        outputs=(
            "diffuse_reflectance",
            "diffuse_reflectance_error",
            "diffuse_reflectance_total_error",
            "dipole_s",
        ),
        eta=eta,
    )


def estimate_in_sequence(
    lumitexels: xr.Dataset, *, eta: float, scan_error: float
) -> xr.Dataset:
    """Normals from `estimate_normals`, and R_d for them."""
    normals = estimate_normals(lumitexels, eta=eta, scan_error=scan_error)
    lit = lumitexels.merge(normals)
    return normals.merge(estimate_diffuse_reflectance(lit, eta=eta))


def block_reflectance(
    arrays: Arrays, *, eta: float
) -> tuple[Array, Array, Array, Array]:
    """(n, 3) R_d within SMALLEST_R_D and LARGEST_R_D, its standard error and total
    error, and dipole s.
    """
    n = len(arrays["surfel_position"])
    turns = [_turn(arrays.get(name), n) for name in NORMAL_ERRORS]
    if "normal_total_error" not in arrays:
        turns[1] = turns[0]
    block = block_of(arrays)
    value, error, shared, gloss = separate_diffuse(
        block, np.stack(turns, axis=1), eta=eta
    )
    clamped = np.clip(value, SMALLEST_R_D, LARGEST_R_D)
    model_error = MODEL_ERROR_ALBEDO * gloss
    if POLARISATION[0] in arrays:
        even = np.where(gloss > MAX_GLOSS_CROSSED, gloss * UNKNOWN_ERROR, 0.0)
        model_error = np.hypot(model_error, even)
    total = np.hypot(shared, model_error[:, None])
    return clamped, error, total, dipole_s(clamped, eta=eta)[0]


def _turn(normal_error: Array | None, surfels: int) -> Float64:
    """Standard error (surfels,) of the normal about each of two axes [rad]; 0 where it
    is not known.
    """
    if normal_error is None:
        return np.zeros(surfels)
    radians = np.nan_to_num(np.deg2rad(normal_error, dtype=float))
    # the RMS angle is that of two axes
    return np.clip(radians, 0, LARGEST_TURN) / np.sqrt(2)
