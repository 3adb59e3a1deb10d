"""Texture maps of a surface: rasterisation, filling of gaps, sampling."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skindb.geometry._texture_kernels import (
    CORNERS,
    average,
    interpolate,
    pull,
    push,
    rasterise,
)
from skindb.types import Array, Faces, Float64, Index, float64

Image = NDArray[np.float32]


def rasterise_atlas(
    uv: Array, faces: Faces, size: int
) -> tuple[NDArray[np.int32], Image]:
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
    face = np.full((size, size), -1, np.int32)
    weight = np.zeros((size, size, 3), np.float32)
    rasterise(_doubles(uv), _indices(faces), face, weight)
    return face, weight


def atlas_values(
    values: Array,
    trust: Array,
    uv: Array,
    faces: Faces,
    raster: tuple[NDArray[np.int32], Image],
) -> tuple[Image, Image]:
    """Values of the vertices at the texels of a map.

    Values are interpolated linearly at the centre of the texel in triangles larger than
    a texel, and averaged by area over the texel in smaller triangles.

    Parameters
    ----------
    values
        (v, c); values without trust are not used.
    trust
        (v,) in [0, 1]: weights of the corners in a texel.
    uv, faces
        (v, 2) and (f, 3).
    raster
        `rasterise_atlas(uv, faces, size)`.

    Returns
    -------
    image : ndarray
        (size, size, c); 0 where nothing is known.
    confidence : ndarray
        (size, size): mean trust in each texel, 0 outside.
    """
    face, weight = raster
    corner = _indices(faces)
    place = _doubles(uv)
    mixed, trusted = (np.ascontiguousarray(x, np.float32) for x in (values, trust))
    image = np.zeros((*face.shape, values.shape[1]), np.float32)
    confidence: Image = np.zeros(face.shape, np.float32)
    interpolate(face, weight, corner, trusted, mixed, image, confidence)
    tiny = _areas(place, corner) * face.size < 1
    if tiny.any():
        chosen = (face >= 0) & tiny[face]
        memory = np.zeros_like(confidence), *np.empty((2, CORNERS, 2)), np.empty(3)
        average(place, corner, chosen, trusted, mixed, image, confidence, *memory)
    return image, confidence


def _doubles(x: Array) -> Float64:
    """Convert to one type, so that kernels are compiled once."""
    return np.ascontiguousarray(x, np.float64)


def _indices(faces: Faces) -> NDArray[np.int32]:
    return np.ascontiguousarray(faces, np.int32)


def _areas(uv: Array, faces: Faces) -> Image:
    a, b, c = np.asarray(uv, np.float32)[faces.T]
    ab = b - a
    ac = c - a
    return np.asarray(np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]) / 2)


def push_pull(image: Array, confidence: Array) -> tuple[Image, Image]:
    """Fill unknown texels from increasingly coarse averages (Gortler et al. 1996, section 3.5).

    Parameters
    ----------
    image
        (h, w, c), any size; NaN counts as unknown.
    confidence
        (h, w) in [0, 1]: 1 keeps a texel exactly, 0 replaces it, and values between blend.

    Returns
    -------
    image : ndarray
        (h, w, c) filled; NaN only if nothing is known.
    confidence : ndarray
        (h, w): 1 where known; elsewhere that of the average it was filled from, 0 if
        nothing is known.
    """
    filled = np.array(image, np.float32)
    weight = np.nan_to_num(np.clip(np.asarray(confidence, np.float32), 0, 1))
    weight[~np.isfinite(filled).all(axis=-1)] = 0
    if not weight.any():
        return np.full_like(filled, np.nan), weight
    filled[weight == 0] = 0
    levels = [(filled, weight)]
    while max(levels[-1][1].shape) > 1:
        height, width = ((n + 1) // 2 for n in levels[-1][1].shape)
        coarse = (
            np.empty((height, width, filled.shape[2]), np.float32),
            np.empty((height, width), np.float32),
        )
        pull(*levels[-1], *coarse)
        levels.append(coarse)
    for fine, coarse in zip(levels[-2::-1], levels[:0:-1], strict=True):
        push(*fine, *coarse)
    return filled, weight


def bilinear(image: Array, pixels: Array) -> Float64:
    """Interpolate an image bilinearly between its pixel centres.

    Parameters
    ----------
    image
        (h, w, c).
    pixels
        (..., 2) column and row in px; pixel centres at integer + 0.5.

    Returns
    -------
    ndarray
        (..., c); the nearest edge in the outer half pixel; NaN outside the image, at
        NaN pixels, and wherever one of the pixels that take part is NaN.
    """
    values = np.asarray(image)
    height, width = values.shape[:2]
    place = float64(pixels)
    inside = np.asarray(((place >= 0) & (place <= (width, height))).all(axis=-1))
    column, x = _cell(np.where(inside, place[..., 0], 0.5), width)
    row, y = _cell(np.where(inside, place[..., 1], 0.5), height)
    # a neighbour of weight 0 must not spread its NaN: it is replaced by the pixel itself
    right = column + (x > 0)
    below = row + (y > 0)
    x = x[..., None]
    y = y[..., None]
    top = values[row, column] * (1 - x) + values[row, right] * x
    bottom = values[below, column] * (1 - x) + values[below, right] * x
    return np.where(inside[..., None], top * (1 - y) + bottom * y, np.nan)


def _cell(place: Array, size: int) -> tuple[Index, Float64]:
    """Pixel before a position along one axis, and the weight of the pixel after it."""
    centred = np.clip(place - 0.5, 0.0, size - 1.0)
    index = np.minimum(centred.astype(np.int64), size - 1)
    return index, np.asarray(centred - index)
