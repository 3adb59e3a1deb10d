"""Light positions from photographs of a mirror ball that are ray traced by formulas."""

from __future__ import annotations

import json

import imagecodecs
import numpy as np
import pytest
from mirror import ball_outline_of, ball_picture

from skindb.calibration.lights import calibrate_positions, positioned_dome
from skindb.calibration.mirror_ball import ball_centre
from skindb.calibration.setup import read_calibration_frames, read_setup_dome
from skindb.errors import InputError
from skindb.format.dome import Pinhole

RADIUS = 30.0
LIGHTS = {
    "l0": (100.0, 200.0, 800.0),
    "l1": (-500.0, 100.0, 600.0),
    "l2": (600.0, -300.0, 400.0),
}
PLACES = {"a": (-100.0, -30.0, 0.0), "b": (100.0, 40.0, -40.0)}
EYES = {"c0": (0.0, 0.0, 900.0), "c1": (500.0, 150.0, 750.0)}


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
        np.testing.assert_allclose(one.centre, centre, atol=3)
        np.testing.assert_allclose(two.centre, centre, atol=0.3)
        assert np.isnan(one.mismatch)
        assert two.mismatch < 0.003


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
