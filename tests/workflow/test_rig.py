"""Calibration of a rig from its own takes: planted gains of the lights are found, and
later takes use them.
"""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from planted_pictures import directions, write_pictures, write_table

from skindb import workflow
from skindb.cli import cli
from skindb.errors import InputError
from skindb.fit.rig import take_residuals
from skindb.ingest.pictures import import_images
from skindb.store import Database, Record

LIGHTS = directions(13)
# the errors of the lights of a rig, and those of one session
GAINS = np.exp(0.08 * np.random.default_rng(5).standard_normal(len(LIGHTS)))
SESSION = 0.02
# the median of five sessions is known to 1.25 SESSION / sqrt(5) = 1.1 %, and the
# estimator to about 1 % on a sphere of 48 pixels
TOLERANCE = 0.02
SPACING_MM = 8.0


class Rig(NamedTuple):
    """A database, and the folder of its captures."""

    db: Database
    folder: Path


def import_take(
    folder: Path,
    name: str,
    *,
    seed: int,
    gains: NDArray[np.float64] = GAINS,
    lights: NDArray[np.float64] = LIGHTS,
    stated: NDArray[np.float64] | None = None,
) -> Path:
    """A capture folder of a sphere whose albedo the seed decides."""
    albedo = np.random.default_rng(seed).uniform(0.15, 0.45, 3)
    pictures = folder / f"pictures-{name}"
    names = write_pictures(pictures, lights, albedo=tuple(albedo), gains=gains)
    write_table(pictures / "lights.csv", names, lights if stated is None else stated)
    consent = {"scope": ["fit", "statistics"], "reference": "form 1"}
    import_images(pictures, folder / name, {"subject": name, "consent": consent})
    return folder / name


def ingest(rig: Rig, name: str) -> Record:
    return workflow.ingest_take(rig.db, rig.folder / name, spacing_mm=SPACING_MM)


def spread(factors: NDArray[np.float64]) -> float:
    return float(np.log(factors).std())


def lights_of(rig: Rig, name: str) -> NDArray[np.float64]:
    """Intensities (light,) of the newest capture."""
    return rig.db.read("capture", name)["dome"]["light_intensity"].values.mean(axis=1)


def normal_error(rig: Rig, name: str) -> float:
    """Median stated error [degree] of the normals of the newest model."""
    model = rig.db.read("model", name)["fitted"].to_dataset()
    return float(np.nanmedian(model["normal_total_error"]))


@pytest.fixture(scope="module")
def pristine_rig(tmp_path_factory) -> Path:
    """Five fitted takes of a rig, and a sixth one that is not ingested."""
    folder = tmp_path_factory.mktemp("rig")
    rig = Rig(Database(folder / "db"), folder)
    rng = np.random.default_rng(1)
    for number in range(5):
        name = f"S{number}"
        session = np.exp(SESSION * rng.standard_normal(len(LIGHTS)))
        import_take(folder, name, seed=number, gains=GAINS * session)
        ingest(rig, name)
        workflow.fit_take(rig.db, name)
    import_take(folder, "S5", seed=5)
    return folder


@pytest.fixture
def rig(pristine_rig, tmp_path) -> Rig:
    folder = Path(shutil.copytree(pristine_rig, tmp_path / "rig"))
    return Rig(Database(folder / "db"), folder)


def gains_of(rig: Rig, name: str = "dome") -> NDArray[np.float64]:
    return rig.db.read("calibration", name)["rig_calibration"]["rig_light_gain"].values


def test_calibrate_rig__finds_the_planted_gains_with_their_errors(rig):
    record = workflow.calibrate_rig(rig.db, name="dome")
    assert spread(gains_of(rig) / GAINS) < TOLERANCE < spread(GAINS) / 3
    group = rig.db.read("calibration", "dome")["rig_calibration"].to_dataset()
    off = np.log(gains_of(rig) / GAINS)
    z = (off - off.mean()) / group["rig_light_gain_error"].values
    assert z.std() < 2
    assert (group["rig_takes"] == 5).all()
    report = workflow.describe_rig(rig.db, record)
    assert report["spread"] == pytest.approx(spread(GAINS), rel=0.2)
    # a session differs from the median of four others by sqrt(1 + 1.57 / 4) SESSION
    assert report["spread_left"] < 1.5 * SESSION
    assert report["without_gain"] == []
    assert report["ingest_again"] == [f"S{number}" for number in range(5)]
    assert rig.db.verify() == []


