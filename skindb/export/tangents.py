"""Tangent frames of a textured mesh as in glTF 2.0, and normals in these frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]


def tangent_frames(
    position: Float, normal: Float, uv: Float, triangles: NDArray[np.integer[Any]]
) -> NDArray[np.float64]:
    """Tangents (n, 4) of vertices: unit vectors in the direction of increasing u, and
    the sign of the bitangent.

    The bitangent is sign * cross(normal, tangent) and points towards the top of the
    texture, where v = 0 (glTF 2.0, section 3.7.2.1). Tangents of triangles are averaged
    with their angles as weights, as in MikkTSpace.

    Parameters
    ----------
    position, normal, uv
        (n, 3), unit vectors (n, 3) and (n, 2) of the vertices; v = 0 is the top row of the texture.
    triangles
        (f, 3) indices of vertices.
    """
    corner = position[triangles].astype(np.float64)
    place = uv[triangles].astype(np.float64)
    edge = corner[:, 1:] - corner[:, :1]
    step = place[:, 1:] - place[:, :1]
    area = step[:, 0, 0] * step[:, 1, 1] - step[:, 1, 0] * step[:, 0, 1]
    regular = np.abs(area) > 1e-20
    scale = np.where(regular, 1 / np.where(regular, area, 1.0), 0.0)[:, None]
    along_u = (edge[:, 0] * step[:, 1, 1:] - edge[:, 1] * step[:, 0, 1:]) * scale
    # towards decreasing v
    up = -(edge[:, 1] * step[:, 0, :1] - edge[:, 0] * step[:, 1, :1]) * scale
    along_u, up = (
        x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)
        for x in (along_u, up)
    )
    sums = np.zeros((2, len(position), 3))
    for k in range(3):
        a, b = (corner[:, (k + i) % 3] - corner[:, k] for i in (1, 2))
        cosine = (a * b).sum(axis=1) / np.maximum(
            np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-30
        )
        angle = np.arccos(np.clip(cosine, -1, 1))[:, None]
        for total, direction in zip(sums, (along_u, up), strict=True):
            np.add.at(total, triangles[:, k], direction * angle)
    tangent = sums[0] - (sums[0] * normal).sum(axis=1, keepdims=True) * normal
    length = np.linalg.norm(tangent, axis=1, keepdims=True)
    tangent = np.where(
        length > 1e-9, tangent / np.maximum(length, 1e-9), _any_perpendicular(normal)
    )
    sign = np.where((np.cross(normal, tangent) * sums[1]).sum(axis=1) < 0, -1.0, 1.0)
    return np.concatenate([tangent, sign[:, None]], axis=1)


def to_tangent_space(
    direction: Float, normal: Float, tangent: Float
) -> NDArray[np.float64]:
    """Coordinates (n, 3) of directions along tangent, bitangent and normal, see
    `tangent_frames`.
    """
    bitangent = np.cross(normal, tangent[:, :3]) * tangent[:, 3:]
    return np.stack(
        [
            (direction * axis).sum(axis=1)
            for axis in (tangent[:, :3], bitangent, normal)
        ],
        axis=1,
    )


def _any_perpendicular(normal: Float) -> NDArray[np.float64]:
    axis = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0, 0]], [[0.0, 1, 0]])
    found = np.cross(normal, axis)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))
