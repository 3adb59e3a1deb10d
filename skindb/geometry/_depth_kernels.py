"""Compiled check of the pixels around a projected point; see
`skindb.ingest.visibility.camera_visibility`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from skindb.jit import kernel

Array = NDArray[np.float64]
Single = NDArray[np.float32]


@kernel
def matches_tangent_plane(
    points: Array,
    normals: Array,
    pixels: Array,
    chosen: NDArray[np.int64],
    centre: Array,
    rays: Single,
    distance: Single,
    reach: float,
    slack: float,
    longest: float,
) -> NDArray[np.bool_]:
    """Whether the pixels around each chosen point show the surface that its tangent plane predicts.

    Parameters
    ----------
    points, normals, pixels
        (n, 3) mm, (n, 3) and (n, 2) px.
    chosen
        (m,) indices of the points.
    centre
        (3,) mm of the camera.
    rays, distance
        (h, w, 3) unit vectors and (h, w) mm to what is seen along them; infinity for nothing.
    reach
        px; distance within which pixel centres are checked.
    slack
        mm; allowed difference from the predicted depth, in addition to the slope.
    longest
        Change of depth per distance of the point beyond which the pixel shows another surface.

    Returns
    -------
    ndarray
        (m,) bool.
    """
    height, width = distance.shape
    out = np.ones(len(chosen), np.bool_)
    span = math.ceil(reach)
    for k in range(len(chosen)):
        i = chosen[k]
        x = points[i, 0] - centre[0]
        y = points[i, 1] - centre[1]
        z = points[i, 2] - centre[2]
        nx, ny, nz = normals[i]
        own = math.sqrt(x * x + y * y + z * z)
        level = x * nx + y * ny + z * nz
        column0 = math.floor(pixels[i, 0] - 0.5)
        row0 = math.floor(pixels[i, 1] - 0.5)
        for row in range(max(row0 - span + 1, 0), min(row0 + span + 1, height)):
            for column in range(
                max(column0 - span + 1, 0), min(column0 + span + 1, width)
            ):
                dx = column + 0.5 - pixels[i, 0]
                dy = row + 0.5 - pixels[i, 1]
                if dx * dx + dy * dy > reach * reach:
                    continue
                facing = (
                    rays[row, column, 0] * nx
                    + rays[row, column, 1] * ny
                    + rays[row, column, 2] * nz
                )
                foretold = level / facing if facing != 0 else math.inf
                found = distance[row, column]
                smooth = abs(found - foretold) <= slack + abs(foretold - own)
                # also rejects NaN and infinity
                if not (smooth and abs(found - own) <= slack + longest * own):
                    out[k] = False
    return out
