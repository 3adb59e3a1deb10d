"""The white target: which pixels show it, where on it they look, and which lights it shows."""

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
    light_intensities,
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
