"""Calibration of cameras from frames that are simulated by formulas, and captures that use it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from click.testing import CliRunner
from sphere import BLACK, HEIGHT, WHITE, WIDTH, write_capture

import skindb
from skindb import workflow
from skindb.calibration.cameras import calibrate_cameras
from skindb.calibration.setup import read_calibration_frames, read_setup_dome
from skindb.cli import cli
from skindb.errors import InputError

SECONDS = {f"e{i}": 0.4 / 2.0**i for i in range(7)}
FULL = 20000.0
READ = 6.0
DARK_SEED = 3
VIGNETTE = np.array([-0.2, 0.03, 0.0])
TO_SRGB = np.array([[1.6, -0.45, -0.15], [-0.25, 1.4, -0.15], [0.0, -0.5, 1.5]])
GLARE = 0.0
CENTRE = np.array([WIDTH / 2, HEIGHT / 2])
COLUMN, ROW = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
R2 = ((COLUMN - CENTRE[0]) ** 2 + (ROW - CENTRE[1]) ** 2) / (
    np.hypot(WIDTH, HEIGHT) / 2
) ** 2
LENS = 1 + R2 * (VIGNETTE[0] + R2 * VIGNETTE[1])
PATCHES = [[6 + 12 * (i % 6), 8 + 16 * (i // 6)] for i in range(24)]


def encoded(exposure, gamma):
    """A gamma with a linear toe below 0.004; 1 is linear."""
    toe = 0.004
    power = 1 / gamma
    slope = power * toe ** (power - 1)
    lift = toe**power - slope * toe
    return np.where(
        exposure < toe, slope * exposure, np.maximum(exposure, toe) ** power - lift
    ) / (1 - lift)


def frame(radiance, seconds, gamma, rng):
    """Values of a frame of (h, w, 3) radiance with shot and read noise."""
    electrons = radiance * seconds * FULL
    electrons = electrons + np.sqrt(
        np.maximum(electrons, 0) + READ**2
    ) * rng.standard_normal(radiance.shape)
    # noise below black is kept, which is the purpose of a black level
    share = np.where(electrons < 0, electrons / FULL * encoded(1e-6, gamma) / 1e-6, 0)
    share = share + encoded(np.clip(electrons / FULL, 0, None), gamma)
    return np.clip(np.rint(BLACK + share * (WHITE - BLACK)), 0, WHITE).astype(np.uint16)


def chart_radiance():
    """Camera radiance of a ColorChecker whose patches fill the picture, from
    colour-science's reference.
    """
    import colour  # which takes as long as a test

    chart = colour.CCS_COLOURCHECKERS["ColorChecker24 - After November 2014"]
    srgb = colour.XYZ_to_sRGB(
        colour.xyY_to_XYZ(np.array(list(chart.data.values()))),
        illuminant=chart.illuminant,
        apply_cctf_encoding=False,
    )
    camera = srgb @ np.linalg.inv(TO_SRGB).T
    picture = np.zeros((HEIGHT, WIDTH, 3))
    for (x, y), value in zip(PATCHES, camera, strict=True):
        picture[y - 8 : y + 8, x - 6 : x + 6] = value
    return picture


def write_frames(setup, gamma, rng):
    """Write all kinds of frames for each camera, and dome/calibration.json."""
    folder = setup / "calibration"
    folder.mkdir()
    light = 1 + 0.1 * COLUMN / WIDTH  # uneven light, which must not count
    blocks = np.kron(
        np.exp(rng.uniform(np.log(0.05), np.log(150), (HEIGHT // 4, WIDTH // 4))),
        np.ones((4, 4)),
    )
    scenes = {
        "response": blocks,
        "white": 6.0 * light * LENS,
        "chart": 6.0 * chart_radiance() * (light * LENS)[..., None],
    }
    for camera in ("c0", "c1"):
        for r in range(1, 9):
            dark = frame(np.zeros((HEIGHT, WIDTH, 3)), 1.0, gamma, rng)
            dark[5, 7] = 30000  # a hot pixel
            (folder / f"dark_{camera}_{r}.png").write_bytes(
                imagecodecs.png_encode(dark)
            )
        for e, seconds in SECONDS.items():
            for name, scene in scenes.items():
                values = scene[..., None] * np.ones(3) if scene.ndim == 2 else scene
                png = imagecodecs.png_encode(frame(values, seconds, gamma, rng))
                (folder / f"{name}_{camera}_{e}.png").write_bytes(png)
            for r in (1, 2):
                png = imagecodecs.png_encode(
                    frame(
                        (2.2 * light * LENS)[..., None] * np.ones(3),
                        seconds,
                        gamma,
                        rng,
                    )
                )
                (folder / f"flat_{camera}_{e}_{r}.png").write_bytes(png)
    both = ("c0", "c1")
    record = {
        "exposures": [{"id": e, "seconds": s} for e, s in SECONDS.items()],
        "dark": {"frames": "calibration/dark_{camera}_{repeat}.png", "repeats": 8},
        "response": {"frames": "calibration/response_{camera}_{exposure}.png"},
        "flat": {
            "frames": "calibration/flat_{camera}_{exposure}_{repeat}.png",
            "repeats": 2,
        },
        "chart": {
            "frames": "calibration/chart_{camera}_{exposure}.png",
            "white": "calibration/white_{camera}_{exposure}.png",
            "radius": 4,
            "patches": dict.fromkeys(both, PATCHES),
        },
    }
    if gamma == 1:
        del record["response"]
    (setup / "dome/calibration.json").write_text(json.dumps(record))


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sphere") / "T001"
    write_capture(folder)
    return folder


def laboratory(pristine, folder, gamma):
    setup = Path(shutil.copytree(pristine, folder / "lab"))
    shutil.rmtree(setup / "dome/frames")
    write_frames(setup, gamma, np.random.default_rng(5))
    return setup


@pytest.fixture(scope="module")
def linear_setup(pristine, tmp_path_factory):
    return laboratory(pristine, tmp_path_factory.mktemp("linear"), 1)


@pytest.mark.parametrize("gamma", [1, 2.2])
def test_calibrate_cameras__finds_what_was_put_in(pristine, tmp_path, gamma):
    dome = read_setup_dome(laboratory(pristine, tmp_path, gamma))
    found = calibrate_cameras(dome, read_calibration_frames(dome))
    assert found["camera"].values.tolist() == ["c0", "c1"]
    # z of 2 cameras; a response that is 1 % off near black moves noise and vignette by
    # more than their own noise
    most = 4 if gamma == 1 else 12
    gain = found["calibrated_electrons_per_value"] - FULL / (WHITE - BLACK)
    assert np.abs(gain / found["calibrated_electrons_per_value_error"]).max() < most
    assert np.abs(found["calibrated_read_noise"] - READ).max() < (
        1 if gamma == 1 else 3
    )
    shade = 1 + R2[..., None] * (
        found["calibrated_vignette"].values[:, 0]
        + R2[..., None]
        * (
            found["calibrated_vignette"].values[:, 1]
            + R2[..., None] * found["calibrated_vignette"].values[:, 2]
        )
    )
    # noise of 5 electrons per mille
    assert np.abs(shade / LENS[..., None] - 1).max() < (0.01 if gamma == 1 else 0.02)
    # noise of 0.2 % in a patch, times rows of the inverse as large as 2
    np.testing.assert_allclose(
        found["calibrated_colour_matrix"], np.stack([TO_SRGB] * 2), atol=0.02
    )
    assert found["chart_difference"].max() < 1
    assert found["defect_pixels"].values.tolist() == [1, 1]
    known = (
        np.isfinite(found["calibrated_response"])
        .all(["response_level", "channel"])
        .values
    )
    assert known.tolist() == [gamma != 1] * 2
    if gamma != 1:
        exposure = np.logspace(-2, -0.01, 50)
        for one in (
            found["calibrated_response"]
            .values.reshape(2, -1, 3)
            .transpose(0, 2, 1)
            .reshape(6, -1)
        ):
            got = np.interp(
                encoded(exposure, gamma), found["response_level"].values, one
            )
            assert np.abs(got / exposure - 1).max() < 0.02


@pytest.mark.slow
def test_ingest__uses_the_calibrated_cameras(linear_setup, pristine, tmp_path):
    folder = Path(shutil.copytree(pristine, tmp_path / "T001"))
    meta = json.loads((folder / "capture.json").read_text()) | {
        "version": 2,
        "calibration": "dome-a",
    }
    (folder / "capture.json").write_text(json.dumps(meta))
    db = skindb.open(str(tmp_path / "db"), create=True)
    result = CliRunner().invoke(
        cli, ["calibrate", str(db.folder), str(linear_setup), "--name", "dome-a"]
    )
    assert result.exit_code == 0
    assert "colour of 2 cameras: CIEDE2000" in result.output
    capture = skindb.ingest.read_capture(folder)
    used = workflow.captures.calibrated_capture(db, capture)
    np.testing.assert_allclose(used.dome.cameras[0].vignette[0], VIGNETTE[0], atol=0.05)
    assert used.dome.cameras[1].sensor.electrons_per_dn == pytest.approx(
        FULL / (WHITE - BLACK), rel=0.05
    )
    # not photographed: as dome.json says
    assert used.dome.cameras[0].sensor.response is None
    workflow.ingest_take(db, folder)
    assert db.record("capture", "T001").provenance["calibrated_by"]["generation"] == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"flat": {"frames": "calibration/flat_{camera}.png", "repeats": 2}},
            "must name {camera} and {exposure}",
        ),
        (
            {
                "flat": {
                    "frames": "calibration/flat_{camera}_{exposure}_{repeat}.png",
                    "repeats": 1,
                }
            },
            "at least 2",
        ),
        (
            {
                "dark": {
                    "frames": "calibration/none_{camera}_{repeat}.png",
                    "repeats": 2,
                }
            },
            "none_c0_1.png",
        ),
        (
            {"dark": {"frames": "../../x_{camera}_{repeat}.png", "repeats": 2}},
            "must stay inside",
        ),
        ({"chrat": {}}, "chrat (did you mean chart?)"),
        (
            {
                "chart": {
                    "frames": "calibration/chart_{camera}_{exposure}.png",
                    "white": "calibration/white_{camera}_{exposure}.png",
                    "radius": 4,
                    "patches": {"c9": PATCHES},
                }
            },
            "c9",
        ),
        (
            {
                "chart": {
                    "frames": "calibration/chart_{camera}_{exposure}.png",
                    "white": "calibration/white_{camera}_{exposure}.png",
                    "radius": 4,
                    "patches": {"c0": [[99, 9]] * 24},
                }
            },
            "inside",
        ),
        ({"chart": 5}, "must be a JSON object"),
        ({"exposures": [{"id": "e0", "seconds": -1}]}, "seconds"),
        ({"exposures": []}, "at least one"),
    ],
)
def test_calibrate_cameras__faults_are_named_in_lines(
    linear_setup, tmp_path, change, said
):
    setup = Path(shutil.copytree(linear_setup, tmp_path / "lab"))
    file = setup / "dome/calibration.json"
    record = json.loads(file.read_text()) | change
    if "chrat" in change:
        del record["chart"]
    file.write_text(json.dumps(record))
    db = skindb.open(str(tmp_path / "db"), create=True)
    with pytest.raises(InputError) as caught:
        workflow.calibrate(db, setup, name="dome-a")
    assert said in str(caught.value)
    assert not db.takes("calibration")
