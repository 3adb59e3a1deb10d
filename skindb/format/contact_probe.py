"""The contact probe of a capture, `probe.json`: fibres, sites, placements, pressure, and
the paths of its frames.

Limits are about ten times beyond any device known to us: they find wrong units and
slips, not unusual devices.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault
from skindb.format.fields import IDENTIFIER, Fields
from skindb.format.frame_paths import (
    EXPOSURE,
    PLACEMENT,
    SITE,
    filled,
    inside,
    read_exposures,
    require_merged,
    require_own_files,
)
from skindb.format.frames import FrameKind, frame_size, header_faults, is_linear
from skindb.format.json_file import MAX_MAGNITUDE, is_number, shown
from skindb.format.sensor import SensorRecord, read_sensor
from skindb.limits import MAX_FIBRES, MAX_PLACEMENTS, MAX_PRESSURE_SAMPLES, MAX_SITES

Array = NDArray[np.float64]
# mm, of the farthest fibre: light does not scatter within a tenth of a millimetre
FIBRE_DISTANCES_MM = (0.1, 300.0)
MAX_FIBRE_RADIUS_MM = 10.0  # mm; fibres of probes have 0.02 to 1
# of the sum of the radii [px]: fibres may touch, and circles are approximate
MIN_CENTRE_DISTANCE_FRACTION = 0.9
# of a fibre's gain to the median one; fibres of a probe differ by tens of percent
MAX_GAIN_RATIO = 100.0
MAX_GAIN_ERROR = 1.0  # relative
# kPa: from a vacuum to the double of it; suction has no more than the air
GAUGE_PRESSURES_KPA = (-101.4, 101.4)
GAIN_ERROR = 0.005  # relative error of a fibre's gain, where the file does not state it
PRESSURE_RULE = (
    "must be a pressure in kPa, or a list of [seconds, kPa] with rising seconds"
)
Log = NDArray[np.float64]  # (n, 2) seconds since the start of the placement, kPa


@dataclass(frozen=True)
class ProbeRecord:
    """The contact probe of a capture."""

    folder: Path
    sites: tuple[str, ...]
    # names of the placements at each site; ("",) for a single one
    placements: Mapping[str, tuple[str, ...]]
    distance: Array  # (fibre,) mm
    azimuth: Array  # (fibre,) degrees about the source fibre; NaN if unknown
    centre: Array  # (fibre, 2) px
    radius: Array  # (fibre,) px
    exposures: Mapping[str, float]
    frames: str
    gain: Array  # (fibre, 3)
    gain_error: float  # relative, of each
    face: float  # radius of a fibre in mm; 0 if unknown
    scale: float | None
    sensor: SensorRecord
    fibres: tuple[str, ...]
    pressure: Mapping[tuple[str, str], Array]  # (site, placement) -> (n, 2) s, kPa
    file: Path  # probe.json

    def frame(self, site: str, exposure: str, placement: str = "") -> Path:
        """File of a frame."""
        return self.folder / filled(
            self.frames, site=site, exposure=exposure, placement=placement
        )

    def frame_files(self) -> Iterator[Path]:
        """Files of all frames."""
        for site in self.sites:
            for placement, exposure in product(self.placements[site], self.exposures):
                yield self.frame(site, exposure, placement)


def read_probe(folder: Path, fields: Fields) -> ProbeRecord:
    """The probe of `probe.json`; faults are recorded in `fields`."""
    noted = len(fields.faults)
    fibres = fields.items("fibres", most=MAX_FIBRES)
    exposures = read_exposures(fields)
    several = {EXPOSURE} if len(exposures) > 1 else set()
    sites = fields.names("sites", most=MAX_SITES)
    placements = _placements(fields, sites)
    several |= (
        {PLACEMENT} if any(len(own) > 1 for own in placements.values()) else set()
    )
    frames = fields.template("frames", {SITE} | several, {EXPOSURE, PLACEMENT})
    if is_linear(frames):
        require_merged(fields, exposures)
    scale = fields.get("scale", None)
    probe = ProbeRecord(
        folder=folder,
        sites=sites,
        placements=placements,
        azimuth=np.array([_azimuth(fibre) for fibre in fibres]),
        distance=np.array([fibre.number("distance", above=0.0) for fibre in fibres]),
        centre=np.array([fibre.array("centre", (2,)) for fibre in fibres]).reshape(
            -1, 2
        ),
        radius=np.array([fibre.number("radius", above=0.0) for fibre in fibres]),
        exposures=exposures,
        frames=frames,
        gain=fields.gains("gain", len(fibres)),
        gain_error=fields.number(
            "gain_error", default=GAIN_ERROR, least=0.0, most=MAX_GAIN_ERROR
        ),
        face=fields.number(
            "fibre_radius", default=0.0, least=0.0, most=MAX_FIBRE_RADIUS_MM
        ),
        scale=None if scale is None else fields.number("scale", above=0.0),
        sensor=read_sensor(
            folder, fields, FrameKind(0, 0, 0), linear=is_linear(frames)
        ),
        fibres=tuple(fibre.text("id", rule=IDENTIFIER) for fibre in fibres),
        pressure=read_pressure(fields, placements),
        file=Path(fields.where),
    )
    if len(fields.faults) == noted:
        fields.faults += fibre_faults(
            fields.where, probe.distance, probe.centre, probe.radius, probe.face
        )
        fields.faults += gain_faults(fields.where, probe.gain)
    _check_probe_frames(probe, fields)
    return probe


def _placements(fields: Fields, sites: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Names of the placements of the probe at each site; a site without names has a
    single placement.
    """
    given = Fields(
        fields.get("placements", {}), f"{fields.where}[placements]", fields.faults
    )
    if unknown := sorted(set(given.data) - set(sites)):
        given.fault(unknown[0], "must be one of the sites", shown(unknown[0]))
    return {
        site: given.names(site, most=MAX_PLACEMENTS) if site in given.data else ("",)
        for site in sites
    }


