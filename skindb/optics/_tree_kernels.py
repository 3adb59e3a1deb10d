"""Compiled octree of irradiance points; see `skindb.optics.dipole_tree`.

Rows are numbered with the points first and then the nodes, so that a sum over nodes and
points is one list of rows.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from skindb.jit import fast_kernel, inline_fast_kernel, kernel

MAX_DEPTH = 10  # levels of the octree, with three bits of the Morton code each
# rows evaluated at a time, so that the list and its profiles stay in the first-level
# cache
ROWS_PER_SUM = 1024
LIGHTS_IN_REGISTERS = 8  # lights whose sums stay in registers


@kernel
def build(code: Any, points: Any, area: Any, leaf: int) -> Any:
    """Nodes over points sorted by Morton code, which makes every node a contiguous range of points.

    Returns first, last, child, children, box, centre (area-weighted) and node area;
    children come after their parents.
    """
    most = 2 * len(code) + 16
    first = np.zeros(most, np.int64)
    last = np.zeros(most, np.int64)
    child = np.full(most, -1, np.int64)
    children = np.zeros(most, np.int64)
    level = np.zeros(most, np.int64)
    centre = np.zeros((most, 3))
    box = np.zeros((most, 6))
    node_area = np.zeros(most)
    count, last[0], i = 1, len(code), 0
    while i < count:
        box[i, :3], box[i, 3:] = np.inf, -np.inf
        total = 0.0
        for j in range(first[i], last[i]):
            w = area[j] + 1e-300
            total += w
            node_area[i] += area[j]
            for a in range(3):
                centre[i, a] += w * points[j, a]
                box[i, a], box[i, a + 3] = (
                    min(box[i, a], points[j, a]),
                    max(box[i, a + 3], points[j, a]),
                )
        for a in range(3):
            centre[i, a] /= total
        if last[i] - first[i] > leaf and level[i] < MAX_DEPTH:
            shift = 3 * (MAX_DEPTH - 1 - level[i])
            start = first[i]
            child[i] = count
            while start < last[i]:
                digit = (code[start] >> shift) & 7
                stop = start
                while stop < last[i] and ((code[stop] >> shift) & 7) == digit:
                    stop += 1
                first[count], last[count], level[count] = start, stop, level[i] + 1
                count = count + 1
                start = stop
            children[i] = count - child[i]
        i += 1
    stretch = (first[:count], last[:count])
    family = (child[:count], children[:count])
    return *stretch, *family, box[:count], centre[:count], node_area[:count]


@kernel
def sum_nodes(
    power: Any, points: int, first: Any, last: Any, child: Any, children: Any
) -> None:
    """Fill the rows of the nodes of power (groups, rows, LIGHTS_IN_REGISTERS) from the
    rows of the points.
    """
    for g in range(power.shape[0]):
        for v in range(len(first) - 1, -1, -1):  # children before their parents
            low = first[v]
            high = last[v]
            if child[v] >= 0:
                low = points + child[v]
                high = points + child[v] + children[v]
            for c in range(LIGHTS_IN_REGISTERS):
                total = 0.0
                for j in range(low, high):
                    total += power[g, j, c]
                power[g, points + v, c] = total


@inline_fast_kernel
def _decay(x: float) -> float:
    """exp(-x) for x >= 0 without a function call, so that loops are vectorised;
    relative error below 1e-6.

    Taylor polynomial of degree seven in x / 64, then six squarings; constant above 24 (4e-11).
    """
    t = -min(x, 24.0) * 0.015625
    e = 1.0 + t * (
        1.0
        + t
        * (
            0.5
            + t
            * (1 / 6 + t * (1 / 24 + t * (1 / 120 + t * (1 / 720 + t * (1 / 5040)))))
        )
    )
    e *= e
    e *= e
    e *= e
    e *= e
    e *= e
    return e * e


@inline_fast_kernel
def _source(square: float, z: float, decay: float) -> float:
    """Contribution of one source of the dipole at depth or height z, times 4 pi / alpha'."""
    d2 = square + z * z
    d = math.sqrt(d2)
    return z * (1.0 + decay * d) * _decay(decay * d) / (d2 * d)


