"""Units of length: whether scan, landmarks, cameras and lights can be in mm and in one
frame, and the likely units of parts that cannot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import inf, log

import numpy as np

from skindb.errors import Fault
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.format.scan_checks import (
    FACE_HEIGHT,
    FACE_HEIGHTS,
    HEAD_DIAGONAL,
    LANDMARK_REACH,
    SCAN_DIAGONAL,
    UNITS,
    face_height,
    likely_unit,
    rescaling,
)
from skindb.geometry.clean import CleanMesh
from skindb.geometry.mesh import closest_on_mesh, face_crosses, winding_number
from skindb.geometry.scan import Scan
from skindb.types import Float64

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
# mm from the origin: 100 m; domes have a radius of 0.5 to 5 m
MAX_DEVICE_DISTANCE_MM = 100_000.0
# distance of the lights over the diagonal of a head; below it they are inside
MIN_LIGHT_RATIO = 0.6
# logarithm of a factor, of lengths that are as far from the usual ones as one more
# part, or one more unit, is unlikely
PART_COST = UNIT_COST = 0.7
MAX_VERTICES = 5_000  # of a scan, for its span in the pictures
# of a point inside; outside the convex hull of a surface it is at most 0.5
MIN_WINDING_NUMBER = 0.5
# of the longest side of a picture. Heads in a dome span 0.7 to 1; ten times too far
# away they span at most 0.1
LEAST_SPAN = 0.1
USUAL_SPAN = 0.8
# for a small scan: a patch of 20 mm in a picture of a person of 1.7 m spans 0.01
PATCH_SPAN = 0.005
# mm, of a child's face; a scan of this size is not a patch of skin
FACE_DIAGONAL = 200.0
LARGEST_HEAD = 700.0  # mm, with neck and shoulders
# |sum of normals| over area: at most 0.47 for faces and heads, 0.75 to 1 for patches of
# cheek, forehead and jaw
MAX_MEAN_NORMAL = 0.6
# distance of the devices over the diagonal of a head; domes of 0.8 m have 2.1 to 2.5
DOME_RADIUS_RATIO = 2.0


@dataclass(frozen=True)
class Lengths:
    """Parts of a capture, as far as they are known; `middles` are the centres of named
    regions of the scan.
    """

    scan: Scan
    landmarks: Mapping[str, Float64]
    middles: Mapping[str, Float64]
    dome: DomeRecord | None

    @cached_property
    def sizes(self) -> dict[str, float]:
        """A length of each part: diagonal, height of the face, median distances from
        the centre of the scan.
        """
        vertices = self.scan.vertices
        sizes = {SCAN: float(np.linalg.norm(np.ptp(vertices, axis=0)))}
        if (height := face_height(self.landmarks)) is not None:
            sizes[LANDMARKS] = height
        if self.dome is not None and self.dome.cameras:
            sizes[CAMERAS] = self.distance([c.centre for c in self.dome.cameras])
        if self.dome is not None and self.dome.lights:
            sizes[LIGHTS] = self.distance([x.position for x in self.dome.lights])
        return sizes

    def distance(self, positions: list[Float64], factor: float = 1.0) -> float:
        """Median distance from the centre of the scan of positions times a factor."""
        away = factor * np.array(positions) - self.scan.vertices.mean(axis=0)
        return float(np.median(np.linalg.norm(away, axis=1)))


def likely_units(lengths: Lengths) -> dict[str, str]:
    """The unit of each part that is not in mm; empty if all of them may be, or if no
    units make a capture of a head.

    Of all combinations, the one is chosen in which lengths are closest to those of
    heads in domes, and in which the fewest parts are in the fewest other units.
    """
    parts = [*lengths.sizes]
    ratios = {a / b for a, b in product(MM.values(), repeat=2)}
    near = {}
    if LANDMARKS in parts:
        near = {ratio: _landmark_distance(lengths, ratio) for ratio in ratios}
    views = {ratio: _device_costs(lengths, ratio) for ratio in ratios}
    best = dict[str, str]()
    lowest = inf
    for names in product(MM, repeat=len(parts)):
        units = dict(zip(parts, names, strict=True))
        other_units = {part: unit for part, unit in units.items() if MM[unit] != 1}
        cost = PART_COST * len(other_units) + UNIT_COST * max(len({*names}) - 1, 0)
        if cost < lowest:
            factors = {part: MM[unit] for part, unit in units.items()}
            cost += _cost(lengths, factors, near, views)
        if cost < lowest:
            best = other_units
            lowest = cost
    return best


def _cost(
    lengths: Lengths,
    factor: Mapping[str, float],
    near: Mapping[float, float],
    views: Mapping[float, Mapping[str, float]],
) -> float:
    """Sum of the logarithms by which lengths differ from the usual ones; infinite for
    lengths that are impossible.
    """
    sizes = {part: factor[part] * size for part, size in lengths.sizes.items()}
    diagonal = sizes[SCAN]
    height = sizes.get(LANDMARKS, (face_height(lengths.middles) or 0.0) * factor[SCAN])
    if not SCAN_DIAGONAL[0] <= diagonal <= SCAN_DIAGONAL[1]:
        return inf
    cost = abs(log(diagonal / HEAD_DIAGONAL))
    if height:
        if not FACE_HEIGHTS[0] <= height <= FACE_HEIGHTS[1]:
            return inf
        cost = abs(log(height / FACE_HEIGHT))
    if LANDMARKS in factor:
        reach = LANDMARK_REACH / factor[SCAN]
        if min(near.values()) < reach < near[factor[LANDMARKS] / factor[SCAN]]:
            return inf
    for part in (CAMERAS, LIGHTS):
        if part in factor:
            cost += views[factor[part] / factor[SCAN]][part]
    return cost


def _landmark_distance(lengths: Lengths, ratio: float) -> float:
    """Median distance of the landmarks from the scan, in its unit, if they are this
    many times larger.
    """
    points = ratio * np.array([*lengths.landmarks.values()])
    distances = closest_on_mesh(lengths.scan.vertices, lengths.scan.faces, points)[2]
    return float(np.median(distances))


def _device_costs(lengths: Lengths, ratio: float) -> dict[str, float]:
    """Costs of cameras and lights that are this many times farther away, in the unit of
    the scan.
    """
    dome = lengths.dome
    if dome is None:
        return {}
    vertices = lengths.scan.vertices[:: -(-len(lengths.scan.vertices) // MAX_VERTICES)]
    spans = [picture_span(camera, vertices, factor=ratio) for camera in dome.cameras]
    finite = [span for span in spans if span is not None and np.isfinite(span)]
    camera_cost = inf
    if 2 * len(finite) >= len(spans):
        camera_cost = abs(log(float(np.median(finite)) / USUAL_SPAN))
    positions = [light.position for light in dome.lights]
    far = lengths.distance(positions, ratio) / lengths.sizes[SCAN]
    light_cost = abs(log(far / DOME_RADIUS_RATIO)) if far >= MIN_LIGHT_RATIO else inf
    return {CAMERAS: camera_cost, LIGHTS: light_cost}


def unit_text(units: Mapping[str, str]) -> str:
    """The correction for parts in other units, for a message."""
    cures = list[str]()
    for unit in dict.fromkeys(units.values()):
        *before, final = (LENGTHS[part] for part in units if units[part] == unit)
        lengths = f"{', '.join(before)} and {final}" if before else final
        cures.append(rescaling(unit, lengths))
    if not {CAMERAS, LIGHTS}.isdisjoint(units):
        cures.append("check disc_radius and the white target too")
    return "; ".join(cures)


def device_faults(where: str, dome: DomeRecord, surface: CleanMesh) -> list[Fault]:
    """Faults of cameras and lights that are inside the head, or too far away."""
    faults = []
    for key, positions in (
        ("cameras", {camera.id: camera.centre for camera in dome.cameras}),
        ("lights", {light.id: light.position for light in dome.lights}),
    ):
        far = [
            name
            for name, position in positions.items()
            if np.linalg.norm(position) > MAX_DEVICE_DISTANCE_MM
        ]
        inner = [
            name for name, position in positions.items() if _inside(surface, position)
        ]
        if far:
            rule = (
                f"{key} must be within {MAX_DEVICE_DISTANCE_MM / 1000:g} m of the "
                "origin of the scan's frame"
            )
            finding = f"{len(far)} of {len(positions)} farther: {_first_names(far)}"
            faults.append(
                Fault(f"{where}[{key}]", rule, finding, "give positions in mm")
            )
        if inner:
            rule = f"{key} must be outside the head"
            finding = (
                f"{len(inner)} of {len(positions)} inside it: {_first_names(inner)}"
            )
            cure = "calibrate in mm and in the frame of the scan; the centre of a camera is -R^T t"
            faults.append(Fault(f"{where}[{key}]", rule, finding, cure))
    return faults


def _first_names(names: list[str]) -> str:
    return ", ".join(names[:3]) + ", .." * (len(names) > 3)


def dome_unit_faults(
    where: str, dome: DomeRecord, mesh: str, surface: CleanMesh, *, sized: bool
) -> list[Fault]:
    """Fault of a dome and a scan that cannot both be in mm, or cannot be in the same frame.

    Only impossible captures are faults: a dome within the bounding box of the scan; a
    scan that no camera shows; a scan that is large enough for a face but spans less
    than a tenth of every picture. A small scan that spans as little is a fault if it is
    probably a head in centimetres or inches: it curves around the origin of its frame,
    which a patch of skin does not. If scan and dome are both too small by the same
    factor, only the landmarks reveal it.

    Parameters
    ----------
    where, mesh
        Files of the dome and of the scan, for the message.
    dome, surface
        As read.
    sized
        Whether landmarks or regions have shown that the face is in mm.
    """
    low = surface.vertices.min(axis=0)
    high = surface.vertices.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    positions = np.array(
        [*(c.centre for c in dome.cameras), *(x.position for x in dome.lights)]
    )
    if ((positions > low) & (positions < high)).all():
        # the origin is near the centre of the dome
        distance = float(np.median(np.linalg.norm(positions, axis=1)))
        unit = likely_unit(distance, DOME_RADIUS_RATIO * diagonal)
        rule = "lengths must be in mm, and a dome must surround the scan"
        finding = "all of it within the bounding box of the scan"
        cure = f"{rescaling(unit)}, or calibrate in the frame of the scan"
        return [Fault(where, rule, finding, cure)]
    spans = [picture_span(camera, surface.vertices) for camera in dome.cameras]
    span = max((span for span in spans if span is not None), default=None)
    if span is None:
        rule = "the picture of a camera must show the scan"
        finding = f"none of {len(dome.cameras)} does"
        cure = (
            "calibrate in mm and in the frame of the scan: x_cam = R x + t, z forwards"
        )
        return [Fault(where, rule, finding, cure)]
    if not sized and span < LEAST_SPAN and _shrunken_head(surface, diagonal):
        rule = (
            "lengths must be in mm, and a head must span at least a tenth of a picture"
        )
        finding = f"{diagonal:.0f} mm across, {span:.1%} of a picture's side"
        cure = rescaling(likely_unit(diagonal, HEAD_DIAGONAL))
        return [Fault(mesh, rule, finding, cure)]
    if span < (LEAST_SPAN if diagonal > FACE_DIAGONAL else PATCH_SPAN):
        rule = "lengths must be in mm, and the scan must be visible in the pictures"
        finding = f"{diagonal:,.0f} mm across, it spans {span:.2%} of a picture's side"
        cure = rescaling(likely_unit(USUAL_SPAN / span, 1.0))
        return [Fault(where, rule, finding, cure)]
    return []


def _inside(surface: CleanMesh, point: Float64) -> bool:
    vertices = surface.vertices
    if not ((point > vertices.min(axis=0)) & (point < vertices.max(axis=0))).all():
        return False
    number = winding_number(vertices, surface.faces, point)[0]
    return bool(number > MIN_WINDING_NUMBER)


def picture_span(
    camera: CameraRecord, vertices: Float64, *, factor: float = 1.0
) -> float | None:
    """Fraction of the picture's side that the scan spans; None if it is outside the
    picture or behind the camera.

    The camera is taken to be `factor` times as far away.

    Distortion is ignored, and the picture is extended by half its size: only scans
    clearly outside count as invisible.
    """
    local = vertices @ camera.R.T + factor * camera.t
    behind = local[:, 2] <= 0
    if behind.all():
        return None
    if behind.any():
        return np.inf  # the camera is inside the scan
    pixels = local @ camera.K.T
    relative = pixels[:, :2] / pixels[:, 2:] / [camera.width, camera.height]
    low = relative.min(axis=0)
    high = relative.max(axis=0)
    if (low < 1.5).all() and (high > -0.5).all():
        return float((high - low).max())
    return None


def _shrunken_head(surface: CleanMesh, diagonal: float) -> bool:
    """Whether a surface has the size of a head in inches or centimetres, and curves
    around the origin of its frame.
    """
    unit = UNITS[likely_unit(diagonal, HEAD_DIAGONAL)]
    cross = face_crosses(surface.vertices, surface.faces)
    facing = np.linalg.norm(cross.sum(axis=0)) / np.linalg.norm(cross, axis=1).sum()
    away = np.linalg.norm(surface.vertices.mean(axis=0))
    return bool(
        unit > 1
        and FACE_DIAGONAL < unit * diagonal < LARGEST_HEAD
        and facing < MAX_MEAN_NORMAL
        and away < diagonal
    )
