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
    cosines,
    directions,
    noise_inputs,
)
from skindb.optics.diffusion import dipole_s
from skindb.optics.fresnel import fresnel_transmittance
from skindb.parameters import BARE_SKIN
from skindb.reflectance._separation_kernels import (
    MAX_GLOSS_CROSSED,
    MIN_COSINE_ALBEDO,
    MIN_SAMPLES_ALBEDO,
)
from skindb.reflectance.model import typical_noise
from skindb.reflectance.separation import separate_diffuse
from skindb.schema import check
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D
from skindb.types import Array, Float64

METHODS = ("separated", "quantile", "minimum")
# rad; largest error of a normal: no sample above the grazing limit falls below the
# horizon
LARGEST_TURN = 0.25
# Coloured highlights, which eq. 7 excludes: under the lobes of Marschner et al. (1999),
# whose channels differ by 12 to 23 % from their mean, R_d was wrong by a tenth of what
# the surface reflects (RMS over the channels).
MODEL_ERROR_ALBEDO = 0.1 * BARE_SKIN[0]
NORMAL_ERRORS = ("normal_error", "normal_total_error")
# surfels processed at once by the other rules: 15 MB of samples of a full dome
BATCH = 512
# quantiles of the method "quantile", and their normal deviates
LOW = 0.10
LOWER = 0.02
Z_LOW = -1.2816
Z_LOWER = -2.0537


def estimate_diffuse_reflectance(
    lumitexels: xr.Dataset,
    *,
    eta: float = 1.3,
    method: str = "separated",
    discard: int = 2,
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
        ratios with half its noise bias taken out. "separated": by the colours and by
        non-negative least squares, see `skindb.reflectance.separation`.
    discard
        Number of smallest ratios that "minimum" ignores.

    Returns
    -------
    Dataset
        `diffuse_reflectance` within [1e-4, 0.9999], `diffuse_reflectance_error`,
        `diffuse_reflectance_total_error`, `dipole_s`; NaN where fewer than ten samples
        lie above the grazing limit. R_d includes what the surface reflects evenly and
        without colour, see `skindb.fit.energy`. The error of
        "separated" is that of the samples' noise and, at first order, of the normal: 93
        to 97 % of the true values lie within 1.96 of it where the model holds, with
        given and with estimated normals. It ignores that both use the same samples: an
        efficient estimate of the normal is uncorrelated with that of R_d at a fixed
        normal. The total error ("separated" alone) has two parts in quadrature: the
        error of the samples, as residuals that samples of one light or of one camera
        have in common show it, and of the normal by `normal_total_error`; and 0.004. The
        errors of the other two methods do not include their bias. If ten or more samples
        are behind crossed polarisers, "separated" uses these alone, and 0.004 is scaled by
        the part of the surface's light that they pass.

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
        method=method,
        eta=eta,
        discard=discard,
    )


def block_reflectance(
    arrays: Arrays,
    *,
    method: str,
    eta: float,
    discard: int = 2,
) -> tuple[Array, Array, Array, Array]:
    """(n, 3) R_d within SMALLEST_R_D and LARGEST_R_D, its standard error and total
    error, and dipole s.
    """
    if method == "separated":
        value, error, shared, gloss = _separated(arrays, eta=eta)
    else:
        gloss = np.ones(len(arrays["surfel_position"]))
        value, error, shared = _by_rule(arrays, eta=eta, method=method, discard=discard)
    clamped = np.clip(value, SMALLEST_R_D, LARGEST_R_D)
    model_error = MODEL_ERROR_ALBEDO * gloss
    if POLARISATION[0] in arrays:
        even = np.where(gloss > MAX_GLOSS_CROSSED, gloss * UNKNOWN_ERROR, 0.0)
        model_error = np.hypot(model_error, even)
    total = np.hypot(shared, model_error[:, None])
    return clamped, error, total, dipole_s(clamped, eta=eta)[0]


def _separated(arrays: Arrays, *, eta: float) -> tuple[Array, Array, Array, Array]:
    """R_d (n, 3) by the separation, its standard error, that for errors by device, and
    the factor (n,) of the surface by polarisers.
    """
    n = len(arrays["surfel_position"])
    turns = [_turn(arrays.get(name), n) for name in NORMAL_ERRORS]
    if "normal_total_error" not in arrays:
        turns[1] = turns[0]
    block = block_of(arrays, typical_noise())
    return separate_diffuse(block, np.stack(turns, axis=1), eta=eta)


