"""Fibre profiles of the contact probe from its bracketed photographs (Weyrich et al.
2005, section 8), checks of their quality, and their statistics: isotropy of the tissue
(figure 10), variance between placements, drift and effect of the pressure.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from skindb.calibration.fibres import place_text, placement_signal
from skindb.errors import Fault, InputError, attempt, input_error, require
from skindb.format.contact_probe import ProbeRecord
from skindb.format.fields import MAX_MAGNITUDE
from skindb.format.frames import Digests
from skindb.types import Float64, Index, Mask, finite_rows, float64

# the mean and two harmonics have five unknowns; one degree of freedom remains
MIN_AZIMUTHS = 6
MIN_DISTANCES = 3
MIN_PLACEMENTS = 3
# of every azimuth at a distance that is used: logarithms of noisier signals are biased
MIN_SIGNAL_TO_NOISE = 5.0
FLAG_P_VALUE = 0.003  # below which a trend is flagged: three standard deviations
# of the incident light; 1 by energy conservation, doubled for errors of scale and gain
MAX_RETURNED_FRACTION = 2.0
# kPa: suction that holds a probe has 5 to 10, and 40 leave a bruise
USUAL_PRESSURES_KPA = (-40.0, 1.0)
MIN_LIT_FIBRES = 3  # of a site: a decay and a level, and one fibre that confirms them
# within a placement; more presses blood out of the skin, or indicates a leak
MAX_PRESSURE_DRIFT_KPA = 1.0
MAX_REPEATABILITY = 0.05  # relative: ten times the error of a gain
MAX_P_VALUE = 0.001  # small, as three channels at several sites are tested
# mm^-1, decay of red light, -d ln (r^2 R) / dr: 0.3 to 0.9 in simulated skin; distances
# in cm make it ten times larger
RED_DECAYS = (0.03, 3.0)
MIN_DECAY_FIBRES = 6  # distances at which a profile is clear of noise, for a decay
# of red to blue light; blood and melanin absorb blue light much more
MAX_DECAY_RATIO = 1.1
# of a fibre to its neighbours at all sites: at most 1.1 in simulated skin
MAX_GAIN_RATIO = 1.22
# of the distances of the two neighbours, between which ln (r^2 R) is nearly straight
MAX_NEIGHBOUR_RATIO = 2.1
DISTANCE_TOLERANCE_MM = 1e-3  # fibres of several rows are at the same distances


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
        float64(values) for values in (value, error, distance, azimuth)
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
    profile = float64(value)
    sigma = float64(error)
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
    placements = len(log)
    centred = log - log.mean(axis=0)
    levels = centred.mean(axis=1)
    level_variance, rest_variance = _variances(centred, levels)
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


def _variances(centred: Float64, levels: Float64) -> tuple[Float64, Float64]:
    """Variances (3,) of the levels (placement, 3) and of the residuals of logarithms
    (placement, fibre, 3), by the method of moments.
    """
    placements, fibres, _ = centred.shape
    rest = (centred - levels[:, None]).reshape(-1, 3)
    rest_variance = (rest**2).sum(axis=0) / ((placements - 1) * (fibres - 1))
    level_variance = (levels**2).sum(axis=0) / (placements - 1)
    return level_variance - rest_variance / fibres, rest_variance


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
    y = float64(levels)
    x = float64(covariate)
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


@dataclass(frozen=True)
class Profiles:
    """R(r) of every site, in mm^-2 if `scale_known`, otherwise up to a factor."""

    value: Float64  # (site, fibre, 3) mean over placements
    error: Float64  # (site, fibre, 3) standard error
    scale_known: bool
    placements: tuple[Float64, ...]  # for each site (placement, fibre, 3)
    # (site, 3) relative standard deviation between placements; NaN of a single one
    repeatability: Float64


def fibre_profiles(probe: ProbeRecord, digests: Digests | None = None) -> Profiles:
    """Mean signal of each fibre's pixels over all brackets, times scale, divided by gain.

    The error combines photons, read noise and quantisation, a few 1e-4 near the source,
    with the gains: about 4e-3, independent between fibres but the same at every site.

    Raises
    ------
    InputError
        With every frame that cannot be decoded, and fibres that lie outside the picture.
    """
    faults = list[Fault]()
    by_site = list[list[tuple[Float64, Float64]]]()
    for site in probe.sites:
        parts = [
            attempt(faults, partial(placement_signal, probe, site, name, digests))
            for name in probe.placements[site]
        ]
        by_site.append([signal for signal in parts if signal is not None])
    if faults:
        # the faults of the fibres repeat at every site
        raise InputError(dict.fromkeys(faults))
    # values and errors (placement, fibre, 3) of each site
    signals = [
        (np.stack([x for x, _ in site]), np.stack([x for _, x in site]))
        for site in by_site
    ]
    if faults := _light_faults(probe, signals):
        raise InputError(faults)
    factor = (probe.scale or 1.0) / probe.gain
    combined = [combine_placements(value, error) for value, error in signals]
    mean, noise, spread = (np.array(part) for part in zip(*combined, strict=True))
    value = mean * factor
    error = np.hypot(noise, probe.gain_error * mean) * factor
    require(
        not (np.fmax(np.abs(value), error) > MAX_MAGNITUDE).any(),
        f"{probe.file}[gain]",
        f"scale * signal / gain must be at most {MAX_MAGNITUDE:g}",
        f"{np.nanmax(np.abs(value)):.3g}",
        "correct scale, gain and seconds",
    )
    if probe.scale is not None:
        _require_energy(probe, value, error)
    single = tuple(placements * factor for placements, _ in signals)
    return Profiles(value, error, probe.scale is not None, single, spread)


def _light_faults(
    probe: ProbeRecord, signals: list[tuple[Float64, Float64]]
) -> list[Fault]:
    """Faults of placements whose frames are black or white: nearly no fibre shows light
    that is clear of noise.
    """
    faults = list[Fault]()
    minimum = min(MIN_LIT_FIBRES, len(probe.fibres))
    rule = f"at least {minimum} fibres must show light, and not be saturated in every bracket"
    for site, (values, errors) in zip(probe.sites, signals, strict=True):
        names = probe.placements[site]
        for placement, value, error in zip(names, values, errors, strict=True):
            lit = int((value > MIN_SIGNAL_TO_NOISE * error).any(axis=1).sum())
            if lit < minimum:
                saturated = int(np.isnan(value).all(axis=1).sum())
                faults.append(
                    Fault(
                        f"{probe.file}[frames]",
                        rule,
                        f"{place_text(site, placement)}: {lit} of {len(value)}, "
                        f"{saturated} saturated",
                        "place the probe and take its frames again, or remove the site",
                    )
                )
    return faults


def _require_energy(probe: ProbeRecord, value: Float64, error: Float64) -> None:
    """Require profiles (site, fibre, 3) in mm^-2 that return no more light than is incident.

    A profile that falls with the distance returns at least pi r^2 R(r) of the light within r.
    """
    returned = np.pi * probe.distance[:, None] ** 2 * (value - 3 * error)
    if not (returned > MAX_RETURNED_FRACTION).any():
        return
    site, fibre, _ = np.unravel_index(int(np.nanargmax(returned)), returned.shape)
    raise input_error(
        f"{probe.file}[scale]",
        f"R at r mm must be at most {MAX_RETURNED_FRACTION:g} / (pi r^2): skin cannot "
        "return more light",
        f"{np.nanmax(returned):.3g} / (pi r^2) at fibre {fibre} of {probe.sites[site]}",
        "correct scale, gain, seconds or distance; use a scale of null if it is unknown",
    )


def combine_placements(
    value: Float64, error: Float64
) -> tuple[Float64, Float64, Float64]:
    """Mean of repeated placements of the probe at one site, its standard error, and
    their repeatability.

    Each placement changes the coupling of the fibres to the skin. Its relative standard
    deviation is estimated from all fibres of a channel together, after the variance of
    photons and read noise is subtracted, and is part of the error of the mean. For a
    single placement it is unknown, and the error contains noise alone.

    Parameters
    ----------
    value, error
        (placement, fibre, 3) signals and their standard errors due to noise.

    Returns
    -------
    mean, error : ndarray
        (fibre, 3); NaN where a placement lacks the fibre.
    repeatability : ndarray
        (3,) relative standard deviation between placements; NaN of a single one.
    """
    count = len(value)
    mean = value.mean(axis=0)
    noise = np.sqrt((error**2).sum(axis=0)) / count
    if count == 1:
        return mean, noise, np.full(3, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = (value.var(axis=0, ddof=1) - (error**2).mean(axis=0)) / mean**2
        # far fibres carry little information
        weight = np.where(np.isfinite(relative), (mean / noise) ** 2, 0.0)
        variance = np.nansum(weight * relative, axis=0) / weight.sum(axis=0)
    spread = np.sqrt(np.maximum(variance, 0.0))
    return mean, np.hypot(noise, spread * np.abs(mean) / np.sqrt(count)), spread


def isotropy_p_values(probe: ProbeRecord, profiles: Profiles) -> Float64 | None:
    """P value (site, 3) of equal decay along all azimuths; NaN where profiles are too noisy.

    None for a probe without six rows of fibres at the same distances (Weyrich et al.
    2005, figure 10, has sixteen).
    """
    rows = _rows(probe)
    if rows is None:
        return None
    azimuth, index = rows
    p_values = np.full((len(probe.sites), 3), np.nan)
    for site, value, error in zip(
        p_values, profiles.value, profiles.error, strict=True
    ):
        distance = probe.distance[index[0]]
        test = attempt(
            [],
            partial(
                compare_azimuths,
                value[index],
                error[index],
                distance,
                np.radians(azimuth),
            ),
        )
        if test is not None:  # otherwise no contact, or too little light
            site[:] = test.p_value
    return p_values


def probe_notes(
    probe: ProbeRecord, profiles: Profiles, p_values: Float64 | None
) -> list[str]:
    """Warnings, one line for each placement or site that fails a check."""
    notes = [*_pressure_notes(probe), *_decay_notes(probe, profiles)]
    for site, spread in zip(probe.sites, profiles.repeatability, strict=True):
        if (worst := float(np.nanmax(spread, initial=0.0))) > MAX_REPEATABILITY:
            notes.append(f"probe at {site}: placements differ by {worst:.0%}")
    if p_values is None:
        return notes
    for site, p_value in zip(probe.sites, p_values, strict=True):
        if (smallest := float(np.nanmin(p_value, initial=1.0))) < MAX_P_VALUE:
            notes.append(
                f"probe at {site}: light decays differently along the azimuths (p = {smallest:.2g})"
            )
    return notes


def _pressure_notes(probe: ProbeRecord) -> Iterator[str]:
    low, high = USUAL_PRESSURES_KPA
    for (site, placement), log in probe.pressure.items():
        note = f"probe at {site}" + (f", placement {placement}" if placement else "")
        drift = float(np.ptp(log[:, 1]))
        if drift > MAX_PRESSURE_DRIFT_KPA:
            yield f"{note}: the pressure drifted by {drift:.1f} kPa"
        mean = float(log[:, 1].mean())
        if not low <= mean <= high:
            yield (
                f"{note}: a pressure of {mean:.4g} kPa is outside {low:g} to "
                f"{high:g} kPa; give that of a gauge in kPa; suction is negative"
            )


def _decay_notes(probe: ProbeRecord, profiles: Profiles) -> Iterator[str]:
    """Warnings about profiles that no skin has: wrong unit of distances, order of
    channels, or gain of a fibre.
    """
    order = np.argsort(probe.distance, kind="stable")
    distance = probe.distance[order]
    value = profiles.value[:, order]
    error = profiles.error[:, order]
    clear = np.isfinite(value) & (value > MIN_SIGNAL_TO_NOISE * error)
    log = np.full(value.shape, np.nan)
    np.log(value * distance[:, None] ** 2, out=log, where=clear)
    decay = np.array([[_decay(distance, site[:, c]) for c in (0, 2)] for site in log])
    decay = decay[finite_rows(decay)]
    if len(decay):
        red, blue = np.median(decay, axis=0)
        low, high = RED_DECAYS
        if red > MAX_DECAY_RATIO * blue:
            yield (
                f"probe: red light decays by {red:.2g} and blue light by {blue:.2g} per "
                "mm, but light of longer waves reaches farther in skin; check the order "
                "of the channels"
            )
        if not low <= red <= high:
            yield (
                f"probe: red light decays by {red:.2g} per mm, and by {low:g} to "
                f"{high:g} in skin; check the distances"
            )
    steps = _steps(distance, log)
    worst = int(np.abs(steps).argmax()) if len(steps) else 0
    if len(steps) and np.abs(steps[worst]) > np.log(MAX_GAIN_RATIO):
        yield (
            f"probe: fibre {probe.fibres[order[worst + 1]]} is {np.exp(steps[worst]):.2f} "
            "times as bright as its neighbours; check its gain"
        )


def _steps(distance: Float64, log: Float64) -> Float64:
    """Median step (fibre - 2,) from the line between both neighbours to each fibre, of
    logarithms (site, fibre, 3).
    """
    gap = np.maximum(distance[2:] - distance[:-2], DISTANCE_TOLERANCE_MM)
    part = ((distance[1:-1] - distance[:-2]) / gap)[:, None]
    step = log[:, 1:-1] - (1 - part) * log[:, :-2] - part * log[:, 2:]
    step[:, distance[2:] > MAX_NEIGHBOUR_RATIO * distance[:-2]] = np.nan
    finite = [values[np.isfinite(values)] for values in np.moveaxis(step, 1, 0)]
    return np.array([np.median(x) if len(x) > 1 else 0.0 for x in finite])


def _decay(distance: Float64, log: Float64) -> float:
    """Decay [mm^-1] of a profile, -d ln (r^2 R) / dr; NaN of too few distances."""
    clear = np.isfinite(log)
    if len(np.unique(distance[clear])) < MIN_DECAY_FIBRES:
        return float("nan")
    return float(-np.polyfit(distance[clear], log[clear], 1)[0])


def _rows(probe: ProbeRecord) -> tuple[Float64, Index] | None:
    """Azimuths (row,) [degrees] and the fibres (row, fibre) of each, in order of their distance."""
    if not np.isfinite(probe.azimuth).all():
        return None
    azimuth = np.unique(np.round(probe.azimuth % 360, 3))
    rows = [
        np.flatnonzero(np.isclose(probe.azimuth % 360, phi, atol=2e-3))
        for phi in azimuth
    ]
    if len(azimuth) < MIN_AZIMUTHS or len({len(row) for row in rows}) > 1:
        return None
    index = np.array([row[np.argsort(probe.distance[row])] for row in rows])
    differences = np.ptp(probe.distance[index], axis=0)
    return (azimuth, index) if (differences <= DISTANCE_TOLERANCE_MM).all() else None
