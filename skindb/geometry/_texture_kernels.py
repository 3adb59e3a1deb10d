"""Compiled loops over texels: rasterisation of triangles, means over texels, pull and push."""

from __future__ import annotations

import numpy as np

from skindb.jit import inline_kernel, kernel
from skindb.types import (
    BoolMatrix,
    Cube32,
    IntMatrix32,
    IntVector,
    IntVector32,
    Matrix,
    Matrix32,
    Vector,
    Vector32,
)

EDGE = 1e-9  # texels; a texel centre on an edge belongs to both triangles
# of a triangle clipped by four lines: at most 7, plus a margin for rounding
CORNERS = 9


@inline_kernel
def _corners(
    uv: Matrix, face: IntVector32, size: int, offset: float
) -> tuple[float, float, float, float, float, float]:
    """Corners of a triangle in texels, minus an offset."""
    a, b, c = face
    return (
        uv[a, 0] * size - offset,
        uv[a, 1] * size - offset,
        uv[b, 0] * size - offset,
        uv[b, 1] * size - offset,
        uv[c, 0] * size - offset,
        uv[c, 1] * size - offset,
    )


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
        ax, ay, bx, by, cx, cy = _corners(uv, faces[f], size, 0.5)
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
def average(
    uv: Matrix,
    faces: IntMatrix32,
    chosen: BoolMatrix,
    trust: Vector32,
    values: Matrix32,
    image: Cube32,
    confidence: Matrix32,
    covered: Matrix32,
    polygon: Matrix,
    clipped: Matrix,
    part: Vector,
) -> None:
    """Replace the chosen texels by the mean over their covered area, weighted by trust;
    exact for linear values.

    `covered` (size, size) starts as 0; `polygon` and `clipped` (CORNERS, 2) and `part`
    (3,) are buffers.
    """
    size = chosen.shape[0]
    for i in range(size):
        for j in range(size):
            if chosen[i, j]:
                confidence[i, j] = 0
                for channel in range(values.shape[1]):
                    image[i, j, channel] = 0
    for f in range(len(faces)):
        ax, ay, bx, by, cx, cy = _corners(uv, faces[f], size, 0.0)
        double_area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not (abs(double_area) > 0):
            continue
        left = max(np.floor(min(ax, bx, cx)), 0)
        right = min(np.floor(max(ax, bx, cx)), size - 1)
        top = max(np.floor(min(ay, by, cy)), 0)
        bottom = min(np.floor(max(ay, by, cy)), size - 1)
        for i in range(int(top), int(bottom) + 1):
            for j in range(int(left), int(right) + 1):
                if not chosen[i, j]:
                    continue
                polygon[0, 0], polygon[0, 1] = ax, ay
                polygon[1, 0], polygon[1, 1] = bx, by
                polygon[2, 0], polygon[2, 1] = cx, cy
                _corner_areas(polygon, clipped, i, j, double_area, part)
                covered[i, j] += part[0] + part[1] + part[2]
                for k in range(3):
                    corner = faces[f, k]
                    trusted = part[k] * trust[corner]
                    if trusted > 0:
                        confidence[i, j] += trusted
                        for channel in range(values.shape[1]):
                            image[i, j, channel] += trusted * values[corner, channel]
    for i in range(size):
        for j in range(size):
            if chosen[i, j] and confidence[i, j] > 0:
                for channel in range(values.shape[1]):
                    image[i, j, channel] /= confidence[i, j]
                confidence[i, j] = min(confidence[i, j] / covered[i, j], 1)


@kernel
def _corner_areas(
    polygon: Matrix,
    clipped: Matrix,
    i: int,
    j: int,
    double_area: float,
    part: Vector,
) -> None:
    """Write area times mean weight of each corner over the part of a triangle in texel (i, j).

    `polygon` holds the corners; it and `clipped` are overwritten.
    """
    ax, ay = polygon[0, 0], polygon[0, 1]
    bx, by = polygon[1, 0], polygon[1, 1]
    cx, cy = polygon[2, 0], polygon[2, 1]
    n = 3
    for side in range(4):  # left, right, top, bottom
        line = (i if side // 2 else j) + side % 2
        sign = 1.0 - 2.0 * (side % 2)
        n = _clip(polygon, clipped, n, side // 2, line, sign)
        polygon, clipped = clipped, polygon
    for k in range(3):
        part[k] = 0.0
    # a fan of triangles: area of each times the weights of the corners at its centroid
    for k in range(1, n - 1):
        px = polygon[k, 0] - polygon[0, 0]
        py = polygon[k, 1] - polygon[0, 1]
        qx = polygon[k + 1, 0] - polygon[0, 0]
        qy = polygon[k + 1, 1] - polygon[0, 1]
        area = abs(px * qy - py * qx) / 2
        x = polygon[0, 0] + (px + qx) / 3 - ax
        y = polygon[0, 1] + (py + qy) / 3 - ay
        u = min(max((x * (cy - ay) - y * (cx - ax)) / double_area, 0), 1)
        v = min(max(((bx - ax) * y - (by - ay) * x) / double_area, 0), 1 - u)
        part[0] += area * (1 - u - v)
        part[1] += area * u
        part[2] += area * v


@kernel
def _clip(
    polygon: Matrix, out: Matrix, n: int, axis: int, line: float, sign: float
) -> int:
    """Corners of the part of a convex polygon where sign * (x[axis] - line) >= 0
    (Sutherland and Hodgman 1974).
    """
    m = 0
    for k in range(n):
        after = k + 1 if k + 1 < n else 0
        start = sign * (polygon[k, axis] - line)
        end = sign * (polygon[after, axis] - line)
        if start >= 0:
            out[m, 0] = polygon[k, 0]
            out[m, 1] = polygon[k, 1]
            m += 1
        if (start > 0 and end < 0) or (start < 0 and end > 0):
            t = start / (start - end)
            out[m, 0] = polygon[k, 0] + t * (polygon[after, 0] - polygon[k, 0])
            out[m, 1] = polygon[k, 1] + t * (polygon[after, 1] - polygon[k, 1])
            out[m, axis] = line
            m += 1
    return m


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
