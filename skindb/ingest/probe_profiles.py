"""Fibre profiles of the contact probe from its bracketed photographs (Weyrich et al.
2005, section 8), and checks of their quality.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.fibres import placement_signal
from skindb.calibration.profile_statistics import (
    MIN_AZIMUTHS,
    MIN_SIGNAL_TO_NOISE,
    compare_azimuths,
)
from skindb.errors import Fault, InputError
from skindb.format.contact_probe import ProbeRecord
from skindb.format.frames import Digests
from skindb.format.json_file import MAX_MAGNITUDE

Array = NDArray[np.float64]

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
class Profiles:
    """R(r) of every site, in mm^-2 if `scale_known`, otherwise up to a factor."""

    value: Array  # (site, fibre, 3) mean over placements
    error: Array  # (site, fibre, 3) standard error
    scale_known: bool
    placements: tuple[Array, ...]  # for each site (placement, fibre, 3)
    # (site, 3) relative standard deviation between placements; NaN of a single one
    repeatability: Array


def fibre_profiles(probe: ProbeRecord, digests: Digests | None = None) -> Profiles:
    """Mean signal of each fibre's pixels over all brackets, times scale, divided by gain.

    The error combines photons, read noise and quantisation, a few 1e-4 near the source,
    with the gains: about 4e-3, independent between fibres but the same at every site.

    Raises
    ------
    InputError
        With every frame that cannot be decoded, and fibres that lie outside the picture.
    """
    found = list[list[tuple[Array, Array]]]()
    faults = list[Fault]()
    for site in probe.sites:
        try:
            found.append(
                [
                    placement_signal(probe, site, placement, digests)
                    for placement in probe.placements[site]
                ]
            )
        except InputError as problem:
            faults += problem.faults
    if faults:
        # the faults of the fibres repeat at every site
        raise InputError(dict.fromkeys(faults))
    if faults := _light_faults(probe, found):
        raise InputError(faults)
    factor = (probe.scale or 1.0) / probe.gain
    each = [
        (np.stack([v for v, _ in one]), np.stack([e for _, e in one])) for one in found
    ]
    together = [combine_placements(value, error) for value, error in each]
    value, error, spread = (np.array(column) for column in zip(*together, strict=True))
    value, error = value * factor, np.hypot(error, probe.gain_error * value) * factor
    if (np.fmax(np.abs(value), error) > MAX_MAGNITUDE).any():
        rule = f"scale * signal / gain must be at most {MAX_MAGNITUDE:g}"
        cure = "correct scale, gain and seconds"
        raise InputError(
            Fault(f"{probe.file}[gain]", rule, f"{np.nanmax(np.abs(value)):.3g}", cure)
        )
    known = probe.scale is not None
    fault = (
        energy_fault(str(probe.file), probe.sites, probe.distance, value, error)
        if known
        else None
    )
    if fault is not None:
        raise InputError(fault)
    return Profiles(value, error, known, tuple(one * factor for one, _ in each), spread)


def _light_faults(
    probe: ProbeRecord, signals: list[list[tuple[Array, Array]]]
) -> list[Fault]:
    """Faults of placements whose frames are black or white: nearly no fibre shows light
    that is clear of noise.
    """
    faults = list[Fault]()
    least = min(MIN_LIT_FIBRES, len(probe.fibres))
    rule = f"at least {least} fibres must show light, and not be saturated in every bracket"
    cure = "place the probe and take its frames again, or remove the site"
    for site, placements in zip(probe.sites, signals, strict=True):
        for placement, (value, error) in zip(
            probe.placements[site], placements, strict=True
        ):
            lit = int((value > MIN_SIGNAL_TO_NOISE * error).any(axis=1).sum())
            if lit < least:
                at = (
                    f"site {site}, placement {placement}"
                    if placement
                    else f"site {site}"
                )
                saturated = int(np.isnan(value).all(axis=1).sum())
                found = f"{at}: {lit} of {len(value)}, {saturated} saturated"
                faults.append(Fault(f"{probe.file}[frames]", rule, found, cure))
    return faults


def energy_fault(
    where: str, sites: Sequence[str], distance: Array, value: Array, error: Array
) -> Fault | None:
    """Fault of profiles (site, fibre, 3) in mm^-2 that return more light than is incident.

    A profile that falls with the distance returns at least pi r^2 R(r) of the light within r.
    """
    returned = np.pi * distance[:, None] ** 2 * (value - 3 * error)
    if not (returned > MAX_RETURNED_FRACTION).any():
        return None
    site, fibre = divmod(int(np.nanargmax(returned)) // value.shape[2], value.shape[1])
    rule = (
        f"R at r mm must be at most {MAX_RETURNED_FRACTION:g} / (pi r^2): skin cannot "
        "return more light"
    )
    found = f"{np.nanmax(returned):.3g} / (pi r^2) at fibre {fibre} of {sites[site]}"
    cure = (
        "correct scale, gain, seconds or distance; use a scale of null if it is unknown"
    )
    return Fault(f"{where}[scale]", rule, found, cure)


def combine_placements(value: Array, error: Array) -> tuple[Array, Array, Array]:
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
        spread = np.sqrt(
            np.maximum(np.nansum(weight * relative, axis=0) / weight.sum(axis=0), 0.0)
        )
    return mean, np.hypot(noise, spread * np.abs(mean) / np.sqrt(count)), spread


def isotropy_p_values(probe: ProbeRecord, profiles: Profiles) -> Array | None:
    """P value (site, 3) of equal decay along all azimuths; NaN where profiles are too noisy.

    None for a probe without six rows of fibres at the same distances (Weyrich et al.
    2005, figure 10, has sixteen).
    """
    rows = _rows(probe)
    if rows is None:
        return None
    azimuth, index = rows
    out = np.full((len(probe.sites), 3), np.nan)
    for s in range(len(probe.sites)):
        try:
            found = compare_azimuths(
                profiles.value[s][index],
                profiles.error[s][index],
                probe.distance[index[0]],
                np.radians(azimuth),
            )
        except InputError:  # no contact, or too little light
            continue
        out[s] = found.p_value
    return out


def probe_notes(
    probe: ProbeRecord, profiles: Profiles, p_values: Array | None
) -> list[str]:
    """Warnings, one line for each placement or site that fails a check."""
    notes = [*_pressure_notes(probe), *_decay_notes(probe, profiles)]
    for site, spread in zip(probe.sites, profiles.repeatability, strict=True):
        if (worst := float(np.nanmax(spread, initial=0.0))) > MAX_REPEATABILITY:
            notes.append(f"probe at {site}: placements differ by {worst:.0%}")
    for site, own in zip(
        probe.sites, () if p_values is None else p_values, strict=p_values is not None
    ):
        if (least := float(np.nanmin(own, initial=1.0))) < MAX_P_VALUE:
            notes.append(
                f"probe at {site}: light decays differently along the azimuths (p = {least:.2g})"
            )
    return notes


def _pressure_notes(probe: ProbeRecord) -> Iterator[str]:
    low, high = USUAL_PRESSURES_KPA
    for (site, placement), log in probe.pressure.items():
        at = f"{site}, placement {placement}" if placement else site
        drift = float(np.ptp(log[:, 1]))
        if drift > MAX_PRESSURE_DRIFT_KPA:
            yield f"probe at {at}: the pressure drifted by {drift:.1f} kPa"
        mean = float(log[:, 1].mean())
        if not low <= mean <= high:
            cure = "give that of a gauge in kPa; suction is negative"
            yield (
                f"probe at {at}: a pressure of {mean:.4g} kPa is outside {low:g} to "
                f"{high:g} kPa; {cure}"
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
    decay = np.array(
        [[_decay(distance, log[s, :, c]) for c in (0, 2)] for s in range(len(log))]
    )
    known = decay[np.isfinite(decay).all(axis=1)]
    if len(known):
        red, blue = np.median(known, axis=0)
        if red > MAX_DECAY_RATIO * blue:
            said = f"red light decays by {red:.2g} and blue light by {blue:.2g} per mm"
            yield (
                f"probe: {said}, but light of longer waves reaches farther in skin; "
                "check the order of the channels"
            )
        if not RED_DECAYS[0] <= red <= RED_DECAYS[1]:
            usual = f"{RED_DECAYS[0]:g} to {RED_DECAYS[1]:g}"
            yield (
                f"probe: red light decays by {red:.2g} per mm, and by {usual} in skin; "
                "check the distances"
            )
    steps = _steps(distance, log)
    if len(steps) and np.abs(steps).max() > np.log(MAX_GAIN_RATIO):
        worst = int(np.abs(steps).argmax())
        fibre = probe.fibres[order[worst + 1]]
        yield (
            f"probe: fibre {fibre} is {np.exp(steps[worst]):.2f} times as bright as "
            "its neighbours; check its gain"
        )


def _steps(distance: Array, log: Array) -> Array:
    """Median step (fibre - 2,) from the line between both neighbours to each fibre, of
    logarithms (site, fibre, 3).
    """
    gap = np.maximum(distance[2:] - distance[:-2], DISTANCE_TOLERANCE_MM)
    part = ((distance[1:-1] - distance[:-2]) / gap)[:, None]
    step = log[:, 1:-1] - (1 - part) * log[:, :-2] - part * log[:, 2:]
    step[:, distance[2:] > MAX_NEIGHBOUR_RATIO * distance[:-2]] = np.nan
    known = [values[np.isfinite(values)] for values in np.moveaxis(step, 1, 0)]
    return np.array([np.median(values) if len(values) > 1 else 0.0 for values in known])


def _decay(distance: Array, log: Array) -> float:
    """Decay [mm^-1] of a profile, -d ln (r^2 R) / dr; NaN of too few distances."""
    clear = np.isfinite(log)
    if len(np.unique(distance[clear])) < MIN_DECAY_FIBRES:
        return float("nan")
    return float(-np.polyfit(distance[clear], log[clear], 1)[0])


def _rows(probe: ProbeRecord) -> tuple[Array, NDArray[np.int64]] | None:
    """Azimuths (row,) [degrees] and the fibres (row, fibre) of each, in order of their distance."""
    if not np.isfinite(probe.azimuth).all():
        return None
    azimuth = np.unique(np.round(probe.azimuth % 360, 3))
    fibres = [
        np.flatnonzero(np.isclose(probe.azimuth % 360, phi, atol=2e-3))
        for phi in azimuth
    ]
    if len(azimuth) < MIN_AZIMUTHS or len({len(own) for own in fibres}) > 1:
        return None
    index = np.array([own[np.argsort(probe.distance[own])] for own in fibres])
    same = np.ptp(probe.distance[index], axis=0) <= DISTANCE_TOLERANCE_MM
    return (azimuth, index) if same.all() else None
