"""Compiled forming of basis rows; see `skindb.optics.rows` for shapes and sources."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
# arctan(t) = t sum c_k t^2k on [0, 1] to 5.3e-11, fitted to the largest error: unlike atan2 it runs in vector registers
ARCTAN = (
    0.9999999999476555,
    -0.3333333172329439,
    0.1999991812672282,
    -0.1428407563003924,
    0.1109400135133806,
    -0.08983791592027021,
    0.07256067657628158,
    -0.05447270115554298,
    0.03444219805422348,
    -0.01628516998556444,
    0.004924053342038083,
    -0.0006980987612493564,
)


@nb.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _arctangent(y: float, x: float) -> float:
    """atan2 for y >= 0, without branches."""
    size = abs(x)
    t = min(size, y) / max(max(size, y), 1e-300)
    q = t * t
    total = ARCTAN[11]
    for k in range(10, -1, -1):
        total = total * q + ARCTAN[k]
    angle = 0.5 * math.pi - total * t if y > size else total * t
    return math.pi - angle if x < 0.0 else angle


@nb.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _angles(n: Any, wi: Any, wo: Any) -> tuple[float, float, float]:
    """theta_h, theta_d, phi_d of unit 3-tuples; sines from cross products keep narrow lobes."""
    hx, hy, hz = wi[0] + wo[0], wi[1] + wo[1], wi[2] + wo[2]
    scale = 1.0 / max(math.sqrt(hx * hx + hy * hy + hz * hz), 1e-12)
    hx, hy, hz = hx * scale, hy * scale, hz * scale
    bx, by, bz = n[1] * hz - n[2] * hy, n[2] * hx - n[0] * hz, n[0] * hy - n[1] * hx
    cx, cy, cz = hy * wi[2] - hz * wi[1], hz * wi[0] - hx * wi[2], hx * wi[1] - hy * wi[0]
    tx, ty, tz = by * hz - bz * hy, bz * hx - bx * hz, bx * hy - by * hx
    sin_h = math.sqrt(bx * bx + by * by + bz * bz)
    theta_h = _arctangent(sin_h, max(n[0] * hx + n[1] * hy + n[2] * hz, 0.0))
    theta_d = _arctangent(math.sqrt(cx * cx + cy * cy + cz * cz), max(hx * wi[0] + hy * wi[1] + hz * wi[2], 0.0))
    across, along = bx * wi[0] + by * wi[1] + bz * wi[2], tx * wi[0] + ty * wi[1] + tz * wi[2]
    # period pi: a pair with phi_d < 0 is the pair with both signs turned
    phi = _arctangent(abs(across), along if across >= 0.0 else -along)
    return theta_h, theta_d, phi if sin_h > 1e-7 else 0.0


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def _coordinates(n: Any, wi: Any, wo: Any, count: int, shape: Any, out: Any) -> None:
    """Places in a table of `shape`, out (3, count), of one direction with the columns of wo (3, count)."""
    per_h, per_d, per_phi = 2.0 / math.pi, (shape[1] - 1) * 2.0 / math.pi, shape[2] / math.pi
    for q in range(count):
        theta_h, theta_d, phi = _angles(n, wi, (wo[0, q], wo[1, q], wo[2, q]))
        out[0, q] = math.sqrt(theta_h * per_h) * (shape[0] - 1)
        out[1, q] = theta_d * per_d
        out[2, q] = phi * per_phi


@nb.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _interpolate(table: Any, x: float, y: float, z: float, factor: float, out: Any) -> None:
    """out[:] = factor * trilinear table value at x, y, z in cells; NaN gives NaN from cell 0, never a wild address."""
    nh, nd, n_phi, size = table.shape
    i, j, k = max(min(int(x), nh - 2), 0), max(min(int(y), nd - 2), 0), max(int(z), 0)
    fx, fy, fz = x - i, y - j, z - k
    k = k if k < n_phi else 0
    k1 = k + 1 if k + 1 < n_phi else 0
    w00, w01 = nb.float32(factor * (1 - fx) * (1 - fy) * (1 - fz)), nb.float32(factor * (1 - fx) * (1 - fy) * fz)
    w10, w11 = nb.float32(factor * (1 - fx) * fy * (1 - fz)), nb.float32(factor * (1 - fx) * fy * fz)
    v00, v01 = nb.float32(factor * fx * (1 - fy) * (1 - fz)), nb.float32(factor * fx * (1 - fy) * fz)
    v10, v11 = nb.float32(factor * fx * fy * (1 - fz)), nb.float32(factor * fx * fy * fz)
    for m in range(size):
        out[m] = (
            w00 * table[i, j, k, m]
            + w01 * table[i, j, k1, m]
            + w10 * table[i, j + 1, k, m]
            + w11 * table[i, j + 1, k1, m]
            + v00 * table[i + 1, j, k, m]
            + v01 * table[i + 1, j, k1, m]
            + v10 * table[i + 1, j + 1, k, m]
            + v11 * table[i + 1, j + 1, k1, m]
        )


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def fill_rows(
    table: Any, normal: Any, to_light: Any, to_camera: Any, usable: Any, offsets: Any, rows: Any, index: Any
) -> None:
    """Write the rows of every surfel behind its offset, lights outer, cameras inner.

    Angles of all usable cameras of a light come first, in vector registers; then their rows are gathered. Neighbouring
    surfels meet the same cells, so coherent order keeps the table's part in the cache.
    """
    seen, place = np.empty((3, to_camera.shape[1])), np.empty((3, to_camera.shape[1]))
    for s in range(normal.shape[0]):
        at = offsets[s]
        n = (normal[s, 0], normal[s, 1], normal[s, 2])
        for i in range(to_light.shape[1]):
            wi = (to_light[s, i, 0], to_light[s, i, 1], to_light[s, i, 2])
            count = 0
            for o in range(to_camera.shape[1]):
                if usable[s, i, o]:
                    index[at + count, 0], index[at + count, 1] = i, o
                    for axis in range(3):
                        seen[axis, count] = to_camera[s, o, axis]
                    count += 1
            _coordinates(n, wi, seen, count, table.shape, place)
            cos_i = n[0] * wi[0] + n[1] * wi[1] + n[2] * wi[2]
            for q in range(count):
                _interpolate(table, place[0, q], place[1, q], place[2, q], cos_i, rows[at + q])
            at += count


@nb.njit(cache=True, nogil=True, fastmath=FAST)
def average_disc(table: Any, wi: Any, wo: Any, points: Any, weights: Any, out: Any) -> None:
    """Add to `out` (n, m) the weighted mean of the table over directions around wi."""
    count = points.shape[0]
    disc, place, value = np.empty((3, count)), np.empty((3, count)), np.empty(out.shape[1], out.dtype)
    for s in range(wi.shape[0]):
        x, y, z = wi[s, 0], wi[s, 1], wi[s, 2]
        sign = 1.0 if z >= 0.0 else -1.0
        a = -1.0 / (sign + z)
        b = x * y * a
        for q in range(count):
            u, v = points[q, 0], points[q, 1]
            px = x + u * (1.0 + sign * x * x * a) + v * b
            py = y + u * sign * b + v * (sign + y * y * a)
            pz = z - u * sign * x - v * y
            scale = 1.0 / math.sqrt(px * px + py * py + pz * pz)
            disc[0, q], disc[1, q], disc[2, q] = px * scale, py * scale, pz * scale
        # the angles do not change when the two directions are exchanged
        _coordinates((0.0, 0.0, 1.0), (wo[s, 0], wo[s, 1], wo[s, 2]), disc, count, table.shape, place)
        for q in range(count):
            _interpolate(table, place[0, q], place[1, q], place[2, q], weights[q], value)
            for m in range(out.shape[1]):
                out[s, m] += value[m]
