"""Quality checks of the measurements of the probe: pressure, repeatability, decay and
isotropy of the tissue.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.isotropy import (
    MIN_AZIMUTHS,
    MIN_SIGNAL_TO_NOISE,
    compare_azimuths,
)
from skindb.errors import InputError
from skindb.format.device_checks import USUAL_PRESSURES_KPA
from skindb.format.devices import ProbeRecord
from skindb.ingest.probe_profiles import Profiles

Array = NDArray[np.float64]
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