def test_ingest__a_sixth_take_is_measured_better_by_default_and_says_so(rig):
    before = normal_error(rig, "S0")
    assert spread(lights_of(rig, "S0") / GAINS) == pytest.approx(spread(GAINS))
    workflow.calibrate_rig(rig.db, name="dome")
    result = CliRunner().invoke(
        cli,
        ["ingest", str(rig.db.folder), str(rig.folder / "S5"), "--spacing", "8"],
    )
    line = "calibration dome, version 1, made from takes with its lights"
    assert result.exit_code == 0, result.output
    assert line in result.output
    for words in ([], ["-v"]):
        shown = CliRunner().invoke(cli, ["info", str(rig.db.folder), *words]).output
        assert shown.count(line) == 1
    assert spread(lights_of(rig, "S5") / GAINS) < TOLERANCE
    workflow.fit_take(rig.db, "S5")
    assert normal_error(rig, "S5") < before / 2


def test_ingest__lights_elsewhere_or_two_calibrations_leave_the_intensities(rig):
    workflow.calibrate_rig(rig.db, name="dome")
    turned = LIGHTS @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    import_take(rig.folder, "T0", seed=6, lights=turned)
    assert "calibrated_by" not in ingest(rig, "T0").provenance
    # two lamps of the rig failed
    import_take(rig.folder, "F0", seed=7, gains=GAINS[:-2], lights=LIGHTS[:-2])
    assert ingest(rig, "F0").provenance["calibrated_by"]["take"] == "dome"
    assert spread(lights_of(rig, "F0") / GAINS[:-2]) < TOLERANCE
    workflow.calibrate_rig(rig.db, name="again")
    record = ingest(rig, "S5")
    assert "calibrated_by" not in record.provenance
    assert "calibrations again and dome have the same lights" in str(
        record.provenance["skipped"]
    )
    file = rig.folder / "S5/capture.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"calibration": "dome"}))
    assert ingest(rig, "S5").provenance["calibrated_by"]["take"] == "dome"
    file = rig.folder / "T0/capture.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"calibration": "dome"}))
    with pytest.raises(InputError, match="applies to captures with its lights"):
        ingest(rig, "T0")


@pytest.mark.slow
def test_calibrate_rig__good_lights_stay_and_later_takes_know_the_lobes(tmp_path):
    """Lights are where and as bright as they are stated, as in a rig that was calibrated
    with a target: what its takes have in common is the skin.
    """
    rig = Rig(Database(tmp_path / "db"), tmp_path)
    lights = directions(24)
    names = ["S0", "S1", "S2"]
    for number, name in enumerate(names):
        # other lights are too bright in each session, so that none helps to predict another
        bright = np.arange(len(lights)) % 3 == number % 3
        gains = np.where(bright, 1.05, 1.0)
        import_take(tmp_path, name, seed=number, gains=gains, lights=lights)
        ingest(rig, name)
        workflow.fit_take(rig.db, name)
    workflow.record_consent(rig.db, "S2", ["fit"])
    with pytest.raises(InputError, match="common gains must lower the spread"):
        workflow.calibrate_rig(rig.db, names, name="dome")
    workflow.record_consent(rig.db, "S2", ["fit", "statistics"])
    record = workflow.calibrate_rig(rig.db, names, name="dome")
    report = workflow.describe_rig(rig.db, record)
    assert not report["light_gains"]
    assert report["angle"] == 0
    assert [*report["lobes"]] == ["face"]
    before = lights_of(rig, "S0")
    assert ingest(rig, "S0").provenance["calibrated_by"]["take"] == "dome"
    applied = rig.db.read("capture", "S0")["surfels"]["lobe_strength_applied"].values
    np.testing.assert_allclose(
        applied, len(applied) * [report["lobes"]["face"]], rtol=1e-6
    )
    np.testing.assert_array_equal(lights_of(rig, "S0"), before)
    workflow.fit_take(rig.db, "S0")
    # a take with these lobes contributes again
    assert workflow.calibrate_rig(rig.db, names, name="dome").generation == 2
    assert rig.db.verify() == []


