"""Irradiance and intensities of the lights from the white target."""

from __future__ import annotations

import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from sphere import TARGET

from skindb.calibration.irradiance import (
    PIXELS_PER_BLOCK,
    TARGET_INTERIOR_FRACTION,
    TargetPixels,
    fit_light,
    light_intensities,
    position_sensitivity,
    target_pixels,
)
from skindb.calibration.radiance import frame_mergers
from skindb.errors import InputError
from skindb.format.dome import CameraRecord, WhiteRecord
from skindb.format.folder import read_capture
from skindb.geometry.camera import project

Z = 900.0
FOCAL = 2000.0
FLAT = WhiteRecord(
    "", 0.9, np.array([12.0, -7.0, Z]), np.array([0, 0, -1.0]), 50.0, ("c0",)
)


@pytest.fixture
def camera(pristine) -> CameraRecord:
    """Of 850 x 700 pixels, which is many blocks, looking along z from the origin."""
    matrix = np.array([[FOCAL, 0, 425], [0, FOCAL, 350], [0, 0, 1]])
    found = read_capture(pristine).dome.cameras[0]
    return replace(
        found,
        width=850,
        height=700,
        K=matrix,
        R=np.eye(3),
        t=np.zeros(3),
        distortion=np.zeros(5),
    )


def test_target_pixels__of_a_target_that_faces_the_camera_are_a_disc(camera):
    assert camera.width * camera.height > 5 * PIXELS_PER_BLOCK
    target = target_pixels(camera, FLAT)
    y, x = (
        (np.mgrid[:700, :850] + 0.5 - np.array([350, 425])[:, None, None]) * Z / FOCAL
    )
    disc = np.hypot(x - 12, y + 7) < TARGET_INTERIOR_FRACTION * 50
    np.testing.assert_array_equal(target.at, np.flatnonzero(disc))
    np.testing.assert_allclose(
        target.points, np.stack([x, y, np.full_like(x, Z)], axis=-1)[disc], rtol=1e-12
    )
    for row, (first, last) in zip(disc, target.spans, strict=True):
        assert np.flatnonzero(row).tolist() == list(range(first, last))


def test_target_pixels__see_their_points(camera):
    lens = replace(
        camera, distortion=np.array([-0.2, 0.05, 1e-3, -2e-3, 0.01]), width=853
    )
    tilted = replace(FLAT, normal=np.array([0.6, 0, -0.8]))
    target = target_pixels(lens, tilted)
    seen, _ = project(target.points, lens.K, lens.R, lens.t, lens.distortion)
    row, column = np.divmod(target.at, 853)
    # of undistort: 1e-7 px
    np.testing.assert_allclose(seen, np.stack([column, row], axis=1) + 0.5, atol=1e-6)
    np.testing.assert_allclose(
        (target.points - tilted.point) @ tilted.normal, 0, atol=1e-9
    )
    assert len(target.at) > 10_000


def test_target_pixels__none_behind_the_camera(camera):
    assert len(target_pixels(camera, replace(FLAT, point=np.array([0, 0, -Z]))).at) == 0


def test_target_pixels__memory_is_of_a_block_and_of_the_target(camera):
    small = replace(FLAT, half_size=5.0)
    target_pixels(camera, small)
    tracemalloc.start()
    target_pixels(camera, small)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # rays and points of all pixels: 78 MB
    assert peak < 160 * PIXELS_PER_BLOCK + 4 * camera.width * camera.height


AWAY = {
    "turned away": {"axis": np.array([0.0, 0.0, 1.0]), "falloff": 2.0},
    "behind the target": {"position": np.array([0.0, 0.0, -500.0])},
    "in the plane of the target": {"position": np.array([400.0, 0.0, 60.0])},
    "on the target": {"position": np.array(TARGET["point"], float), "falloff": 1.0},
}


@pytest.mark.parametrize("how", AWAY)
def test_light_intensities__a_light_that_does_not_light_the_target_is_one_fault(
    pristine, how
):
    """And no warning of arithmetic, which the tests make an error."""
    dome = read_capture(pristine).dome
    others = [replace(light, intensity=np.ones(3)) for light in dome.lights[1:]]
    dome = replace(dome, lights=(replace(dome.lights[0], **AWAY[how]), *others))
    message = (
        "light l0: every light must illuminate the white target; found no usable pixel"
    )
    with (
        ThreadPoolExecutor(2) as pool,
        pytest.raises(InputError, match=message) as caught,
    ):
        light_intensities(dome, frame_mergers(dome, []), pool)
    assert len(caught.value.faults) == 1


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


def test_fit_light__knows_its_error():
    fits = [fit_light(target(np.random.default_rng(s)), falloff=2.0) for s in range(40)]
    z = np.array([(f.intensity - INTENSITY) / f.intensity_error for f in fits])
    # 40 z-scores: their mean has a deviation of 0.16, their deviation one of 0.11
    assert (np.abs(z.mean(axis=0)) < 0.6).all()
    assert ((z.std(axis=0) > 0.65) & (z.std(axis=0) < 1.35)).all()


def test_fit_light__is_within_a_thousandth():
    fit = fit_light(target(np.random.default_rng(1)), falloff=2.0)
    # 2,500 pixels of 1 %: 0.02 %
    np.testing.assert_allclose(fit.intensity, INTENSITY, rtol=0.001)


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
            fit_light(replace(taken, radiance=radiance), falloff=2.0)
    behind = replace(taken, normal=np.array([0.0, 0.0, -1.0]))
    with pytest.raises(InputError, match="at least 50"):
        fit_light(behind, falloff=2.0)


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


@pytest.mark.parametrize("source", ["given", "white target", "relative"])
def test_light_intensities__are_multiplied_by_the_gain_of_the_light(pristine, source):
    dome = read_capture(pristine).dome
    if source == "given":
        lights = tuple(replace(x, intensity=np.array([3.0, 2, 1])) for x in dome.lights)
        dome = replace(dome, lights=lights)
    if source == "relative":
        dome = replace(dome, white=None)
    gains = np.linspace(0.8, 1.3, len(dome.lights))
    # gains are relative to the intensity that the stated position gives
    offset = np.array([0.0, 30.0, 0.0]) * (source == "white target")
    lights = (
        replace(x, gain=g, position=x.position + offset, offset=tuple(offset))
        for x, g in zip(dome.lights, gains, strict=True)
    )
    brighter = replace(dome, lights=tuple(lights))
    with ThreadPoolExecutor(2) as pool:
        plain, changed = (
            light_intensities(each, frame_mergers(each, []), pool)
            for each in (dome, brighter)
        )
    np.testing.assert_allclose(changed, plain * gains[:, None], rtol=1e-12)
