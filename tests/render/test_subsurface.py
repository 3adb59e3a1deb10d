"""Subsurface light against sums over a fine grid, and the meshes on which it is interpolated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.interpolate import LinearNDInterpolator

from skindb.geometry.rays import RayScene
from skindb.optics.diffusion import (
    diffuse_reflectance,
    dipole_profile,
    dipole_s,
    scattering_coefficients,
)
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.mixture import Mixture
from skindb.render.scene import (
    Camera,
    Environment,
    Lighting,
    Lights,
    Surface,
    subdivide_surface,
)
from skindb.render.subsurface import (
    received_irradiance,
    refined_surface,
    subsurface_light,
)
from tests.pictures import render_view

HALF = 20.0  # mm, of the side of the square
EDGE = 0.13  # mm, where the shadow ends, inside the coarse triangles
SIGMA_TR = np.array([0.5, 0.7, 1.2])
REFLECTANCE = np.array([0.5, 0.4, 0.3])
ETA = 1.3


def skin(cells: int) -> Surface:
    """A square in the plane z = 0, and a wall at x = EDGE which neither sends nor receives
    subsurface light.
    """
    line = np.linspace(-HALF, HALF, cells + 1)
    x, y = np.meshgrid(line, line)
    square = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right = np.stack([i, i + 1, i + cells + 2], 1)
    left = np.stack([i, i + cells + 2, i + cells + 1], 1)
    n = len(square)
    side, top = 60.0, 60.0
    wall = [[EDGE, -side, 0], [EDGE, side, 0], [EDGE, side, top], [EDGE, -side, top]]
    two = [[n, n + 1, n + 2], [n, n + 2, n + 3]]
    colour = np.tile(REFLECTANCE, (n + 4, 1))
    s, _ = dipole_s(colour, eta=ETA)
    s[n:] = np.nan
    return Surface(
        np.concatenate([square, wall]),
        np.concatenate([right, left, two]),
        np.repeat([[0.0, 0, 1], [-1.0, 0, 0]], [n, 4], axis=0),
        colour,
        np.zeros((n + 4, 1)),
        Mixture(np.zeros((4, 4, 4, 1), np.float32)),
        s,
        np.tile(SIGMA_TR, (n + 4, 1)),
        ETA,
    )


def above(width: int = 160) -> Camera:
    """A camera 300 mm above the square, which fills its picture."""
    K = np.array([[7.5 * width, 0, width / 2], [0, 7.5 * width, width / 2], [0, 0, 1]])
    R = np.diag([1.0, -1, -1])
    return Camera(K, R, np.array([0.0, 0, 300]), np.zeros(5), width, width)


# a lamp whose light the wall keeps from x < EDGE, and a beam that makes a spot of 3 mm there
PLACE = np.array([[400.0, 0, 400], [-10.0, 0, 60]])
LAMPS = Lights(
    PLACE,
    np.repeat([[3.2e5], [2e3]], 3, axis=1),
    np.zeros(2),
    np.array([-PLACE[0] / np.linalg.norm(PLACE[0]), [0.0, 0, -1]]),
    np.array([0.0, 800]),
)


def summed_light(x: np.ndarray) -> np.ndarray:
    """Exitance (n, 3) at the points (x, 0, 0): the sum over a grid of 0.2 mm."""
    step = 0.2
    middle = (np.arange(-100, 100) + 0.5) * step + EDGE
    points = np.stack(np.meshgrid(middle, middle, [0.0]), axis=-1).reshape(-1, 3)
    received = np.zeros(len(points))
    for i in range(2):
        towards = LAMPS.position[i] - points
        distance = np.linalg.norm(towards, axis=1)
        cosine = towards[:, 2] / distance
        along = (-towards @ LAMPS.axis[i] / distance) ** LAMPS.falloff[i]
        seen = (points[:, 0] > EDGE) == (i == 0)
        passed = fresnel_transmittance(cosine, ETA)
        strength = LAMPS.intensity[i, 0] / distance**2
        received += seen * strength * along * cosine * passed
    s, _ = dipole_s(REFLECTANCE, eta=ETA)
    absorbed, scattered = scattering_coefficients(s, SIGMA_TR)
    at = np.stack([x, 0 * x, 0 * x], axis=1)
    r = np.linalg.norm(at[:, None] - points, axis=2)[..., None]
    profile = dipole_profile(r, absorbed, scattered, eta=ETA)
    mean = np.einsum("xpc,p->xc", profile, received) / profile.sum(axis=1)
    return mean * diffuse_reflectance(s, eta=ETA)


def test_subsurface_light__at_a_shadow_and_at_a_bright_spot_is_the_sum() -> None:
    """On triangles of 5 mm: within 0.6 % (RMS) of the brightest light, twice the standard error
    of eight passes.
    """
    coarse = skin(8)
    lighting = Lighting(LAMPS)
    scene = RayScene(coarse.vertices, coarse.faces)
    fine = refined_surface(coarse, above(), lighting, scene)
    flat = fine.vertices[:, 2] == 0
    light, _ = subsurface_light(
        fine,
        lighting,
        scene,
        flat,
        tolerance=0.1,
        count=8,
        rng=np.random.default_rng(0),
    )
    for low, high in ((-4.0, 4.0), (-14.0, -6.0)):
        x = np.linspace(low, high, 15)
        true = summed_light(x)
        at = np.stack([x, 0 * x], axis=1)
        found = LinearNDInterpolator(fine.vertices[flat, :2], light[flat])(at)
        off = np.sqrt(np.mean((found - true) ** 2, axis=0)) / true.max(axis=0)
        assert (off < 0.006).all()


@pytest.mark.parametrize("most", [4_000_000, 1])
def test_received_irradiance__of_even_surroundings_with_many_and_few_directions(
    most, monkeypatch
) -> None:
    """The wall hides a quarter of the sphere, which is half of the light."""
    monkeypatch.setattr("skindb.render.subsurface.MAX_DIRECTIONS", most)
    surface = skin(8)
    lighting = Lighting(None, Environment(np.ones((8, 16, 3))))
    points = np.tile([EDGE + 1e-3, 0, 0], (4000, 1))
    scene = RayScene(surface.vertices, surface.faces)
    received = received_irradiance(
        points,
        np.tile([0.0, 0, 1], (len(points), 1)),
        lighting,
        scene,
        eta=ETA,
        rng=np.random.default_rng(0),
    )
    whole = (
        2 * np.pi * quad(lambda c: c * float(fresnel_transmittance(c, ETA)), 0, 1)[0]
    )
    error = received.std(axis=0) / np.sqrt(len(points))
    np.testing.assert_array_less(np.abs(received.mean(axis=0) - whole / 2), 4 * error)


def test_refined_surface__divides_triangles_where_light_changes() -> None:
    coarse = skin(8)
    scene = RayScene(coarse.vertices, coarse.faces)
    fine = refined_surface(coarse, above(), Lighting(LAMPS.select([0])), scene)
    new = fine.vertices[len(coarse.vertices) :]
    # only in the rows of triangles beside the edge of the shadow, down to half a depth
    assert np.abs(new[:, 0]).max() <= 10
    near = np.sort(np.unique(new[np.abs(new[:, 0]) < 4, 0]))
    depth = (dipole_s(REFLECTANCE, eta=ETA)[0] / SIGMA_TR).min()
    assert np.diff(near).max() <= depth / 2


def test_subdivide_surface__pictures_without_subsurface_light_stay_the_same() -> None:
    coarse = replace(skin(8), s=None, sigma_tr=None)
    finer = subdivide_surface(coarse, 1.0, 100 * coarse.vertices)
    assert finer.s is None
    assert len(finer.vertices) > 20 * len(coarse.vertices)
    one, other = (render_view(each, above(40), LAMPS)[0] for each in (coarse, finer))
    # rays are traced in single precision
    np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-6 * one.max())


def test_subdivide_surface__ends_at_the_largest_number_of_vertices(monkeypatch) -> None:
    monkeypatch.setattr("skindb.render.scene.MAX_VERTICES", 1000)
    coarse = skin(8)
    finer = subdivide_surface(coarse, 0.1, 100 * coarse.vertices)
    assert len(coarse.vertices) < len(finer.vertices) <= 1000
