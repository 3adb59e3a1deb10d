"""Pressure of the suction gauge of a probe over time (capture format, version 2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.format.device_checks import GAUGE_PRESSURES_KPA
from skindb.format.fields import Fields
from skindb.format.json_file import MAX_MAGNITUDE, is_number, shown
from skindb.limits import MAX_PRESSURE_SAMPLES

Log = NDArray[np.float64]  # (n, 2) seconds since the start of the placement, kPa
RULE = "must be a pressure in kPa, or a list of [seconds, kPa] with rising seconds"


def read_pressure(
    fields: Fields, placements: Mapping[str, tuple[str, ...]]
) -> dict[tuple[str, str], Log]:
    """(site, placement) -> log of its pressure; a single number is a log without times (NaN)."""
    given = Fields(
        fields.get("pressure", {}), f"{fields.where}[pressure]", fields.faults
    )
    found = {}
    for site, value in given.data.items():
        own = placements.get(site, ("",))
        parts = value if isinstance(value, dict) else dict.fromkeys(own, value)
        for placement, one in parts.items():
            if site in placements and placement not in own:
                given.fault(
                    site,
                    f"must name placements of the site: {', '.join(own)}",
                    shown(placement),
                )
            log = _log(one)
            if log is None:
                given.fault(site, RULE, shown(one))
            elif not (
                (log[:, 1] >= GAUGE_PRESSURES_KPA[0])
                & (log[:, 1] <= GAUGE_PRESSURES_KPA[1])
            ).all():
                low, high = GAUGE_PRESSURES_KPA
                rule = f"a gauge pressure must be {low:g} to {high:g} kPa"
                given.fault(site, rule, f"{log[np.abs(log[:, 1]).argmax(), 1]:.4g} kPa")
            else:
                found[site, placement] = log
    return found


def _log(value: Any) -> Log | None:
    if is_number(value):
        return np.array([[np.nan, value]]) if abs(value) <= MAX_MAGNITUDE else None
    pairs = isinstance(value, list) and 0 < len(value) <= MAX_PRESSURE_SAMPLES
    if not pairs or not all(
        isinstance(one, list) and len(one) == 2 and all(map(is_number, one))
        for one in value
    ):
        return None
    log = np.array(value, np.float64)
    return (
        log
        if (np.abs(log) <= MAX_MAGNITUDE).all() and (np.diff(log[:, 0]) > 0).all()
        else None
    )
