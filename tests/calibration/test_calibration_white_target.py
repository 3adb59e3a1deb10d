from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skindb.calibration.irradiance import TargetPixels, fit_light, position_sensitivity
from skindb.errors import InputError

INTENSITY = np.array([900.0, 1000.0, 800.0])
POSITION = np.array([200.0, 150.0, 700.0])


def target(rng, *, falloff=2.0, noise=0.01, half=75.0, tilt=0.25):
    """A square of 50 x 50 px, lit by one light whose axis points `tilt` rad beside its middle."""
    side = np.linspace(-half, half, 50)
    points = np.stack([*np.meshgrid(side, side), np.zeros((50, 50))], axis=-1).reshape(
        -1, 3
    )
    axis = -POSITION / np.linalg.norm(POSITION)
    axis = np.cos(tilt) * axis + np.sin(tilt) * np.cross(
        axis, [0, 1, 0]
    ) / np.linalg.norm(np.cross(axis, [0, 1, 0]))
    way = points - POSITION
    distance = np.linalg.norm(way, axis=1)
    cosine = -way[:, 2] / distance
    angle = way @ axis / distance
    radiance = (
        INTENSITY * (0.9 / np.pi * cosine * angle**falloff / distance**2)[:, None]
    )
    radiance = radiance * (1 + noise * rng.standard_normal(radiance.shape))
    return TargetPixels(
        radiance, points, POSITION, axis, np.array([0.0, 0.0, 1.0]), 0.9
    )


def test_fit_light__finds_intensity_and_falloff_and_knows_their_errors():
    fits = [fit_light(target(np.random.default_rng(s))) for s in range(40)]
    z = np.array(
        [
            [
                (f.falloff - 2) / f.falloff_error,
                *((f.intensity - INTENSITY) / f.intensity_error),
            ]
            for f in fits
        ]
    )
    # 40 z-scores: their mean has a deviation of 0.16, their deviation one of 0.11
    assert (np.abs(z.mean(axis=0)) < 0.6).all()
    assert ((z.std(axis=0) > 0.65) & (z.std(axis=0) < 1.35)).all()


def test_fit_light__with_a_known_falloff_is_within_a_thousandth():
    fit = fit_light(target(np.random.default_rng(1)), falloff=2.0)
    # 2,500 pixels of 1 %: 0.02 %
    np.testing.assert_allclose(fit.intensity, INTENSITY, rtol=0.001)
    assert fit.falloff_error == 0.0


@pytest.mark.parametrize("shadowed", [0.1, 0.3, 0.4])
def test_fit_light__leaves_out_shadows_and_saturated_pixels(shadowed):
    taken = target(np.random.default_rng(2))
    radiance = taken.radiance.copy()
    radiance[: int(2500 * shadowed)] *= 0.3
    radiance[-300:, 1] = np.nan  # saturated in green
    fit = fit_light(replace(taken, radiance=radiance), falloff=2.0)
    # 0.03 % of noise, and what 4 deviations keep
    np.testing.assert_allclose(fit.intensity, INTENSITY, rtol=0.002)
    assert fit.used == pytest.approx(1 - 2500 * shadowed / 2200, abs=0.02)


def test_fit_light__refuses_a_target_that_tells_nothing():
    taken = target(np.random.default_rng(3))
    for radiance in (np.full((2500, 3), np.nan), np.zeros((2500, 3))):
        with pytest.raises(InputError, match="at least 50"):
            fit_light(replace(taken, radiance=radiance))
    with pytest.raises(InputError, match="the shape"):
        fit_light(replace(taken, radiance=np.ones((5, 3))))
    behind = replace(taken, normal=np.array([0.0, 0.0, -1.0]))
    with pytest.raises(InputError, match="at least 50"):
        fit_light(behind)


def test_position_sensitivity__is_the_gradient_of_the_inverse_square_and_the_cosine():
    small = target(np.random.default_rng(4), half=0.5, tilt=0.0)
    distance = np.linalg.norm(POSITION)
    towards = POSITION / distance
    cosine = POSITION[2] / distance
    # of 3 ln d - ln((light - point) . normal); the cosine to an axis that meets the
    # point has no gradient
    expected = np.linalg.norm(3 * towards - np.array([0, 0, 1]) / cosine) / distance
    for falloff in (0.0, 2.0):
        assert position_sensitivity(small, falloff=falloff) == pytest.approx(
            expected, rel=1e-4
        )
    # the fitted intensity changes by as much along the direction of the gradient
    moved = replace(
        small,
        position=POSITION
        + (3 * towards - np.array([0, 0, 1]) / cosine) / expected / distance,
    )
    change = np.log(
        fit_light(moved, falloff=0.0).intensity
        / fit_light(small, falloff=0.0).intensity
    )
    # a step of 1 mm from 740 mm is nearly linear
    np.testing.assert_allclose(change, expected, rtol=0.01)
