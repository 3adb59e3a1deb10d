"""Light positions from photographs of a mirror ball that are ray traced by formulas."""

from __future__ import annotations

import json
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from mirror import ball_outline_of, ball_picture
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from skindb.calibration.cameras import reprojection_error
from skindb.calibration.lights import positioned_dome
from skindb.calibration.mirror_ball import (
    Outline,
    ball_centre,
    ball_outline,
    ball_places,
    calibrate_positions,
    distant_light,
    highlight_centre,
    light_position,
    reflected_ray,
)
from skindb.calibration.setup import read_calibration_frames, read_setup_dome
from skindb.errors import InputError
from skindb.geometry.camera import Pinhole, camera_centre, project

PUBLISHED = Path(__file__).resolve().parents[3] / "shared/data/photometric/uw"
BALL_RADIUS = 25.0  # mm
LIGHT = np.array([400.0, 500.0, 300.0])  # mm
RADIUS = 30.0
LIGHTS = {
    "l0": (100.0, 200.0, 800.0),
    "l1": (-500.0, 100.0, 600.0),
    "l2": (600.0, -300.0, 400.0),
}
PLACES = {"a": (-100.0, -30.0, 0.0), "b": (100.0, 40.0, -40.0)}
EYES = {"c0": (0.0, 0.0, 900.0), "c1": (500.0, 150.0, 750.0)}


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
        point = ball + BALL_RADIUS * normal
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


BALL_CAMERAS = [
    camera_at([0.0, 0.0, 1000.0]),
    camera_at([500.0, 100.0, 900.0]),
    camera_at([-500.0, -100.0, 900.0]),
]
BALL_PLACES = [
    np.array([0.0, 0.0, 0.0]),
    np.array([60.0, 40.0, 0.0]),
    np.array([-60.0, 0.0, 30.0]),
]


