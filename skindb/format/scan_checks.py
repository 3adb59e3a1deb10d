"""Sanity checks of scans and landmarks: wrong units, exchanged left and right; the file
beside the landmarks that holds the box by which the scan is cropped.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from skindb.errors import Fault, InputError
from skindb.geometry.clean import CleanMesh
from skindb.geometry.mesh import closest_on_mesh, vertex_normals
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


def scan_faults(where: str, surface: CleanMesh) -> list[Fault]:
    """Fault of a scan that is too large or too small to be in mm."""
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    smallest, largest = SCAN_DIAGONAL
    if smallest <= diagonal <= largest:
        return []
    rule = f"lengths must be in mm, and a scan must be {smallest:g} to {largest:g} mm across"
    finding = f"{diagonal:,.{0 if diagonal > largest else 3}f} mm"
    cure = rescaling(likely_unit(diagonal, HEAD_DIAGONAL))
    return [Fault(where, rule, finding, cure)]


def face_faults(where: str, points: Mapping[str, Float64]) -> list[Fault]:
    """Fault of a face that is too large or too small to be in mm, by its landmarks or
    the centres of its regions.
    """
    height = face_height(points)
    smallest, largest = FACE_HEIGHTS
    if height is None or smallest <= height <= largest:
        return []
    rule = (
        f"lengths must be in mm, and a face must be {smallest:g} to {largest:g} mm from "
        "brows and eyes to mouth and chin"
    )
    cure = f"{rescaling(likely_unit(height, FACE_HEIGHT))}, also for the scan"
    return [Fault(where, rule, f"{height:.3g} mm", cure)]


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
    rule = "landmarks must lie on the largest component of the scan, which is kept"
    finding = (
        f"{len(distant)} of {len(points)} up to {max(distances.values()):.0f} mm from "
        f"it, such as {distant[0]}"
    )
    cure = "remove everything from the scan that does not belong to this face"
    return [Fault(where, rule, finding, cure)]


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
    rule = f"{high} must lie above {low} on a face"
    finding = f"it {worst * np.sqrt(size):.0f} mm below"
    cure = "exchange the two points, or mark them again"
    return [Fault(f"{where}[{high}]", rule, finding, cure)]


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
        rule = 'a crop box must be {"low": [x, y, z], "high": [x, y, z]} in mm'
        raise InputError(
            Fault(where, rule, str(value)[:80], "correct it, or remove the file")
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
