"""What a plan skips, against pictures that skip nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skindb.geometry.rays import RayScene
from skindb.optics.diffusion import dipole_s
from skindb.render.monte_carlo import Quality, render_monte_carlo
from skindb.render.plan import covered_pixels, plan_scene
from skindb.render.scene import Camera, Lighting, Lights, Surface, from_model
from skindb.render.shading import trace_view
from tests.render.test_monte_carlo import ball, camera
from tests.small_face import small_face


def skin() -> Surface:
    """A face with a nose, which casts shadows."""
    return from_model(small_face())


def front(
    distortion: tuple[float, ...] = (0, 0, 0, 0, 0),
    distance: float = 400.0,
    focal: float = 200.0,
) -> Camera:
    K = np.array([[focal, 0, 40], [0, focal, 40], [0, 0, 1]])
    R = np.diag([1.0, -1, -1])
    return Camera(K, R, -R @ np.array([0, 0, distance]), np.array(distortion), 80, 80)


def around(power: np.ndarray, seed: int = 3, radius: float = 5.0) -> Lights:
    """Lights in random directions in front of the face, with these powers."""
    way = np.random.default_rng(seed).standard_normal((len(power), 3))
    way[:, 2] = np.abs(way[:, 2])
    place = 500 * way / np.linalg.norm(way, axis=1, keepdims=True)
    size = np.full(len(power), radius)
    return Lights(
        place,
        power[:, None] * np.array([1.0, 0.9, 0.8]),
        size,
        -place / 500,
        np.zeros(len(power)),
    )


CAMERAS = {
    "plain": front(),
    "distorted": front((-0.4, 0.1, 0.01, -0.02, 0.0)),
    "pincushion": front((0.5, 0.2, -0.01, 0.01, 0.0), distance=300.0),
    "strongly distorted": front((-0.4, 0.1, 0.0, 0.0, 0.0), distance=120.0, focal=60.0),
    "close": front(distance=120.0, focal=400.0),
    "wide": front(distance=60.0, focal=20.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CAMERAS))
@pytest.mark.parametrize("coarse", [False, True])
def test_covered_pixels__contain_every_hit(name: str, coarse: bool) -> None:
    surface = skin()
    if coarse:  # two triangles, so that their edges are as curved as they can be
        corner = np.array([[-60.0, -60, 0], [60, -60, 0], [60, 60, 0], [-60, 60, 0]])
        four = {
            key: getattr(surface, key)[:4]
            for key in ("diffuse", "parameters", "s", "sigma_tr")
        }
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        surface = replace(
            surface,
            vertices=corner,
            faces=faces,
            normals=np.tile([0.0, 0, 1], (4, 1)),
            **four,
        )
    mask, omissions = covered_pixels(surface, CAMERAS[name])
    every = trace_view(surface, CAMERAS[name], samples=4)
    assert mask.ravel()[every.pixel].all()
    assert sum(one.skipped for one in omissions) == (~mask).sum()
    if name in ("plain", "distorted"):
        assert (~mask).any()
        # a margin around the face, not the whole picture
        assert mask.sum() < 1.6 * (every.coverage > 0).sum() + 400


def test_covered_pixels__triangles_behind_the_camera_mean_all_pixels() -> None:
    mask, omissions = covered_pixels(ball(), front(distance=50.0))  # inside the ball
    assert mask.all()
    assert omissions == ()


@pytest.mark.parametrize("subsurface", [False, True])
def test_plan_scene__the_picture_is_the_same_to_the_bit(subsurface: bool) -> None:
    """Without a wanted error, whatever is skipped has the bound 0."""
    surface = ball(eta=1.3, weight=0.5)
    n = len(surface.vertices)
    surface = replace(
        surface,
        s=np.full((n, 3), dipole_s(0.6, eta=1.3)[0]),
        sigma_tr=np.full((n, 3), 1.0),
    )
    scene = RayScene(surface.vertices, surface.faces)
    lighting = Lighting(around(np.full(9, 1e5)))
    size = camera()
    plan = plan_scene(surface, size, lighting, scene, subsurface=subsurface)
    assert any(one.what == "pixels" for one in plan.omissions)
    quality = Quality(samples=16, subsurface=subsurface)
    found = [
        render_monte_carlo(
            one,
            size,
            light,
            quality,
            rng=np.random.default_rng(1),
            scene=scene,
            pixels=pixels,
        ).radiance
        for one, light, pixels in (
            (surface, lighting, None),
            (plan.surface, plan.lighting, plan.pixels),
        )
    ]
    np.testing.assert_array_equal(*found)
    assert found[0].max() > 0
