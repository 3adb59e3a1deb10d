"""Calibrations of lights: their numbers, versions, and captures that name them."""

from __future__ import annotations

import json
import shutil
from itertools import product
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from click.testing import CliRunner
from mirror import ball_outline_of, ball_picture
from sphere import BLACK, INTENSITY, LIGHTS, save, write_capture

import skindb
from skindb import workflow
from skindb.calibration.lights import _view, calibrate_lights
from skindb.calibration.radiance import frame_mergers
from skindb.calibration.setup import read_setup_dome
from skindb.cli import cli
from skindb.errors import InputError


def _edit(file, **changes):
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sphere") / "T001"
    write_capture(folder)
    return folder


@pytest.fixture
def capture(pristine, tmp_path):
    """A capture that names a calibration and has no white target of its own."""
    folder = Path(shutil.copytree(pristine, tmp_path / "T001"))
    _edit(folder / "dome/dome.json", white=None)
    _edit(folder / "capture.json", version=2, calibration="dome-a")
    return folder


@pytest.fixture
def setup(pristine, tmp_path):
    """The set-up of the laboratory: a white target, no face."""
    folder = Path(shutil.copytree(pristine, tmp_path / "lab"))
    shutil.rmtree(folder / "dome/frames")
    return folder


def test_calibrate__intensities_of_the_made_up_lights(setup, tmp_path):
    db = skindb.open(str(tmp_path / "db"), create=True)
    record = workflow.calibrate(db, setup, name="dome-a")
    found = db.read("calibration", "dome-a")["light_calibration"].to_dataset().load()
    assert found["light"].values.tolist() == list(LIGHTS)
    z = (found["calibrated_intensity"] - INTENSITY) / found[
        "calibrated_intensity_error"
    ]
    assert np.abs(z).max() < 4  # of 12 numbers
    # noise of a frame alone: a per mille
    assert (found["calibrated_intensity_error"] / INTENSITY).max() < 0.002
    assert (found["calibrated_falloff"] == 0).all()
    assert workflow.describe_calibration(db, record)["lights"] == len(LIGHTS)


def test_calibrate_lights__light_beside_the_target_is_part_of_the_error(setup):
    before = calibrate_lights(read_setup_dome(setup))
    # the surroundings are black, and every second noisy value is cut off at the black
    # level: 0.03 % of the target
    assert before["glare_fraction"].max() < 0.001
    for file in sorted((setup / "dome/white").glob("*/*.png")):
        picture = imagecodecs.png_decode(file.read_bytes()).astype(float)
        # an even veil of 2 % of the mean
        veiled = picture + 0.02 * (picture.mean(axis=(0, 1)) - BLACK)
        save(file, np.clip(np.rint(veiled), 0, 65535).astype(np.uint16))
    after = calibrate_lights(read_setup_dome(setup))
    dome = read_setup_dome(setup)
    beside = _view(
        dome.cameras[0], frame_mergers(dome, [])["c0"], dome.white
    ).beside.mean()
    expected = 0.02 * beside  # the target is nearly all light of the picture
    np.testing.assert_allclose(
        after["glare_fraction"], expected, rtol=0.15, atol=0.0004
    )
    np.testing.assert_array_equal(
        before["calibrated_intensity_position_error"] > 0.001, True
    )


@pytest.mark.slow
def test_ingest__takes_the_lights_of_the_named_calibration(
    setup, capture, pristine, tmp_path
):
    db = skindb.open(str(tmp_path / "db"), create=True)
    with pytest.raises(
        InputError,
        match="must hold the calibration that it names; found dome-a; calibrations: none",
    ):
        workflow.ingest_take(db, capture)
    workflow.calibrate(db, setup, name="dome-a")
    workflow.ingest_take(db, capture)
    record = db.record("capture", "T001")
    assert record.provenance["calibrated_by"]["generation"] == 1
    found = db.read("capture", "T001")["dome"]["light_intensity"].values
    # noise and quantisation
    np.testing.assert_allclose(
        found, np.broadcast_to(INTENSITY, found.shape), rtol=0.005
    )

    # a lamp was replaced in the set-up; the capture does not change until it is ingested again
    dome = json.loads((setup / "dome/dome.json").read_text())
    dome["white"]["reflectance"] = 0.9
    (setup / "dome/dome.json").write_text(json.dumps(dome))
    result = CliRunner().invoke(
        cli, ["calibrate", str(db.folder), str(setup), "--name", "dome-a"]
    )
    assert "dome-a: calibration 2 of 4 lights" in result.output
    assert "should be ingested again: T001" in result.output
    np.testing.assert_array_equal(
        db.read("capture", "T001")["dome"]["light_intensity"].values, found
    )
    said = (
        "1 take was ingested with an earlier version of calibration dome-a: T001; run "
        "skindb ingest again"
    )
    for command in ("info", "refresh"):
        assert said in CliRunner().invoke(cli, [command, str(db.folder)]).output
    workflow.ingest_take(db, capture)
    assert (
        "1 take was ingested with"
        not in CliRunner().invoke(cli, ["info", str(db.folder)]).output
    )
    assert db.record("capture", "T001").provenance["calibrated_by"]["generation"] == 2
    again = db.read("capture", "T001")["dome"]["light_intensity"].values
    np.testing.assert_allclose(again, found * 0.99 / 0.9, rtol=1e-4)
    assert db.read("calibration", "dome-a", generation=1) is not None
    assert db.subjects() == [] or db.takes("capture") == ["T001"]
    assert [*db.info()["calibrations"]] == ["dome-a"]
    assert db.verify() == []


