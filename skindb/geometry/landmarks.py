"""Named points of a surface: where they lie on it, and the mean shape of many of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
BLOCK = 1 << 10  # points at a time: each may have a hundred triangles near it
ROUNDS = 100  # of the mean shape; a face needs about 5
SETTLED = 1e-12  # change of the mean shape over its size


def nearest_on_mesh(
    points: Float, vertices: Float, faces: Faces
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """The nearest point of a mesh, exactly.

    Parameters
    ----------
    points
        (n, 3) mm, finite.
    vertices, faces
        (v, 3) mm and (f, 3).

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


def similarity(source: Float, target: Float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The turn and scale (2, 2) and shift (2,) that bring source nearest to target, never mirrored (Umeyama 1991).

    Parameters
    ----------
    source, target
        (k, 2), k > 0; a single point, or points that coincide, are only shifted.

    Returns
    -------
    matrix, shift : ndarray
        `source @ matrix + shift` is near target.
    """
    x, y = np.asarray(source, np.float64), np.asarray(target, np.float64)
    a, b = x - x.mean(axis=0), y - y.mean(axis=0)
    # the plane as complex numbers: a similarity is one factor, found by least squares
    za, zb = a[:, 0] + 1j * a[:, 1], b[:, 0] + 1j * b[:, 1]
    length = float((abs(za) ** 2).sum())
    factor = (za.conj() * zb).sum() / length if length > 0 else 1.0 + 0j
    if abs(factor) == 0:
        factor = 1.0 + 0j
    matrix = np.array([[factor.real, factor.imag], [-factor.imag, factor.real]])
    return matrix, y.mean(axis=0) - x.mean(axis=0) @ matrix


def mean_shape(shapes: Float) -> NDArray[np.float64]:
    """Mean of shapes after turn, scale and shift are taken out (Gower 1975), in the mean pose of the shapes.

    Parameters
    ----------
    shapes
        (t, k, 2); NaN where a shape lacks a point.

    Returns
    -------
    ndarray
        (k, 2); NaN for a point no shape has.
    """
    all_of = np.asarray(shapes, np.float64)
    pose = mean = _known_mean(all_of)
    size = float(np.nanmax(np.abs(pose - np.nanmean(pose, axis=0)), initial=0.0))
    for _ in range(ROUNDS):
        before = mean
        mean = _onto(_known_mean(np.stack([_onto(shape, before) for shape in all_of])), pose)
        if not np.nanmax(np.abs(mean - before), initial=0.0) > SETTLED * size:
            break
    return mean


def _onto(shape: Float, target: Float) -> NDArray[np.float64]:
    known = np.isfinite(shape).all(axis=1) & np.isfinite(target).all(axis=1)
    if not known.any():
        return np.asarray(shape, np.float64)
    matrix, shift = similarity(shape[known], target[known])
    return np.asarray(shape @ matrix + shift)


def _known_mean(shapes: Float) -> NDArray[np.float64]:
    known = np.isfinite(shapes).all(axis=2, keepdims=True)
    total, count = np.where(known, shapes, 0.0).sum(axis=0), known.sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))
