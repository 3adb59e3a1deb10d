"""Compiled preparation of rays between points (`skindb.geometry.rays.RayScene.occluded`),
and check of the pixels around a projected point (`skindb.ingest.surfels`).
"""

from __future__ import annotations

import math

import numpy as np

from skindb.jit import kernel
from skindb.types import (
    BoolVector,
    Cube32,
    IntVector,
    Matrix,
    Matrix32,
    Vector,
    Vector32,
)


@kernel
def aim(
    origin: Matrix,
    chosen: IntVector,
    target: Matrix,
    lift: Matrix,
    centre: Vector,
    offset: float,
    ahead: float,
    short: float,
    start: Matrix32,
    way: Matrix32,
    reach: Vector32,
) -> None:
    """Write rays from chosen points to targets, computed in double precision.

    Parameters
    ----------
    origin, lift
        (n, 3) mm and directions, or one for all.
    chosen
        (m,) indices of the points.
    target
        (m, 3) mm, or one for all.
    centre
        (3,) mm; origin of the coordinates of the rays.
    offset, ahead, short
        mm; a ray starts `offset` along the lift and `ahead` along itself, and ends
        `short` before the target.
    start, way, reach
        (m, 3) mm, unit directions and (m,) mm, output; reach is at least 0, and not
        finite if a point is not.
    """
    for k in range(len(chosen)):
        i = chosen[k] if len(origin) > 1 else 0
        up = chosen[k] if len(lift) > 1 else 0
        to = k if len(target) > 1 else 0
        x = origin[i, 0] - centre[0] + offset * lift[up, 0]
        y = origin[i, 1] - centre[1] + offset * lift[up, 1]
        z = origin[i, 2] - centre[2] + offset * lift[up, 2]
        dx = target[to, 0] - centre[0] - x
        dy = target[to, 1] - centre[1] - y
        dz = target[to, 2] - centre[2] - z
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        dx = dx / length
        dy = dy / length
        dz = dz / length
        start[k, 0] = x + ahead * dx
        start[k, 1] = y + ahead * dy
        start[k, 2] = z + ahead * dz
        way[k, 0], way[k, 1], way[k, 2] = dx, dy, dz
        # Embree marks a hit by a negative length, so that the input must not be negative
        remaining = length - ahead - short
        reach[k] = 0.0 if remaining < 0 else remaining


@kernel
def matches_tangent_plane(
    points: Matrix,
    normals: Matrix,
    pixels: Matrix,
    chosen: IntVector,
    centre: Vector,
    rays: Cube32,
    distance: Matrix32,
    reach: float,
    slack: float,
    max_slope: float,
) -> BoolVector:
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
    max_slope
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
        depth = math.sqrt(x * x + y * y + z * z)
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
                expected = level / facing if facing != 0 else math.inf
                measured = distance[row, column]
                smooth = abs(measured - expected) <= slack + abs(expected - depth)
                # also rejects NaN and infinity
                if not (smooth and abs(measured - depth) <= slack + max_slope * depth):
                    out[k] = False
    return out
