from __future__ import annotations

from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from skindb.calibration.mirror_ball import (
    Outline,
    ball_outline,
    distant_light,
    highlight_centre,
    light_position,
    reflected_ray,
    reprojection_error,
)
from skindb.errors import InputError
from skindb.format.dome import Pinhole
from skindb.geometry.camera import camera_centre, project

PUBLISHED = Path(__file__).resolve().parents[3] / "shared/data/photometric/uw"
RADIUS = 25.0  # mm
LIGHT = np.array([400.0, 500.0, 300.0])  # mm


def camera_at(centre):
    """A camera that looks at the origin."""
    forward = -np.asarray(centre) / np.linalg.norm(centre)
    right = np.cross([0, 1, 0], forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    K = np.array([[2000.0, 0, 640], [0, 2000.0, 512], [0, 0, 1]])
    return Pinhole(
        K, R, -R @ np.asarray(centre, float), np.array([-0.05, 0.01, 0.0, 0.0, 0.0])
    )


def highlight_of(camera, ball, light=LIGHT):
    """Pixel of the highlight by Fermat: the shortest way from camera over ball to light."""
    centre = camera_centre(camera.R, camera.t)

    def length(angles):
        z = np.cos(angles[0])
        phi = angles[1]
        normal = np.array(
            [np.sin(angles[0]) * np.cos(phi), np.sin(angles[0]) * np.sin(phi), z]
        )
        point = ball + RADIUS * normal
        return np.linalg.norm(point - centre) + np.linalg.norm(point - light), point

    half = (centre - ball) / np.linalg.norm(centre - ball) + (
        light - ball
    ) / np.linalg.norm(light - ball)
    half /= np.linalg.norm(half)
    start = [np.arccos(half[2]), np.arctan2(half[1], half[0])]
    best = minimize(
        lambda a: length(a)[0],
        start,
        method="Nelder-Mead",
        options={"xatol": 1e-10, "fatol": 1e-13},
    )
    return project(length(best.x)[1], camera.K, camera.R, camera.t, camera.distortion)[
        0
    ]


CAMERAS = [
    camera_at([0.0, 0.0, 1000.0]),
    camera_at([500.0, 100.0, 900.0]),
    camera_at([-500.0, -100.0, 900.0]),
]
PLACES = [
    np.array([0.0, 0.0, 0.0]),
    np.array([60.0, 40.0, 0.0]),
    np.array([-60.0, 0.0, 30.0]),
]


def rays(noise, rng):
    found = [
        reflected_ray(
            camera,
            place,
            RADIUS,
            highlight_of(camera, place) + noise * rng.standard_normal(2),
        )
        for camera in CAMERAS
        for place in PLACES
    ]
    return np.array([f[0] for f in found]), np.array([f[1] for f in found])


def test_light_position__is_that_of_the_shortest_ways():
    found = light_position(*rays(0.0, np.random.default_rng(1)))
    # Fermat's minimum is flat: 1e-7 rad of normal, times two, at 700 mm
    np.testing.assert_allclose(found.position, LIGHT, atol=0.01)
    assert found.miss.max() < 1e-3


@pytest.mark.slow
def test_light_position__knows_its_error():
    z = []
    for seed in range(60):
        found = light_position(*rays(0.2, np.random.default_rng(seed)))
        off = found.position - LIGHT
        z.append(off @ np.linalg.solve(found.covariance, off) / 3)
    # mean of squares of Student's t of 15 degrees of freedom is 15 / 13; its deviation
    # over 60 draws is 0.15
    assert 0.75 < np.mean(z) < 1.6


def test_light_position__needs_rays_that_cross():
    parallel = np.array([[0.0, 0.0, 1.0]] * 2)
    with pytest.raises(InputError, match="must not be parallel"):
        light_position([[0, 0, 0], [10, 0, 0]], parallel)
    with pytest.raises(InputError, match="two or more rays"):
        light_position([[0, 0, 0]], parallel[:1])
    with pytest.raises(InputError, match="two or more rays"):
        light_position([[0, 0, np.nan], [1, 0, 0]], parallel)


def test_reflected_ray__must_meet_the_ball():
    with pytest.raises(InputError, match="must meet the ball"):
        reflected_ray(CAMERAS[0], PLACES[0], RADIUS, [5.0, 5.0])


def test_highlight_centre__is_found_below_a_pixel():
    rng = np.random.default_rng(3)
    row, column = np.mgrid[:200, :240] + 0.5
    outline = Outline(np.array([120.0, 100.0]), 80.0)
    for _ in range(10):
        at = outline.centre + rng.uniform(-50, 50, 2)
        picture = (
            20
            + 400 * np.exp(-((column - at[0]) ** 2 + (row - at[1]) ** 2) / 18)
            + rng.standard_normal((200, 240))
        )
        # cut at 255: the centroid of a disc of 40 pixels, whose rim of 20 pixels is
        # decided by rounding
        np.testing.assert_allclose(
            highlight_centre(np.minimum(picture, 255), outline), at, atol=0.2
        )


@pytest.mark.parametrize(
    ("picture", "match"),
    [
        (np.zeros((50, 50)), "a uniform picture"),
        (np.full((50, 50), np.nan), "no finite values"),
        (
            np.where(np.arange(50) < 20, 255.0, 0.0) + np.zeros((50, 50)),
            "must cover at most",
        ),
    ],
)
def test_highlight_centre__refuses_what_is_no_highlight(picture, match):
    with pytest.raises(InputError, match=match):
        highlight_centre(picture, Outline(np.array([25.0, 25.0]), 20.0))


@pytest.mark.parametrize("mask", [np.zeros((20, 20)), np.eye(20)])
def test_ball_outline__refuses_what_is_no_disc(mask):
    with pytest.raises(InputError, match="must be one disc"):
        ball_outline(mask)


def test_distant_light__is_the_mirrored_view():
    outline = Outline(np.array([100.0, 100.0]), 50.0)
    np.testing.assert_allclose(
        distant_light(outline, [100, 100]), [0, 0, 1], atol=1e-12
    )
    # a normal of 45 degrees upwards mirrors the view to straight up
    np.testing.assert_allclose(
        distant_light(outline, [100, 100 - 50 / np.sqrt(2)]), [0, 1, 0], atol=1e-12
    )
    with pytest.raises(InputError, match="must lie on the ball"):
        distant_light(outline, [151, 100])


def test_distant_light__agrees_with_published_directions():
    if not PUBLISHED.is_dir():
        pytest.skip("the photographs of the chrome ball are not on this computer")
    outline = ball_outline(
        imagecodecs.imread(str(PUBLISHED / "chrome" / "chrome.mask.png"))[..., 0] > 128
    )
    published = np.loadtxt(PUBLISHED / "light_directions_chrome.csv", delimiter=",")
    for number, expected in enumerate(published):
        picture = imagecodecs.imread(
            str(PUBLISHED / "chrome" / f"chrome.{number}.png")
        )[..., :3]
        found = distant_light(outline, highlight_centre(picture, outline))
        # one pixel of the highlight or of the centre is one degree; measured 0.31 to
        # 0.75, nearly the same shift in all
        assert np.degrees(np.arccos(found @ expected / np.linalg.norm(expected))) < 1.0


def test_reprojection_error__is_that_of_the_pose():
    rng = np.random.default_rng(4)
    points = rng.uniform(-80, 80, (50, 3))
    camera = CAMERAS[1]
    pixels, _ = project(points, camera.K, camera.R, camera.t, camera.distortion)
    exact = reprojection_error(points, pixels, camera)
    assert exact.rms < 1e-9
    assert exact.count == 50
    turn = Rotation.from_rotvec([0, 0.001, 0]).as_matrix()
    turned = Pinhole(camera.K, turn @ camera.R, turn @ camera.t, camera.distortion)
    # 1 mrad about the centre moves everything by 2 px, within 1 % at the borders
    assert abs(reprojection_error(points, pixels, turned).rms - 2) < 0.04
    noisy = reprojection_error(
        points, pixels + 0.3 * rng.standard_normal(pixels.shape), camera
    )
    # 50 points: 7 % of standard deviation
    assert abs(noisy.rms / (0.3 * np.sqrt(2)) - 1) < 0.3
    pixels[0] = np.nan
    assert reprojection_error(points, pixels, camera).count == 49
    with pytest.raises(InputError, match="at least one known point"):
        reprojection_error(points, np.full((50, 2), np.nan), camera)
