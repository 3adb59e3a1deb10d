"""Sanity checks of scans and landmarks: wrong units, exchanged left and right."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skindb.errors import Fault
from skindb.geometry.clean import CleanMesh
from skindb.geometry.mesh import closest_on_mesh, vertex_normals
from skindb.geometry.scan import Scan

Array = NDArray[np.float64]
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


def scan_fault(where: str, surface: CleanMesh) -> Fault | None:
    """Fault of a scan that is too large or too small to be in mm."""
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    least, most = SCAN_DIAGONAL
    if least <= diagonal <= most:
        return None
    rule = f"lengths must be in mm, and a scan must be {least:g} to {most:g} mm across"
    return Fault(
        where,
        rule,
        f"{diagonal:,.{0 if diagonal > most else 3}f} mm",
        rescaling(likely_unit(diagonal, HEAD_DIAGONAL)),
    )


def face_fault(where: str, points: Mapping[str, Array]) -> Fault | None:
    """Fault of a face that is too large or too small to be in mm, by its landmarks or
    the centres of its regions.
    """
    height = face_height(points)
    least, most = FACE_HEIGHTS
    if height is None or least <= height <= most:
        return None
    rule = (
        f"lengths must be in mm, and a face must be {least:g} to {most:g} mm from "
        "brows and eyes to mouth and chin"
    )
    cure = f"{rescaling(likely_unit(height, FACE_HEIGHT))}, also for the scan"
    return Fault(where, rule, f"{height:.3g} mm", cure)


def face_height(points: Mapping[str, Array]) -> float | None:
    """Distance [mm] between the centres of the lower and the upper landmarks; None
    without landmarks of both.
    """
    up = _up_direction(points)
    return None if up is None else float(np.linalg.norm(up))


def landmark_faults(where: str, points: Mapping[str, Array], scan: Scan) -> list[Fault]:
    """Faults of landmarks that are not on the scan."""
    place = np.array([*points.values()]).reshape(-1, 3)
    distance = closest_on_mesh(scan.vertices, scan.faces, place)[2]
    off = distance > LANDMARK_REACH
    rule = f"a landmark must lie within {LANDMARK_REACH:g} mm of the scan"
    return [
        Fault(f"{where}[{name}]", rule, f"{d:.1f} mm away", "mark it again, in mm")
        for name, d, wrong in zip(points, distance, off, strict=True)
        if wrong
    ]


def discarded_piece_faults(
    where: str, points: Mapping[str, Array], surface: CleanMesh
) -> list[Fault]:
    """Fault of landmarks on a component of the scan that cleaning removed, because
    another one is larger.
    """
    place = np.array([*points.values()]).reshape(-1, 3)
    distance = closest_on_mesh(surface.vertices, surface.faces, place)[2]
    off = [name for name, d in zip(points, distance, strict=True) if d > LANDMARK_REACH]
    if not off:
        return []
    found = f"{len(off)} of {len(points)} up to {distance.max():.0f} mm from it, such as {off[0]}"
    cure = "remove everything from the scan that does not belong to this face"
    return [
        Fault(
            where,
            "landmarks must lie on the largest component of the scan, which is kept",
            found,
            cure,
        )
    ]


def coincidence_faults(where: str, points: Mapping[str, Array]) -> list[Fault]:
    """Faults of landmarks at the same point."""
    names = [*points]
    place = np.array([*points.values()]).reshape(-1, 3)
    rule = f"landmarks must be at least {MIN_LANDMARK_DISTANCE_MM:g} mm apart"
    return [
        Fault(
            f"{where}[{names[j]}]",
            rule,
            f"{names[i]} at the same point",
            "mark one of them again, or remove it",
        )
        for i, j in sorted(cKDTree(place).query_pairs(MIN_LANDMARK_DISTANCE_MM))
    ]


def order_fault(where: str, points: Mapping[str, Array]) -> Fault | None:
    """Fault of landmarks in the wrong vertical order: names the two that violate it
    most, probably exchanged ones.
    """
    up = _up_direction(points)
    if up is None:
        return None
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
        return None
    rule = f"{high} must lie above {low} on a face"
    found = f"it {worst * np.sqrt(size):.0f} mm below"
    return Fault(
        f"{where}[{high}]", rule, found, "exchange the two points, or mark them again"
    )


def swapped_faults(
    where: str, points: Mapping[str, Array], surface: CleanMesh
) -> list[Fault]:
    """Faults of left and right landmarks with exchanged names, for any pose of the
    head: left is up x front.

    Up follows from the landmarks (forehead, brows and eyes above lips and chin), front
    from the surface normals at the landmarks; nothing is checked without such a pair or
    such landmarks.
    """
    pairs = [
        (name, mate)
        for name in points
        if (mate := name.replace("left", "right")) != name and mate in points
    ]
    axis = _left_direction(points, surface) if pairs else None
    if axis is None:
        return []
    across = np.array([points[left] - points[right] for left, right in pairs])
    wrong = across @ axis < -MIN_COSINE_SIDEWAYS * np.linalg.norm(across, axis=1)
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
        Fault(f"{where}[{left}]", rule, f"{mate} on that side", cure)
        for (left, mate), bad in zip(pairs, wrong, strict=True)
        if bad
    ]


def _left_direction(points: Mapping[str, Array], surface: CleanMesh) -> Array | None:
    """Unit vector to the subject's left, from up and front directions; None if the
    landmarks do not determine up.
    """
    up = _up_direction(points)
    if up is None:
        return None
    nearest = cKDTree(surface.vertices).query(np.array([*points.values()]))[1]
    front = np.nansum(vertex_normals(surface.vertices, surface.faces)[nearest], axis=0)
    axis = np.cross(up, front)
    length = float(np.linalg.norm(axis))
    return axis / length if length > 0 else None


def _up_direction(points: Mapping[str, Array]) -> Array | None:
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
    return min(
        UNITS,
        key=lambda name: float(abs(np.log(max(length, 1e-300) * UNITS[name] / usual))),
    )


def rescaling(unit: str) -> str:
    """The correction for lengths in a wrong unit, for a message."""
    factor = UNITS[unit]
    return f"these look like {unit}: " + (
        f"multiply by {factor:g}" if factor > 1 else f"divide by {1 / factor:g}"
    )
