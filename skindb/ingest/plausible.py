"""Scans and landmarks that cannot be of a face: lengths of another unit, left and right exchanged."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skindb.errors import Fault
from skindb.geometry.clean import CleanMesh
from skindb.geometry.nearest import closest_on_mesh
from skindb.geometry.scan import Scan
from skindb.geometry.surfels import vertex_normals

Array = NDArray[np.float64]
UNITS = {
    "metres": 1000.0,
    "inches": 25.4,
    "centimetres": 10.0,
    "tenths of a millimetre": 0.1,
    "micrometres": 0.001,
}  # mm of each
SCAN_DIAGONAL = (20.0, 3000.0)  # mm: a patch of skin, a whole person; a head is 350 to 400
HEAD_DIAGONAL, FACE_HEIGHT = 380.0, 90.0  # mm
FACE_HEIGHTS = (20.0, 400.0)  # mm from the middle of the upper names to that of the lower: a child's nose, a statue
LANDMARK_REACH = 10.0  # mm; a landmark farther from the scan is not of this face
SITE_LANDMARK = {"forehead": "forehead_centre"}  # where the probe touches a site that is no landmark itself
UPPER = ("forehead", "brow", "eye", "nasion")
LOWER = ("chin", "lip", "mouth", "subnasale")
# names from top to bottom, as in every face; the corners of jaws are as high as mouths in some
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
# of the height of the face, 9 mm: neighbouring levels are 12 mm and more apart, and clicks are off by 1
MAX_LEVEL_INVERSION = 0.1
MIN_LANDMARK_DISTANCE_MM = 0.5  # mm between two names: the inner corners of lips or eyes are 5 and more apart
SIDEWAYS = 0.5  # cosine to the face's own left beyond which a pair is judged: 60 degrees leave room for asymmetry


def scan_fault(where: str, surface: CleanMesh) -> Fault | None:
    """A scan too large or too small to be one in mm."""
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    least, most = SCAN_DIAGONAL
    if least <= diagonal <= most:
        return None
    rule = f"lengths are in mm, and a scan is {least:g} to {most:g} mm across"
    return Fault(
        where,
        rule,
        f"{diagonal:,.{0 if diagonal > most else 3}f} mm",
        rescaling(likely_unit(diagonal, HEAD_DIAGONAL)),
    )


def face_fault(where: str, points: Mapping[str, Array]) -> Fault | None:
    """A face too large or too small to be one in mm, by the names of its landmarks or of its regions' middles."""
    height = face_height(points)
    least, most = FACE_HEIGHTS
    if height is None or least <= height <= most:
        return None
    rule = f"lengths are in mm, and a face is {least:g} to {most:g} mm from brows and eyes to mouth and chin"
    cure = f"{rescaling(likely_unit(height, FACE_HEIGHT))}, the scan as well"
    return Fault(where, rule, f"{height:.3g} mm", cure)


def face_height(points: Mapping[str, Array]) -> float | None:
    """From the middle of the lower names to that of the upper ones, mm; None without names of both."""
    up = _up(points)
    return None if up is None else float(np.linalg.norm(up))


def landmark_faults(where: str, points: Mapping[str, Array], scan: Scan) -> list[Fault]:
    """Landmarks that are not on the scan: one fault if they are of another unit, else one each."""
    place = np.array([*points.values()]).reshape(-1, 3)
    distance = closest_on_mesh(scan.vertices, scan.faces, place)[2]
    off = distance > LANDMARK_REACH
    if len(off) > 2 and off.mean() > 0.5:
        for unit, factor in UNITS.items():
            if np.linalg.norm(np.ptp(place * factor, axis=0)) < FACE_HEIGHTS[0]:
                continue  # all in one point, which may well lie on the scan
            if np.median(closest_on_mesh(scan.vertices, scan.faces, place * factor)[2]) <= LANDMARK_REACH:
                rule, found = "lengths are in mm, and landmarks lie on the scan", f"{off.sum()} of {len(off)} in {unit}"
                return [Fault(where, rule, found, rescaling(unit))]
    rule = f"a landmark lies on the face, within {LANDMARK_REACH:g} mm of the scan"
    return [
        Fault(f"{where}[{name}]", rule, f"{d:.1f} mm away", "click it again; lengths are in mm")
        for name, d, wrong in zip(points, distance, off, strict=True)
        if wrong
    ]


