"""Texture maps of a surface: which triangle covers each texel, filling of gaps, sampling."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
BLOCK = 1 << 22  # candidate texels at a time: 200 MB
EDGE = 1e-9  # a texel centre on an edge belongs to both triangles


def rasterise_atlas(uv: Float, faces: Faces, size: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Triangle and position at every texel centre of a square map.

    Parameters
    ----------
    uv
        (v, 2), u first; texel (i, j) has its centre at v = (i + 0.5)/size, u = (j + 0.5)/size.
    faces
        (f, 3), of either orientation.
    size
        Texels along each side.

    Returns
    -------
    face : ndarray
        (size, size) index of the triangle, the lowest where several cover the centre; -1 outside.
    barycentric : ndarray
        (size, size, 3) weights of its corners; 0 outside.
    """
    corners = np.asarray(uv, np.float64)[faces] * size - 0.5  # texel centres become integers
    low = np.maximum(np.ceil(corners.min(axis=1) - EDGE), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=1) + EDGE), size - 1).astype(np.int64)
    extent = np.maximum(high - low + 1, 0)
    count = extent.prod(axis=1)
    face = np.full(size * size, -1, np.int32)
    weight = np.zeros((size * size, 3), np.float32)
    for part in _blocks(count):
        _rasterise(part, corners, low, extent, count, size, face, weight)
    return face.reshape(size, size), weight.reshape(size, size, 3)


def _blocks(count: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Runs of triangles with about BLOCK candidate texels each."""
    block = np.cumsum(count) // BLOCK
    return [part for part in np.split(np.arange(len(count)), np.flatnonzero(np.diff(block)) + 1) if len(part)]


def _rasterise(
    part: NDArray[np.int64],
    corners: Float,
    low: NDArray[np.int64],
    extent: NDArray[np.int64],
    count: NDArray[np.int64],
    size: int,
    face: NDArray[np.int32],
    weight: NDArray[np.float32],
) -> None:
    """Test the texels in the boxes of some triangles, all at once, and write those inside."""
    owner = np.repeat(part, count[part])
    within = np.arange(len(owner)) - np.repeat(np.cumsum(count[part]) - count[part], count[part])
    column = low[owner, 0] + within % np.maximum(extent[owner, 0], 1)
    row = low[owner, 1] + within // np.maximum(extent[owner, 0], 1)
    a, b, c = (corners[owner, k] for k in range(3))
    first, second = b - a, c - a
    p = np.stack([column, row], axis=1) - a
    double_area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    safe = np.where(double_area == 0, np.inf, double_area)
    u = (p[:, 0] * second[:, 1] - p[:, 1] * second[:, 0]) / safe
    v = (first[:, 0] * p[:, 1] - first[:, 1] * p[:, 0]) / safe
    bary = np.stack([1 - u - v, u, v], axis=1)
    texel = row * size + column
    inside = np.flatnonzero((bary >= -EDGE).all(axis=1) & (double_area != 0) & (face[texel] < 0))
    # backwards, so that of several triangles at one texel the lowest is written last
    inside = inside[::-1]
    face[texel[inside]] = owner[inside]
    clipped = np.maximum(bary[inside], 0)
    weight[texel[inside]] = clipped / clipped.sum(axis=1, keepdims=True)


def push_pull(image: Float, confidence: Float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fill what is unknown from coarser and coarser averages (Gortler et al. 1996, section 3.5).

    Parameters
    ----------
    image
        (h, w, c), any size; NaN counts as unknown.
    confidence
        (h, w) in [0, 1]: 1 keeps a texel exactly, 0 replaces it, between blends.

    Returns
    -------
    image : ndarray
        (h, w, c) filled; NaN only if nothing is known.
    confidence : ndarray
        (h, w): 1 where known; elsewhere that of the average it was filled from, 0 if nothing is known.
    """
    values = np.asarray(image, np.float64)
    known = np.where(np.isfinite(values).all(axis=-1), np.clip(np.asarray(confidence, np.float64), 0.0, 1.0), 0.0)
    known = np.nan_to_num(known)
    if not known.any():
        return np.full(values.shape, np.nan), known
    levels = [(np.where(known[..., None] > 0, values, 0.0), known)]
    while max(levels[-1][0].shape[:2]) > 1:
        levels.append(_pull(*levels[-1]))
    filled, sure = levels.pop()
    while levels:
        fine, weight = levels.pop()
        below = _enlarge(np.concatenate([filled, sure[..., None]], axis=-1), fine.shape[:2])
        rest = (1 - weight)[..., None]
        filled = weight[..., None] * fine + rest * below[..., :-1]
        sure = weight + rest[..., 0] * below[..., -1]
    return filled, sure


def _pull(values: NDArray[np.float64], weight: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Half the size: mean of 2 x 2 texels by confidence, and their summed confidence up to 1."""
    h, w = weight.shape
    pad = ((0, h % 2), (0, w % 2))
    weight = np.pad(weight, pad)
    values = np.pad(values, (*pad, (0, 0)))
    total = _sum_2x2(weight[..., None])
    mean = _sum_2x2(values * weight[..., None]) / np.where(total > 0, total, 1.0)
    return mean, np.minimum(total[..., 0], 1.0)


def _sum_2x2(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(x[0::2, 0::2] + x[1::2, 0::2] + x[0::2, 1::2] + x[1::2, 1::2])


def _enlarge(x: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Twice the size, (h, w) of `shape`, linear between the centres of the coarse texels."""
    for axis in (0, 1):
        before = np.maximum(np.arange(x.shape[axis]) - 1, 0)
        after = np.minimum(np.arange(x.shape[axis]) + 1, x.shape[axis] - 1)
        even = 0.75 * x + 0.25 * np.take(x, before, axis)
        odd = 0.75 * x + 0.25 * np.take(x, after, axis)
        both = np.stack([even, odd], axis=axis + 1)
        merged = both.reshape(*x.shape[:axis], -1, *x.shape[axis + 1 :])
        x = np.take(merged, np.arange(shape[axis]), axis)
    return x


def bilinear(image: Float, pixels: Float) -> NDArray[np.float64]:
    """Values of an image between its pixel centres.

    Parameters
    ----------
    image
        (h, w, c).
    pixels
        (..., 2) column and row in px; pixel centres at integer + 0.5.

    Returns
    -------
    ndarray
        (..., c); the nearest edge in the outer half pixel; NaN outside the image, at NaN pixels, and wherever one of
        the pixels that take part is NaN.
    """
    values = np.asarray(image)
    height, width = values.shape[:2]
    place = np.asarray(pixels, np.float64)
    inside = np.asarray(((place >= 0) & (place <= (width, height))).all(axis=-1))
    column, x = _cell(np.where(inside, place[..., 0], 0.5), width)
    row, y = _cell(np.where(inside, place[..., 1], 0.5), height)
    # a neighbour of weight 0 must not spread its NaN: it is replaced by the pixel itself
    right, below = column + (x > 0), row + (y > 0)
    x, y = x[..., None], y[..., None]
    top = values[row, column] * (1 - x) + values[row, right] * x
    bottom = values[below, column] * (1 - x) + values[below, right] * x
    return np.asarray(np.where(inside[..., None], top * (1 - y) + bottom * y, np.nan))


def _cell(place: Float, size: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Pixel before a place along one axis, and the share of the pixel after it."""
    centred = np.clip(place - 0.5, 0.0, size - 1.0)
    index = np.minimum(centred.astype(np.int64), size - 1)
    return index, np.asarray(centred - index)
