"""Distortion of the surface by a texture atlas: areas, stretch, triangles turned over."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
Array = NDArray[np.float64]
TRIANGLES_PER_BLOCK = 1 << 17  # takes 50 MB
# relative to the summed products: the sign of a larger difference is correct (Shewchuk
# 1997)
CERTAIN = 3.4e-16


def flipped(uv: Float, faces: Faces) -> NDArray[np.bool_]:
    """Mask (f,) of the triangles that are turned over in the map, v downwards; exact
    for the given coordinates.
    """
    wrong = np.empty(len(faces), bool)
    for start in range(0, len(faces), TRIANGLES_PER_BLOCK):
        part = faces[start : start + TRIANGLES_PER_BLOCK]
        a, b, c = (np.asarray(uv)[part[:, i]].astype(np.float64) for i in range(3))
        first = b - a
        second = c - a
        plus = first[:, 1] * second[:, 0]
        minus = first[:, 0] * second[:, 1]
        wrong[start : start + TRIANGLES_PER_BLOCK] = plus <= minus
        for i in np.flatnonzero(
            np.abs(plus - minus) <= CERTAIN * (np.abs(plus) + np.abs(minus))
        ):
            wrong[start + i] = _turned(a[i], b[i], c[i])
    return wrong


def _turned(*corners: Array) -> bool:
    (ax, ay), (bx, by), (cx, cy) = (
        map(Fraction, corner.tolist()) for corner in corners
    )
    return (by - ay) * (cx - ax) <= (bx - ax) * (cy - ay)


def stretches(vertices: Float, faces: Faces, uv: Float) -> tuple[Array, Array, Array]:
    """Largest and smallest length on the surface of a unit step in the map, and the
    area (Sander et al. 2001).

    Parameters
    ----------
    vertices, faces, uv
        (v, 3) mm, (f, 3), (v, 2).

    Returns
    -------
    largest, smallest, area : ndarray
        (f,) mm, mm and mm2; infinite and 0 where the triangle has no area in the map.
    """
    parts = [
        _stretches(vertices, faces[i : i + TRIANGLES_PER_BLOCK], uv)
        for i in range(0, len(faces), TRIANGLES_PER_BLOCK)
    ]
    largest, smallest, area = (np.concatenate(x) for x in zip(*parts, strict=True))
    return largest, smallest, area


def _stretches(vertices: Float, faces: Faces, uv: Float) -> tuple[Array, Array, Array]:
    p, q, r = (np.asarray(vertices)[faces[:, k]].astype(np.float64) for k in range(3))
    s, t = (np.asarray(uv)[:, axis].astype(np.float64)[faces].T for axis in (0, 1))
    first = q - p
    second = r - p
    area = np.linalg.norm(np.cross(first, second), axis=1) / 2
    double = (s[1] - s[0]) * (t[2] - t[0]) - (t[1] - t[0]) * (s[2] - s[0])
    flat = double == 0
    safe = np.where(flat, 1.0, double)[:, None]
    along_u = (first * (t[2] - t[0])[:, None] - second * (t[1] - t[0])[:, None]) / safe
    along_v = (second * (s[1] - s[0])[:, None] - first * (s[2] - s[0])[:, None]) / safe
    a, b, c = (
        np.einsum("ni,ni->n", x, y)
        for x, y in ((along_u, along_u), (along_u, along_v), (along_v, along_v))
    )
    largest = np.sqrt((a + c + np.hypot(a - c, 2 * b)) / 2)
    # from their product, 2 area / |double|, as their difference would suffer from cancellation
    smallest = 2 * area / np.abs(safe[:, 0]) / np.where(largest > 0, largest, 1.0)
    return (
        np.where(flat, np.inf, largest),
        np.where(flat, 0.0, np.minimum(smallest, largest)),
        area,
    )


def area_log2_sd(largest: Array, smallest: Array, area: Array) -> float:
    """Standard deviation over the surface of log2 of area in the map over area on the surface."""
    used = (area > 0) & (smallest > 0)
    weight = area[used] / area[used].sum()
    ratio = np.log2(largest[used] * smallest[used])
    return float(np.sqrt(weight @ (ratio - weight @ ratio) ** 2))


def symmetric_dirichlet(largest: Array, smallest: Array, area: Array) -> float:
    """Mean over the surface of (a^2 + b^2 + a^-2 + b^-2) / 4, a and b the stretches at
    equal total area; 1 at best.

    The energy of Smith and Schaefer (2015): it weighs uneven areas and stretch against each other.
    """
    used = (area > 0) & (smallest > 0)
    if not used.any():
        return float("inf")
    high = largest[used] ** 2
    low = smallest[used] ** 2
    weight = area[used] / area[used].sum()
    # mm2 of a unit of the map
    scale = area[used].sum() / (area[used] / (largest[used] * smallest[used])).sum()
    return float(weight @ (high / scale + low / scale + scale / high + scale / low) / 4)


def distortion(
    vertices: Float, faces: Faces, uv: Float, member: NDArray[np.bool_]
) -> dict[str, NDArray[Any]]:
    """Distortion of an atlas, for the entire surface and by region.

    Parameters
    ----------
    vertices, faces, uv
        (v, 3) mm, (f, 3), (v, 2), as stored.
    member
        (v, r) vertices of each region; a triangle with all corners in a region belongs to it.

    Returns
    -------
    dict
        (1 + r,) each, the entire surface first: `area_log2_sd`, `anisotropy_median`,
        `anisotropy_p99` (largest over smallest stretch, quantiles over the area), NaN
        where a region has no triangle, and `flips`.
    """
    largest, smallest, area = stretches(vertices, faces, uv)
    wrong = flipped(uv, faces)
    masks = [
        np.ones(len(faces), bool),
        *(column[faces].all(axis=1) for column in member.T),
    ]
    rows = [
        (*_summary(largest[m], smallest[m], area[m]), int(wrong[m].sum()))
        for m in masks
    ]
    names = ("area_log2_sd", "anisotropy_median", "anisotropy_p99", "flips")
    return {
        name: np.array(column)
        for name, column in zip(names, zip(*rows, strict=True), strict=True)
    }


def _summary(
    largest: Array, smallest: Array, area: Array
) -> tuple[float, float, float]:
    used = (area > 0) & (smallest > 0)
    if not used.any():
        return (np.nan,) * 3
    ratio = largest[used] / smallest[used]
    order = np.argsort(ratio)
    share = np.cumsum(area[used][order]) / area[used].sum()
    median, high = (
        ratio[order[min(int(np.searchsorted(share, q)), len(order) - 1)]]
        for q in (0.5, 0.99)
    )
    return area_log2_sd(largest, smallest, area), float(median), float(high)
