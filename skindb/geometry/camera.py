"""Pinhole cameras with Brown-Conrady distortion, in the conventions of OpenCV with
pixel centres at integer + 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skindb.geometry._camera_kernels import undistorted
from skindb.types import Array, Float64, float64

UNDISTORT_TOLERANCE = 1e-10  # in units of the focal length: 1e-7 px


@dataclass(frozen=True)
class Pinhole:
    """Projection of a camera: `x_cam = R x + t`, distortion k1 k2 p1 p2 k3."""

    K: Float64  # (3, 3) px
    R: Float64  # (3, 3)
    t: Float64  # (3,) mm
    distortion: Float64  # (5,)

    @property
    def centre(self) -> Float64:
        """Centre of projection (3,) in mm."""
        return camera_centre(self.R, self.t)

    def project(self, points: ArrayLike) -> Float64:
        """Pixels (..., 2) of points (..., 3) in mm; NaN behind the camera."""
        return project(points, self.K, self.R, self.t, self.distortion)[0]

    def rays(self, pixels: ArrayLike) -> Float64:
        """Unit directions (..., 3) through pixels (..., 2)."""
        return pixel_rays(pixels, self.K, self.R, self.distortion)

    def pixel_width(self, point: Float64) -> float:
        """Width [mm] of a pixel at the distance of a point."""
        distance = float(np.linalg.norm(self.centre - point))
        return distance / float(np.sqrt(self.K[0, 0] * self.K[1, 1]))


def camera_centre(R: ArrayLike, t: ArrayLike) -> Float64:
    """Centre of projection (3,) in mm of the camera `x_cam = R x + t`."""
    return -float64(R).T @ float64(t)


def project(
    points: ArrayLike, K: ArrayLike, R: ArrayLike, t: ArrayLike, distortion: ArrayLike
) -> tuple[Float64, Float64]:
    """Pixels at which points appear.

    Parameters
    ----------
    points
        (..., 3) mm, subject frame.
    K, R, t
        (3, 3) px, (3, 3) and (3,) mm: `x_cam = R x + t`.
    distortion
        (5,) k1 k2 p1 p2 k3 (Brown 1966, order of OpenCV).

    Returns
    -------
    pixels : ndarray
        (..., 2) column and row in px. NaN behind the camera, and beyond the angle where
        the distortion polynomial folds back (there a point far outside the picture
        would appear inside it).
    depth : ndarray
        (...) mm along the optical axis.
    """
    rotated = float64(points) @ float64(R).T
    local = rotated + float64(t)
    depth = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = local[..., :2] / depth[..., None]
    plane = np.where((depth > 0)[..., None], ratio, np.nan)
    coefficients = float64(distortion)
    square = np.einsum("...i,...i->...", plane, plane)
    plane[square >= _fold(coefficients)] = np.nan
    bent = _distort(plane, coefficients)
    matrix = float64(K)
    return bent @ matrix[:2, :2].T + matrix[:2, 2], depth


def undistort(pixels: ArrayLike, K: ArrayLike, distortion: ArrayLike) -> Float64:
    """Ideal image-plane coordinates (..., 2), x/z and y/z, of pixels (..., 2) by Newton's method.

    NaN where no point in front of the camera appears at that pixel.
    """
    matrix = float64(K)
    coefficients = float64(distortion)
    offset = float64(pixels) - matrix[:2, 2]
    bent = (offset @ np.linalg.inv(matrix[:2, :2]).T).reshape(-1, 2)
    if not coefficients.any():
        return float64(bent.reshape(offset.shape))
    plane = np.empty_like(bent)
    limit = float(np.sqrt(_fold(coefficients)))
    bent = np.ascontiguousarray(bent)
    undistorted(bent, coefficients, limit, UNDISTORT_TOLERANCE, plane)
    return plane.reshape(offset.shape)


def pixel_rays(
    pixels: ArrayLike, K: ArrayLike, R: ArrayLike, distortion: ArrayLike
) -> Float64:
    """Unit directions (..., 3) in the subject frame, from the camera through pixels
    (..., 2); NaN as `undistort`.
    """
    plane = undistort(pixels, K, distortion)
    local = np.ones((*plane.shape[:-1], 3))
    local[..., :2] = plane
    local /= np.sqrt(1 + np.einsum("...i,...i->...", plane, plane))[..., None]
    return local @ float64(R)


def _distort(plane: Array, coefficients: Array) -> Float64:
    """Distorted coordinates (..., 2) (OpenCV, camera calibration, 5 coefficients)."""
    k1, k2, p1, p2, k3 = coefficients
    x = plane[..., 0]
    y = plane[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([bent_x, bent_y], -1)


def _fold(coefficients: Array) -> float:
    """Square radius beyond which r (1 + k1 r^2 + k2 r^4 + k3 r^6) no longer grows;
    infinity if it always does.
    """
    k1, k2, _, _, k3 = coefficients
    growth = np.array([7 * k3, 5 * k2, 3 * k1, 1.0])
    # a coefficient of 1e-12 folds beyond a thousand focal lengths; division by a
    # smaller one may overflow
    roots = np.roots(np.where(np.abs(growth) < 1e-12, 0.0, growth))
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min()) if len(real) else np.inf
