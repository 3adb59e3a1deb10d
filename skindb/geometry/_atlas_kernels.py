"""Compiled loops over the texels of maps; see `skindb.geometry.atlas`."""

from __future__ import annotations

import numpy as np

from skindb.jit import kernel
from skindb.types import AnyArray, Cube, Cube32, IntMatrix, Matrix, Vector

EDGE = 1e-9  # texels; a texel centre on an edge belongs to both triangles
TINY = np.finfo(np.float64).tiny


@kernel
def rasterise(
    corner: Cube,
    double_area: Vector,
    low: IntMatrix,
    sides: IntMatrix,
    face: AnyArray,
    weight: AnyArray,
) -> None:
    """Write the triangle at every texel centre, and the weights of its corners.

    Parameters
    ----------
    corner
        (f, 3, 2) column and row of the corners, relative to `low`.
    double_area
        (f,) twice the signed areas.
    low, sides
        (f, 2) column and row of the first texel of a triangle, and numbers of both.
    face, weight
        (size, size) and (size, size, 3) output.
    """
    share = np.empty(3)
    # a texel under several triangles is written last by the first one
    for k in range(len(low) - 1, -1, -1):
        for row, column in np.ndindex((sides[k, 1], sides[k, 0])):
            for c in range(3):
                x, y = corner[k, c - 2]
                before = corner[k, c - 1]
                area = (y - row) * (before[0] - column)
                area -= (x - column) * (before[1] - row)
                share[c] = area / double_area[k]
            if min(share[0], share[1], share[2]) >= -EDGE:
                face[low[k, 1] + row, low[k, 0] + column] = k
                for c in range(3):
                    weight[low[k, 1] + row, low[k, 0] + column, c] = max(share[c], 0.0)


@kernel
def interpolate(
    values: Matrix,
    trust: Vector,
    faces: AnyArray,
    face: AnyArray,
    weight: AnyArray,
    image: AnyArray,
    confidence: AnyArray,
) -> None:
    """Write the weighted means of the values of the corners, and of their trust.

    Parameters
    ----------
    values, trust
        (v, c) finite values and (v,) weights of the vertices.
    faces
        (f, 3).
    face, weight
        As `rasterise` writes them.
    image, confidence
        (size, size, c) and (size, size) output.
    """
    share = np.empty(3)
    for y, x in np.ndindex(face.shape):
        corners = faces[face[y, x]]  # of any triangle outside, where all weights are 0
        total = 0.0
        for k in range(3):
            share[k] = np.float64(weight[y, x, k]) * trust[corners[k]]
            total += share[k]
        confidence[y, x] = total
        for c in range(values.shape[1]):
            mixed = 0.0
            for k in range(3):
                mixed += share[k] * values[corners[k], c]
            image[y, x, c] = mixed / max(total, TINY)


@kernel
def pulled(values: Cube32, weight: Matrix) -> tuple[Cube, Matrix]:
    """Sums over 2 x 2 texels, fewer at an odd border, of weighted values and of weights.

    Values (h, w, c) are not used where the weight (h, w) is 0.
    """
    height, width, channels = values.shape
    sums = np.zeros(((height + 1) // 2, (width + 1) // 2, channels))
    total = np.zeros(sums.shape[:2])
    for y, x in np.ndindex(weight.shape):
        if weight[y, x] > 0:
            total[y // 2, x // 2] += weight[y, x]
            for c in range(channels):
                sums[y // 2, x // 2, c] += weight[y, x] * values[y, x, c]
    return sums, total


@kernel
def pushed(coarse: Cube32, values: Cube32, weight: Matrix) -> Cube32:
    """Values (h, w, c), blended by their weights (h, w) with those of a coarser level, which
    has another texel on every side.
    """
    out = np.empty_like(values)
    for y, x in np.ndindex(weight.shape):
        row = y // 2 + y % 2 * 2
        column = x // 2 + x % 2 * 2
        for c in range(values.shape[2]):
            near = 0.75 * coarse[y // 2 + 1, x // 2 + 1, c]
            near += 0.25 * coarse[row, x // 2 + 1, c]
            far = 0.75 * coarse[y // 2 + 1, column, c] + 0.25 * coarse[row, column, c]
            mixed = 0.75 * near + 0.25 * far
            if weight[y, x] > 0:
                mixed += weight[y, x] * (values[y, x, c] - mixed)
            out[y, x, c] = mixed
    return out
