"""Compiled octree of irradiance points; see `skindb.optics.dipole_tree`."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
DEPTH = 10  # levels of the octree: three bits of the Morton code each


@nb.njit(cache=True, nogil=True)
def build(code: Any, points: Any, power: Any, area: Any, leaf: int) -> Any:
    """Nodes over points sorted by Morton code: children are neighbours, so a node is a stretch of points.

    Returns first, last, child, children, centre (power-weighted), box, node power, node area.
    """
    most = 2 * len(code) + 16
    first, last = np.zeros(most, np.int64), np.zeros(most, np.int64)
    child, children, level = np.full(most, -1, np.int64), np.zeros(most, np.int64), np.zeros(most, np.int64)
    centre, box = np.zeros((most, 3)), np.zeros((most, 6))
    node_power, node_area = np.zeros((most, power.shape[1])), np.zeros(most)
    count, last[0], i = 1, len(code), 0
    while i < count:
        box[i, :3], box[i, 3:] = np.inf, -np.inf
        total = 0.0
        for j in range(first[i], last[i]):
            w = 1e-300
            for c in range(power.shape[1]):
                w += power[j, c]
                node_power[i, c] += power[j, c]
            total += w
            node_area[i] += area[j]
            for a in range(3):
                centre[i, a] += w * points[j, a]
                box[i, a], box[i, a + 3] = min(box[i, a], points[j, a]), max(box[i, a + 3], points[j, a])
        for a in range(3):
            centre[i, a] /= total
        if last[i] - first[i] > leaf and level[i] < DEPTH:
            shift, start = 3 * (DEPTH - 1 - level[i]), first[i]
            child[i] = count
            while start < last[i]:
                digit, stop = (code[start] >> shift) & 7, start
                while stop < last[i] and ((code[stop] >> shift) & 7) == digit:
                    stop += 1
                first[count], last[count], level[count] = start, stop, level[i] + 1
                count, start = count + 1, stop
            children[i] = count - child[i]
        i += 1
    stretch, family = (first[:count], last[:count]), (child[:count], children[:count])
    return *stretch, *family, centre[:count], box[:count], node_power[:count], node_area[:count]


@nb.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _profile(square: float, depth: float, above: float, decay: float, albedo: float) -> float:
    real, virtual = math.sqrt(square + depth * depth), math.sqrt(square + above * above)
    return (
        albedo
        * 0.07957747154594767
        * (
            depth * (1.0 + decay * real) * math.exp(-decay * real) / (real * real * real)
            + above * (1.0 + decay * virtual) * math.exp(-decay * virtual) / (virtual * virtual * virtual)
        )
    )


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def gather(
    receivers: Any, parameters: Any, points: Any, power: Any, first: Any, last: Any, child: Any, children: Any,
    centre: Any, box: Any, node_power: Any, node_area: Any, tolerance: float, reach: float, out: Any,
) -> None:  # fmt: skip
    """Dipole sums at the receivers; parameters (n, 3, 4): z_r, z_v, sigma_tr, alpha' of each receiver and channel."""
    sets = power.shape[1] // 3
    for block in nb.prange((len(receivers) + 255) // 256):
        stack = np.empty(8 * (DEPTH + 2), np.int64)
        for i in range(256 * block, min(len(receivers), 256 * block + 256)):
            x, y, z = receivers[i, 0], receivers[i, 1], receivers[i, 2]
            top, stack[0] = 1, 0
            while top > 0:
                top -= 1
                v = stack[top]
                gx = max(max(box[v, 0] - x, x - box[v, 3]), 0.0)
                gy = max(max(box[v, 1] - y, y - box[v, 4]), 0.0)
                gz = max(max(box[v, 2] - z, z - box[v, 5]), 0.0)
                gap = gx * gx + gy * gy + gz * gz
                if gap > reach * reach:
                    continue
                dx, dy, dz = x - centre[v, 0], y - centre[v, 1], z - centre[v, 2]
                square = dx * dx + dy * dy + dz * dz
                if gap > 0.0 and node_area[v] < tolerance * square:
                    for c in range(3):
                        p = parameters[i, c]
                        r = _profile(square, p[0], p[1], p[2], p[3])
                        for s in range(sets):
                            out[i, 3 * s + c] += r * node_power[v, 3 * s + c]
                elif child[v] < 0:
                    for j in range(first[v], last[v]):
                        dx, dy, dz = x - points[j, 0], y - points[j, 1], z - points[j, 2]
                        square = dx * dx + dy * dy + dz * dz
                        for c in range(3):
                            p = parameters[i, c]
                            r = _profile(square, p[0], p[1], p[2], p[3])
                            for s in range(sets):
                                out[i, 3 * s + c] += r * power[j, 3 * s + c]
                else:
                    for q in range(children[v]):
                        stack[top] = child[v] + q
                        top += 1
