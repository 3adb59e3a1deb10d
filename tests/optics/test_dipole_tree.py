"""The octree against the plain sum, and uniform light."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.optics.diffuse import diffuse_reflectance, dipole_s, scattering_coefficients
from skindb.optics.dipole import dipole_profile
from skindb.optics.dipole_tree import subsurface_exitance

ETA = 1.3


def _sphere(n: int, radius: float = 30.0):
    k = np.arange(n) + 0.5
    z, phi = 1 - 2 * k / n, np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    points = radius * np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    return points, np.full(n, 4 * np.pi * radius**2 / n)


def _skin(n: int):
    diffuse = np.tile([0.5, 0.3, 0.2], (n, 1)) * np.linspace(0.8, 1.2, n)[:, None]
    return diffuse, dipole_s(diffuse, eta=ETA)[0], np.tile([0.55, 0.98, 1.55], (n, 1))


@pytest.mark.parametrize(("tolerance", "bound"), [(0.0, 1e-6), (0.1, 4e-3)])
def test_subsurface_exitance__against_the_plain_sum(tolerance, bound):
    points, area = _sphere(4000)
    _, s, tr = _skin(4000)
    light = np.maximum(points[:, :1], 0) * np.ones(3) * (np.sin(points[:, 1:2]) > 0)
    got = subsurface_exitance(points, area, light, s, tr, eta=ETA, tolerance=tolerance, normalise=False)
    some = np.arange(0, 4000, 97)
    r = np.linalg.norm(points[some, None] - points, axis=-1)
    a, scattered = scattering_coefficients(s, tr)
    for c in range(3):
        kernel = dipole_profile(r, a[some, c : c + 1], scattered[some, c : c + 1], eta=ETA)
        want = kernel @ (light[:, c] * area)
        assert np.sqrt(((got[some, c] - want) ** 2).mean() / (want**2).mean()) < bound


def test_subsurface_exitance__uniform_light_gives_rd():
    points, area = _sphere(3000)
    diffuse, s, tr = _skin(3000)
    got = subsurface_exitance(points, area, np.ones((3000, 3)), s, tr, eta=ETA)
    np.testing.assert_allclose(got, diffuse, rtol=1e-12)


def test_subsurface_exitance__plain_sum_of_a_fine_surface_is_rd():
    """Without normalisation, points 0.5 mm apart: the kernel's integral over a nearly flat surface (radius 30 mm)."""
    points, area = _sphere(45000)
    _, s, tr = _skin(45000)
    got = subsurface_exitance(points, area, np.ones((45000, 3)), s, tr, eta=ETA, normalise=False)
    ratio = got / diffuse_reflectance(s, eta=ETA)
    np.testing.assert_allclose(np.median(ratio, axis=0), 1.0, atol=0.02)  # curvature and 0.5 mm spacing
    assert np.abs(ratio - 1).max() < 0.08  # blue at the poles, where the spiral is uneven


def test_subsurface_exitance__one_point_and_none():
    out = subsurface_exitance(
        np.zeros((1, 3)), np.ones(1), np.ones((1, 3)), np.full((1, 3), 0.5), np.ones((1, 3)), eta=ETA
    )
    np.testing.assert_allclose(out, diffuse_reflectance(0.5, eta=ETA))