def rays(noise, rng):
    found = [
        reflected_ray(
            camera,
            place,
            BALL_RADIUS,
            highlight_of(camera, place) + noise * rng.standard_normal(2),
        )
        for camera in BALL_CAMERAS
        for place in BALL_PLACES
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


def test_reflected_ray__must_meet_the_ball():
    with pytest.raises(InputError, match="must meet the ball"):
        reflected_ray(BALL_CAMERAS[0], BALL_PLACES[0], BALL_RADIUS, [5.0, 5.0])


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


def _rms(values):
    return np.sqrt(np.mean(values**2))


def test_reprojection_error__is_that_of_the_pose():
    rng = np.random.default_rng(4)
    points = rng.uniform(-80, 80, (50, 3))
    camera = BALL_CAMERAS[1]
    pixels, _ = project(points, camera.K, camera.R, camera.t, camera.distortion)
    exact = reprojection_error(points, pixels, camera)
    assert exact.max() < 1e-9
    assert len(exact) == 50
    turn = Rotation.from_rotvec([0, 0.001, 0]).as_matrix()
    turned = Pinhole(camera.K, turn @ camera.R, turn @ camera.t, camera.distortion)
    # 1 mrad about the centre moves everything by 2 px, within 1 % at the borders
    assert abs(_rms(reprojection_error(points, pixels, turned)) - 2) < 0.04
    noisy = reprojection_error(
        points, pixels + 0.3 * rng.standard_normal(pixels.shape), camera
    )
    # 50 points: 7 % of standard deviation
    assert abs(_rms(noisy) / (0.3 * np.sqrt(2)) - 1) < 0.3
    pixels[0] = np.nan
    assert len(reprojection_error(points, pixels, camera)) == 49
    with pytest.raises(InputError, match="at least one known point"):
        reprojection_error(points, np.full((50, 2), np.nan), camera)


def camera(name, eye):
    z = -np.asarray(eye) / np.linalg.norm(eye)
    x = np.cross([0, 1, 0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    K = [[1100.0, 0, 180], [0, 1100.0, 90], [0, 0, 1]]
    return {
        "id": name,
        "width": 360,
        "height": 180,
        "K": K,
        "R": R.tolist(),
        "t": (-R @ np.asarray(eye)).tolist(),
    }


CAMERAS = {name: camera(name, eye) for name, eye in EYES.items()}


@pytest.fixture(scope="module")
def pictures():
    """Values (place, light, camera) of the frames."""
    return {
        (place, light, name): np.rint(
            60000
            * np.minimum(ball_picture(one, PLACES[place], RADIUS, LIGHTS[light]), 1)
        )
        for place in PLACES
        for light in LIGHTS
        for name, one in CAMERAS.items()
    }


@pytest.fixture(scope="module")
def outlines():
    """Outlines of the ball by place and camera."""
    return {
        place: {
            name: ball_outline_of(one, centre, RADIUS) for name, one in CAMERAS.items()
        }
        for place, centre in PLACES.items()
    }


@pytest.fixture
def setup(pictures, outlines, tmp_path):
    """A set-up whose stated light positions are 20 mm off."""
    (tmp_path / "dome").mkdir()
    (tmp_path / "ball").mkdir()
    for (place, light, name), values in pictures.items():
        png = imagecodecs.png_encode(
            np.repeat(values[..., None], 3, axis=-1).astype(np.uint16)
        )
        (tmp_path / f"ball/{place}_{light}_{name}.png").write_bytes(png)
    stated = {name: [x + 20.0, y, z] for name, (x, y, z) in LIGHTS.items()}
    dome = {
        "cameras": [one | {"bit_depth": 16} for one in CAMERAS.values()],
        "lights": [
            {"id": name, "position": place, "intensity": [1, 1, 1]}
            for name, place in stated.items()
        ],
        "exposures": [{"id": "e0", "seconds": 0.04}],
        "frames": "dome/frames/{exposure}/{light}_{camera}.png",
    }
    (tmp_path / "dome/dome.json").write_text(json.dumps(dome))
    write(
        tmp_path,
        {
            "frames": "ball/{place}_{light}_{camera}.png",
            "radius": RADIUS,
            "outlines": outlines,
        },
    )
    return tmp_path


def write(folder, ball):
    (folder / "dome/calibration.json").write_text(json.dumps({"ball": ball}))


def edited(folder, **changes):
    file = folder / "dome/calibration.json"
    write(folder, json.loads(file.read_text())["ball"] | changes)


def calibrated(folder):
    dome = read_setup_dome(folder, white=False)
    return dome, calibrate_positions(dome, read_calibration_frames(dome).ball)


@pytest.mark.slow
def test_calibrate_positions__finds_the_lights_and_its_error(setup):
    dome, found = calibrated(setup)
    off = found["calibrated_position"].values - np.array([*LIGHTS.values()])
    # highlights are smaller than a pixel of 0.8 mm; with pixels half as large the
    # largest error is 0.6 mm
    assert np.linalg.norm(off, axis=1).max() < 10
    assert (np.abs(off) < 4 * found["calibrated_position_error"].values + 2).all()
    assert found["position_ray_count"].values.tolist() == [4, 4, 4]
    assert float(found["position_miss"].max()) < 0.3
    moved = positioned_dome(dome, found, where="calibration")
    np.testing.assert_array_equal(
        moved.lights[1].position, found["calibrated_position"].values[1]
    )
    np.testing.assert_array_equal(moved.lights[1].axis, dome.lights[1].axis)


def test_ball_centre__from_one_and_from_two_cameras(outlines):
    for place, centre in PLACES.items():
        seen = [
            Pinhole(np.array(c["K"]), np.array(c["R"]), np.array(c["t"]), np.zeros(5))
            for c in CAMERAS.values()
        ]
        circles = list(outlines[place].values())
        one = ball_centre(seen[:1], circles[:1], RADIUS)
        two = ball_centre(seen, circles, RADIUS)
        # the outline is known to a tenth of 37 px: 0.3 % of 900 mm along the view, 0.1 mm across it
        np.testing.assert_allclose(one, centre, atol=3)
        np.testing.assert_allclose(two, centre, atol=0.3)


def test_ball_places__from_highlights_alone(pictures):
    cameras = {
        name: Pinhole(*(np.array(c[key]) for key in ("K", "R", "t")), np.zeros(5))
        for name, c in CAMERAS.items()
    }
    whole = Outline(np.array([180.0, 90.0]), 400.0)
    highlights = [
        {
            (place, name): highlight_centre(pictures[place, light, name], whole)
            for place in PLACES
            for name in CAMERAS
        }
        for light in LIGHTS
    ]
    found = ball_places(cameras, highlights, RADIUS)
    for place, centre in PLACES.items():
        # as by outlines: highlights are known to a tenth of a pixel of 0.8 mm
        np.testing.assert_allclose(found[place], centre, atol=0.5)
    with pytest.raises(InputError, match="of a ball of radius 60 mm; found of 29"):
        ball_places(cameras, highlights, 2 * RADIUS)
    one = [{key: at for key, at in h.items() if key[1] == "c0"} for h in highlights]
    with pytest.raises(InputError, match="two cameras must see its highlights"):
        ball_places(cameras, [one[0] | {("b", "c1"): np.zeros(2)}], RADIUS)


def test_calibrate_positions__skips_frames_without_a_highlight(setup, pictures):
    dark = imagecodecs.png_encode(np.full((180, 360, 3), 900, np.uint16))
    (setup / "ball/a_l0_c1.png").write_bytes(dark)
    _, found = calibrated(setup)
    assert found["position_ray_count"].values.tolist() == [3, 4, 4]
    for name in ("a_l0_c0", "b_l0_c1"):
        (setup / f"ball/{name}.png").write_bytes(dark)
    with pytest.raises(
        InputError,
        match="light l0, mirror ball: its highlight must appear in two frames; found 1",
    ):
        calibrated(setup)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"radius": 2 * RADIUS},
            "place a: its outlines must be of the size of a ball of radius 60 mm",
        ),
        ({"radius": -1}, "must be greater than 0"),
        (
            {"frames": "ball/{light}_{camera}.png"},
            r"must name \{camera\} and \{light\} and \{place\}",
        ),
        ({"frames": "../{place}_{light}_{camera}.png"}, "must stay inside"),
        ({"frames": "none/{place}_{light}_{camera}.png"}, "a_l0_c0.png"),
        ({"outlines": {"a": {"c9": [10, 10, 5]}}}, "must be a camera of the dome"),
        ({"outlines": {"a": {"c0": [2, 10, 5]}}}, "a circle in the picture"),
        ({"outlines": {"a": [1, 2]}}, "must be a JSON object"),
        ({"outlines": {}}, "its highlight must appear in two frames; found 0"),
        ({"radios": 3}, "radios"),
    ],
)
def test_read_calibration_frames__faults_are_named(setup, change, said):
    edited(setup, **change)
    with pytest.raises(InputError, match=said):
        calibrated(setup)