def dropped_faults(where: str, points: Mapping[str, Array], surface: CleanMesh) -> list[Fault]:
    """Landmarks on a piece of the scan that cleaning left out, as another one is larger."""
    place = np.array([*points.values()]).reshape(-1, 3)
    distance = closest_on_mesh(surface.vertices, surface.faces, place)[2]
    off = [name for name, d in zip(points, distance, strict=True) if d > LANDMARK_REACH]
    if not off:
        return []
    found = f"{len(off)} of {len(points)} up to {distance.max():.0f} mm from it, such as {off[0]}"
    cure = "remove what is not of this face from the scan"
    return [Fault(where, "landmarks lie on the largest piece of the scan, the one that is kept", found, cure)]


def doubled_faults(where: str, points: Mapping[str, Array]) -> list[Fault]:
    """Two names at one point."""
    names, place = [*points], np.array([*points.values()]).reshape(-1, 3)
    rule = f"landmarks are at least {MIN_LANDMARK_DISTANCE_MM:g} mm apart"
    return [
        Fault(f"{where}[{names[j]}]", rule, f"{names[i]} at the same point", "click one of them again, or remove it")
        for i, j in sorted(cKDTree(place).query_pairs(MIN_LANDMARK_DISTANCE_MM))
    ]


def order_fault(where: str, points: Mapping[str, Array]) -> Fault | None:
    """Names along the face in the wrong order: the two that are farthest out of it, which are the exchanged ones."""
    up = _up(points)
    if up is None:
        return None
    size = float(up @ up)
    level = {name: i for name in points for i, parts in enumerate(LEVELS) if name.startswith(parts)}
    inversions = [
        (float(up @ (points[low] - points[high])) / size, high, low)
        for high in level
        for low in level
        if level[high] < level[low]
    ]
    worst, high, low = max(inversions, default=(0.0, "", ""))
    if worst <= MAX_LEVEL_INVERSION:
        return None
    rule = f"{high} lies above {low} on a face"
    found = f"it {worst * np.sqrt(size):.0f} mm below"
    return Fault(f"{where}[{high}]", rule, found, "exchange the two points, or click them again")


def swapped_faults(where: str, points: Mapping[str, Array], surface: CleanMesh) -> list[Fault]:
    """Pairs of left and right whose names are exchanged, however the head is turned: left is up x front.

    Up comes from the names (forehead, brows and eyes over lips and chin), front from the surface's normals at the
    landmarks; nothing is judged where there is no such pair or no such names.
    """
    pairs = [(name, mate) for name in points if (mate := name.replace("left", "right")) != name and mate in points]
    axis = _own_left(points, surface) if pairs else None
    if axis is None:
        return []
    across = np.array([points[left] - points[right] for left, right in pairs])
    wrong = across @ axis < -SIDEWAYS * np.linalg.norm(across, axis=1)
    rule = "left is the subject's own left: +x of a face that looks along +z, y up"
    if len(pairs) > 1 and wrong.all():
        cure = "exchange left and right in the names; if the scan is a mirror image, mirror it and the landmarks"
        return [Fault(where, rule, f"all {len(pairs)} pairs the other way round", cure)]
    cure = "exchange the two points"
    return [
        Fault(f"{where}[{left}]", rule, f"{mate} on that side", cure)
        for (left, mate), bad in zip(pairs, wrong, strict=True)
        if bad
    ]


def _own_left(points: Mapping[str, Array], surface: CleanMesh) -> Array | None:
    """Unit vector to the face's own left, from its up and its front; None where the names do not tell what is up."""
    up = _up(points)
    if up is None:
        return None
    nearest = cKDTree(surface.vertices).query(np.array([*points.values()]))[1]
    front = np.nansum(vertex_normals(surface.vertices, surface.faces)[nearest], axis=0)
    axis = np.cross(up, front)
    length = float(np.linalg.norm(axis))
    return axis / length if length > 0 else None


def _up(points: Mapping[str, Array]) -> Array | None:
    """From the middle of the lower landmarks to that of the upper, mm; None without names of both."""
    upper, lower = (
        [p for name, p in points.items() if any(part in name for part in parts)] for parts in (UPPER, LOWER)
    )
    return np.mean(upper, axis=0) - np.mean(lower, axis=0) if upper and lower else None


def likely_unit(length: float, usual: float) -> str:
    """The unit that brings a length nearest to the usual one, as a ratio."""
    return min(UNITS, key=lambda name: float(abs(np.log(max(length, 1e-300) * UNITS[name] / usual))))


def rescaling(unit: str) -> str:
    """The cure for lengths of a unit."""
    factor = UNITS[unit]
    return f"these look like {unit}: " + (f"multiply by {factor:g}" if factor > 1 else f"divide by {1 / factor:g}")
