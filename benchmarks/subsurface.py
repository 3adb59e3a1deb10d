"""Error and time of the dipole octree against its tolerance and the spacing of the points.

    python benchmarks/subsurface.py

A ball of 30 mm, light skin, in hard shadows 4 mm wide: the hardest case for the spacing, since a point is either lit or
not. Errors are RMS of the exitance relative to its RMS, over receivers, channels and lights.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.optics.diffuse import diffuse_reflectance, dipole_s, scattering_coefficients
from skindb.optics.dipole import dipole_profile
from skindb.optics.dipole_tree import subsurface_exitance

Array = NDArray[np.floating[Any]]
ETA, RADIUS, RECEIVERS = 1.3, 30.0, 150
SIGMA_TR = np.array([0.55, 0.98, 1.55])  # mm-1
S = dipole_s(np.array([0.5, 0.3, 0.2]), eta=ETA)[0]
FINE = 0.1  # mm, spacing of the reference
NEAR = 25.0  # mm: beyond it the profile is below 1e-6 of its integral


def tree_errors(
    *, spacing_mm: float = 0.5, tolerances: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.4), lights: int = 4
) -> dict[float, tuple[float, float]]:
    """tolerance -> (error against the plain sum over the same points, seconds of all lights together)."""
    points, areas = _ball(spacing_mm)
    light, chosen = _irradiance(points, lights), _receivers(len(points))
    want, result = _plain(points[chosen], points, areas, light), {}
    skin = np.tile(S, (len(points), 1)), np.tile(SIGMA_TR, (len(points), 1))
    subsurface_exitance(points[:9], areas[:9], light[:9], skin[0][:9], skin[1][:9], eta=ETA)  # compiles
    for tolerance in tolerances:
        start = time.perf_counter()
        got = subsurface_exitance(points, areas, light, *skin, eta=ETA, tolerance=tolerance)
        result[tolerance] = _error(got[:, chosen], want), time.perf_counter() - start
    return result


def spacing_error(spacing_mm: float, *, lights: int = 4) -> float:
    """Error of the plain sum over points `spacing_mm` apart against points FINE apart."""
    points, areas = _ball(spacing_mm)
    at, (fine, small) = points[_receivers(len(points))], _ball(FINE)
    want = _plain(at, fine, small, _irradiance(fine, lights))
    return _error(_plain(at, points, areas, _irradiance(points, lights)), want)


def _ball(spacing: float) -> tuple[Array, Array]:
    """Points (n, 3) of a spiral and their areas."""
    n = round(4 * np.pi * RADIUS**2 / spacing**2)
    z, phi = 1 - (2 * np.arange(n) + 1) / n, np.pi * (1 + 5**0.5) * (np.arange(n) + 0.5)
    r = np.sqrt(1 - z * z)
    return RADIUS * np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), np.full(n, spacing**2)


def _irradiance(points: Array, lights: int) -> Array:
    towards = np.random.default_rng(3).normal(size=(3, lights))
    towards /= np.linalg.norm(towards, axis=0)
    return np.maximum(points @ towards / RADIUS, 0) * (np.sin(points[:, 1:2] * np.pi / 4 + np.arange(lights)) > 0)


def _receivers(n: int) -> NDArray[np.int64]:
    return np.random.default_rng(4).integers(0, n, RECEIVERS)


def _plain(at: Array, points: Array, areas: Array, light: Array) -> Array:
    """(lights, receivers, 3) exitance, the kernel divided by its own sum as `subsurface_exitance` does."""
    absorbed, scattered = scattering_coefficients(S, SIGMA_TR)
    out = np.empty((light.shape[1], len(at), 3))
    for i, place in enumerate(at):
        near = np.flatnonzero(((points - place) ** 2).sum(axis=1) < NEAR**2)
        r = np.linalg.norm(points[near] - place, axis=1)[:, None]
        kernel = dipole_profile(r, absorbed, scattered, eta=ETA) * areas[near, None]
        out[:, i] = (light[near].T @ kernel) / kernel.sum(axis=0) * diffuse_reflectance(S, eta=ETA)
    return out


def _error(got: Array, want: Array) -> float:
    return float(np.sqrt(((got - want) ** 2).mean() / (want**2).mean()))


def main() -> None:
    """Print both tables."""
    print("| spacing [mm] | of the spacing [%] | tolerance: of the tree [%], time [s] |\n|---|---|---|")
    for spacing in (0.4, 0.8, 1.6):
        row = [f"{t}: {100 * error:.3f}, {s:.2f}" for t, (error, s) in tree_errors(spacing_mm=spacing).items()]
        print(f"| {spacing} | {100 * spacing_error(spacing):.2f} | {'; '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
