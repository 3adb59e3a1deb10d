"""Filling holes of a mesh with the triangulation of least area."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
Index = NDArray[np.int64]
# height over longest side: 4 um on a scan, a tenth of its noise; valid scans have 1e-2
MIN_HEIGHT_RATIO = 1e-3
MIN_FILL_HEIGHT_RATIO = 1e-4  # of a triangle that closes a slit, which may be thinner


def sliver_mask(
    vertices: Float, faces: NDArray[np.integer[Any]], thinnest: float = MIN_HEIGHT_RATIO
) -> NDArray[np.bool_]:
    """Mask (f,) of triangles with a height below `thinnest` of their longest side, or
    with coinciding corners.
    """
    p = np.asarray(vertices, np.float64)[faces]
    sides = p - np.roll(p, -1, axis=1)
    longest = np.einsum("fki,fki->fk", sides, sides).max(axis=1, initial=0.0)
    double_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return np.asarray(double_area <= thinnest * longest)


def fill_hole(
    vertices: Float, loop: Index, taken: set[tuple[int, int]]
) -> Index | None:
    """Triangles that close a boundary loop (Barequet and Sharir 1995, weight: area).

    Parameters
    ----------
    vertices
        (v, 3) mm.
    loop
        (n,) vertices along the faces of the mesh (as `boundary_loops` returns).
    taken
        Edges (lower, higher) of the mesh, which no new diagonal may repeat.

    Returns
    -------
    ndarray or None
        (n - 2, 3) wound like the mesh; None where every triangulation has a sliver or
        repeats an edge.
    """
    # the mesh follows the loop, so that the patch follows its reverse
    ring = loop[::-1]
    n = len(ring)
    p = np.asarray(vertices, np.float64)[ring]
    cost = np.full((n, n), np.inf)
    split = np.zeros((n, n), np.int64)
    cost[np.arange(n - 1), np.arange(1, n)] = 0.0
    for span in range(2, n):
        for i in range(n - span):
            k = i + span
            if span < n - 1 and (min(ring[i], ring[k]), max(ring[i], ring[k])) in taken:
                continue
            middle = np.arange(i + 1, k)
            corners = np.stack(
                [np.full(len(middle), i), middle, np.full(len(middle), k)], axis=1
            )
            area = np.linalg.norm(np.cross(p[middle] - p[i], p[k] - p[i]), axis=1)
            total = (
                cost[i, middle]
                + cost[middle, k]
                + np.where(sliver_mask(p, corners, MIN_FILL_HEIGHT_RATIO), np.inf, area)
            )
            split[i, k] = middle[total.argmin()]
            cost[i, k] = total.min()
    if not np.isfinite(cost[0, n - 1]):
        return None
    triangles = []
    todo = [(0, n - 1)]
    while todo:
        i, k = todo.pop()
        if k - i > 1:
            j = int(split[i, k])
            triangles.append((ring[i], ring[j], ring[k]))
            todo += [(i, j), (j, k)]
    return np.array(triangles, np.int64)
