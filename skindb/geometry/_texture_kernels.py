"""Compiled loops over texels: rasterisation of triangles, interpolation, pull and push."""

from __future__ import annotations

import numpy as np

from skindb.jit import inline_kernel, kernel
from skindb.types import (
    Cube32,
    IntMatrix32,
    IntVector,
    Matrix,
    Matrix32,
    Vector32,
)

EDGE = 1e-9  # texels; a texel centre on an edge belongs to both triangles


@kernel
def rasterise(
    uv: Matrix, faces: IntMatrix32, face: IntMatrix32, weight: Cube32
) -> None:
    """Write the first triangle over each texel centre and the weights of its corners;
    `face` starts as -1.
    """
    size = face.shape[0]
    for f in range(len(faces)):
        # texel centres become integers
        a, b, c = faces[f]
        ax = uv[a, 0] * size - 0.5
        ay = uv[a, 1] * size - 0.5
        bx = uv[b, 0] * size - 0.5
        by = uv[b, 1] * size - 0.5
        cx = uv[c, 0] * size - 0.5
        cy = uv[c, 1] * size - 0.5
        double_area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not (abs(double_area) > 0):
            continue
        left = max(np.ceil(min(ax, bx, cx) - EDGE), 0)
        right = min(np.floor(max(ax, bx, cx) + EDGE), size - 1)
        top = max(np.ceil(min(ay, by, cy) - EDGE), 0)
        bottom = min(np.floor(max(ay, by, cy) + EDGE), size - 1)
        for i in range(int(top), int(bottom) + 1):
            for j in range(int(left), int(right) + 1):
                if face[i, j] >= 0:
                    continue
                u = ((j - ax) * (cy - ay) - (i - ay) * (cx - ax)) / double_area
                v = ((bx - ax) * (i - ay) - (by - ay) * (j - ax)) / double_area
                if min(u, v, 1 - u - v) < -EDGE:
                    continue
                at_a = max(1 - u - v, 0)
                at_b = max(u, 0)
                at_c = max(v, 0)
                total = at_a + at_b + at_c
                face[i, j] = f
                weight[i, j, 0] = at_a / total
                weight[i, j, 1] = at_b / total
                weight[i, j, 2] = at_c / total


@kernel
def interpolate(
    face: IntMatrix32,
    weight: Cube32,
    faces: IntMatrix32,
    trust: Vector32,
    values: Matrix32,
    image: Cube32,
    confidence: Matrix32,
) -> None:
    """Write value and confidence at the texel centres; corners without trust have no weight."""
    mixed = np.empty(values.shape[1])
    for i in range(face.shape[0]):
        for j in range(face.shape[1]):
            f = face[i, j]
            total = 0.0
            mixed[:] = 0
            for k in range(3 if f >= 0 else 0):
                corner = faces[f, k]
                trusted = np.float64(weight[i, j, k]) * trust[corner]
                if trusted > 0:
                    total += trusted
                    for c in range(len(mixed)):
                        mixed[c] += trusted * values[corner, c]
            if total > 0:
                confidence[i, j] = total
                for c in range(len(mixed)):
                    image[i, j, c] = mixed[c] / total


@kernel
def pull(values: Cube32, weight: Matrix32, coarse: Cube32, total: Matrix32) -> None:
    """Halve the size: weighted mean of 2 x 2 texels, and their summed weight up to 1."""
    height, width = weight.shape
    for i in range(total.shape[0]):
        for j in range(total.shape[1]):
            rows = min(2 * i + 2, height)
            columns = min(2 * j + 2, width)
            weights = 0.0
            for y in range(2 * i, rows):
                for x in range(2 * j, columns):
                    weights += weight[y, x]
            total[i, j] = min(weights, 1.0)
            for c in range(values.shape[2]):
                mixed = 0.0
                for y in range(2 * i, rows):
                    for x in range(2 * j, columns):
                        mixed += np.float64(weight[y, x]) * values[y, x, c]
                coarse[i, j, c] = mixed / weights if weights > 0 else 0.0


@kernel
def push(values: Cube32, weight: Matrix32, coarse: Cube32, total: Matrix32) -> None:
    """Blend texels with a weight below 1 with the interpolated coarser level, in place."""
    rows = np.empty(2, np.int64)
    columns = np.empty(2, np.int64)
    for i in range(weight.shape[0]):
        rows[0] = i // 2
        rows[1] = min(max(rows[0] + 2 * (i % 2) - 1, 0), total.shape[0] - 1)
        for j in range(weight.shape[1]):
            if weight[i, j] >= 1:
                continue
            columns[0] = j // 2
            columns[1] = min(max(columns[0] + 2 * (j % 2) - 1, 0), total.shape[1] - 1)
            rest = 1.0 - weight[i, j]
            weight[i, j] += rest * _between(total, rows, columns)
            for c in range(values.shape[2]):
                below = _between(coarse[:, :, c], rows, columns)
                values[i, j, c] = (1.0 - rest) * values[i, j, c] + rest * below


@inline_kernel
def _between(plane: Matrix32, rows: IntVector, columns: IntVector) -> float:
    near = 0.75 * plane[rows[0], columns[0]] + 0.25 * plane[rows[0], columns[1]]
    far = 0.75 * plane[rows[1], columns[0]] + 0.25 * plane[rows[1], columns[1]]
    return 0.75 * near + 0.25 * far
