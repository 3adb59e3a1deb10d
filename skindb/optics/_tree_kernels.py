"""Compiled octree of irradiance points; see `skindb.optics.dipole_tree`.

Rows are numbered with the points first and then the nodes, so that a sum over nodes and
points is one list of rows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skindb.jit import fast_kernel, inline_fast_kernel, kernel
from skindb.types import Cube, Cube32, IntVector, Matrix, Tensor, Vector

MAX_DEPTH = 10  # levels of the octree, with three bits of the Morton code each
# rows evaluated at a time, so that the list and its profiles stay in the first-level
# cache
ROWS_PER_SUM = 1024
LIGHTS_IN_REGISTERS = 8  # lights whose sums stay in registers


class Tree(NamedTuple):
    """Nodes (v,) of an octree over sorted points; children come after their parents."""

    begin: IntVector  # points of a node, from begin to end
    end: IntVector
    child: IntVector  # its first child; -1 for a leaf
    children: IntVector  # number of its children, which follow each other
    box: Matrix  # (v, 6) lower and upper corner [mm]
    centre: Matrix  # (v, 3) mean of the points weighted by area [mm]
    area: Vector  # sum over the points [mm2]


class Sources(NamedTuple):
    """Rows of points and nodes."""

    place: Matrix  # (rows, 3) mm
    area: Vector  # (rows,) mm2
    power: Cube32  # (groups, rows, LIGHTS_IN_REGISTERS) irradiance times area


class SumMemory(NamedTuple):
    """Memory for the sums at one receiver; each thread needs its own."""

    rows: IntVector  # (ROWS_PER_SUM,)
    square: Vector  # (ROWS_PER_SUM,) squared distances
    profile: Matrix  # (3, ROWS_PER_SUM)


@kernel
def _bound(
    begin: int, end: int, points: Matrix, area: Vector, box: Vector, centre: Vector
) -> float:
    """Write the box and the centre of the points of a node; returns their area."""
    box[:3] = np.inf
    box[3:] = -np.inf
    centre[:] = 0.0
    node_area = 0.0
    total = 0.0
    for j in range(begin, end):
        w = area[j] + 1e-300
        total += w
        node_area += area[j]
        for a in range(3):
            centre[a] += w * points[j, a]
            box[a] = min(box[a], points[j, a])
            box[a + 3] = max(box[a + 3], points[j, a])
    for a in range(3):
        centre[a] /= total
    return node_area


@kernel
def build(code: IntVector, points: Matrix, area: Vector, leaf: int) -> Tree:
    """Nodes over points sorted by Morton code, so that every node is a contiguous range
    of points.
    """
    size = 2 * len(code) + 16
    begin = np.zeros(size, np.int64)
    end = np.zeros(size, np.int64)
    child = np.full(size, -1, np.int64)
    children = np.zeros(size, np.int64)
    level = np.zeros(size, np.int64)
    centre = np.zeros((size, 3))
    box = np.zeros((size, 6))
    node_area = np.zeros(size)
    end[0] = len(code)
    count = 1
    i = 0
    while i < count:
        node_area[i] = _bound(begin[i], end[i], points, area, box[i], centre[i])
        if end[i] - begin[i] > leaf and level[i] < MAX_DEPTH:
            shift = 3 * (MAX_DEPTH - 1 - level[i])
            start = begin[i]
            child[i] = count
            while start < end[i]:
                digit = (code[start] >> shift) & 7
                stop = start
                while stop < end[i] and ((code[stop] >> shift) & 7) == digit:
                    stop += 1
                begin[count] = start
                end[count] = stop
                level[count] = level[i] + 1
                count = count + 1
                start = stop
            children[i] = count - child[i]
        i += 1
    return Tree(
        begin[:count],
        end[:count],
        child[:count],
        children[:count],
        box[:count],
        centre[:count],
        node_area[:count],
    )


@kernel
def sum_nodes(power: Cube32, points: int, tree: Tree) -> None:
    """Fill the rows of the nodes of power (groups, rows, LIGHTS_IN_REGISTERS) from the
    rows of the points.
    """
    for g in range(power.shape[0]):
        for v in range(len(tree.begin) - 1, -1, -1):  # children before their parents
            low = tree.begin[v]
            high = tree.end[v]
            if tree.child[v] >= 0:
                low = points + tree.child[v]
                high = low + tree.children[v]
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
    e = 1 / 120 + t * (1 / 720 + t * (1 / 5040))
    e = 0.5 + t * (1 / 6 + t * (1 / 24 + t * e))
    e = 1.0 + t * (1.0 + t * e)
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
    count: int,
    receiver: Vector,
    parameters: Matrix,
    sources: Sources,
    memory: SumMemory,
    even: Vector,
    out: Cube,
) -> None:
    """Add the listed rows to the sums of one receiver: even (3,) for unit irradiance,
    out (groups, 3, lights).
    """
    rows = memory.rows
    place = sources.place
    area = sources.area
    power = sources.power
    square = memory.square
    profile = memory.profile
    for e in range(count):
        j = rows[e]
        dx = receiver[0] - place[j, 0]
        dy = receiver[1] - place[j, 1]
        dz = receiver[2] - place[j, 2]
        square[e] = dx * dx + dy * dy + dz * dz
    for c in range(3):
        depth = parameters[c, 0]
        above = parameters[c, 1]
        decay = parameters[c, 2]
        scale = parameters[c, 3] * 0.07957747154594767
        for e in range(count):
            real = _source(square[e], depth, decay)
            profile[c, e] = scale * (real + _source(square[e], above, decay))
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


@inline_fast_kernel
def _squared_gap(box: Vector, x: float, y: float, z: float) -> float:
    """Squared distance from a point to a box, 0 inside."""
    gx = max(max(box[0] - x, x - box[3]), 0.0)
    gy = max(max(box[1] - y, y - box[4]), 0.0)
    gz = max(max(box[2] - z, z - box[5]), 0.0)
    return gx * gx + gy * gy + gz * gz


@fast_kernel
def gather(
    start: int,
    stop: int,
    receivers: IntVector,
    parameters: Cube,
    sources: Sources,
    tree: Tree,
    tolerance: float,
    reach: float,
    even: Matrix,
    out: Tensor,
) -> None:
    """Dipole sums at the points receivers[start:stop], with receivers (m,).

    parameters (n, 3, 4) are z_r, z_v, sigma_tr, alpha' of each point and channel. The
    sums are even (m, 3), under unit irradiance, and out (m, groups, 3,
    LIGHTS_IN_REGISTERS).
    """
    points = len(parameters)
    place = sources.place
    stack = np.empty(8 * (MAX_DEPTH + 2), np.int64)
    rows = np.empty(ROWS_PER_SUM, np.int64)
    square = np.empty(ROWS_PER_SUM)
    memory = SumMemory(rows, square, np.empty((3, ROWS_PER_SUM)))
    for k in range(start, stop):
        i = receivers[k]
        x = place[i, 0]
        y = place[i, 1]
        z = place[i, 2]
        stack[0] = 0
        top = 1
        count = 0
        while top > 0:
            top -= 1
            v = stack[top]
            gap = _squared_gap(tree.box[v], x, y, z)
            if gap > reach * reach:
                continue
            low = points + v
            high = points + v + 1
            dx = x - place[low, 0]
            dy = y - place[low, 1]
            dz = z - place[low, 2]
            area_limit = tolerance * (dx * dx + dy * dy + dz * dz)
            if gap == 0.0 or sources.area[low] >= area_limit:
                low = tree.begin[v]
                high = tree.end[v]
                if tree.child[v] >= 0:
                    low = high
                    for q in range(tree.children[v]):
                        stack[top] = tree.child[v] + q
                        top += 1
            for j in range(low, high):
                if count == ROWS_PER_SUM:
                    _add(
                        count, place[i], parameters[i], sources, memory, even[k], out[k]
                    )
                    count = 0
                rows[count] = j
                count += 1
        _add(count, place[i], parameters[i], sources, memory, even[k], out[k])
