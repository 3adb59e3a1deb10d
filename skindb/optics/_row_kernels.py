"""Compiled forming of basis rows; see `skindb.optics.rows` for shapes and sources."""

from __future__ import annotations

import math
from typing import Any

import numba as nb

FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}


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
    theta_h = math.atan2(sin_h, max(n[0] * hx + n[1] * hy + n[2] * hz, 0.0))
    theta_d = math.atan2(math.sqrt(cx * cx + cy * cy + cz * cz), max(hx * wi[0] + hy * wi[1] + hz * wi[2], 0.0))
    phi = 0.0
    if sin_h > 1e-7:
        phi = math.atan2(bx * wi[0] + by * wi[1] + bz * wi[2], tx * wi[0] + ty * wi[1] + tz * wi[2])
    return theta_h, theta_d, phi + math.pi if phi < 0.0 else phi


@nb.njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _interpolate(table: Any, theta_h: float, theta_d: float, phi: float, factor: float, out: Any) -> None:
    """out[:] = factor * trilinear table value."""
    nh, nd, n_phi, size = table.shape
    half = 0.5 * math.pi
    x = math.sqrt(min(theta_h / half, 1.0)) * (nh - 1)
    y = min(theta_d / half, 1.0) * (nd - 1)
    z = phi / math.pi * n_phi
    i, j, k = min(int(x), nh - 2), min(int(y), nd - 2), int(z)
    fx, fy, fz = x - i, y - j, z - k
    k %= n_phi
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
    """Write the rows of every surfel behind its offset, lights outer, cameras inner."""
    for s in range(normal.shape[0]):
        at = offsets[s]
        n = (float(normal[s, 0]), float(normal[s, 1]), float(normal[s, 2]))
        for i in range(to_light.shape[1]):
            wi = (float(to_light[s, i, 0]), float(to_light[s, i, 1]), float(to_light[s, i, 2]))
            cos_i = n[0] * wi[0] + n[1] * wi[1] + n[2] * wi[2]
            for o in range(to_camera.shape[1]):
                if usable[s, i, o]:
                    wo = (float(to_camera[s, o, 0]), float(to_camera[s, o, 1]), float(to_camera[s, o, 2]))
                    theta_h, theta_d, phi = _angles(n, wi, wo)
                    _interpolate(table, theta_h, theta_d, phi, cos_i, rows[at])
                    index[at, 0], index[at, 1] = i, o
                    at += 1


@nb.njit(cache=True, nogil=True, parallel=True, fastmath=FAST)
def average_disc(table: Any, wi: Any, wo: Any, points: Any, weights: Any, out: Any) -> None:
    """Add to `out` (n, m) the weighted mean of the table over directions around wi; one-shot, so parallel."""
    for s in nb.prange(wi.shape[0]):
        x, y, z = wi[s, 0], wi[s, 1], wi[s, 2]
        sign = 1.0 if z >= 0.0 else -1.0
        a = -1.0 / (sign + z)
        b = x * y * a
        value = out[s].copy()
        up = (0.0, 0.0, 1.0)
        o = (wo[s, 0], wo[s, 1], wo[s, 2])
        for q in range(points.shape[0]):
            u, v = points[q, 0], points[q, 1]
            px = x + u * (1.0 + sign * x * x * a) + v * b
            py = y + u * sign * b + v * (sign + y * y * a)
            pz = z - u * sign * x - v * y
            scale = 1.0 / math.sqrt(px * px + py * py + pz * pz)
            theta_h, theta_d, phi = _angles(up, (px * scale, py * scale, pz * scale), o)
            _interpolate(table, theta_h, theta_d, phi, weights[q], value)
            for m in range(out.shape[1]):
                out[s, m] += value[m]
