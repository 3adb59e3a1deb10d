"""Named points of a face: the similarity between two sets of points, the mean shape of
many takes, and where landmarks that are not set yet may lie.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from skindb.geometry.mesh import closest_on_mesh
from skindb.types import Array, Faces, Float64, finite_rows, float64

MAX_SHAPE_ROUNDS = 100  # of the mean shape; a face needs about 5
SETTLED = 1e-12  # relative change of the mean shape at which it has converged
Points = dict[str, Float64]
NOSE = "nose_tip"
RIGHT = "_right"
LEFT = "_left"
# of the width of the scan to each side of its middle, where the nose tip is searched
MIDDLE_FRACTION = 0.15
# of points over their length, below which they lie on a line and do not determine a
# rotation
MIN_WIDTH = 0.15
# positions in mm on a mean face that looks along +z, y up: the mean of the virtual head of
# average proportions and of 40 random adults of ICT FaceKit (Li et al. 2020, a model of
# scanned people), with the same nose tip, rounded. The subject's left is mirrored.
_MIDDLE = {
    "forehead_centre": (0, 99, 92),
    "nasion": (0, 42, 103),
    NOSE: (0, 8, 125),
    "subnasale": (0, -9, 108),
    "lip_upper": (0, -26, 112),
    "chin": (0, -71, 98),
}
_OF_RIGHT = {
    "forehead": (-48, 91, 75),
    "brow": (-38, 63, 92),
    "ala": (-14, -6, 104),
    "eye_outer": (-44, 35, 82),
    "eye_inner": (-17, 34, 87),
    "mouth_corner": (-25, -33, 95),
    "jaw": (-55, -53, 41),
}
MEAN_FACE: Mapping[str, Float64] = {
    name: np.array(place, np.float64)
    for name, place in (
        *_MIDDLE.items(),
        *((f"{name}{RIGHT}", place) for name, place in _OF_RIGHT.items()),
        *((f"{name}{LEFT}", (-x, y, z)) for name, (x, y, z) in _OF_RIGHT.items()),
    )
}


def similarity(source: Array, target: Array) -> tuple[Float64, Float64]:
    """Rotation and scale (d, d) and shift (d,) that best map source to target, without
    reflection (Umeyama 1991).

    Parameters
    ----------
    source, target
        (k, d), k > 0; a single point, or points that coincide, are only shifted.

    Returns
    -------
    matrix, shift : ndarray
        `source @ matrix + shift` approximates target.
    """
    x = float64(source)
    y = float64(target)
    a = x - x.mean(axis=0)
    b = y - y.mean(axis=0)
    u, value, v = np.linalg.svd(a.T @ b)
    sign = np.ones(len(value))
    sign[-1] = np.sign(np.linalg.det(u @ v))
    length = float((a**2).sum())
    along = float(value @ sign)
    matrix = np.eye(len(value))
    if along > 0 and length > 0:
        matrix = along / length * (u * sign) @ v
    return matrix, y.mean(axis=0) - x.mean(axis=0) @ matrix


def width(points: Array) -> float:
    """Second largest extent of points (k, d) over the largest; 0 for a single point."""
    value = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(value[1] / value[0]) if len(value) > 1 and value[0] > 0 else 0.0


def mean_shape(shapes: Array) -> Float64:
    """Mean of shapes after rotation, scale and shift are removed (Gower 1975), in the
    mean pose of the shapes.

    Parameters
    ----------
    shapes
        (t, k, 2); NaN where a shape lacks a point.

    Returns
    -------
    ndarray
        (k, 2); NaN for a point no shape has.
    """
    shapes = float64(shapes)
    pose = _mean_of_complete(shapes)
    mean = pose
    size = float(np.nanmax(np.abs(pose - np.nanmean(pose, axis=0)), initial=0.0))
    for _ in range(MAX_SHAPE_ROUNDS):
        before = mean
        aligned = np.stack([_onto(shape, before) for shape in shapes])
        mean = _onto(_mean_of_complete(aligned), pose)
        if not np.nanmax(np.abs(mean - before), initial=0.0) > SETTLED * size:
            break
    return mean


def _onto(shape: Array, target: Array) -> Float64:
    """A shape (k, 2) after the similarity that best maps it to another."""
    shared = finite_rows(shape) & finite_rows(target)
    if not shared.any():
        return float64(shape)
    matrix, shift = similarity(shape[shared], target[shared])
    return shape @ matrix + shift


def _mean_of_complete(shapes: Array) -> Float64:
    """Mean (k, 2) over the shapes that have a point."""
    complete = np.isfinite(shapes).all(axis=2, keepdims=True)
    total = shapes.sum(axis=0, where=complete)
    with np.errstate(invalid="ignore"):
        return total / complete.sum(axis=0)


def mate(name: str) -> str:
    """The name of the point on the other side; points of the middle are their own."""
    if name.endswith(RIGHT):
        return name.removesuffix(RIGHT) + LEFT
    if name.endswith(LEFT):
        return name.removesuffix(LEFT) + RIGHT
    return name


def nose_tip(vertices: Array) -> Float64:
    """The foremost vertex (3,) of the middle of a scan (v, 3) that looks along +z, y up, mm.

    The middle is a strip around the median of x; hair and clothes that stand out
    farther than the nose mislead it.
    """
    points = float64(vertices)
    across = points[:, 0] - np.median(points[:, 0])
    strip = points[np.abs(across) <= MIDDLE_FRACTION * np.ptp(points[:, 0])]
    return strip[np.argmax(strip[:, 2])]


def suggest_landmarks(
    vertices: Array, faces: Faces, points: Mapping[str, Array]
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
    fixed = {name: float64(points[name]) for name in points if name in MEAN_FACE}
    names = [name for name in MEAN_FACE if name not in fixed]
    if not names:
        return {}
    if determine_rotation(fixed):
        guess = _fitted(fixed) | _mirrored(fixed)
    else:
        start = {NOSE: nose_tip(vertices), **fixed}
        guess = _fitted(start) | _mirrored(fixed)
        guess[NOSE] = start[NOSE]
    places = np.array([guess[name] for name in names])
    triangle, weight, _ = closest_on_mesh(vertices, faces, places)
    corners = float64(vertices)[faces[triangle]]
    nearest = (weight[..., None] * corners).sum(axis=1)
    return dict(zip(names, nearest, strict=True))


def determine_rotation(points: Mapping[str, Array]) -> bool:
    """Whether points determine the rotation of the head."""
    return len(points) > 2 and width(np.array([*points.values()])) > MIN_WIDTH


def _fitted(points: Points) -> Points:
    """The mean face, moved onto the points that are set; only shifted where they
    determine no rotation.
    """
    mean = np.array([*MEAN_FACE.values()])
    source = np.array([MEAN_FACE[name] for name in points])
    target = np.array([*points.values()])
    if determine_rotation(points):
        matrix, shift = similarity(source, target)
    else:
        matrix = np.eye(3)
        shift = (target - source).mean(axis=0)
    return dict(zip(MEAN_FACE, mean @ matrix + shift, strict=True))


def _mirrored(points: Points) -> Points:
    """Mirror images of points whose mate is not set, by the reflection that best maps
    the others onto their mates.
    """
    both = {name: p for name, p in points.items() if mate(name) in points}
    if not determine_rotation(both):
        return {}
    flip = np.array([-1.0, 1, 1])
    source = np.array([points[mate(name)] for name in both]) * flip
    matrix, shift = similarity(source, np.array([*both.values()]))
    return {
        mate(name): (p * flip) @ matrix + shift
        for name, p in points.items()
        if mate(name) not in points
    }
