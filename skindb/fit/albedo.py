"""Diffuse reflectance per surfel (Weyrich et al. 2005, section 6, eq. 4 to 6)."""

from __future__ import annotations

from functools import partial

import numpy as np
import xarray as xr

from skindb._half_kernels import sample_bits
from skindb._types import Array
from skindb.elementwise import elementwise
from skindb.fit._albedo_kernels import separate_block
from skindb.fit._albedo_rules import lobe_table, rule_reflectance
from skindb.fit._arrays import in_batches
from skindb.fit.lumitexels import GEOMETRY
from skindb.optics.diffuse import dipole_s
from skindb.schema import check
from skindb.schema.status import LARGEST_R_D, SMALLEST_R_D

METHODS = ("separated", "quantile", "minimum")
LARGEST_TURN = 0.25  # rad; of a normal, for its error in R_d: no sample above the limit falls below the horizon
# Total error of "separated": 93 to 96 % of the values of six independent captures with known truth within 1.96 of it.
# The second is the even white reflection of the measured materials that no photograph tells from diffuse light.
NOISE_FACTOR_ALBEDO, MODEL_ERROR_ALBEDO = 2.0, 0.014


def estimate_diffuse_reflectance(
    lumitexels: xr.Dataset, *, eta: float = 1.3, method: str = "separated", discard: int = 2
) -> xr.Dataset:
    """R_d, its standard error and the dipole's s per surfel and channel.

    Parameters
    ----------
    lumitexels
        Samples with geometry and `shading_normal`; with `normal_error` its share in the error of R_d is counted.
    eta
        Refractive index of F_t and of eq. 5.
    method
        "minimum": the paper's eq. 6, biased down by noise and up by whatever the surface reflects into every
        direction. "quantile": tenth percentile of the same ratios with half its noise bias taken out. "separated":
        light from the surface is white, so differences between channels give the differences of R_d by a robust
        slope; what is common to the channels is split by non-negative least squares between the diffuse shape
        cos(theta_i) F_t F_t and six microfacet lobes without diffuse part.
    discard
        Smallest ratios that "minimum" leaves out.

    Returns
    -------
    Dataset
        `diffuse_reflectance` within [1e-4, 0.9999], `diffuse_reflectance_error`, `diffuse_reflectance_total_error`,
        `dipole_s`; NaN where fewer than ten samples lie above the grazing limit. The error of "separated" is that of
        the samples' noise and, at first order, of the normal: 93 to 97 % of the truth lies within 1.96 of it where the
        model holds, with given and with found normals. That both come from the same samples is left out: an efficient
        estimate of the normal does not vary with that of R_d at a fixed normal. What a
        surface reflects evenly and without colour cannot be told from diffuse light: the total error ("separated"
        alone) is twice the first and 0.014 in quadrature. The errors of the other two leave out their bias.

    Notes
    -----
    Median relative error of R, G, B on independent captures with known truth [%]:

    | surface of the capture           | minimum       | quantile      | separated     |
    |----------------------------------|---------------|---------------|---------------|
    | measured materials, 16 x 150     | 5.5  7.4  9.6 | 4.4  6.5  9.0 | 1.8  2.9  4.0 |
    | the same, subsurface, 8 x 64     | 4.8  6.3  8.0 | 3.7  5.3  7.6 | 1.9  2.8  3.9 |
    | the same, 6 x 32                 | 6.5  8.2 10.1 | 5.0  7.7 10.4 | 2.6  4.1  5.7 |
    | Lafortune lobes, coloured, 8 x 64 | 3.4  3.9  4.7 | 2.7  3.3  3.9 | 1.9  3.8  5.5 |

    Share of the true values within 1.96 errors on six captures: 22 to 47 % for the first error, 93 to 96 % for the
    total one, whose two numbers were chosen on them.

    The measured materials reflect 0.02 evenly into all directions: 4 to 8 % of R_d that no minimum can avoid.
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, not {method!r}")
    check(lumitexels, (*GEOMETRY, "shading_normal"), where="lumitexels")
    inputs = (*GEOMETRY, "shading_normal", *(("normal_error",) if "normal_error" in lumitexels else ()))
    return elementwise(
        _reflectances,
        lumitexels,
        over="surfel",
        inputs=inputs,
        outputs=(
            "diffuse_reflectance",
            "diffuse_reflectance_error",
            "diffuse_reflectance_total_error",
            "dipole_s",
        ),
        method=method,
        eta=eta,
        discard=discard,
    )


def _reflectances(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    normal_error: Array | None = None,
    *,
    method: str,
    eta: float,
    discard: int,
) -> tuple[Array, Array, Array, Array]:
    """(n, 3) R_d within SMALLEST_R_D and LARGEST_R_D, its standard and total error, and dipole s."""
    if method == "separated":
        turn = np.zeros(len(sample)) if normal_error is None else np.nan_to_num(np.deg2rad(normal_error, dtype=float))
        estimate, error = (np.empty((len(sample), 3)) for _ in range(2))
        doubles = (np.ascontiguousarray(a, np.float64) for a in (position, light, camera, normal))
        angle = np.clip(turn, 0, LARGEST_TURN) / np.sqrt(2)  # the RMS angle is that of two axes
        separate_block(sample_bits(sample), *doubles, angle, lobe_table(), float(eta), estimate, error)
    else:
        rule = partial(rule_reflectance, method=method, eta=eta, discard=discard)
        estimate, error = in_batches(
            lambda sample, position, normal: rule(sample, position, light, camera, normal), (sample, position, normal)
        )
    clamped = np.clip(estimate, SMALLEST_R_D, LARGEST_R_D)
    total = np.hypot(NOISE_FACTOR_ALBEDO * error, MODEL_ERROR_ALBEDO if method == "separated" else np.nan)
    return clamped, error, total, dipole_s(clamped, eta=eta)[0]
