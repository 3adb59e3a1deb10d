"""Compiled preparation of rays between points; see `skindb.geometry.rays.RayScene.occluded`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from skindb.jit import kernel

Array = NDArray[np.float64]
Single = NDArray[np.float32]


@kernel
def aim(
    origin: Array,
    at: NDArray[np.int64],
    target: Array,
    lift: Array,
    centre: Array,
    offset: float,
    ahead: float,
    short: float,
    start: Single,
    way: Single,
    reach: Single,
) -> None:
    """Write rays from chosen points to targets, computed in double precision.

    Parameters
    ----------
    origin, lift
        (n, 3) mm and directions, or one for all.
    at
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
    for k in range(len(at)):
        i = at[k] if len(origin) > 1 else 0
        up = at[k] if len(lift) > 1 else 0
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
        start[k, 0], start[k, 1], start[k, 2] = (
            x + ahead * dx,
            y + ahead * dy,
            z + ahead * dz,
        )
        way[k, 0], way[k, 1], way[k, 2] = dx, dy, dz
        # Embree marks a hit by a negative length, so that the input must not be negative
        left = length - ahead - short
        reach[k] = 0.0 if left < 0 else left
