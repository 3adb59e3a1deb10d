"""Nearest points of a mesh, and whether points lie inside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
POINTS_PER_BLOCK = 1 << 10  # each point may have a hundred candidate triangles


def closest_on_mesh(
    vertices: Float, faces: Faces, points: Float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
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
    p = np.asarray(points, np.float64).reshape(-1, 3)
    triangles = np.asarray(vertices, np.float64)[faces]
    used = np.zeros(len(vertices), np.bool_)
    used[faces] = True
    near = cKDTree(np.asarray(vertices, np.float64)[used]).query(p)[0]
    classes = _by_reach(triangles)
    face = np.empty(len(p), np.int64)
    corner = np.empty((len(p), 3))
    for start in range(0, len(p), POINTS_PER_BLOCK):
        own = slice(start, start + POINTS_PER_BLOCK)
        row, at = _candidates(classes, p[own], near[own])
        weight = _closest(p[own][row], triangles[at])
        away = np.linalg.norm(
            np.einsum("nk,nkc->nc", weight, triangles[at]) - p[own][row], axis=1
        )
        order = np.lexsort((at, away, row))
        best = order[np.searchsorted(row[order], np.arange(len(p[own])))]
        face[own], corner[own] = at[best], weight[best]
    found = np.einsum("nk,nkc->nc", corner, triangles[face])
    return face, corner, np.linalg.norm(found - p, axis=1)


@dataclass(frozen=True)
class _Class:
    """Triangles of similar size: none extends farther from its centre than `reach`."""

    face: NDArray[np.int64]
    middles: cKDTree
    reach: float


def _by_reach(triangles: Float) -> list[_Class]:
    """Classes of triangles (f, 3, 3) by their radius, in powers of two, so that long
    ones do not slow the others.
    """
    middle = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - middle[:, None], axis=2).max(axis=1)
    octave = np.frexp(np.maximum(reach, np.median(reach)))[1]
    faces = [np.flatnonzero(octave == one) for one in np.unique(octave)]
    return [
        _Class(face, cKDTree(middle[face]), float(reach[face].max())) for face in faces
    ]


def _candidates(
    classes: list[_Class], points: Float, near: Float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs (m,) of a point and a triangle that may be nearest to it, given the
    distance `near` of some vertex.
    """
    rows = []
    faces = []
    for one in classes:
        # no point of a triangle is nearer than its centre minus its radius
        found = one.middles.query_ball_point(points, (near + one.reach) * (1 + 1e-12))
        rows.append(np.repeat(np.arange(len(points)), [len(few) for few in found]))
        faces.append(one.face[np.concatenate(found).astype(np.int64)])
    return np.concatenate(rows), np.concatenate(faces)


def _closest(point: Float, triangles: Float) -> Float:
    """Barycentric (n, 3) of the point of each triangle (n, 3, 3) nearest to a point (n,
    3): inside, or on an edge.
    """
    a = triangles[:, 0]
    first = triangles[:, 1] - a
    second = triangles[:, 2] - a
    away = point - a
    # by orthogonalisation: Gram determinants are squared quantities, which lose
    # precision for needles
    base = _square(first)
    along = _dot(first, second) / base
    ahead = _dot(first, away) / base
    height = second - along[:, None] * first
    v = _dot(height, away - ahead[:, None] * first) / _square(height)
    u = ahead - v * along
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    weights = [np.stack([1 - u - v, u, v], axis=1)]
    off = u[:, None] * first + v[:, None] * second - away
    squared = [np.where(inside, _dot(off, off), np.inf)]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start = triangles[:, i]
        edge = triangles[:, j] - triangles[:, i]
        t = np.clip(_dot(point - start, edge) / _square(edge), 0.0, 1.0)
        weight = np.zeros((len(t), 3))
        weight[:, i], weight[:, j] = 1 - t, t
        weights.append(weight)
        off = start + t[:, None] * edge - point
        squared.append(_dot(off, off))
    best = np.argmin(squared, axis=0)
    return np.asarray(np.stack(weights)[best, np.arange(len(best))])


def _square(a: Float) -> Float:
    """Squared lengths (n,) to divide by."""
    return np.maximum(_dot(a, a), np.finfo(np.float64).tiny)


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(np.einsum("nc,nc->n", a, b))


def winding_number(vertices: Float, faces: Faces, points: Float) -> NDArray[np.float64]:
    """Winding numbers of a mesh around points (k, 3): solid angle of its back over 4 pi
    (Jacobson et al. 2013).

    1 inside a closed surface, 0 outside. For an open surface, the fraction of
    directions in which its inner side is visible minus that of its outer side, at most
    one half outside the convex hull.
    """
    used = np.asarray(vertices, np.float64)[faces]
    total = []
    for point in np.asarray(points, np.float64).reshape(-1, 3):
        a, b, c = (used[:, i] - point for i in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        # van Oosterom and Strackee 1983
        volume = np.einsum("fi,fi->f", a, np.cross(b, c))
        dots = (np.einsum("fi,fi->f", p, q) for p, q in ((a, b), (b, c), (c, a)))
        ab, bc, ca = dots
        total.append(
            2
            * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum()
            / (4 * np.pi)
        )
    return np.array(total, np.float64)
