"""Sanity checks of scans, landmarks and lengths: whether all are in mm and in one frame,
the likely unit of a part that is not, exchanged left and right; the file beside the
landmarks that holds the box by which the scan is cropped.
"""

from collections.abc import Mapping, Sequence
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
from skindb.geometry.scan import Crop
from skindb.types import Float64, lengths

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
# mm from the origin: 100 m; domes have a radius of 0.5 to 5 m
MAX_DEVICE_DISTANCE_MM = 100_000.0
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
# of the diagonal of the scan, 8 mm for a head: a dome in metres lies within it
MIN_DOME_REACH = 0.02


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


def face_faults(
    where: str, points: Mapping[str, Float64], *, on_scan: bool = True
) -> list[Fault]:
    """Fault of a face that is too large or too small to be in mm, by its landmarks or
    the centres of its regions, which may lie on the scan, so that it has their unit.
    """
    height = face_height(points)
    smallest, largest = FACE_HEIGHTS
    if height is None or smallest <= height <= largest:
        return []
    cure = rescaling(likely_unit(height, FACE_HEIGHT))
    return [
        Fault(
            where,
            f"lengths must be in mm, and a face must be {smallest:g} to {largest:g} mm from "
            "brows and eyes to mouth and chin",
            f"{height:.3g} mm",
            f"{cure}, also for the scan" if on_scan else cure,
        )
    ]


def face_height(points: Mapping[str, Float64]) -> float | None:
    """Distance [mm] between the centres of the lower and the upper landmarks; None
    without landmarks of both.
    """
    up = _up_direction(points)
    return None if up is None else float(np.linalg.norm(up))


def landmark_faults(
    where: str, points: Mapping[str, Float64], surface: CleanMesh
) -> list[Fault]:
    """Faults of landmarks that are not on the part of the scan that is kept."""
    rule = (
        f"a landmark must lie within {LANDMARK_REACH:g} mm of the largest component of "
        "the scan, which is kept"
    )
    cure = (
        "mark it again, with scan and landmarks in mm and in one frame, and remove from "
        "the scan what does not belong to this face"
    )
    positions = np.array([*points.values()]).reshape(-1, 3)
    distances = closest_on_mesh(surface.vertices, surface.faces, positions)[2]
    return [
        Fault(f"{where}[{name}]", rule, f"{d:.1f} mm away", cure)
        for name, d in zip(points, distances, strict=True)
        if d > LANDMARK_REACH
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
    limit = -MIN_COSINE_SIDEWAYS * lengths(across)
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


def rescaling(unit: str) -> str:
    """The correction for lengths in a wrong unit, for a message."""
    factor = UNITS[unit]
    cure = f"divide by {1 / factor:g}" if factor < 1 else f"multiply by {factor:g}"
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


def device_faults(where: str, dome: DomeRecord, surface: CleanMesh) -> list[Fault]:
    """Faults of cameras and lights that are inside the head, or too far away."""
    faults = []
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    for key, positions in (
        ("cameras", {camera.id: camera.centre for camera in dome.cameras}),
        ("lights", {light.id: light.position for light in dome.lights}),
    ):
        reach = lengths([*positions.values()]).max()
        if len(positions) > 2 and reach < MIN_DOME_REACH * diagonal:
            rule = "positions must be in mm, and a dome must surround the scan"
            finding = f"all {len(positions)} within {reach:.2g} mm of the origin"
            cure = _dome_rescaling([*positions.values()], diagonal)
            faults.append(Fault(f"{where}[{key}]", rule, finding, cure))
            continue
        far = [n for n, p in positions.items() if lengths(p) > MAX_DEVICE_DISTANCE_MM]
        inner = [n for n, p in positions.items() if _inside(surface, p)]
        if far:
            rule = (
                f"{key} must be within {MAX_DEVICE_DISTANCE_MM / 1000:g} m of the "
                "origin of the scan's frame"
            )
            finding = f"{len(far)} of {len(positions)} farther: {_first_names(far)}"
            cure = "give positions in mm"
            faults.append(Fault(f"{where}[{key}]", rule, finding, cure))
        if inner:
            cure = "calibrate in mm and in the frame of the scan; a camera is at -R^T t"
            if len(inner) == len(positions):
                cure = f"{_dome_rescaling([*positions.values()], diagonal)}, or {cure}"
            rule = f"{key} must be outside the head"
            finding = (
                f"{len(inner)} of {len(positions)} inside it: {_first_names(inner)}"
            )
            faults.append(Fault(f"{where}[{key}]", rule, finding, cure))
    return faults


def _dome_rescaling(positions: Sequence[Float64] | Float64, diagonal: float) -> str:
    """The correction for positions of cameras or lights around a scan of this diagonal [mm]."""
    # the origin is near the centre of the dome
    distance = float(np.median(lengths(positions)))
    return rescaling(likely_unit(distance, DOME_RADIUS_RATIO * diagonal))


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
        return [
            Fault(
                where,
                "lengths must be in mm, and a dome must surround the scan",
                "all of it within the bounding box of the scan",
                f"{_dome_rescaling(positions, diagonal)}, or calibrate in the frame of the scan",
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
    return bool(winding_number(vertices, surface.faces, point) > MIN_WINDING_NUMBER)


def picture_span(camera: CameraRecord, vertices: Float64) -> float | None:
    """Fraction of the picture's side that the scan spans; None if it is outside the
    picture or behind the camera.

    Distortion is ignored, and the picture is extended by half its size: only scans
    clearly outside count as invisible.
    """
    local = vertices @ camera.R.T + camera.t
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
    facing = np.linalg.norm(cross.sum(axis=0)) / lengths(cross).sum()
    away = np.linalg.norm(surface.vertices.mean(axis=0))
    return bool(
        unit > 1
        and FACE_DIAGONAL < unit * diagonal < LARGEST_HEAD
        and facing < MAX_MEAN_NORMAL
        and away < diagonal
    )