@pytest.mark.slow
def test_calibrate_rig__takes_that_used_the_gains_do_not_count_twice(rig):
    takes = ["S0", "S1", "S2"]
    workflow.calibrate_rig(rig.db, takes, name="dome")
    first = gains_of(rig)
    for take in takes:
        ingest(rig, take)
        workflow.fit_take(rig.db, take)
    record = workflow.calibrate_rig(rig.db, takes, name="dome")
    assert record.generation == 2
    # normals that are fitted to better samples change the gains a little
    assert spread(gains_of(rig) / first) < 0.01
    assert workflow.describe_rig(rig.db, record)["ingest_again"] == takes


def test_calibrate_rig__turned_lights_move_in_later_captures(tmp_path):
    """Lights that are 2 degrees off: what all takes have in common lowers that."""
    rig = Rig(Database(tmp_path / "db"), tmp_path)
    turned = LIGHTS + 0.025 * np.random.default_rng(3).standard_normal(LIGHTS.shape)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)

    def degrees_off() -> float:
        dome = rig.db.read("capture", "S2")["dome"].to_dataset()
        towards = dome["light_position"].values.astype(float)
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        cosine = np.clip((towards * turned).sum(axis=1), -1, 1)
        return float(np.degrees(np.sqrt(np.square(np.arccos(cosine)).mean())))

    names = ("S0", "S1", "S2")
    for seed, name in enumerate(names):
        shown = slice(len(LIGHTS) - 1) if name == "S0" else slice(None)
        import_take(
            tmp_path,
            name,
            seed=seed,
            gains=GAINS[shown],
            lights=turned[shown],
            stated=LIGHTS[shown],
        )
        ingest(rig, name)
        workflow.fit_take(rig.db, name)
    before = degrees_off()
    record = workflow.calibrate_rig(rig.db, name="dome")
    report = workflow.describe_rig(rig.db, record)
    assert report["angle"] > 0.5 * before
    # a lamp failed in one of the three takes
    assert len(report["without_gain"]) == 1
    assert report["lights"] == len(LIGHTS)
    ingest(rig, "S2")
    assert degrees_off() < 0.7 * before
    assert rig.db.verify() == []


@pytest.mark.slow
def test_calibrate_rig__cameras_of_a_wrong_calibration_agree_in_later_captures(
    tmp_path,
):
    """A camera whose red is stated 15 % too low, with a white target in another one."""
    factor = 1.15
    folders = workflow.simulate(
        tmp_path, takes=3, cameras=4, lights=12, width=48, height=60, seed=3
    )
    for folder in folders:
        file = folder / "capture.json"
        about = json.loads(file.read_text())
        del about["contact"]
        file.write_text(json.dumps(about))
    rig = Rig(Database(tmp_path / "db"), tmp_path)
    names = [folder.name for folder in folders]

    def red_of_third() -> float:
        capture = rig.db.read("capture", names[0])
        return float(capture["calibration"]["camera_brightness"][2, 0])

    ingest(rig, names[0])
    right = red_of_third()
    for folder in folders:
        file = folder / "dome/dome.json"
        dome = json.loads(file.read_text())
        dome["cameras"][2]["colour_matrix"] = np.diag([1 / factor, 1, 1]).tolist()
        file.write_text(json.dumps(dome))
    for name in names:
        ingest(rig, name)
        workflow.fit_take(rig.db, name)
    record = workflow.calibrate_rig(rig.db, name="dome")
    assert workflow.describe_rig(rig.db, record)["camera_gains"]
    group = rig.db.read("calibration", "dome")["rig_calibration"]
    gain = group["rig_camera_gain"].values
    # 0.6 % in median, 1.2 % at most with six cameras of 160 x 200
    assert gain[2, 0] == pytest.approx(1 / factor, rel=0.03)
    assert np.abs(np.log(gain[[0, 1, 3]])).max() < 0.03
    ingest(rig, names[0])
    assert red_of_third() == pytest.approx(right, rel=0.03)
    # this take says the same again
    takes = (rig.db.read(kind, names[0]) for kind in ("capture", "model"))
    _, again = take_residuals(*takes, rng=np.random.default_rng(0))
    assert float(again[2, 0]) == pytest.approx(1 / factor, rel=0.03)


