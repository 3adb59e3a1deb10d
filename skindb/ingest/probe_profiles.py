"""Fibre profiles of the contact probe from its bracketed photographs (Weyrich et al.
2005, section 8), checks of their quality, and a test for isotropy of the tissue (figure
10).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import special

from skindb.calibration.fibres import place_text, placement_signal
from skindb.errors import Fault, InputError, attempt, input_error, require, require_none
from skindb.format.contact_probe import ProbeRecord
from skindb.format.fields import MAX_MAGNITUDE
from skindb.format.frames import Digests
from skindb.types import Float64, Index, finite_rows

MIN_AZIMUTHS = 6
MIN_DISTANCES = 3
# of every azimuth at a distance that is used: logarithms of noisier signals are biased
MIN_SIGNAL_TO_NOISE = 5.0
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


def decay_p_values(value: Float64, error: Float64, distance: Float64) -> Float64:
    """P values (3,) of equal decay along all azimuths, by a chi-squared test.

    The decay is -d ln (r^2 R) / dr, which far from the source is close to sigma_tr
    (Farrell, Patterson and Wilson 1992). ln (r^2 R) is fitted by a level and a slope for
    each azimuth. The level absorbs gain and contact of its fibres; differences of the
    slope are differences in transport. All azimuths have the same weights, so that the
    mean profile, which is not a straight line, cancels.

    Parameters
    ----------
    value, error
        (azimuth, fibre, 3) profile and its standard error, errors independent between fibres.
    distance
        (fibre,) mm.

    Returns
    -------
    ndarray
        NaN if there are too few distances at which all profiles are clear of noise.
    """
    with np.errstate(invalid="ignore"):
        clear = (value > MIN_SIGNAL_TO_NOISE * error) & (error > 0)
    fibres = clear.all(axis=(0, 2))
    if len(np.unique(distance[fibres])) < MIN_DISTANCES:
        return np.full(3, np.nan)
    r = distance[fibres, None]
    log = np.log(value[:, fibres] * r**2)
    sigma = error[:, fibres] / value[:, fibres]
    weight = 1 / np.median(sigma**2, axis=0)
    way = r - (weight * r).sum(axis=0) / weight.sum(axis=0)
    factor = weight * way / (weight * way**2).sum(axis=0)
    slope = -(factor * log).sum(axis=1)
    variance = (factor**2 * sigma**2).sum(axis=1)
    level = np.average(slope, axis=0, weights=1 / variance)
    chi_square = ((slope - level) ** 2 / variance).sum(axis=0)
    return special.chdtrc(len(value) - 1, chi_square)


@dataclass(frozen=True)
class Profiles:
    """R(r) of every site, in mm^-2 if `scale_known`, otherwise up to a factor."""

    value: Float64  # (site, fibre, 3) mean over placements
    error: Float64  # (site, fibre, 3) standard error
    scale_known: bool
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
    by_site = []
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
    require_none(_light_faults(probe, signals))
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
    return Profiles(value, error, probe.scale is not None, spread)


def _light_faults(
    probe: ProbeRecord, signals: list[tuple[Float64, Float64]]
) -> list[Fault]:
    """Faults of placements whose frames are black or white: nearly no fibre shows light
    that is clear of noise.
    """
    faults = []
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
    index = _rows(probe)
    if index is None:
        return None
    sites = zip(profiles.value, profiles.error, strict=True)
    distance = probe.distance[index[0]]
    return np.array(
        [decay_p_values(value[index], error[index], distance) for value, error in sites]
    )


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


def _rows(probe: ProbeRecord) -> Index | None:
    """The fibres (azimuth, fibre) of each row, in order of their distance."""
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
    return index if (differences <= DISTANCE_TOLERANCE_MM).all() else None
