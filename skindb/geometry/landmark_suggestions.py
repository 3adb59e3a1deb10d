"""Where the landmarks of a face that are not set yet may lie, from its surface and from
those that are set.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.landmarks import similarity, width
from skindb.geometry.nearest import closest_on_mesh

Float = NDArray[np.floating[Any]]
Points = dict[str, NDArray[np.float64]]
NOSE = "nose_tip"
RIGHT = "_right"
LEFT = "_left"
# of the width of the scan to each side of its middle, where the nose tip is searched
MIDDLE_FRACTION = 0.15
# of points over their length, below which they lie on a line and do not determine a
# rotation
MIN_WIDTH = 0.15
# positions in mm on a mean face that looks along +z, y up: the virtual head of average
# proportions, rounded. The subject's left is mirrored.
_MIDDLE = {
    "forehead_centre": (0, 96, 96),
    "nasion": (0, 42, 106),
    NOSE: (0, 8, 125),
    "subnasale": (0, -10, 107),
    "lip_upper": (0, -30, 113),
    "chin": (0, -72, 101),
}
_OF_RIGHT = {
    "forehead": (-46, 88, 80),
    "brow": (-37, 59, 93),
    "ala": (-16, -5, 107),
    "eye_outer": (-44, 32, 85),
    "eye_inner": (-17, 32, 90),
    "mouth_corner": (-25, -36, 97),
    "jaw": (-57, -55, 37),
}
MEAN_FACE: Mapping[str, NDArray[np.float64]] = {
    **{name: np.array(place, np.float64) for name, place in _MIDDLE.items()},
    **{
        f"{name}{RIGHT}": np.array(place, np.float64)
        for name, place in _OF_RIGHT.items()
    },
    **{
        f"{name}{LEFT}": np.array(place, np.float64) * (-1, 1, 1)
        for name, place in _OF_RIGHT.items()
    },
}


def mate(name: str) -> str:
    """The name of the point on the other side; points of the middle are their own."""
    if name.endswith(RIGHT):
        return name.removesuffix(RIGHT) + LEFT
    return name.removesuffix(LEFT) + RIGHT if name.endswith(LEFT) else name


def nose_tip(vertices: Float) -> NDArray[np.float64]:
    """The foremost vertex (3,) of the middle of a scan (v, 3) that looks along +z, y up, mm.

    The middle is a strip around the median of x; hair and clothes that stand out
    farther than the nose mislead it.
    """
    points = np.asarray(vertices, np.float64)
    across = points[:, 0] - np.median(points[:, 0])
    strip = points[np.abs(across) <= MIDDLE_FRACTION * np.ptp(points[:, 0])]
    return np.asarray(strip[np.argmax(strip[:, 2])])


def suggest_landmarks(
    vertices: Float, faces: NDArray[np.integer[Any]], points: Mapping[str, Float]
) -> Points:
    """Positions on the surface for the landmarks of `MEAN_FACE` that are not set.

    A point whose mate is set is its mirror image across the plane of symmetry of the
    points that are set. The nose tip is the foremost point of the middle, as long as no
    three points that are not on a line are set. The rest are the mean face after the
    similarity that brings it nearest to the points that are set (Umeyama 1991). All are
    moved to the nearest point of the surface.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3); the face looks along +z, y up, unless three points are set.
    points
        Name to position (3,) mm of those that are set; names that the mean face lacks are ignored.

    Returns
    -------
    dict
        Name to position (3,) mm.
    """
    known = {
        name: np.asarray(p, np.float64)
        for name, p in points.items()
        if name in MEAN_FACE
    }
    begin = known if _spread(known) else {NOSE: nose_tip(vertices), **known}
    guess = _fitted(begin) | _mirrored(known)
    open_ = [name for name in MEAN_FACE if name not in known]
    if not open_:
        return {}
    if NOSE in begin and NOSE in open_:
        guess[NOSE] = begin[NOSE]
    triangle, weight, _ = closest_on_mesh(
        vertices, faces, np.array([guess[name] for name in open_])
    )
    nearest = (
        weight[..., None] * np.asarray(vertices, np.float64)[faces[triangle]]
    ).sum(axis=1)
    return dict(zip(open_, nearest, strict=True))


def _spread(known: Mapping[str, Float]) -> bool:
    """Whether points determine the rotation of the head."""
    return len(known) > 2 and width(np.array([*known.values()])) > MIN_WIDTH


def _fitted(known: Points) -> Points:
    """The mean face, moved onto the points that are set; only shifted where they
    determine no rotation.
    """
    names = [*known]
    mean = np.array([*MEAN_FACE.values()])
    source = np.array([MEAN_FACE[name] for name in names])
    target = np.array([known[name] for name in names])
    if _spread(known):
        matrix, shift = similarity(source, target)
    else:
        matrix = np.eye(3)
        shift = (target - source).mean(axis=0)
    return dict(zip(MEAN_FACE, mean @ matrix + shift, strict=True))


def _mirrored(known: Points) -> Points:
    """Mirror images of points whose mate is not set, by the reflection that best maps
    the others onto their mates.
    """
    both = [name for name in known if mate(name) in known]
    if not _spread({name: known[name] for name in both}):
        return {}
    flip = np.array([-1.0, 1, 1])
    source = np.array([known[mate(name)] for name in both]) * flip
    matrix, shift = similarity(source, np.array([known[name] for name in both]))
    return {
        mate(name): (p * flip) @ matrix + shift
        for name, p in known.items()
        if mate(name) not in known
    }
