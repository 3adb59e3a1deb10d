"""Sanity checks of scans, landmarks and lengths: whether all are in mm and in one frame,
the likely units of parts that are not, exchanged left and right; the file beside the
landmarks that holds the box by which the scan is cropped.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import inf, log
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from skindb.errors import Fault, input_error
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.geometry.clean import CleanMesh
from skindb.geometry.mesh import (
    closest_on_mesh,
    face_crosses,
    vertex_normals,
    winding_number,
)
from skindb.geometry.scan import Crop, Scan
from skindb.types import Float64

UNITS = {
    "metres": 1000.0,
    "inches": 25.4,
    "centimetres": 10.0,
    "tenths of a millimetre": 0.1,
    "micrometres": 0.001,
}  # mm of each
# mm: from a patch of skin to an entire person; a head has 350 to 400
SCAN_DIAGONAL = (20.0, 3000.0)
# mm
HEAD_DIAGONAL = 380.0
FACE_HEIGHT = 90.0
# mm between the centres of upper and lower landmarks: from a child's nose to a statue
FACE_HEIGHTS = (20.0, 400.0)
# mm; a landmark farther from the scan does not belong to this face
LANDMARK_REACH = 10.0
# landmark at a probe site that has another name
SITE_LANDMARK = {"forehead": "forehead_centre"}
UPPER = ("forehead", "brow", "eye", "nasion")
LOWER = ("chin", "lip", "mouth", "subnasale")
# landmarks from top to bottom; the corners of the jaw are excluded, as some faces have
# them level with the mouth
LEVELS = (
    ("forehead",),
    ("brow",),
    ("eye", "nasion"),
    ("nose_tip",),
    ("ala", "subnasale"),
    ("lip_upper", "mouth"),
    ("lip_lower",),
    ("chin",),
)
# of the height of the face, 9 mm: neighbouring levels are at least 12 mm apart, and
# clicks have an error of 1 mm
MAX_LEVEL_INVERSION = 0.1
# mm between two landmarks; the closest ones of lips or eyes are at least 5 mm apart
MIN_LANDMARK_DISTANCE_MM = 0.5
# to the subject's left, for a pair to be checked: 60 degrees allow for asymmetry
MIN_COSINE_SIDEWAYS = 0.5
MAX_COORDINATE_MM = 1e30  # smaller than infinity in single precision
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


def scan_faults(where: str, surface: CleanMesh) -> list[Fault]:
    """Fault of a scan that is too large or too small to be in mm."""
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    smallest, largest = SCAN_DIAGONAL
    if smallest <= diagonal <= largest:
        return []
    cure = rescaling(likely_unit(diagonal, HEAD_DIAGONAL))
    return [
        Fault(
            where,
            f"lengths must be in mm, and a scan must be {smallest:g} to {largest:g} mm across",
            f"{diagonal:,.{0 if diagonal > largest else 3}f} mm",
            cure,
        )
    ]


def face_faults(where: str, points: Mapping[str, Float64]) -> list[Fault]:
    """Fault of a face that is too large or too small to be in mm, by its landmarks or
    the centres of its regions.
    """
    height = face_height(points)
    smallest, largest = FACE_HEIGHTS
    if height is None or smallest <= height <= largest:
        return []
    return [
        Fault(
            where,
            f"lengths must be in mm, and a face must be {smallest:g} to {largest:g} mm from "
            "brows and eyes to mouth and chin",
            f"{height:.3g} mm",
            f"{rescaling(likely_unit(height, FACE_HEIGHT))}, also for the scan",
        )
    ]


def face_height(points: Mapping[str, Float64]) -> float | None:
    """Distance [mm] between the centres of the lower and the upper landmarks; None
    without landmarks of both.
    """
    up = _up_direction(points)
    return None if up is None else float(np.linalg.norm(up))


def landmark_faults(
    where: str, points: Mapping[str, Float64], scan: Scan
) -> list[Fault]:
    """Faults of landmarks that are not on the scan."""
    rule = f"a landmark must lie within {LANDMARK_REACH:g} mm of the scan"
    return [
        Fault(f"{where}[{name}]", rule, f"{d:.1f} mm away", "mark it again, in mm")
        for name, d in _distances(points, scan).items()
        if d > LANDMARK_REACH
    ]


def _distances(
    points: Mapping[str, Float64], mesh: Scan | CleanMesh
) -> dict[str, float]:
    """Distance [mm] of each point from a mesh."""
    positions = np.array([*points.values()]).reshape(-1, 3)
    distances = closest_on_mesh(mesh.vertices, mesh.faces, positions)[2]
    return dict(zip(points, distances, strict=True))


def discarded_piece_faults(
    where: str, points: Mapping[str, Float64], surface: CleanMesh
) -> list[Fault]:
    """Fault of landmarks on a component of the scan that cleaning removed, because
    another one is larger.
    """
    distances = _distances(points, surface)
    distant = [name for name, d in distances.items() if d > LANDMARK_REACH]
    if not distant:
        return []
    return [
        Fault(
            where,
            "landmarks must lie on the largest component of the scan, which is kept",
            f"{len(distant)} of {len(points)} up to {max(distances.values()):.0f} mm from "
            f"it, such as {distant[0]}",
            "remove everything from the scan that does not belong to this face",
        )
    ]


def coincidence_faults(where: str, points: Mapping[str, Float64]) -> list[Fault]:
    """Faults of landmarks at the same point."""
    names = [*points]
    tree = cKDTree(np.array([*points.values()]).reshape(-1, 3))
    rule = f"landmarks must be at least {MIN_LANDMARK_DISTANCE_MM:g} mm apart"
    cure = "mark one of them again, or remove it"
    return [
        Fault(f"{where}[{names[j]}]", rule, f"{names[i]} at the same point", cure)
        for i, j in sorted(tree.query_pairs(MIN_LANDMARK_DISTANCE_MM))
    ]


def order_faults(where: str, points: Mapping[str, Float64]) -> list[Fault]:
    """Fault of landmarks in the wrong vertical order: names the two that violate it
    most, probably exchanged ones.
    """
    up = _up_direction(points)
    if up is None:
        return []
    size = float(up @ up)
    level = {
        name: i
        for name in points
        for i, parts in enumerate(LEVELS)
        if name.startswith(parts)
    }
    inversions = [
        (float(up @ (points[low] - points[high])) / size, high, low)
        for high in level
        for low in level
        if level[high] < level[low]
    ]
    worst, high, low = max(inversions, default=(0.0, "", ""))
    if worst <= MAX_LEVEL_INVERSION:
        return []
    return [
        Fault(
            f"{where}[{high}]",
            f"{high} must lie above {low} on a face",
            f"it {worst * np.sqrt(size):.0f} mm below",
            "exchange the two points, or mark them again",
        )
    ]


def swapped_faults(
    where: str, points: Mapping[str, Float64], surface: CleanMesh
) -> list[Fault]:
    """Faults of left and right landmarks with exchanged names, for any pose of the
    head: left is up x front.

    Up follows from the landmarks (forehead, brows and eyes above lips and chin), front
    from the surface normals at the landmarks; nothing is checked without such a pair or
    such landmarks.
    """
    mates = {name: name.replace("left", "right") for name in points if "left" in name}
    pairs = [(left, right) for left, right in mates.items() if right in points]
    up = _up_direction(points)
    if not pairs or up is None:
        return []
    nearest = cKDTree(surface.vertices).query(np.array([*points.values()]))[1]
    front = np.nansum(vertex_normals(surface.vertices, surface.faces)[nearest], axis=0)
    axis = np.cross(up, front)
    length = float(np.linalg.norm(axis))
    if length == 0:
        return []
    across = np.array([points[left] - points[right] for left, right in pairs])
    limit = -MIN_COSINE_SIDEWAYS * np.linalg.norm(across, axis=1)
    wrong = across @ (axis / length) < limit
    rule = (
        "left must be the subject's left: +x of a face that looks along +z, with y up"
    )
    if len(pairs) > 1 and wrong.all():
        cure = (
            "exchange left and right in the names; if the scan is a mirror image, "
            "mirror it and the landmarks"
        )
        return [Fault(where, rule, f"all {len(pairs)} pairs the other way round", cure)]
    cure = "exchange the two points"
    return [
        Fault(f"{where}[{left}]", rule, f"{right} on that side", cure)
        for (left, right), exchanged in zip(pairs, wrong, strict=True)
        if exchanged
    ]


def _up_direction(points: Mapping[str, Float64]) -> Float64 | None:
    """Vector [mm] from the centre of the lower to that of the upper landmarks; None
    without landmarks of both.
    """
    upper, lower = (
        [p for name, p in points.items() if any(part in name for part in parts)]
        for parts in (UPPER, LOWER)
    )
    return np.mean(upper, axis=0) - np.mean(lower, axis=0) if upper and lower else None


def likely_unit(length: float, usual: float) -> str:
    """The unit in which a length is closest to the usual one, by their ratio."""

    def distance(unit: str) -> float:
        return float(abs(np.log(max(length, 1e-300) * UNITS[unit] / usual)))

    return min(UNITS, key=distance)


def rescaling(unit: str, lengths: str = "") -> str:
    """The correction for lengths in a wrong unit, for a message."""
    factor = UNITS[unit]
    words = f" {lengths}" if lengths else ""
    cure = f"multiply{words} by {factor:g}"
    if factor < 1:
        cure = f"divide{words} by {1 / factor:g}"
    return f"these look like {unit}: {cure}"


def crop_path(landmarks: Path) -> Path:
    """The file that holds the crop box that belongs to this file of landmarks."""
    return landmarks.with_suffix(".crop.json")


def parsed_crop(value: Any, where: str) -> Crop:
    """A crop box from JSON: {"low": [x, y, z], "high": [x, y, z]}.

    Raises
    ------
    InputError
        If it is not that, or its corners are exchanged.
    """
    if not isinstance(value, dict) or not (
        is_point(value.get("low")) and is_point(value.get("high"))
    ):
        raise input_error(
            where,
            'a crop box must be {"low": [x, y, z], "high": [x, y, z]} in mm',
            str(value)[:80],
            "correct it, or remove the file",
        )
    low, high = (tuple(map(float, value[corner])) for corner in ("low", "high"))
    return Crop((low[0], low[1], low[2]), (high[0], high[1], high[2]))


def is_point(value: Any) -> bool:
    """Whether JSON holds three finite numbers."""
    sound = isinstance(value, list) and len(value) == 3
    # not NaN either
    return sound and all(
        type(x) in (int, float) and abs(x) < MAX_COORDINATE_MM for x in value
    )


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
            faults.append(
                Fault(
                    f"{where}[{key}]",
                    rule,
                    finding,
                    "calibrate in mm and in the frame of the scan; a camera is at -R^T t",
                )
            )
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
        return [
            Fault(
                where,
                "lengths must be in mm, and a dome must surround the scan",
                "all of it within the bounding box of the scan",
                f"{rescaling(unit)}, or calibrate in the frame of the scan",
            )
        ]
    spans = [picture_span(camera, surface.vertices) for camera in dome.cameras]
    span = max((span for span in spans if span is not None), default=None)
    if span is None:
        return [
            Fault(
                where,
                "the picture of a camera must show the scan",
                f"none of {len(dome.cameras)} does",
                "calibrate in mm and in the frame of the scan: x_cam = R x + t, z forwards",
            )
        ]
    if not sized and span < LEAST_SPAN and _shrunken_head(surface, diagonal):
        cure = rescaling(likely_unit(diagonal, HEAD_DIAGONAL))
        return [
            Fault(
                mesh,
                "lengths must be in mm, and a head must span at least a tenth of a picture",
                f"{diagonal:.0f} mm across, {span:.1%} of a picture's side",
                cure,
            )
        ]
    if span < (LEAST_SPAN if diagonal > FACE_DIAGONAL else PATCH_SPAN):
        cure = rescaling(likely_unit(USUAL_SPAN / span, 1.0))
        return [
            Fault(
                where,
                "lengths must be in mm, and the scan must be visible in the pictures",
                f"{diagonal:,.0f} mm across, it spans {span:.2%} of a picture's side",
                cure,
            )
        ]
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
