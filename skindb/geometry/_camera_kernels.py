"""Compiled inverse of the lens's distortion; see `skindb.geometry.camera.undistort`."""

from __future__ import annotations

import math

from skindb.jit import inline_kernel, kernel
from skindb.types import Matrix, Vector

# 4 to 6 suffice for real lenses; more are needed at the rim of a strong distortion
NEWTON_STEPS = 25


@inline_kernel
def _within(x: float, y: float, limit: float) -> tuple[float, float]:
    """A point, moved towards the axis to a distance of at most `limit`."""
    scale = limit / max(math.sqrt(x * x + y * y), limit) if limit < math.inf else 1.0
    return x * scale, y * scale


@kernel
def undistorted(
    bent: Matrix, coefficients: Vector, limit: float, tolerance: float, out: Matrix
) -> None:
    """Write ideal points `out` (n, 2) for distorted points `bent` (n, 2), by Newton's method.

    Parameters
    ----------
    bent
        (n, 2) distorted image-plane coordinates.
    coefficients
        (5,) k1 k2 p1 p2 k3.
    limit
        Radius up to which the distortion is one to one; infinity if it always is.
    tolerance
        Largest allowed residual of the distorted coordinates.
    out
        (n, 2) output; NaN where no point within the limit is distorted to that point.
    """
    k1, k2, p1, p2, k3 = coefficients
    for i in range(len(bent)):
        u, v = bent[i]
        x, y = _within(u, v, 0.9 * limit)
        error = math.inf
        for _ in range(NEWTON_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)  # d radial / d r2
            right = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - u
            below = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - v
            error = max(abs(right), abs(below))
            if error < 1e-3 * tolerance:
                break
            xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
            xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
            yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
            determinant = float(xx * yy - xy * xy)
            if abs(determinant) < 1e-12:
                determinant = 1e-12
            x, y = _within(
                x - (yy * right - xy * below) / determinant,
                y - (xx * below - xy * right) / determinant,
                limit,
            )
        out[i, 0] = x if error < tolerance else math.nan
        out[i, 1] = y if error < tolerance else math.nan
