"""Quality checks of the measurements of the probe: pressure, repeatability, isotropy of the tissue."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skindb.errors import InputError
from skindb.ingest.devices import ProbeRecord
from skindb.ingest.isotropy import MIN_AZIMUTHS, compare_azimuths
from skindb.ingest.probe import Profiles

Array = NDArray[np.float64]
MAX_PRESSURE_DRIFT_KPA = 1.0  # within a placement; more presses blood out of the skin, or indicates a leak
MAX_REPEATABILITY = 0.05  # relative: ten times the error of a gain
MAX_P_VALUE = 0.001  # small, as three channels at several sites are tested
DISTANCE_TOLERANCE_MM = 1e-3  # fibres of several rows are at the same distances


def isotropy_p_values(probe: ProbeRecord, profiles: Profiles) -> Array | None:
    """P value (site, 3) of equal decay along all azimuths; NaN where profiles are too noisy.

    None for a probe without six rows of fibres at the same distances (Weyrich et al. 2005, figure 10, has sixteen).
    """
    rows = _rows(probe)
    if rows is None:
        return None
    azimuth, index = rows
    out = np.full((len(probe.sites), 3), np.nan)
    for s in range(len(probe.sites)):
        try:
            found = compare_azimuths(
                profiles.value[s][index], profiles.error[s][index], probe.distance[index[0]], np.radians(azimuth)
            )
        except InputError:  # no contact, or too little light
            continue
        out[s] = found.p_value
    return out


def probe_notes(probe: ProbeRecord, profiles: Profiles, p_values: Array | None) -> list[str]:
    """Warnings, one line for each placement or site that fails a check."""
    notes = []
    for (site, placement), log in probe.pressure.items():
        drift = float(np.ptp(log[:, 1]))
        if drift > MAX_PRESSURE_DRIFT_KPA:
            at = f"{site}, placement {placement}" if placement else site
            notes.append(f"probe at {at}: the pressure drifted by {drift:.1f} kPa")
    for site, spread in zip(probe.sites, profiles.repeatability, strict=True):
        if (worst := float(np.nanmax(spread, initial=0.0))) > MAX_REPEATABILITY:
            notes.append(f"probe at {site}: placements differ by {worst:.0%}")
    for site, own in zip(probe.sites, () if p_values is None else p_values, strict=p_values is not None):
        if (least := float(np.nanmin(own, initial=1.0))) < MAX_P_VALUE:
            notes.append(f"probe at {site}: light decays differently along the azimuths (p = {least:.2g})")
    return notes


def _rows(probe: ProbeRecord) -> tuple[Array, NDArray[np.int64]] | None:
    """Azimuths (row,) [degrees] and the fibres (row, fibre) of each, in order of their distance."""
    if not np.isfinite(probe.azimuth).all():
        return None
    azimuth = np.unique(np.round(probe.azimuth % 360, 3))
    fibres = [np.flatnonzero(np.isclose(probe.azimuth % 360, phi, atol=2e-3)) for phi in azimuth]
    if len(azimuth) < MIN_AZIMUTHS or len({len(own) for own in fibres}) > 1:
        return None
    index = np.array([own[np.argsort(probe.distance[own])] for own in fibres])
    same = np.ptp(probe.distance[index], axis=0) <= DISTANCE_TOLERANCE_MM
    return (azimuth, index) if same.all() else None
