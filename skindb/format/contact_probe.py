"""The contact probe of a capture, `probe.json`: fibres, sites, placements, pressure, and
the paths of its frames.

Limits are about ten times beyond any device known to us: they find wrong units and
slips, not unusual devices.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from skindb.errors import Fault
from skindb.format.fields import IDENTIFIER, MAX_MAGNITUDE, Fields, is_number, shown
from skindb.format.frames import (
    EXPOSURE,
    PLACEMENT,
    SITE,
    FrameKind,
    filled,
    frame_size,
    header_faults,
    inside,
    is_linear,
    read_exposures,
    require_merged,
    require_own_files,
)
from skindb.format.sensor import SensorRecord, read_sensor
from skindb.limits import MAX_FIBRES, MAX_PLACEMENTS, MAX_PRESSURE_SAMPLES, MAX_SITES
from skindb.types import Float64, lengths

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
Log = Float64  # (n, 2) seconds since the start of the placement, kPa


@dataclass(frozen=True)
class ProbeRecord:
    """The contact probe of a capture."""

    folder: Path
    sites: tuple[str, ...]
    # names of the placements at each site; ("",) for a single one
    placements: Mapping[str, tuple[str, ...]]
    distance: Float64  # (fibre,) mm
    azimuth: Float64  # (fibre,) degrees about the source fibre; NaN if unknown
    centre: Float64  # (fibre, 2) px
    radius: Float64  # (fibre,) px
    exposures: Mapping[str, float]
    frames: str
    gain: Float64  # (fibre, 3)
    gain_error: float  # relative, of each
    face: float  # radius of a fibre in mm; 0 if unknown
    scale: float | None
    sensor: SensorRecord
    fibres: tuple[str, ...]
    pressure: Mapping[tuple[str, str], Float64]  # (site, placement) -> (n, 2) s, kPa
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
    earlier_faults = len(fields.faults)
    fibres = fields.items("fibres", maximum=MAX_FIBRES)
    exposures = read_exposures(fields)
    sites = fields.names("sites", maximum=MAX_SITES)
    by_site = fields.object("placements", {})
    if unknown := sorted(set(by_site.data) - set(sites)):
        by_site.fault(unknown[0], "must be one of the sites", shown(unknown[0]))
    placements = {
        site: by_site.names(site, maximum=MAX_PLACEMENTS)
        if site in by_site.data
        else ("",)
        for site in sites
    }
    # a placeholder for all that differs between the frames
    needed = {SITE}
    if len(exposures) > 1:
        needed.add(EXPOSURE)
    if any(len(names) > 1 for names in placements.values()):
        needed.add(PLACEMENT)
    frames = fields.template("frames", needed, {EXPOSURE, PLACEMENT})
    linear = is_linear(frames)
    if linear:
        require_merged(fields, exposures)
    centre = np.array([fibre.array("centre", (2,)) for fibre in fibres])
    probe = ProbeRecord(
        folder=folder,
        sites=sites,
        placements=placements,
        azimuth=np.array(
            [
                fibre.number("azimuth", minimum=-360.0, maximum=360.0)
                if fibre.has("azimuth")
                else np.nan
                for fibre in fibres
            ]
        ),
        distance=np.array([fibre.number("distance", above=0.0) for fibre in fibres]),
        centre=centre.reshape(-1, 2),
        radius=np.array([fibre.number("radius", above=0.0) for fibre in fibres]),
        exposures=exposures,
        frames=frames,
        gain=fields.gains("gain", len(fibres)),
        gain_error=fields.number(
            "gain_error", default=GAIN_ERROR, minimum=0.0, maximum=MAX_GAIN_ERROR
        ),
        face=fields.number(
            "fibre_radius", default=0.0, minimum=0.0, maximum=MAX_FIBRE_RADIUS_MM
        ),
        scale=fields.number("scale", above=0.0) if fields.has("scale") else None,
        sensor=read_sensor(folder, fields, FrameKind(0, 0, 0), linear=linear),
        fibres=tuple(fibre.text("id", rule=IDENTIFIER) for fibre in fibres),
        pressure=_pressure(fields, placements),
        file=Path(fields.where),
    )
    if len(fields.faults) == earlier_faults:
        _require_separate_fibres(fields, probe)
        _require_even_gains(fields, probe.gain)
    _check_frames(probe, fields)
    return probe


def _check_frames(probe: ProbeRecord, fields: Fields) -> None:
    """Require that all frames have the size of the first one, and the declared depth."""
    kind = None
    views = [
        {SITE: site, EXPOSURE: exposure, PLACEMENT: placement}
        for site in (probe.sites if probe.frames else ())
        for placement, exposure in product(probe.placements[site], probe.exposures)
    ]
    require_own_files(
        fields, (("frames", filled(probe.frames, **names), names) for names in views)
    )
    place = f"{fields.where}[frames]"
    for names in views:
        path = inside(probe.folder, filled(probe.frames, **names), place, fields.faults)
        if path is None:
            continue
        size = None if kind else frame_size(path)
        if size is not None:
            kind = FrameKind(*size, probe.sensor.kind.bits)
        fields.faults += header_faults(path, kind or probe.sensor.kind, place)


def _pressure(
    fields: Fields, placements: Mapping[str, tuple[str, ...]]
) -> dict[tuple[str, str], Log]:
    """(site, placement) -> log of its pressure; a single number is a log without times (NaN)."""
    low, high = GAUGE_PRESSURES_KPA
    by_site = fields.object("pressure", {})
    logs = {}
    for site, value in by_site.data.items():
        names = placements.get(site, ("",))
        parts = value if isinstance(value, dict) else dict.fromkeys(names, value)
        for placement, content in parts.items():
            if site in placements and placement not in names:
                rule = f"must name placements of the site: {', '.join(names)}"
                by_site.fault(site, rule, shown(placement))
            log = _log(content)
            if log is None:
                by_site.fault(site, PRESSURE_RULE, shown(content))
            elif not ((log[:, 1] >= low) & (log[:, 1] <= high)).all():
                worst = log[np.abs(log[:, 1]).argmax(), 1]
                rule = f"a gauge pressure must be {low:g} to {high:g} kPa"
                by_site.fault(site, rule, f"{worst:.4g} kPa")
            else:
                logs[site, placement] = log
    return logs


def _log(value: Any) -> Log | None:
    if is_number(value):
        return np.array([[np.nan, value]]) if abs(value) <= MAX_MAGNITUDE else None
    if not isinstance(value, list) or not 0 < len(value) <= MAX_PRESSURE_SAMPLES:
        return None
    for pair in value:
        is_pair = isinstance(pair, list) and len(pair) == 2
        if not is_pair or not all(
            is_number(x) and abs(x) <= MAX_MAGNITUDE for x in pair
        ):
            return None
    log = np.array(value, float)
    return log if (np.diff(log[:, 0]) > 0).all() else None


def _require_separate_fibres(fields: Fields, probe: ProbeRecord) -> None:
    """Require fibres at different distances in mm that do not overlap."""
    distance = probe.distance
    if not len(distance):
        return
    nearest, farthest = FIBRE_DISTANCES_MM
    if not nearest <= distance.max() <= farthest:
        rule = (
            f"distances must be in mm, and the farthest fibre must be {nearest:g} to "
            f"{farthest:g} mm from the source"
        )
        cure = "give the distances in mm"
        fields.fault("fibres", rule, f"{distance.max():g} mm", cure)
    elif len(distance) > 1 and np.ptp(distance) == 0:
        fields.fault(
            "fibres",
            "a profile needs fibres at different distances",
            f"all {len(distance)} at {distance[0]:g} mm",
            "give each fibre its own distance",
        )
    if probe.face > 0 and (distance < 2 * probe.face).any():
        i = int(distance.argmin())
        rule = (
            "fibres must not overlap the source: distance must be at least twice "
            f"fibre_radius, {2 * probe.face:g} mm"
        )
        cure = (
            "distance is measured between the centres; both are in mm, and "
            "fibre_radius is not the diameter"
        )
        place = f"{fields.where}[fibres][{i}][distance]"
        fields.faults.append(Fault(place, rule, f"{distance[i]:g} mm", cure))
    _require_separate_discs(fields, probe.centre, probe.radius)


def _require_separate_discs(fields: Fields, centre: Float64, radius: Float64) -> None:
    """Require discs (n, 2) and (n,) px that do not overlap; the fault names the pair
    that overlaps most.
    """
    gap = lengths(centre[:, None] - centre)
    closeness = gap / (MIN_CENTRE_DISTANCE_FRACTION * (radius[:, None] + radius))
    closeness[np.tril_indices(len(radius))] = np.inf
    if count := int((closeness < 1).sum()):
        i, j = np.unravel_index(closeness.argmin(), closeness.shape)
        fields.fault(
            "fibres",
            "fibres must not overlap in the picture",
            f"{count} pairs, such as {i} and {j}: {gap[i, j]:.3g} px apart, radii "
            f"{radius[i]:g} and {radius[j]:g} px",
            "correct centre and radius, in pixels",
        )


def _require_even_gains(fields: Fields, gain: Float64) -> None:
    """Require gains (n, 3) near the median of their channel."""
    ratio = gain / np.median(gain, axis=0)
    rule = (
        f"the gain of a fibre must be at most {MAX_GAIN_RATIO:g} times as large or "
        "small as the median gain"
    )
    for i, factor in enumerate(np.maximum(ratio, 1 / ratio).max(axis=1)):
        if factor > MAX_GAIN_RATIO:
            fields.fault(
                "gain",
                rule,
                f"{factor:.3g} times, of fibre {i}",
                "measure the flat field of the fibre again",
            )
