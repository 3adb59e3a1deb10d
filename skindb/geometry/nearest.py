"""Points near a mesh: which point of it is nearest, and whether they lie inside."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]


def closest_on_mesh(
    vertices: Float, faces: Faces, points: Float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Nearest point of a mesh to each of a few points.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3); degenerate triangles count as their sides.
    points
        (k, 3) mm.

    Returns
    -------
    face : ndarray
        (k,) the nearest triangle.
    barycentric : ndarray
        (k, 3) weights of its corners, not negative, sum 1.
    distance : ndarray
        (k,) mm.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    centre = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1, initial=0.0)
    found = []
    for point in np.asarray(points, np.float64).reshape(-1, 3):
        to_centre = np.linalg.norm(centre - point, axis=1)
        near = np.flatnonzero(to_centre - reach <= to_centre.min())  # the others are farther than the nearest centre
        at, weight, gap = _closest(corners[near], point)
        found.append((near[at], weight, gap))
    face, barycentric, distance = zip(*found, strict=True) if found else ((), (), ())
    return np.array(face, np.int64), np.array(barycentric).reshape(-1, 3), np.array(distance, np.float64)


def _closest(corners: Float, point: Float) -> tuple[int, Float, float]:
    """Best of four candidates a triangle: the foot on its plane if that lies inside, and one on each side."""
    weight = np.zeros((4, len(corners), 3))
    weight[0] = _plane_foot(corners, point)
    for i in range(3):
        j = (i + 1) % 3
        side = corners[:, j] - corners[:, i]
        square = np.einsum("fi,fi->f", side, side)
        along = np.einsum("fi,fi->f", point - corners[:, i], side)
        t = np.clip(along / np.where(square > 0, square, np.inf), 0.0, 1.0)
        weight[1 + i, :, i], weight[1 + i, :, j] = 1 - t, t
    offset = np.einsum("cfk,fki->cfi", weight, corners) - point
    square = np.einsum("cfi,cfi->cf", offset, offset)
    square[0][(weight[0] < 0).any(axis=1)] = np.inf
    candidate, face = np.unravel_index(int(square.argmin()), square.shape)
    return int(face), weight[candidate, face], float(np.sqrt(square[candidate, face]))


def _plane_foot(corners: Float, point: Float) -> Float:
    """Barycentric (f, 3) of the foot on each triangle's plane; negative where there is no plane."""
    u, v, w = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], point - corners[:, 0]
    uu, uv, vv = (np.einsum("fi,fi->f", a, b) for a, b in ((u, u), (u, v), (v, v)))
    wu, wv = np.einsum("fi,fi->f", w, u), np.einsum("fi,fi->f", w, v)
    determinant = uu * vv - uv * uv
    safe = np.where(determinant > 1e-20 * uu * vv, determinant, -np.inf)
    b, c = (vv * wu - uv * wv) / safe, (uu * wv - uv * wu) / safe
    return np.where(np.isfinite(safe)[:, None], np.stack([1 - b - c, b, c], axis=1), -1.0)


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
