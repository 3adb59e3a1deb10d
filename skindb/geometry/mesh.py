"""Meshes as numbers: order, normals and areas of vertices, nearest points, and whether
points lie inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skindb.types import Array, Faces, Float64, Index, float64

MORTON_BITS = 21  # per axis: 63 bits in all
POINTS_PER_BLOCK = 1 << 10  # each point may have a hundred candidate triangles


def morton_order(points: Array) -> Index:
    """Permutation (n,) that puts points (n, 3) along the Morton curve; ties keep their order.

    Neighbours in this order are neighbours in space: ray tracing and table lookups stay
    in the cache. The cells are cubes, 2^21 along the longest side of the box of the
    points.
    """
    p = float64(points)
    if len(p) == 0:
        return np.zeros(0, np.int64)
    low = p.min(axis=0)
    side = max(float((p.max(axis=0) - low).max()), np.finfo(np.float64).tiny)
    cell = np.minimum((p - low) / side * 2.0**MORTON_BITS, 2.0**MORTON_BITS - 1)
    spread = _spread_bits(cell.astype(np.uint64))
    key = spread[:, 0] << np.uint64(2) | spread[:, 1] << np.uint64(1) | spread[:, 2]
    return np.argsort(key, kind="stable")


def face_crosses(vertices: Array, faces: Faces) -> Float64:
    """Normals (f, 3) of triangles by the right-hand rule, of length twice the area in mm2."""
    a, b, c = float64(vertices)[faces.T]
    return np.cross(b - a, c - a)


def vertex_normals(vertices: Array, faces: Faces) -> Float64:
    """Unit normals (v, 3), the mean of the triangles' weighted by area, outwards if the winding is.

    NaN at a vertex of no triangle, or whose triangles cancel.
    """
    total = _sum_at_vertices(face_crosses(vertices, faces), faces, len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(length > 0, total / length, np.nan)


def vertex_areas(vertices: Array, faces: Faces) -> Float64:
    """Areas (v,) in mm2: a third of each triangle goes to each corner, so that the sum
    is the area of the mesh.
    """
    area = np.linalg.norm(face_crosses(vertices, faces), axis=1, keepdims=True) / 6
    return _sum_at_vertices(area, faces, len(vertices))[:, 0]


def _sum_at_vertices(values: Array, faces: Faces, count: int) -> Float64:
    corners = np.asarray(faces).ravel()
    columns = [
        np.bincount(corners, np.repeat(column, 3), minlength=count)
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


def splat_radius(vertices: Array, faces: Faces) -> Float64:
    """Radius (v,) of the disc [mm] that stands for a vertex among its neighbours: 0.7
    of its longest edge.

    Discs of neighbours then overlap without gaps; 0 where a vertex has no edge.
    """
    out = np.zeros(len(vertices))
    for k in range(3):
        a = faces[:, k]
        b = faces[:, (k + 1) % 3]
        side = float64(vertices[a] - vertices[b])
        length = np.linalg.norm(side, axis=1)
        np.maximum.at(out, a, length)
        np.maximum.at(out, b, length)
    return 0.7 * out


def closest_on_mesh(
    vertices: Array, faces: Faces, points: Array
) -> tuple[Index, Float64, Float64]:
    """The nearest point of a mesh, exactly.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3); degenerate triangles count as their sides.
    points
        (n, 3) mm, finite.

    Returns
    -------
    face : ndarray
        (n,) index of the triangle the nearest point lies on.
    barycentric : ndarray
        (n, 3) weights of its corners, each in [0, 1], sum 1.
    distance : ndarray
        (n,) mm.
    """
    p = float64(points).reshape(-1, 3)
    triangles = float64(vertices)[faces]
    is_corner = np.zeros(len(vertices), np.bool_)
    is_corner[faces] = True
    near = cKDTree(float64(vertices)[is_corner]).query(p)[0]
    classes = _by_reach(triangles)
    face = np.empty(len(p), np.int64)
    barycentric = np.empty((len(p), 3))
    for start in range(0, len(p), POINTS_PER_BLOCK):
        block = slice(start, start + POINTS_PER_BLOCK)
        row, candidate = _candidates(classes, p[block], near[block])
        point = p[block][row]
        weight = _closest(point, triangles[candidate])
        place = np.einsum("nk,nkc->nc", weight, triangles[candidate])
        distance = np.linalg.norm(place - point, axis=1)
        order = np.lexsort((candidate, distance, row))
        best = order[np.searchsorted(row[order], np.arange(len(p[block])))]
        face[block] = candidate[best]
        barycentric[block] = weight[best]
    place = np.einsum("nk,nkc->nc", barycentric, triangles[face])
    return face, barycentric, np.linalg.norm(place - p, axis=1)


@dataclass(frozen=True)
class _Class:
    """Triangles of similar size: none extends farther from its centre than `reach`."""

    face: Index
    middles: cKDTree
    reach: float


def _by_reach(triangles: Array) -> list[_Class]:
    """Classes of triangles (f, 3, 3) by their radius, in powers of two, so that long
    ones do not slow the others.
    """
    middle = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
    octave = np.frexp(np.maximum(reach, np.median(reach)))[1]
    classes = [np.flatnonzero(octave == size) for size in np.unique(octave)]
    return [
        _Class(face, cKDTree(middle[face]), float(reach[face].max()))
        for face in classes
    ]


def _candidates(
    classes: list[_Class], points: Array, near: Array
) -> tuple[Index, Index]:
    """Pairs (m,) of a point and a triangle that may be nearest to it; `near` is the
    distance of some vertex.
    """
    rows = []
    faces = []
    for size in classes:
        # no point of a triangle is nearer than its centre minus its radius
        reach = (near + size.reach) * (1 + 1e-12)
        lists = size.middles.query_ball_point(points, reach)
        rows.append(np.repeat(np.arange(len(points)), [len(list_) for list_ in lists]))
        faces.append(size.face[np.concatenate(lists).astype(np.int64)])
    return np.concatenate(rows), np.concatenate(faces)


def _closest(point: Array, triangles: Array) -> Float64:
    """Barycentric (n, 3) of the point of each triangle (n, 3, 3) nearest to a point (n,
    3): inside, or on an edge.
    """
    a = triangles[:, 0]
    ab = triangles[:, 1] - a
    ac = triangles[:, 2] - a
    away = point - a
    # by orthogonalisation: Gram determinants are squared quantities, which lose
    # precision for needles
    base = _square(ab)
    along = _dot(ab, ac) / base
    ahead = _dot(ab, away) / base
    height = ac - along[:, None] * ab
    v = _dot(height, away - ahead[:, None] * ab) / _square(height)
    u = ahead - v * along
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    weights = [np.stack([1 - u - v, u, v], axis=1)]
    off = u[:, None] * ab + v[:, None] * ac - away
    squared = [np.where(inside, _dot(off, off), np.inf)]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start = triangles[:, i]
        edge = triangles[:, j] - triangles[:, i]
        t = np.clip(_dot(point - start, edge) / _square(edge), 0.0, 1.0)
        weight = np.zeros((len(t), 3))
        weight[:, i] = 1 - t
        weight[:, j] = t
        weights.append(weight)
        off = start + t[:, None] * edge - point
        squared.append(_dot(off, off))
    best = np.argmin(squared, axis=0)
    return np.asarray(np.stack(weights)[best, np.arange(len(best))])


def _square(a: Array) -> Float64:
    """Squared lengths (n,) to divide by."""
    return np.maximum(_dot(a, a), np.finfo(np.float64).tiny)


def _dot(a: Array, b: Array) -> Float64:
    return np.asarray(np.einsum("nc,nc->n", a, b))


def winding_number(vertices: Array, faces: Faces, points: Array) -> Float64:
    """Winding numbers of a mesh around points (k, 3): solid angle of its back over 4 pi
    (Jacobson et al. 2013).

    1 inside a closed surface, 0 outside. For an open surface, the fraction of
    directions in which its inner side is visible minus that of its outer side, at most
    one half outside the convex hull.
    """
    triangles = float64(vertices)[faces]
    numbers = []
    for point in float64(points).reshape(-1, 3):
        a, b, c = (triangles[:, i] - point for i in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        # van Oosterom and Strackee 1983
        volume = _dot(a, np.cross(b, c))
        scale = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
        numbers.append(2 * np.arctan2(volume, scale).sum() / (4 * np.pi))
    return np.array(numbers, np.float64)
