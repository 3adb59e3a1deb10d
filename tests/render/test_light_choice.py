from __future__ import annotations

from dataclasses import replace

import numpy as np

from skindb.render.monte_carlo import LIGHTS_PER_RAY, LightChoice, Lighting
from skindb.render.scene import Lights
from skindb.render.shading import trace_view
from tests.render.test_monte_carlo import ball, camera, rendered

COUNT = 32


def around(count: int = COUNT) -> Lights:
    """Lights all around, of different powers."""
    rng = np.random.default_rng(3)
    position = rng.standard_normal((count, 3))
    position *= 500 / np.linalg.norm(position, axis=1, keepdims=True)
    intensity = rng.uniform(1e5, 5e5, (count, 1)) * np.ones(3)
    return Lights(
        position, intensity, np.zeros(count), -position / 500, np.zeros(count)
    )


def test_light_choice__draws_by_its_probabilities() -> None:
    view = trace_view(ball(), camera(), samples=4)
    choice = LightChoice.of_lights(around(), np.zeros(3))
    rng = np.random.default_rng(1)
    drawn = [pair for _ in range(50) for pair in choice.draw(view, rng)]
    found = sum(np.bincount(at, minlength=COUNT) for at, _ in drawn)
    # the sum of the inverse probabilities of a light, over the hits, estimates the number of hits
    weights = (
        sum(np.bincount(at, weights=weight, minlength=COUNT) for at, weight in drawn)
        / 50
    )
    assert found.sum() == 50 * LIGHTS_PER_RAY * len(view.pixel)
    # of the rarest light, which is behind the ball
    np.testing.assert_allclose(weights, len(view.pixel), rtol=0.06)


def test_light_choice__light_from_below_the_horizon_is_rare() -> None:
    view = trace_view(ball(), camera(), samples=4)
    lights = around()
    rng = np.random.default_rng(1)
    above = [
        np.einsum("nc,nc->n", lights.position[at] - view.position, view.normal) > 0
        for at, _ in LightChoice.of_lights(lights, np.zeros(3)).draw(view, rng)
    ]
    assert np.mean(above) > 0.9  # half of the lights are below the horizon of a place


def test_light_choice__few_lights_are_all_used() -> None:
    view = trace_view(ball(), camera(), samples=2)
    pairs = LightChoice.of_lights(around(3), np.zeros(3)).draw(
        view, np.random.default_rng(1)
    )
    assert [set(at) for at, _ in pairs] == [{0}, {1}, {2}]
    assert all((weight == 1).all() for _, weight in pairs)


def test_light_choice__lights_that_are_off_give_a_black_picture() -> None:
    dark = replace(around(), intensity=np.zeros((COUNT, 3)))
    assert rendered(ball(), Lighting(dark), samples=16).radiance.max() == 0
