"""Likely units of the parts of a capture whose lengths cannot all be in mm: scan,
landmarks, cameras and lights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from math import inf, log

import numpy as np
from numpy.typing import NDArray

from skindb.format.devices import DomeRecord
from skindb.format.dome_checks import (
    DOME_RADIUS_RATIO,
    USUAL_SPAN,
    device_positions,
    picture_span,
)
from skindb.format.scan_checks import (
    FACE_HEIGHT,
    FACE_HEIGHTS,
    HEAD_DIAGONAL,
    LANDMARK_REACH,
    SCAN_DIAGONAL,
    UNITS,
    face_height,
)
from skindb.geometry.nearest import closest_on_mesh
from skindb.geometry.scan import Scan

Array = NDArray[np.float64]
SCAN = "scan"
LANDMARKS = "landmarks"
CAMERAS = "cameras"
LIGHTS = "lights"
SIZES = {
    SCAN: "diagonal of the scan",
    LANDMARKS: "face from eyes to mouth",
    CAMERAS: "cameras at",
    LIGHTS: "lights at",
}
LENGTHS = {
    SCAN: "the vertices of the scan",
    LANDMARKS: "the landmarks",
    CAMERAS: "t of the cameras",
    LIGHTS: "position of the lights",
}
MM = {"millimetres": 1.0, **UNITS}  # mm of each
# distance of the lights over the diagonal of a head; below it they are inside
MIN_LIGHT_RATIO = 0.6
# logarithm of a factor, of lengths that are as far from the usual ones as one more
# part, or one more unit, is unlikely
PART_COST = UNIT_COST = 0.7
MAX_VERTICES = 5_000  # of a scan, for its span in the pictures


@dataclass(frozen=True)
class Lengths:
    """Parts of a capture, as far as they are known; `middles` are the centres of named
    regions of the scan.
    """

    scan: Scan
    landmarks: Mapping[str, Array]
    middles: Mapping[str, Array]
    dome: DomeRecord | None

    @property
    def diagonal(self) -> float:
        """Diagonal of the scan."""
        return float(np.linalg.norm(np.ptp(self.scan.vertices, axis=0)))

    @property
    def sizes(self) -> dict[str, float]:
        """A length of each part: diagonal, height of the face, median distances from
        the centre of the scan.
        """
        sizes = {SCAN: self.diagonal}
        if (height := face_height(self.landmarks)) is not None:
            sizes[LANDMARKS] = height
        if self.dome is not None and self.dome.cameras:
            sizes[CAMERAS] = self._distance([*device_positions(self.dome).values()])
        if self.dome is not None and self.dome.lights:
            sizes[LIGHTS] = self._distance(
                [light.position for light in self.dome.lights]
            )
        return sizes

    def _distance(self, places: list[Array], factor: float = 1.0) -> float:
        middle = self.scan.vertices.mean(axis=0)
        return float(
            np.median(np.linalg.norm(factor * np.array(places) - middle, axis=1))
        )


def likely_units(lengths: Lengths) -> dict[str, str]:
    """The unit of each part that is not in mm; empty if all of them may be, or if no
    units make a capture of a head.

    Of all combinations, the one is chosen in which lengths are closest to those of
    heads in domes, and in which the fewest parts are in the fewest other units.
    """
    parts = [*lengths.sizes]
    near = (
        {ratio: _landmarks_near(lengths, ratio) for ratio in _ratios()}
        if LANDMARKS in parts
        else {}
    )
    views = {ratio: _device_cost(lengths, ratio) for ratio in _ratios()}
    best = dict[str, str]()
    least = inf
    for names in product(MM, repeat=len(parts)):
        units = dict(zip(parts, names, strict=True))
        other = {part: unit for part, unit in units.items() if MM[unit] != 1}
        cost = PART_COST * len(other) + UNIT_COST * max(len({*names}) - 1, 0)
        if cost < least:
            cost += _cost(
                lengths, {part: MM[unit] for part, unit in units.items()}, near, views
            )
        if cost < least:
            best = other
            least = cost
    return best


def _ratios() -> set[float]:
    """Ratios of the units of two parts."""
    return {a / b for a, b in product(MM.values(), repeat=2)}


def _cost(
    lengths: Lengths,
    factor: Mapping[str, float],
    near: Mapping[float, float],
    views: Mapping[float, tuple[float, float]],
) -> float:
    """Sum of the logarithms by which lengths differ from the usual ones; infinite for
    lengths that are impossible.
    """
    sizes = {part: factor[part] * size for part, size in lengths.sizes.items()}
    height = sizes.get(LANDMARKS, (face_height(lengths.middles) or 0.0) * factor[SCAN])
    if not SCAN_DIAGONAL[0] <= sizes[SCAN] <= SCAN_DIAGONAL[1] or (
        height and not _within(height, FACE_HEIGHTS)
    ):
        return inf
    cost = (
        abs(log(height / FACE_HEIGHT))
        if height
        else abs(log(sizes[SCAN] / HEAD_DIAGONAL))
    )
    if LANDMARKS in factor and min(near.values()) < LANDMARK_REACH / factor[SCAN]:
        cost += (
            0.0
            if near[factor[LANDMARKS] / factor[SCAN]] <= LANDMARK_REACH / factor[SCAN]
            else inf
        )
    if CAMERAS in factor:
        cost += views[factor[CAMERAS] / factor[SCAN]][0]
    if LIGHTS in factor:
        cost += views[factor[LIGHTS] / factor[SCAN]][1]
    return cost


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def _landmarks_near(lengths: Lengths, ratio: float) -> float:
    """Median distance of the landmarks from the scan, in its unit, if they are this
    many times larger.
    """
    points = ratio * np.array([*lengths.landmarks.values()])
    return float(
        np.median(closest_on_mesh(lengths.scan.vertices, lengths.scan.faces, points)[2])
    )


def _device_cost(lengths: Lengths, ratio: float) -> tuple[float, float]:
    """Costs of cameras and lights that are this many times farther away, in the unit of
    the scan.
    """
    if lengths.dome is None:
        return 0.0, 0.0
    vertices = lengths.scan.vertices[:: -(-len(lengths.scan.vertices) // MAX_VERTICES)]
    spans = [
        picture_span(camera, vertices, factor=ratio) for camera in lengths.dome.cameras
    ]
    known = [span for span in spans if span is not None and np.isfinite(span)]
    camera = (
        abs(log(float(np.median(known)) / USUAL_SPAN))
        if 2 * len(known) >= len(spans)
        else inf
    )
    places = [light.position for light in lengths.dome.lights]
    far = lengths._distance(places, ratio) / lengths.diagonal
    return camera, abs(log(far / DOME_RADIUS_RATIO)) if far >= MIN_LIGHT_RATIO else inf


def unit_text(units: Mapping[str, str]) -> str:
    """The correction for parts in other units, for a message."""
    said = list[str]()
    for unit in dict.fromkeys(units.values()):
        lengths = _listed([LENGTHS[part] for part, own in units.items() if own == unit])
        how = (
            f"multiply {lengths} by {UNITS[unit]:g}"
            if UNITS[unit] > 1
            else f"divide {lengths} by {1 / UNITS[unit]:g}"
        )
        said.append(f"these look like {unit}: {how}")
    beside = (
        ""
        if {CAMERAS, LIGHTS}.isdisjoint(units)
        else "; check disc_radius and the white target too"
    )
    return f"{'; '.join(said)}{beside}"


def _listed(words: list[str]) -> str:
    return (
        " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else words[0]
    )
