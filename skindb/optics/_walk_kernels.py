"""Compiled part of the random walk of photons; see `skindb.optics.transport`."""

from __future__ import annotations

import numpy as np

from skindb.jit import fast_kernel, inline_fast_kernel
from skindb.types import Matrix32


@fast_kernel
def _escape(cosine: float, eta: float) -> float:
    """Fresnel transmittance from inside (index eta) to air."""
    sine2 = (1.0 - cosine * cosine) * eta * eta
    if sine2 >= 1.0:
        return 0.0
    outside = np.sqrt(1.0 - sine2)
    a = (eta * cosine - outside) / (eta * cosine + outside)
    b = (cosine - eta * outside) / (cosine + eta * outside)
    return float(1.0 - 0.5 * (a * a + b * b))


@inline_fast_kernel
def _scattering_cosine(rng: np.random.Generator, g: float) -> float:
    """Random cosine of the Henyey-Greenstein phase function."""
    if g == 0.0:
        return 2.0 * rng.random() - 1.0
    q = (1.0 - g * g) / (1.0 - g + 2.0 * g * rng.random())
    return (1.0 + g * g - q * q) / (2.0 * g)


@inline_fast_kernel
def _scattered(
    rng: np.random.Generator, ct: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float]:
    """Direction at the cosine `ct` to dx, dy, dz, with a random azimuth."""
    st = np.sqrt(max(0.0, 1.0 - ct * ct))
    # a uniform direction in the plane by rejection, which is faster than sine and cosine
    a = 2.0 * rng.random() - 1.0
    b = 2.0 * rng.random() - 1.0
    r2 = a * a + b * b
    while r2 > 1.0 or r2 < 1e-12:
        a = 2.0 * rng.random() - 1.0
        b = 2.0 * rng.random() - 1.0
        r2 = a * a + b * b
    f = st / np.sqrt(r2)
    c = a * f
    s = b * f
    if abs(dz) > 0.99999:
        return c, s, ct * np.sign(dz)
    h = np.sqrt(1.0 - dz * dz)
    x_turned = c * dx * dz / h - s * dy / h + dx * ct
    y_turned = c * dy * dz / h + s * dx / h + dy * ct
    return x_turned, y_turned, -c * h + dz * ct


@fast_kernel
def walk(
    rng: np.random.Generator,
    packets: int,
    g: float,
    eta: float,
    max_path: float,
    events: Matrix32,
) -> int:
    """Fill `events` (m, 3) with radius, path and weight of every escape; returns their number.

    Lengths are in units of 1/sigma_s'. Packets enter along the normal at the origin and
    are not absorbed. At the boundary, the fraction of a packet that escapes is
    recorded, and the rest is reflected. The walk stops when `events` is full.
    """
    count = 0
    for _ in range(packets):
        x = 0.0
        y = 0.0
        z = 0.0
        dx = 0.0
        dy = 0.0
        dz = 1.0
        path = 0.0
        weight = 1.0
        while path < max_path:
            step = -np.log(1.0 - rng.random()) * (1.0 - g)
            while dz < 0.0 and z + dz * step < 0.0:  # the boundary comes first
                reach = -z / dz
                x = x + dx * reach
                y = y + dy * reach
                z = 0.0
                path = path + reach
                step = step - reach
                out = _escape(-dz, eta)
                if out > 0.0:
                    if count == events.shape[0]:
                        return count
                    events[count, 0] = np.sqrt(x * x + y * y)
                    events[count, 1] = path
                    events[count, 2] = weight * out
                    count += 1
                    weight *= 1.0 - out
                dz = -dz
            x = x + dx * step
            y = y + dy * step
            z = z + dz * step
            path = path + step
            if weight < 0.05:  # Russian roulette preserves the mean
                if rng.random() > 0.25:
                    break
                weight *= 4.0
            ct = _scattering_cosine(rng, g)
            dx, dy, dz = _scattered(rng, ct, dx, dy, dz)
            n = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
            dx = dx * n
            dy = dy * n
            dz = dz * n
    return count
