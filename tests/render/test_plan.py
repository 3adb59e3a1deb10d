"""What a plan skips, against pictures that skip nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skindb.geometry.rays import RayScene
from skindb.optics.diffusion import dipole_s
from skindb.render.monte_carlo import Lighting, Quality, render_monte_carlo
from skindb.render.plan import covered_pixels, notable_lights, plan_scene
from skindb.render.scene import Camera, Lights, Surface, from_model
from skindb.render.shading import render_view, trace_view
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


def whole(surface: Surface, lights: Lights, **options) -> np.ndarray:
    return render_view(
        surface, front(), lights, samples=2, disc_samples=4, **options
    ).sum(axis=0)


def apart(found: np.ndarray, true: np.ndarray) -> float:
    """RMS difference over RMS."""
    return float(np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2)))


def planned(surface: Surface, lights: Lights, error: float, **options):
    """The lights that are kept, and the omission or None."""
    scene = RayScene(surface.vertices, surface.faces)
    view = trace_view(surface, front(), scene=scene)
    kept, omissions = notable_lights(
        lights, surface, view, scene, error=error, **options
    )
    return kept, omissions[0] if omissions else None


POWERS = {
    "one dominates": np.append(np.full(20, 1.0), 1e5),
    "eight decades": 10.0 ** np.random.default_rng(1).uniform(-3, 5, 24),
    "half are faint": np.repeat([1.0, 1e4], 10),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(POWERS))
@pytest.mark.parametrize("subsurface", [False, True])
def test_notable_lights__pictures_agree_within_the_bound(
    name: str, subsurface: bool
) -> None:
    surface = skin()
    lights = around(POWERS[name])
    true = whole(surface, lights, subsurface=subsurface)
    for error in (0.5, 0.05, 0.005):
        kept, omission = planned(surface, lights, error, indirect=subsurface)
        assert omission is not None
        assert omission.skipped == len(lights) - len(kept) > 0
        assert 0 < omission.bound <= 0.1 * error
        assert (
            0
            < apart(whole(surface, kept, subsurface=subsurface), true)
            <= omission.bound
        )


def test_notable_lights__one_dominating_light_is_enough() -> None:
    kept, omission = planned(skin(), around(POWERS["one dominates"]), 0.05)
    assert len(kept) == 1
    assert kept.intensity.max() == 1e5
    assert (
        "lights: 20 of 21 are skipped (together they contribute less than 0.1 of the wanted error)"
        in str(omission)
    )


@pytest.mark.parametrize("error", [0.05, 0.01])
@pytest.mark.parametrize("subsurface", [False, True])
def test_notable_lights__equal_lights_are_all_kept(
    error: float, subsurface: bool
) -> None:
    lights = around(np.ones(24))
    kept, omission = planned(skin(), lights, error, indirect=subsurface)
    assert kept is lights
    assert omission is None


def test_plan_scene__bounds_are_relative_to_the_terms_of_the_picture() -> None:
    surface = skin()
    lights = around(POWERS["eight decades"])
    parts = {
        ("diffuse",): replace(surface, parameters=0 * surface.parameters),
        ("surface",): replace(surface, diffuse=0 * surface.diffuse),
        ("diffuse", "surface"): surface,
    }
    bounds = {}
    for terms, part in parts.items():
        plan = plan_scene(
            surface,
            front(),
            Lighting(lights),
            RayScene(surface.vertices, surface.faces),
            error=0.05,
            terms=terms,
        )
        (omission,) = [one for one in plan.omissions if one.what == "lights"]
        bounds[terms] = omission.bound
        assert omission.bound == pytest.approx(planned(part, lights, 0.05)[1].bound)
        assert plan.surface is surface
    assert len(set(bounds.values())) == 3


def test_notable_lights__in_the_dark_nothing_is_skipped() -> None:
    lights = around(np.ones(3))
    behind = replace(lights, position=lights.position * [1, 1, -1])
    assert (
        planned(skin(), replace(lights, intensity=0 * lights.intensity), 0.1)[1] is None
    )
    kept, omission = planned(skin(), behind, 0.1)
    assert (
        omission is None
        or apart(whole(skin(), kept), whole(skin(), behind)) <= omission.bound
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