# no check for division by zero, which would prevent vectorisation of the loops
@fast_kernel
def _add(
    rows: Any,
    count: int,
    at: Any,
    p: Any,
    place: Any,
    area: Any,
    power: Any,
    square: Any,
    profile: Any,
    even: Any,
    out: Any,
) -> None:
    """Add the listed rows to the sums of one receiver: even (3,) for unit irradiance,
    out (groups, 3, lights).

    `square` (ROWS_PER_SUM,) for squared distances and `profile` (3, ROWS_PER_SUM) are
    working memory.
    """
    for e in range(count):
        j = rows[e]
        dx = at[0] - place[j, 0]
        dy = at[1] - place[j, 1]
        dz = at[2] - place[j, 2]
        square[e] = dx * dx + dy * dy + dz * dz
    for c in range(3):
        depth = p[c, 0]
        above = p[c, 1]
        decay = p[c, 2]
        scale = p[c, 3] * 0.07957747154594767
        for e in range(count):
            profile[c, e] = scale * (
                _source(square[e], depth, decay) + _source(square[e], above, decay)
            )
        total = 0.0
        for e in range(count):
            total += profile[c, e] * area[rows[e]]
        even[c] += total
    for g in range(power.shape[0]):
        for c in range(3):
            # LIGHTS_IN_REGISTERS variables, unrolled to stay in registers
            a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = 0.0
            for e in range(count):
                r = profile[c, e]
                sent = power[g, rows[e]]
                a0 += r * sent[0]
                a1 += r * sent[1]
                a2 += r * sent[2]
                a3 += r * sent[3]
                a4 += r * sent[4]
                a5 += r * sent[5]
                a6 += r * sent[6]
                a7 += r * sent[7]
            sums = out[g, c]
            sums[0] += a0
            sums[1] += a1
            sums[2] += a2
            sums[3] += a3
            sums[4] += a4
            sums[5] += a5
            sums[6] += a6
            sums[7] += a7


@fast_kernel
def gather(
    start: int,
    stop: int,
    receivers: Any,
    parameters: Any,
    place: Any,
    area: Any,
    power: Any,
    first: Any,
    last: Any,
    child: Any,
    children: Any,
    box: Any,
    tolerance: float,
    reach: float,
    even: Any,
    out: Any,
) -> None:
    """Dipole sums at the points receivers[start:stop], with receivers (m,).

    parameters (n, 3, 4) are z_r, z_v, sigma_tr, alpha' of each point and channel; place
    (rows, 3), area (rows,) and power (groups, rows, LIGHTS_IN_REGISTERS) of points and
    nodes. The sums are even (m, 3), under unit irradiance, and out (m, groups, 3,
    LIGHTS_IN_REGISTERS).
    """
    points = len(parameters)
    stack = np.empty(8 * (MAX_DEPTH + 2), np.int64)
    rows = np.empty(ROWS_PER_SUM, np.int64)
    square = np.empty(ROWS_PER_SUM)
    profile = np.empty((3, ROWS_PER_SUM))
    for k in range(start, stop):
        i = receivers[k]
        x = place[i, 0]
        y = place[i, 1]
        z = place[i, 2]
        top, stack[0], count = 1, 0, 0
        while top > 0:
            top -= 1
            v = stack[top]
            gx = max(max(box[v, 0] - x, x - box[v, 3]), 0.0)
            gy = max(max(box[v, 1] - y, y - box[v, 4]), 0.0)
            gz = max(max(box[v, 2] - z, z - box[v, 5]), 0.0)
            gap = gx * gx + gy * gy + gz * gz
            if gap > reach * reach:
                continue
            low = points + v
            high = points + v + 1
            dx = x - place[low, 0]
            dy = y - place[low, 1]
            dz = z - place[low, 2]
            if gap == 0.0 or area[low] >= tolerance * (dx * dx + dy * dy + dz * dz):
                low = first[v]
                high = last[v]
                if child[v] >= 0:
                    low = high
                    for q in range(children[v]):
                        stack[top] = child[v] + q
                        top += 1
            for j in range(low, high):
                if count == ROWS_PER_SUM:
                    _add(
                        rows,
                        count,
                        place[i],
                        parameters[i],
                        place,
                        area,
                        power,
                        square,
                        profile,
                        even[k],
                        out[k],
                    )
                    count = 0
                rows[count] = j
                count += 1
        _add(
            rows,
            count,
            place[i],
            parameters[i],
            place,
            area,
            power,
            square,
            profile,
            even[k],
            out[k],
        )