def _azimuth(fibre: Fields) -> float:
    given = fibre.get("azimuth", None)
    return (
        np.nan if given is None else fibre.number("azimuth", least=-360.0, most=360.0)
    )


def _check_probe_frames(probe: ProbeRecord, fields: Fields) -> None:
    """Require that all frames have the size of the first one, and the declared depth."""
    size: FrameKind | None = None
    views = [
        {SITE: site, EXPOSURE: exposure, PLACEMENT: placement}
        for site in (probe.sites if probe.frames else ())
        for placement, exposure in product(probe.placements[site], probe.exposures)
    ]
    require_own_files(
        fields, (("frames", filled(probe.frames, **names), names) for names in views)
    )
    for names in views:
        where = f"{fields.where}[frames]"
        path = inside(probe.folder, filled(probe.frames, **names), where, fields.faults)
        if path is None:
            continue
        size = size or _kind_of(path, probe.sensor.kind.bits)
        fields.faults += header_faults(path, size or probe.sensor.kind, where)


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
                given.fault(site, PRESSURE_RULE, shown(one))
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


def _kind_of(path: Path, bits: int) -> FrameKind | None:
    size = frame_size(path)
    return None if size is None else FrameKind(*size, bits)


def fibre_faults(
    where: str, distance: Array, centre: Array, radius: Array, face: float
) -> list[Fault]:
    """Faults of fibres that are at one distance, in another unit, or overlap.

    Parameters
    ----------
    where
        File of the probe.
    distance, centre, radius
        (n,) mm from the source, (n, 2) and (n,) px.
    face
        Radius of a fibre and of the source in mm; 0 if unknown.
    """
    if not len(distance):
        return []
    faults, (least, most) = [], FIBRE_DISTANCES_MM
    if not least <= distance.max() <= most:
        rule = (
            f"distances must be in mm, and the farthest fibre must be {least:g} to "
            f"{most:g} mm from the source"
        )
        faults.append(
            Fault(
                f"{where}[fibres]",
                rule,
                f"{distance.max():g} mm",
                "give the distances in mm",
            )
        )
    elif len(distance) > 1 and np.ptp(distance) == 0:
        rule = "a profile needs fibres at different distances"
        cure = "give each fibre its own distance"
        faults.append(
            Fault(
                f"{where}[fibres]",
                rule,
                f"all {len(distance)} at {distance[0]:g} mm",
                cure,
            )
        )
    if face > 0 and (distance < 2 * face).any():
        i = int(distance.argmin())
        rule = (
            "fibres must not overlap the source: distance must be at least twice "
            f"fibre_radius, {2 * face:g} mm"
        )
        cure = (
            "distance is measured between the centres; both are in mm, and "
            "fibre_radius is not the diameter"
        )
        faults.append(
            Fault(f"{where}[fibres][{i}][distance]", rule, f"{distance[i]:g} mm", cure)
        )
    faults += _overlap_faults(where, centre, radius)
    return faults


def _overlap_faults(where: str, centre: Array, radius: Array) -> list[Fault]:
    """Fault of fibres that overlap in the picture; it names the pair that overlaps most."""
    gap = np.linalg.norm(centre[:, None] - centre, axis=-1)
    closeness = gap / (MIN_CENTRE_DISTANCE_FRACTION * (radius[:, None] + radius))
    closeness[np.tril_indices(len(radius))] = np.inf
    count = int((closeness < 1).sum())
    if not count:
        return []
    i, j = np.unravel_index(closeness.argmin(), closeness.shape)
    rule = "fibres must not overlap in the picture"
    cure = "correct centre and radius, in pixels"
    found = (
        f"{count} pairs, such as {i} and {j}: {gap[i, j]:.3g} px apart, radii "
        f"{radius[i]:g} and {radius[j]:g} px"
    )
    return [Fault(f"{where}[fibres]", rule, found, cure)]


def gain_faults(where: str, gain: Array) -> list[Fault]:
    """Faults of gains (n, 3) that are far from the median of their channel."""
    ratio = gain / np.median(gain, axis=0)
    off = np.maximum(ratio, 1 / ratio).max(axis=1)
    rule = (
        f"the gain of a fibre must be at most {MAX_GAIN_RATIO:g} times as large or "
        "small as the median gain"
    )
    cure = "measure the flat field of the fibre again"
    return [
        Fault(f"{where}[gain]", rule, f"{x:.3g} times, of fibre {i}", cure)
        for i, x in enumerate(off)
        if x > MAX_GAIN_RATIO
    ]
