"""Statistics of profiles of the contact probe: isotropy of the tissue (Weyrich et al. 2005,
figure 10), variance between placements, drift and effect of the pressure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from skindb.errors import require
from skindb.types import Float64, Mask

# the mean and two harmonics have five unknowns; one degree of freedom remains
MIN_AZIMUTHS = 6
MIN_DISTANCES = 3
MIN_PLACEMENTS = 3
# of every azimuth at a distance that is used: logarithms of noisier signals are biased
MIN_SIGNAL_TO_NOISE = 5.0
FLAG_P_VALUE = 0.003  # below which a trend is flagged: three standard deviations


@dataclass(frozen=True)
class Isotropy:
    """Decay of each profile relative to the mean one, per channel.

    The decay is -d ln (r^2 R) / dr, which far from the source is close to sigma_tr
    (Farrell, Patterson and Wilson 1992). `slope` (azimuth, 3) and `slope_error` are its
    differences from the mean `decay` (3,), in mm^-1. `p_value` (3,) is the probability
    of differences this large in isotropic tissue. `amplitude` (3,) in mm^-1 and
    `direction` (3,) in radians, 0 to pi, belong to the second harmonic of the slope:
    tissue in which light travels farther along one line. `anisotropy` (3,) is the
    largest over the smallest decay of that harmonic, with its `anisotropy_error`.
    `shift` (3,) is the amplitude of the first harmonic in mm^-1, which indicates uneven
    pressure of the probe. `distances` (fibre,) marks the distances that were used.
    """

    slope: Float64
    slope_error: Float64
    decay: Float64
    p_value: Float64
    amplitude: Float64
    direction: Float64
    anisotropy: Float64
    anisotropy_error: Float64
    shift: Float64
    distances: Mask


def compare_azimuths(
    value: ArrayLike, error: ArrayLike, distance: ArrayLike, azimuth: ArrayLike
) -> Isotropy:
    """Compare the decay of profiles along several azimuths.

    ln (r^2 R) is fitted by a level and a slope for each azimuth. The level absorbs gain
    and contact of its fibres; differences of the slope are differences in transport. A
    chi-squared test of the slopes shows whether they are equal, and their first and
    second harmonics describe them. The form of the mean profile cancels.

    Parameters
    ----------
    value, error
        (azimuth, fibre, 3) profile and its standard error, errors independent between fibres.
    distance
        (fibre,) mm.
    azimuth
        (azimuth,) radians, spread evenly over the full turn or nearly so.

    Raises
    ------
    InputError
        Wrong shapes, too few azimuths, or too few distances at which all profiles are
        clear of noise.
    """
    profile, sigma, r, phi = (
        np.asarray(values, np.float64) for values in (value, error, distance, azimuth)
    )
    shape = (len(phi), len(r), 3)
    require(
        profile.shape == sigma.shape == shape and len(phi) >= MIN_AZIMUTHS,
        "test of isotropy",
        "value and error must have the shape (azimuth, fibre, 3), with "
        f"{MIN_AZIMUTHS} azimuths or more",
        f"{profile.shape}, {sigma.shape}, {shape}",
        "measure more",
    )
    clear = _clear_fibres(profile, sigma) & (sigma > 0).all(axis=(0, 2)) & (r > 0)
    require(
        len(np.unique(r[clear])) >= MIN_DISTANCES,
        "test of isotropy",
        f"all profiles must be {MIN_SIGNAL_TO_NOISE:g} times their error at "
        f"{MIN_DISTANCES} distances or more",
        f"{int(clear.sum())} distances",
        "add longer exposures, and remove profiles without contact",
    )
    log = np.log(profile[:, clear] * r[clear, None] ** 2)
    slope, variance = _slopes(log, sigma[:, clear] / profile[:, clear], r[clear])
    decay = slope.mean(axis=0)
    level = (slope / variance).sum(axis=0) / (1 / variance).sum(axis=0)
    chi_square = ((slope - level) ** 2 / variance).sum(axis=0)
    parts = [_harmonics(slope[:, c] - level[c], variance[:, c], phi) for c in range(3)]
    shift, amplitude, direction, amplitude_error = np.array(parts).T
    # of the smallest decay, which is not positive in noise
    low = np.abs(decay) - amplitude
    ratio = np.full(3, np.inf)
    np.divide(np.abs(decay) + amplitude, low, out=ratio, where=low > 0)
    steep = np.maximum(low, 1e-12)
    return Isotropy(
        slope=slope - level,
        slope_error=np.sqrt(variance),
        decay=decay,
        p_value=stats.chi2.sf(chi_square, len(phi) - 1),
        amplitude=amplitude,
        direction=direction,
        anisotropy=ratio,
        anisotropy_error=2 * np.abs(decay) / steep**2 * amplitude_error,
        shift=shift,
        distances=clear,
    )


def _clear_fibres(profile: Float64, sigma: Float64) -> Mask:
    """Fibres (fibre,) whose signal is clear of noise in all profiles and channels."""
    with np.errstate(invalid="ignore"):
        clear = (profile > 0) & (profile > MIN_SIGNAL_TO_NOISE * sigma) & (sigma >= 0)
    return np.asarray(clear.all(axis=(0, 2)))


def _slopes(log: Float64, sigma: Float64, r: Float64) -> tuple[Float64, Float64]:
    """Decay -d ln (r^2 R) / dr (azimuth, 3) by weighted lines over r, and its variance.

    All azimuths have the same weights, so that the mean profile, which is not a
    straight line, cancels.
    """
    weight = 1 / np.median(sigma**2, axis=0)
    way = r[:, None] - (weight * r[:, None]).sum(axis=0) / weight.sum(axis=0)
    factor = weight * way / (weight * way**2).sum(axis=0)
    return -(factor * log).sum(axis=1), (factor**2 * sigma**2).sum(axis=1)


def _harmonics(
    slope: Float64, variance: Float64, phi: Float64
) -> tuple[float, float, float, float]:
    """Amplitude of the first harmonic; amplitude, direction and error of the second one."""
    design = np.stack(
        [np.ones_like(phi), np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi)],
        axis=1,
    )
    covariance = np.linalg.pinv(design.T @ (design / variance[:, None]))
    coefficients = covariance @ (design.T @ (slope / variance))
    amplitude = float(np.hypot(coefficients[3], coefficients[4]))
    unit = coefficients[3:] / amplitude if amplitude > 0 else np.array([1.0, 0.0])
    error = float(np.sqrt(unit @ covariance[3:, 3:] @ unit))
    # light travels farthest where the decay is smallest, half a period from its maximum
    direction = float(
        np.mod(np.arctan2(coefficients[4], coefficients[3]) / 2 + np.pi / 2, np.pi)
    )
    return (
        float(np.hypot(coefficients[1], coefficients[2])),
        amplitude,
        direction,
        error,
    )


@dataclass(frozen=True)
class Repeatability:
    """Relative standard deviations between placements of the probe, per channel.

    `level` (3,) is common to all fibres (contact, gain); `shape` (3,) is the scatter of
    single fibres in excess of the measurement error, zero if there is none. `levels`
    (placement, 3) are logarithms relative to their mean. `mean` (fibre, 3) is the
    profile of all placements (geometric mean) and `error` its standard error by the
    scatter of the placements. Fibres without a clear signal are NaN.
    """

    level: Float64
    shape: Float64
    levels: Float64
    mean: Float64
    error: Float64


@dataclass(frozen=True)
class Trend:
    """Relative change (3,) of the level per unit of a covariate, with standard error, p
    value and flag.
    """

    slope: Float64
    error: Float64
    p_value: Float64
    flag: Mask


def placement_variance(value: ArrayLike, error: ArrayLike) -> Repeatability:
    """Variance components of repeated placements at one site, by the method of moments.

    ln R = profile of the fibre + level of the placement + residual. The variance of the
    residuals, minus that of the measurement, is the shape component; the variance of
    the levels, minus the contribution of the residuals to their means, is the level
    component (Searle, Casella and McCulloch 1992, section 4.5, crossed without
    interaction).

    Parameters
    ----------
    value, error
        (placement, fibre, 3) profiles and their standard errors.

    Raises
    ------
    InputError
        Wrong shapes, fewer than three placements, or fewer than two fibres with a clear signal.
    """
    profile = np.asarray(value, np.float64)
    sigma = np.asarray(error, np.float64)
    shaped = profile.ndim == 3 and profile.shape[2] == 3
    require(
        shaped and profile.shape == sigma.shape and len(profile) >= MIN_PLACEMENTS,
        "repeated placements",
        "profiles and errors must have the shape (placement, fibre, 3), with "
        f"{MIN_PLACEMENTS} or more placements",
        f"{profile.shape} and {sigma.shape}",
        "place it again",
    )
    clear = _clear_fibres(profile, sigma)
    require(
        clear.sum() >= 2,
        "repeated placements",
        "at least two fibres must have a clear signal in all placements",
        f"{int(clear.sum())}",
        "add longer exposures",
    )
    log = np.log(profile[:, clear])
    noise = (sigma[:, clear] / profile[:, clear]) ** 2
    placements, fibres, _ = log.shape
    centred = log - log.mean(axis=0)
    levels = centred.mean(axis=1)
    rest = (centred - levels[:, None]).reshape(-1, 3)
    rest_variance = (rest**2).sum(axis=0) / ((placements - 1) * (fibres - 1))
    level_variance = (levels**2).sum(axis=0) / (placements - 1) - rest_variance / fibres
    mean = np.full(profile.shape[1:], np.nan)
    spread = np.full(profile.shape[1:], np.nan)
    mean[clear] = np.exp(log.mean(axis=0))
    spread[clear] = mean[clear] * centred.std(axis=0, ddof=1) / np.sqrt(placements)
    shape_variance = rest_variance - noise.mean(axis=(0, 1))
    return Repeatability(
        np.sqrt(np.maximum(level_variance, 0)),
        np.sqrt(np.maximum(shape_variance, 0)),
        levels,
        mean,
        spread,
    )


def level_trend(levels: ArrayLike, covariate: ArrayLike) -> Trend:
    """Line through the levels of placements over time (drift) or pressure, with a t test.

    Parameters
    ----------
    levels
        (placement, 3) logarithms, from `placement_variance`.
    covariate
        (placement,) time in hours or pressure in kPa; the slope is per unit of it.

    Raises
    ------
    InputError
        Wrong shapes, values that are not finite, fewer than three placements, or a
        covariate that does not vary.
    """
    y = np.asarray(levels, np.float64)
    x = np.asarray(covariate, np.float64)
    shaped = x.ndim == 1 and y.shape == (len(x), 3) and len(x) >= MIN_PLACEMENTS
    require(
        shaped and np.isfinite(y).all() and np.isfinite(x).all() and np.ptp(x) > 0,
        "trend of the probe",
        f"levels (placement, 3) and a covariate that varies over {MIN_PLACEMENTS} "
        "placements or more are needed",
        f"{y.shape} and {x.shape}",
        "log it for every placement",
    )
    centred = x - x.mean()
    square = float(centred @ centred)
    slope = centred @ y / square
    rest = y - y.mean(axis=0) - centred[:, None] * slope
    error = np.sqrt((rest**2).sum(axis=0) / (len(x) - 2) / square)
    p_value = np.ones(3)
    with np.errstate(divide="ignore", invalid="ignore"):
        tails = 2 * stats.t.sf(np.abs(slope) / error, len(x) - 2)
    p_value[slope != 0] = tails[slope != 0]
    return Trend(slope, error, p_value, p_value < FLAG_P_VALUE)
