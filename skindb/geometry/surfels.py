"""Order, normals and areas of the vertices of a triangle mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
MORTON_BITS = 21  # per axis: 63 bits in all


def morton_order(points: Float) -> NDArray[np.int64]:
    """Permutation (n,) that puts points (n, 3) along the Morton curve; ties keep their order.

    Neighbours in this order are neighbours in space: ray tracing and table lookups stay
    in the cache. The cells are cubes, 2^21 along the longest side of the box of the
    points.
    """
    p = np.asarray(points, np.float64)
    if len(p) == 0:
        return np.zeros(0, np.int64)
    low = p.min(axis=0)
    side = max(float((p.max(axis=0) - low).max()), np.finfo(np.float64).tiny)
    cell = np.minimum((p - low) / side * 2.0**MORTON_BITS, 2.0**MORTON_BITS - 1).astype(
        np.uint64
    )
    spread = _spread_bits(cell)
    key = spread[:, 0] << np.uint64(2) | spread[:, 1] << np.uint64(1) | spread[:, 2]
    return np.argsort(key, kind="stable")


def face_crosses(vertices: Float, faces: Faces) -> NDArray[np.float64]:
    """Normals (f, 3) of triangles by the right-hand rule, of length twice the area in mm2."""
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, i]] for i in range(3))
    return np.asarray(np.cross(b - a, c - a))


def vertex_normals(vertices: Float, faces: Faces) -> NDArray[np.float64]:
    """Unit normals (v, 3), the mean of the triangles' weighted by area, outwards if the winding is.

    NaN at a vertex of no triangle, or whose triangles cancel.
    """
    total = _sum_at_vertices(face_crosses(vertices, faces), faces, len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(length > 0, total / length, np.nan))


def vertex_areas(vertices: Float, faces: Faces) -> NDArray[np.float64]:
    """Areas (v,) in mm2: a third of each triangle goes to each corner, so that the sum
    is the area of the mesh.
    """
    area = np.linalg.norm(face_crosses(vertices, faces), axis=1, keepdims=True) / 6
    return _sum_at_vertices(area, faces, len(vertices))[:, 0]


def _sum_at_vertices(values: Float, faces: Faces, count: int) -> NDArray[np.float64]:
    at = np.asarray(faces).ravel()
    columns = [
        np.bincount(at, weights=np.repeat(column, 3), minlength=count)
        for column in values.T
    ]
    return np.stack(columns, axis=1)


def _spread_bits(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Each of the lower 21 bits moved to three times its place."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | x << np.uint64(shift)) & np.uint64(mask)
    return x


def splat_radius(vertices: Float, faces: Faces) -> NDArray[np.float64]:
    """Radius (v,) of the disc [mm] that stands for a vertex among its neighbours: 0.7
    of its longest edge.

    Discs of neighbours then overlap without gaps; 0 where a vertex has no edge.
    """
    out = np.zeros(len(vertices))
    for a, b in ((0, 1), (1, 2), (2, 0)):
        length = np.linalg.norm(
            np.asarray(vertices[faces[:, a]] - vertices[faces[:, b]], np.float64),
            axis=1,
        )
        np.maximum.at(out, faces[:, a], length)
        np.maximum.at(out, faces[:, b], length)
    return 0.7 * out