def test_positioned_dome__needs_every_light(setup):
    dome, found = calibrated(setup)
    with pytest.raises(
        InputError, match="must have every light of the capture; found none of l2"
    ):
        positioned_dome(dome, found.isel(light=[0, 1]), where="calibration x")


@pytest.mark.parametrize("seed", range(4))
def test_ball_places__of_random_domes_with_some_wrong_highlights(seed):
    rng = np.random.default_rng(seed)
    cameras = {
        f"c{i}": camera_at(place) for i, place in enumerate(_around(rng, 4, 830))
    }
    balls = {f"p{k}": place for k, place in enumerate(rng.uniform(-60, 60, (3, 3)))}
    highlights = []
    for light in _around(rng, 16, 880):
        found = {}
        for name, camera in cameras.items():
            for place, ball in balls.items():
                pixel = highlight_of(camera, ball, light)
                wrong = rng.random() < 0.05
                found[place, name] = pixel + rng.normal(
                    scale=60 if wrong else 0.1, size=2
                )
        highlights.append(found)
    centres = ball_places(cameras, highlights, BALL_RADIUS)
    off = [np.linalg.norm(centres[place] - ball) for place, ball in balls.items()]
    assert max(off) < 1.5  # a tenth of a pixel is 0.1 mm across and 1 mm along the view
    with pytest.raises(InputError, match=r"a ball of radius 37\.5 mm; found of 2[45]"):
        ball_places(cameras, highlights, 1.5 * BALL_RADIUS)


def _around(rng, count, distance):
    """Places (count, 3) on the front of a sphere."""
    way = np.array([0, 0, 3.0]) + rng.normal(size=(count, 3))
    return distance * way / np.linalg.norm(way, axis=1, keepdims=True)