def _by_rule(
    arrays: Arrays, *, eta: float, method: str, discard: int
) -> tuple[Array, Array, Array]:
    """R_d (n, 3) by the minimum or the quantile, its error, and NaN; in batches, which
    bounds the memory.
    """
    light = arrays["light_position"]
    camera = arrays["camera_position"]
    n = len(arrays["surfel_position"])
    parts = []
    for begin in range(0, max(n, 1), BATCH):
        sample, position, normal = (
            arrays[name][begin : begin + BATCH]
            for name in ("reflectance_sample", "surfel_position", "shading_normal")
        )
        ratio, weight = ratios(sample, position, light, camera, normal, eta)
        parts.append(
            stable_minimum(ratio, weight, discard)
            if method == "minimum"
            else low_quantile(ratio)
        )
    estimate, error = (np.concatenate(part) for part in zip(*parts, strict=True))
    return estimate, error, np.full_like(error, np.nan)


def _turn(normal_error: Array | None, surfels: int) -> Float64:
    """Standard error (surfels,) of the normal about each of two axes [rad]; 0 where it
    is not known.
    """
    if normal_error is None:
        return np.zeros(surfels)
    radians = np.nan_to_num(np.deg2rad(normal_error, dtype=float))
    # the RMS angle is that of two axes
    return np.asarray(np.clip(radians, 0, LARGEST_TURN) / np.sqrt(2))


def ratios(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    normal: Array,
    eta: float,
) -> tuple[Array, Array]:
    """Ratios pi f_r / (F_t F_t) of all samples (n, l c, 3), NaN at grazing angles, and
    weights that decrease there.
    """
    normal = normal.astype(np.float64)
    samples = sample.astype(np.float32)
    lit, seen = (
        cosines(normal, directions(position, targets)) for targets in (light, camera)
    )
    lit, seen = (np.where(c > MIN_COSINE_ALBEDO, c, np.nan) for c in (lit, seen))
    # F_t is evaluated at the limit instead of NaN; the cosine carries the NaN
    per_light = np.pi / (
        lit * fresnel_transmittance(np.fmax(lit, MIN_COSINE_ALBEDO), eta)
    )
    per_camera = seen / (
        seen * fresnel_transmittance(np.fmax(seen, MIN_COSINE_ALBEDO), eta)
    )
    ratio = (
        samples
        * (per_light[:, :, None] * per_camera[:, None]).astype(np.float32)[..., None]
    )
    # -1 would be ambiguous without surfels
    n = len(sample)
    pairs = lit.shape[1] * seen.shape[1]
    weight = (lit[:, :, None] * seen[:, None]).reshape(n, pairs)
    return ratio.reshape(n, pairs, 3), weight


def stable_minimum(ratio: Array, weight: Array, discard: int) -> tuple[Array, Array]:
    """The paper's rule (eq. 6): ratios are raised by up to a fifth at grazing angles,
    the `discard` smallest ignored.

    The error is half the distance between the values that lie `discard` ranks above and below.
    """
    order = np.argsort(ratio * (1.2 - 0.2 * weight[..., None]), axis=1)
    count = np.isfinite(ratio).sum(1, keepdims=True)
    enough = count[:, 0] >= max(MIN_SAMPLES_ALBEDO, 2 * discard + 2)

    def at(rank: int) -> Array:
        place = np.take_along_axis(
            order, np.full_like(count, min(rank, ratio.shape[1] - 1)), 1
        )
        return np.where(enough, np.take_along_axis(ratio, place, 1)[:, 0], np.nan)

    return at(discard), np.abs(at(2 * discard + 1) - at(0)) / 2


def low_quantile(ratio: Array) -> tuple[Array, Array]:
    """Tenth percentile, raised by half of its bias under normal noise, whose spread is
    estimated below it.
    """
    count = np.isfinite(ratio).sum(1)
    low = quantile_finite(ratio, LOW, 1)
    lower = quantile_finite(ratio, LOWER, 1)
    noise = (low - lower) / (Z_LOW - Z_LOWER)
    enough = count >= MIN_SAMPLES_ALBEDO
    # the variance of a quantile: p (1 - p) / (n density^2), density of the normal at it
    error = noise * np.sqrt(LOW * (1 - LOW) / np.maximum(count, 1)) / 0.1755
    return np.where(enough, low - Z_LOW * noise / 2, np.nan), np.where(
        enough, error, np.nan
    )


def quantile_finite(values: Array, level: float, axis: int) -> Array:
    """Quantile at `level` of the finite values along an axis, without interpolation;
    NaN where there is none.
    """
    ordered = np.sort(np.where(np.isfinite(values), values, np.nan), axis=axis)
    count = np.isfinite(ordered).sum(axis, keepdims=True)
    place = np.clip(
        np.rint(level * (count - 1)).astype(np.int64), 0, values.shape[axis] - 1
    )
    return np.asarray(np.take_along_axis(ordered, place, axis).squeeze(axis))