@pytest.mark.slow
def test_calibrate_rig__gains_that_are_not_common_are_not_stored(rig):
    rng = np.random.default_rng(8)
    for number in range(3):
        gains = np.exp(0.05 * rng.standard_normal(len(LIGHTS)))
        import_take(rig.folder, f"U{number}", seed=number, gains=gains)
        ingest(rig, f"U{number}")
        workflow.fit_take(rig.db, f"U{number}")
    message = r"must lower the spread .* found \d\.\d% without them and \d\.\d% with"
    with pytest.raises(InputError, match=message):
        workflow.calibrate_rig(rig.db, ["U0", "U1", "U2"], name="dome")
    assert not rig.db.has("calibration", "dome")


def test_calibrate_rig__mistakes(rig, tmp_path):
    def refused(message: str, *takes: str, name: str = "dome") -> None:
        with pytest.raises(InputError, match=message):
            workflow.calibrate_rig(rig.db, takes, name=name)

    refused("name of a calibration", name="a b")
    refused("at least 3 takes .* found S0;", "S0")
    ingest(rig, "S5")
    refused("S5: a calibration needs a model of the newest capture", "S0", "S1", "S5")
    refused("nobody", "nobody")
    turned = LIGHTS[[0, 2, 1, *range(3, 13)]]
    import_take(rig.folder, "T0", seed=6, lights=turned)
    ingest(rig, "T0")
    workflow.fit_take(rig.db, "T0")
    refused(
        r"T0: takes of one rig must have most of the lights of S0, .* \S+ elsewhere"
    )
    with pytest.raises(InputError, match="found none"):
        workflow.calibrate_rig(Database(tmp_path / "empty"), name="dome")
    workflow.record_consent(rig.db, "S0", [])
    refused("must consent to fit", "S0", "S1", "S2")
    assert not rig.db.has("calibration", "dome")


def test_withdraw__removes_calibrations_from_takes_of_the_subject(rig):
    workflow.calibrate_rig(rig.db, ["S0", "S1", "S2", "S3"], name="dome")
    workflow.calibrate_rig(rig.db, ["S1", "S2", "S3", "S4"], name="other")
    result = workflow.withdraw(rig.db, "S0")
    assert result.removed["calibration"] == 1
    assert not rig.db.has("calibration", "dome")
    assert rig.db.has("calibration", "other")
    assert rig.db.verify() == []
    assert ingest(rig, "S5").provenance["calibrated_by"]["take"] == "other"


def test_calibrate_command(rig):
    def run(*words: str) -> str:
        result = CliRunner().invoke(cli, ["calibrate", str(rig.db.folder), *words])
        return result.output + str(result.exception)

    output = run("--from-takes", "--name", "dome")
    assert "dome: calibration 1 of 13 lights from 5 takes" in output
    assert re.search(r"held-out take: [78]\.\d% without and [1-3]\.\d% with", output)
    assert "gains are known to" in output
    assert "residuals of a held-out take with the gains of the others: " in output
    # a matt sphere without the boundary of skin looks as if its lights were turned a little
    assert "  directions are moved by 0." in output
    assert "from 4 takes" in run("--from-takes", "S0", "S1", "S2", "S3", "--name", "b")
    assert "at least 3 takes" in run("--from-takes", "S0", "--name", "dome")
    assert "belongs to a SETUP" in run(
        "--from-takes", "--position-error", "2", "--name", "dome"
    )
    assert "give one SETUP, or --from-takes" in run("--name", "dome")
    assert "all versions must be from takes, or all from set-ups" in run(
        str(rig.folder / "S0"), "--name", "dome"
    )
