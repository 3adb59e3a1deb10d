"""Diffuse reflectance per surfel (Weyrich et al. 2005, section 6, eq. 4 to 6)."""

from __future__ import annotations

from functools import partial

import numpy as np
import xarray as xr

from skindb.elementwise import elementwise
from skindb.fit._albedo_kernels import separate_block
from skindb.fit._albedo_rules import lobe_table, rule_reflectance
from skindb.fit._arrays import in_batches
from skindb.fit.lumitexels import GEOMETRY
from skindb.fit.sample_noise import NO_NOISE, NOISE_INPUTS, noise_inputs, noise_of
from skindb.jit import sample_bits
from skindb.optics.diffuse import dipole_s
from skindb.parameters import EVEN_REFLECTION
from skindb.schema import check, label
from skindb.schema.status import LARGEST_R_D, SMALLEST_R_D
from skindb.types import Array

METHODS = ("separated", "quantile", "minimum")
# rad; largest error of a normal: no sample above the grazing limit falls below the
# horizon
LARGEST_TURN = 0.25
# Coloured highlights, which eq. 7 excludes: under Lafortune's of skin, R_d of five
# captures was 0.004 to 0.016 too low.
MODEL_ERROR_ALBEDO = 0.01
NORMAL_95 = 1.96


def estimate_diffuse_reflectance(
    lumitexels: xr.Dataset,
    *,
    eta: float = 1.3,
    method: str = "separated",
    discard: int = 2,
    even_reflection: float = EVEN_REFLECTION,
) -> xr.Dataset:
    """R_d, its standard error and the dipole's s per surfel and channel.

    Parameters
    ----------
    lumitexels
        Samples with geometry and `shading_normal`; `normal_error`, if present,
        contributes to the error of R_d. If the noise of the samples is known
        (`sample_variance`), "separated" limits their weights accordingly.
    eta
        Refractive index of F_t and of eq. 5.
    method
        "minimum": the paper's eq. 6, biased down by noise and up by whatever the
        surface reflects into every direction. "quantile": tenth percentile of the same
        ratios with half its noise bias taken out. "separated": light from the surface
        is white, so differences between channels give the differences of R_d by a
        robust slope; what is common to the channels is split by non-negative least
        squares between the diffuse shape cos(theta_i) F_t F_t and six microfacet lobes
        without diffuse part.
    discard
        Number of smallest ratios that "minimum" ignores.
    even_reflection
        Largest fraction of light (95 %) that the surface may reflect evenly and without
        colour. Such light cannot be distinguished from diffuse light, so that R_d of
        the entire take may be too high by up to this value.

    Returns
    -------
    Dataset
        `diffuse_reflectance` within [1e-4, 0.9999], `diffuse_reflectance_error`,
        `diffuse_reflectance_total_error`, `dipole_s`; NaN where fewer than ten samples
        lie above the grazing limit; and `even_reflection_limit`. The error of
        "separated" is that of the samples' noise and, at first order, of the normal: 93
        to 97 % of the true values lie within 1.96 of it where the model holds, with
        given and with estimated normals. It ignores that both use the same samples: an
        efficient estimate of the normal is uncorrelated with that of R_d at a fixed
        normal. The total error ("separated" alone) has three parts in quadrature: the
        error of the samples, as residuals that samples of one light or of one camera
        have in common show it, and of the normal by `normal_total_error`; 0.01; and
        `even_reflection` / 1.96, which is common to the take and acts to one side
        (`reflectance_interval`). The errors of the other two methods do not include
        their bias.

    Notes
    -----
    Median relative error of R, G, B on independent captures with known truth [%]:

    ================================== =============== =============== ===============
    surface of the capture             minimum         quantile        separated
    ================================== =============== =============== ===============
    measured materials, 16 x 150       5.5  7.4  9.6   4.4  6.5  9.0   1.8  2.9  4.0
    the same, subsurface, 8 x 64       4.8  6.3  8.0   3.7  5.3  7.6   1.9  2.8  3.9
    the same, 6 x 32                   6.5  8.2 10.1   5.0  7.7 10.4   2.6  4.1  5.7
    Lafortune lobes, coloured, 8 x 64  3.4  3.9  4.7   2.7  3.3  3.9   1.9  3.8  5.5
    ================================== =============== =============== ===============

    The measured materials reflect 0.02 evenly into all directions: 4 to 8 % of R_d that
    no minimum can avoid.
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, not {method!r}")
    check(lumitexels, (*GEOMETRY, "shading_normal"), where="lumitexels")
    errors = (
        ("normal_error", "normal_total_error")
        if "normal_total_error" in lumitexels
        else ("normal_error",)
    )
    known = errors if "normal_error" in lumitexels else errors[:0]
    found = elementwise(
        _reflectances,
        lumitexels,
        over="surfel",
        inputs=(*GEOMETRY, "shading_normal", *noise_inputs(lumitexels), *known),
        outputs=(
            "diffuse_reflectance",
            "diffuse_reflectance_error",
            "diffuse_reflectance_total_error",
            "dipole_s",
        ),
        method=method,
        eta=eta,
        discard=discard,
        even_reflection=even_reflection,
    )
    return found.assign(
        even_reflection_limit=label("even_reflection_limit", even_reflection)
    )


def reflectance_interval(fitted: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray]:
    """Lower and upper ends of the 95 % interval of R_d, with even reflection to the
    lower side alone.

    Parameters
    ----------
    fitted
        `diffuse_reflectance`, `diffuse_reflectance_total_error` and `even_reflection_limit`.

    Returns
    -------
    low, high
        As `diffuse_reflectance`.

    Examples
    --------
    >>> low, high = reflectance_interval(model["fitted"].to_dataset())  # doctest: +SKIP
    """
    value = fitted["diffuse_reflectance"]
    limit = fitted["even_reflection_limit"]
    both = (NORMAL_95 * fitted["diffuse_reflectance_total_error"]) ** 2
    return value - both**0.5, value + (both - limit**2).clip(min=0) ** 0.5


def _reflectances(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    *others: Array,
    method: str,
    eta: float,
    discard: int,
    even_reflection: float,
) -> tuple[Array, Array, Array, Array]:
    """(n, 3) R_d within SMALLEST_R_D and LARGEST_R_D, its standard error and total
    error, and dipole s.

    `others` are the arrays of the noise of the samples, and the standard and total
    error of the normal, if known.
    """
    known = len(NOISE_INPUTS) if len(others) >= len(NOISE_INPUTS) else 0
    errors = others[known:]
    normal_error, normal_total_error = (
        errors[i] if i < len(errors) else None for i in range(2)
    )
    if method == "separated":
        larger = normal_error if normal_total_error is None else normal_total_error
        angle = np.stack(
            [_turn(normal_error, len(sample)), _turn(larger, len(sample))], axis=1
        )
        estimate, error, shared = (np.empty((len(sample), 3)) for _ in range(3))
        doubles = (
            np.ascontiguousarray(a, np.float64)
            for a in (position, light, camera, normal)
        )
        noise = noise_of(others[:known], NO_NOISE)
        separate_block(
            sample_bits(sample),
            *doubles,
            angle,
            lobe_table(),
            noise,
            float(eta),
            estimate,
            error,
            shared,
        )
    else:
        rule = partial(rule_reflectance, method=method, eta=eta, discard=discard)
        estimate, error = in_batches(
            lambda sample, position, normal: rule(
                sample, position, light, camera, normal
            ),
            (sample, position, normal),
        )
        shared = np.full_like(error, np.nan)
    clamped = np.clip(estimate, SMALLEST_R_D, LARGEST_R_D)
    total = np.hypot(np.hypot(shared, MODEL_ERROR_ALBEDO), even_reflection / NORMAL_95)
    return clamped, error, total, dipole_s(clamped, eta=eta)[0]


def _turn(normal_error: Array | None, surfels: int) -> Array:
    """Standard error (surfels,) of the normal about each of two axes [rad]; 0 where it
    is not known.
    """
    if normal_error is None:
        return np.zeros(surfels)
    radians = np.nan_to_num(np.deg2rad(normal_error, dtype=float))
    # the RMS angle is that of two axes
    return np.asarray(np.clip(radians, 0, LARGEST_TURN) / np.sqrt(2))
