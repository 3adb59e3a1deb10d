"""Points near a mesh: which point of it is nearest, and whether they lie inside."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
BLOCK = 1 << 10  # points at a time: each may have a hundred triangles near it


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
    p, triangles = np.asarray(points, np.float64).reshape(-1, 3), np.asarray(vertices, np.float64)[faces]
    middle = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - middle[:, None], axis=2).max()
    # no triangle is farther than its middle, none nearer than its middle less its reach
    used = np.zeros(len(vertices), np.bool_)
    used[faces] = True
    near = cKDTree(np.asarray(vertices, np.float64)[used]).query(p)[0] + reach
    candidates = cKDTree(middle).query_ball_point(p, near * (1 + 1e-12))
    face, corner = np.empty(len(p), np.int64), np.empty((len(p), 3))
    for start in range(0, len(p), BLOCK):
        own = candidates[start : start + BLOCK]
        row = np.repeat(np.arange(start, start + len(own)), [len(one) for one in own])
        at = np.concatenate(own).astype(np.int64)
        weight = _closest(p[row], triangles[at])
        away = np.linalg.norm(np.einsum("nk,nkc->nc", weight, triangles[at]) - p[row], axis=1)
        order = np.lexsort((away, row))
        best = order[np.searchsorted(row, np.arange(start, start + len(own)))]
        face[start : start + BLOCK], corner[start : start + BLOCK] = at[best], weight[best]
    found = np.einsum("nk,nkc->nc", corner, triangles[face])
    return face, corner, np.linalg.norm(found - p, axis=1)


def _closest(point: Float, triangles: Float) -> Float:
    """Barycentric (n, 3) of the point of each triangle (n, 3, 3) nearest to a point (n, 3): inside, or on an edge."""
    a = triangles[:, 0]
    first, second, away = triangles[:, 1] - a, triangles[:, 2] - a, point - a
    gram = np.stack([_dot(first, first), _dot(first, second), _dot(second, second)])
    d1, d2 = _dot(first, away), _dot(second, away)
    determinant = gram[0] * gram[2] - gram[1] ** 2
    safe = np.where(determinant > 0, determinant, np.inf)  # no area: an edge is nearest
    u, v = (gram[2] * d1 - gram[1] * d2) / safe, (gram[0] * d2 - gram[1] * d1) / safe
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (determinant > 0)
    weights, squared = [np.stack([1 - u - v, u, v], axis=1)], []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, edge = triangles[:, i], triangles[:, j] - triangles[:, i]
        length = np.maximum(_dot(edge, edge), np.finfo(np.float64).tiny)
        t = np.clip(_dot(point - start, edge) / length, 0.0, 1.0)
        weight = np.zeros((len(t), 3))
        weight[:, i], weight[:, j] = 1 - t, t
        weights.append(weight)
        off = start + t[:, None] * edge - point
        squared.append(_dot(off, off))
    best = np.where(inside, 0, 1 + np.argmin(squared, axis=0))
    return np.asarray(np.stack(weights)[best, np.arange(len(best))])


def _dot(a: Float, b: Float) -> Float:
    return np.asarray(np.einsum("nc,nc->n", a, b))


def winding_number(vertices: Float, faces: Faces, points: Float) -> NDArray[np.float64]:
    """How often a mesh winds round points (k, 3): the solid angle of its back over 4 pi (Jacobson et al. 2013).

    1 inside a closed surface, 0 outside; within an open one the share of directions in which its inner side is seen,
    less those of its outer side. At most half outside the convex hull.
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
        total.append(2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (4 * np.pi))
    return np.array(total, np.float64)
