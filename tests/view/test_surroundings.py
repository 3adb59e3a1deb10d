"""Distant lights that stand for an environment."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.optics.fresnel import fresnel_transmittance
from skindb.render.scene import Environment, Surface
from skindb.view.face import distant_lights, overcast_sky
from skindb.view.transfer import even_directions, harmonics, sky_transfer


def irradiance(environment, normal):
    """Integral over the texels, each divided into 4 x 4: (n, 3)."""
    fine = np.repeat(np.repeat(environment.radiance, 4, axis=0), 4, axis=1)
    h, w, _ = fine.shape
    theta = np.pi * (np.arange(h) + 0.5) / h
    phi = 2 * np.pi * ((np.arange(w) + 0.5) / w - 0.5)
    solid = np.sin(theta) * (np.pi / h) * (2 * np.pi / w)
    towards = np.stack(
        [
            np.sin(theta)[:, None] * np.sin(phi),
            np.cos(theta)[:, None] + 0 * phi,
            np.sin(theta)[:, None] * np.cos(phi),
        ],
        axis=-1,
    )
    cosine = np.maximum(np.einsum("hwk,nk->nhw", towards, normal), 0)
    return np.einsum("nhw,hwc->nc", cosine * solid[None, :, None], fine)


def of_lights(lights, normal):
    return np.maximum(normal @ lights.direction.T, 0) @ lights.irradiance


def test_distant_lights__give_the_irradiance_of_the_environment():
    for seed in range(30):
        rng = np.random.default_rng(seed)
        rows = int(rng.integers(4, 40))
        environment = (
            Environment(rng.random((rows, 2 * rows, 3)) ** rng.uniform(0, 8) + 1e-3)
            if seed
            else overcast_sky()
        )
        lights = distant_lights(environment)
        assert len(lights.direction) <= 256
        np.testing.assert_allclose(np.linalg.norm(lights.direction, axis=1), 1)
        normal = rng.standard_normal((20, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        true = irradiance(environment, normal)
        error = np.abs(of_lights(lights, normal) / true - 1)
        # a region covers about 0.05 sr, a part of which may be below the horizon of a
        # surface: all or nothing counts
        assert np.median(error) < 0.03
        assert np.sqrt((error**2).mean()) < 0.08


def test_distant_lights__converge():
    """Four times as many lights: the error falls at least by half."""
    rng = np.random.default_rng(0)
    environment = Environment(rng.random((32, 64, 3)) ** 3)
    normal = rng.standard_normal((50, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    true = irradiance(environment, normal)
    errors = [
        np.abs(of_lights(distant_lights(environment, count), normal) / true - 1).mean()
        for count in (16, 64, 256)
    ]
    assert errors[2] < errors[1] / 2 < errors[0] / 4


def test_distant_lights__of_a_single_texel():
    radiance = np.zeros((8, 16, 3))
    radiance[3, 5] = [1, 2, 3]
    lights = distant_lights(Environment(radiance))
    assert len(lights.direction) == 1
    np.testing.assert_allclose(
        lights.irradiance[0] / lights.irradiance[0, 0], [1, 2, 3]
    )


def test_distant_lights__of_a_sun_that_outshines_a_large_sky():
    radiance = np.ones((80, 160, 3))
    radiance[10, 30] = 1e8
    environment = Environment(radiance)
    lights = distant_lights(environment)
    normal = np.concatenate([np.eye(3), -np.eye(3)])
    np.testing.assert_allclose(
        of_lights(lights, normal), irradiance(environment, normal), rtol=0.1
    )


def test_harmonics__are_orthonormal():
    basis = harmonics(even_directions(4000))
    gram = 4 * np.pi / 4000 * basis.T @ basis
    # of the lattice: 1e-3 for polynomials of the degree 6
    np.testing.assert_allclose(gram, np.eye(16), atol=5e-3)


def test_sky_transfer__of_a_white_sky_is_the_visible_transmitted_cosine():
    """On a plane below a wall, against the integral over the visible quarter of the sky."""
    ground = [[-50, -50, 0], [50, -50, 0], [50, 0, 0], [-50, 0, 0]]
    wall = [[-9e4, 1, -1], [9e4, 1, -1], [9e4, 1, 9e4], [-9e4, 1, 9e4]]
    point = [0, 0, 0]
    surface = Surface(
        np.array([*ground, *wall, point], float),
        np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]),
        np.tile([0.0, 0, 1], (9, 1)),
        np.ones((9, 3)),
        np.zeros((9, 0)),
        model=None,
    )
    transfer = sky_transfer(surface, 4096)[8]
    cosine = (np.arange(1000) + 0.5) / 1000
    hemisphere = 2 * np.pi * np.mean(cosine * fresnel_transmittance(cosine, 1.3))
    half = hemisphere / 2 * harmonics(np.eye(3))[0, 0]
    assert transfer[0] == pytest.approx(half, rel=0.02)  # of 1,024 rays
    # the sky is seen at -y; 256 rays are what a page has
    assert transfer[2] < -0.5 * half
    few = sky_transfer(surface, 256)[8]
    np.testing.assert_allclose(few, transfer, atol=0.05 * half)