@pytest.mark.slow
def test_ingest__takes_the_positions_of_the_named_calibration(setup, capture, tmp_path):
    dome = json.loads((setup / "dome/dome.json").read_text())
    places = {"a": [-60.0, 0.0, 0.0], "b": [60.0, 20.0, 0.0]}
    radius = 25.0
    (setup / "ball").mkdir()
    for place, light, camera in product(places, LIGHTS, dome["cameras"]):
        value = np.rint(
            50000 * ball_picture(camera, places[place], radius, LIGHTS[light])
        ).astype(np.uint16)
        png = imagecodecs.png_encode(np.repeat(value[..., None], 3, axis=-1))
        (setup / f"ball/{place}_{light}_{camera['id']}.png").write_bytes(png)
    outlines = {
        place: {
            camera["id"]: ball_outline_of(camera, at, radius)
            for camera in dome["cameras"]
        }
        for place, at in places.items()
    }
    ball = {
        "frames": "ball/{place}_{light}_{camera}.png",
        "radius": radius,
        "outlines": outlines,
    }
    K, R, t = (np.array(dome["cameras"][0][key]) for key in ("K", "R", "t"))
    seen = K @ (R @ [10.0, 20.0, 30.0] + t)
    points = {
        "positions": {"p": [10, 20, 30]},
        "pixels": {"c0": {"p": [seen[0] / seen[2] + 0.9, seen[1] / seen[2] + 1.2]}},
    }
    (setup / "dome/calibration.json").write_text(
        json.dumps({"ball": ball, "points": points})
    )
    db = skindb.open(str(tmp_path / "db"), create=True)
    result = CliRunner().invoke(
        cli, ["calibrate", str(db.folder), str(setup), "--name", "dome-a"]
    )
    assert result.exit_code == 0, result.output
    assert "positions of the lights: standard error at most" in result.output
    assert (
        "known points of 1 camera: rms distance from their projections at most 1.50 px"
        in result.output
    )
    found = db.read("calibration", "dome-a")["position_calibration"].to_dataset().load()
    off = np.abs(found["calibrated_position"] - np.array([*LIGHTS.values()]))
    assert (off < 4 * found["calibrated_position_error"] + 5).all()  # a ball of 10 px
    workflow.ingest_take(db, capture)
    stored = db.read("capture", "T001")["dome"]["light_position"].values
    # single precision
    np.testing.assert_allclose(stored, found["calibrated_position"].values, rtol=1e-6)


def test_calibrate__refuses_a_camera_that_does_not_show_known_points_where_they_are(
    setup, tmp_path
):
    K, R, t = (
        np.array(json.loads((setup / "dome/dome.json").read_text())["cameras"][0][key])
        for key in ("K", "R", "t")
    )
    positions = {"p": [10.0, 20.0, 30.0], "q": [-30.0, 0.0, 40.0]}
    pixels = {}
    for name, place in positions.items():
        column, row, depth = K @ (R @ place + t)
        pixels[name] = [column / depth + 30, row / depth - 16]
    (setup / "dome/calibration.json").write_text(
        json.dumps({"points": {"positions": positions, "pixels": {"c0": pixels}}})
    )
    db = skindb.open(str(tmp_path / "db"), create=True)
    message = (
        r"calibration\.json\[points\], camera c0: known points must be seen within 2 "
        r"px of .* 34 px, \d\d mm"
    )
    with pytest.raises(InputError, match=message):
        workflow.calibrate(db, setup, name="dome-a")
    assert db.names() is None


def test_calibrate__mistakes(setup, capture, tmp_path):
    db = skindb.open(str(tmp_path / "db"), create=True)
    for name in ("a b", "", "../x"):
        with pytest.raises(InputError, match="name of a calibration"):
            workflow.calibrate(db, setup, name=name)
    with pytest.raises(
        InputError, match="a calibration needs the frames of a white target"
    ):
        workflow.calibrate(db, capture, name="dome-a")
    with pytest.raises(InputError, match=r"dome\.json"):
        workflow.calibrate(db, tmp_path / "nothing", name="dome-a")
    dome = json.loads((setup / "dome/dome.json").read_text())
    dome["lights"] = dome["lights"][:2]
    (setup / "dome/dome.json").write_text(json.dumps(dome))
    workflow.calibrate(db, setup, name="dome-a")
    with pytest.raises(
        InputError, match="must have every light of the capture; found none of l2, l3"
    ):
        workflow.ingest_take(db, capture)
    for path in (setup / "dome/white").rglob("l1_*.png"):
        path.unlink()
    with pytest.raises(InputError, match="the file must exist"):
        workflow.calibrate(db, setup, name="dome-a")
    assert db.record("calibration", "dome-a").generation == 1
