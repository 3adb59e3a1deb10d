"""The octree compared with the plain sum; uniform light; several lights and threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from skindb.optics import _tree_kernels
from skindb.optics.diffusion import (
    S_MAX,
    diffuse_reflectance,
    dipole_profile,
    dipole_s,
    scattering_coefficients,
)
from skindb.optics.dipole_tree import LIGHTS_PER_WALK, subsurface_exitance

ETA = 1.3
FLOAT32 = 2e-6  # power and results are float32; the sums are float64


def _sphere(n: int, radius: float = 30.0):
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    phi = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z * z)
    points = radius * np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    return points, np.full(n, 4 * np.pi * radius**2 / n)


def _skin(n: int):
    diffuse = np.tile([0.5, 0.3, 0.2], (n, 1)) * np.linspace(0.8, 1.2, n)[:, None]
    return diffuse, dipole_s(diffuse, eta=ETA)[0], np.tile([0.55, 0.98, 1.55], (n, 1))


def _striped(points: np.ndarray, lights: int) -> np.ndarray:
    """(n, lights) light from all sides with hard shadows."""
    towards = np.random.default_rng(3).normal(size=(3, lights))
    return np.maximum(points @ towards, 0) * (
        np.sin(points[:, 1:2] + np.arange(lights)) > 0
    )


# 1e-6: float32, on a sphere so small that every point counts; 0.1 costs about 0.3 %
# without normalisation
@pytest.mark.parametrize(
    ("tolerance", "radius", "bound"), [(0.0, 4.0, 1e-6), (0.1, 8.0, 4e-3)]
)
def test_subsurface_exitance__against_the_plain_sum(tolerance, radius, bound):
    points, area = _sphere(4000, radius)
    _, s, tr = _skin(4000)
    light = _striped(points, 11)
    got = subsurface_exitance(
        points, area, light, s, tr, eta=ETA, tolerance=tolerance, normalise=False
    )
    some = np.arange(0, 4000, 97)
    r = np.linalg.norm(points[some, None] - points, axis=-1)
    a, scattered = scattering_coefficients(s, tr)
    for c in range(3):
        kernel = dipole_profile(
            r, a[some, c : c + 1], scattered[some, c : c + 1], eta=ETA
        )
        want = (kernel @ (light * area[:, None])).T
        gap = ((got[:, some, c] - want) ** 2).mean(axis=1) / (want**2).mean(axis=1)
        assert np.sqrt(gap).max() < bound


@pytest.mark.parametrize("lights", [3, LIGHTS_PER_WALK + 2])
def test_subsurface_exitance__a_light_does_not_depend_on_the_others(lights):
    points, area = _sphere(2000)
    _, s, tr = _skin(2000)
    light = _striped(points, lights)
    together = subsurface_exitance(points, area, light, s, tr, eta=ETA)
    for i in (0, lights - 1):
        alone = subsurface_exitance(points, area, light[:, i : i + 1], s, tr, eta=ETA)[
            0
        ]
        np.testing.assert_array_equal(together[i], alone)


def test_subsurface_exitance__two_threads_at_once_give_the_same_bits():
    points, area = _sphere(6000)
    _, s, tr = _skin(6000)
    light = _striped(points, 4)

    def half(columns):
        return subsurface_exitance(points, area, light[:, columns], s, tr, eta=ETA)

    halves = [slice(0, 2), slice(2, 4)] * 2
    with ThreadPoolExecutor(2) as pool:
        at_once = list(pool.map(half, halves))
    for one, columns in zip(at_once, halves, strict=True):
        np.testing.assert_array_equal(one, half(columns))


def test_subsurface_exitance__other_receivers_do_not_matter():
    points, area = _sphere(5000)
    _, s, tr = _skin(5000)
    light = _striped(points, LIGHTS_PER_WALK + 2)
    wanted = np.random.default_rng(2).random(5000) < 0.6
    whole = subsurface_exitance(points, area, light, s, tr, eta=ETA)
    part = subsurface_exitance(points, area, light, s, tr, eta=ETA, receivers=wanted)
    np.testing.assert_array_equal(part, np.where(wanted[:, None], whole, 0))
    assert not subsurface_exitance(
        points, area, light, s, tr, eta=ETA, receivers=wanted & False
    ).any()


def test_subsurface_exitance__uniform_light_gives_rd():
    points, area = _sphere(3000)
    diffuse, s, tr = _skin(3000)
    got = subsurface_exitance(points, area, np.ones((3000, 1)), s, tr, eta=ETA)[0]
    np.testing.assert_allclose(got, diffuse, rtol=FLOAT32)


def test_subsurface_exitance__plain_sum_of_a_fine_surface_is_rd():
    """Without normalisation, points 0.5 mm apart: the kernel's integral over a nearly
    flat surface (radius 30 mm).
    """
    points, area = _sphere(45000)
    _, s, tr = _skin(45000)
    got = subsurface_exitance(
        points, area, np.ones((45000, 1)), s, tr, eta=ETA, normalise=False
    )[0]
    ratio = got / diffuse_reflectance(s, eta=ETA)
    # curvature and 0.5 mm spacing
    np.testing.assert_allclose(np.median(ratio, axis=0), 1.0, atol=0.02)
    # blue at the poles, where the spiral is uneven
    assert np.abs(ratio - 1).max() < 0.08


def test_decay__against_exp():
    x = np.concatenate([[0.0], np.geomspace(1e-6, 24.0, 400)])
    got = np.array([_tree_kernels._decay(float(v)) for v in x])
    np.testing.assert_allclose(got, np.exp(-x), rtol=1e-6)
    assert _tree_kernels._decay(700.0) < 4e-11


# extreme inputs, on points 0.2 mm apart


def _exitance(points, light, s=0.7, tr=1.0, *, eta=ETA, area=0.04):
    n = len(points)
    medium = np.full((n, 3), s), np.full((n, 3), tr)
    return subsurface_exitance(points, np.full(n, area), light, *medium, eta=eta)


def _patch(n=900):
    side = round(n**0.5)
    x, y = np.meshgrid(np.arange(side) * 0.2, np.arange(side) * 0.2)
    return np.stack([x.ravel(), y.ravel(), 0.01 * x.ravel() * y.ravel()], axis=1)


@pytest.mark.parametrize(
    ("s", "tr", "eta"),
    [
        (0.0, 1.0, ETA),
        (0.7, 0.01, ETA),
        (0.7, 100.0, ETA),
        (S_MAX - 1e-6, 1.0, ETA),
        (0.7, 1.0, 1.0),
    ],
)
def test_subsurface_exitance__uniform_light_on_any_medium_gives_rd(s, tr, eta):
    exitance = _exitance(_patch(), np.ones((900, 2)), s, tr, eta=eta)
    # s has a lower bound in the code
    expected = diffuse_reflectance(np.maximum(s, 1e-4), eta=eta)
    np.testing.assert_allclose(exitance, expected, rtol=FLOAT32)


def test_subsurface_exitance__uniform_light_on_any_points_gives_rd():
    expected = diffuse_reflectance(0.7, eta=ETA)
    line = np.stack([0.2 * np.arange(300), np.zeros(300), np.zeros(300)], axis=1)
    for points in (*(_patch(2500)[:n] for n in (0, 1, 3, 2400)), line):
        exitance = _exitance(points, np.ones((len(points), 1)))
        assert exitance.shape == (1, len(points), 3)
        np.testing.assert_allclose(exitance, expected, rtol=FLOAT32)
    assert _exitance(np.zeros((1, 3)), np.ones((1, 0))).shape == (0, 1, 3)


def test_subsurface_exitance__points_in_one_place_receive_the_mean_of_the_light():
    exitance = _exitance(np.zeros((50, 3)), np.linspace(0, 2, 50)[:, None])
    expected = diffuse_reflectance(0.7, eta=ETA)
    np.testing.assert_allclose(exitance, expected, rtol=FLOAT32)


def test_subsurface_exitance__patches_a_kilometre_apart_exchange_no_light():
    both = np.concatenate([_patch(), _patch() + np.array([1e6, 0, 0])])
    exitance = _exitance(both, np.repeat([1.0, 0.0], 900)[:, None])[0]
    expected = diffuse_reflectance(0.7, eta=ETA)
    np.testing.assert_allclose(exitance[:900], expected, rtol=FLOAT32)
    np.testing.assert_array_equal(exitance[900:], 0.0)


def test_subsurface_exitance__any_scale_of_light_and_lengths():
    light = np.linspace(0, 1, 900)[:, None]
    expected = _exitance(_patch(), light)
    for scale in (1e-30, 1e-12, 1e12, 1e30):
        brighter = _exitance(_patch(), light * scale)
        np.testing.assert_allclose(brighter / scale, expected, rtol=FLOAT32, atol=1e-12)
    for scale in (1e-6, 1e6):
        points = _patch() * scale
        larger = _exitance(points, light, tr=1.0 / scale, area=0.04 * scale * scale)
        np.testing.assert_allclose(larger, expected, rtol=1e-5)
    np.testing.assert_array_equal(_exitance(_patch(), 0 * light), 0.0)


def test_subsurface_exitance__a_nan_stays_in_its_light():
    light = np.ones((900, 2))
    light[450, 0] = np.nan
    exitance = _exitance(_patch(), light)
    assert np.isnan(exitance[0, 450]).all()
    np.testing.assert_allclose(
        exitance[1], diffuse_reflectance(0.7, eta=ETA), rtol=FLOAT32
    )
