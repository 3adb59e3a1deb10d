"""`skindb capture --calibration`: targets that the emulated cameras of a small virtual dome see."""

from __future__ import annotations

import json
import resource
from itertools import product

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import skindb
from skindb import workflow
from skindb.calibration.boards import read_boards
from skindb.calibration.setup import (
    read_calibration_frames,
    read_setup_dome,
    with_placeholders,
)
from skindb.errors import InputError
from skindb.format.frames import read_frame, write_frame
from skindb.hw.capture_folder import copy_frame, write_record
from skindb.hw.target_checks import Target, target_faults
from skindb.parameters import SessionParameters
from skindb.types import unit
from skindb.virtual.targets import (
    BOARD,
    TargetScene,
    rehearsed_dome,
    write_laboratory,
)

pytest.importorskip("cv2")
SIZE = {"cameras": 2, "lights": 4, "width": 160, "height": 200}
SECONDS = {"e0": 0.04, "e1": 0.005}


@pytest.fixture
def lab(tmp_path):
    folder = tmp_path / "lab"
    write_laboratory(folder, **SIZE)
    return folder


@pytest.fixture
def small_lab(tmp_path):
    """With pictures that are too small for a board."""
    folder = tmp_path / "lab"
    write_laboratory(folder, **SIZE | {"width": 40, "height": 50})
    return folder


def record(lab, kind, **options):
    parameters = SessionParameters(virtual=True, calibration=kind, **options)
    return workflow.record_target(lab, parameters)


def placeholder_dome(lab):
    known = json.loads((lab / "dome/dome.json").read_text())
    known.pop("white")
    return read_setup_dome(lab, white=False, record=with_placeholders(known))


def test_record_target__a_board_is_calibrated_and_continued(lab):
    report = record(lab, "board", placements=4)
    assert report["frames"] == 8
    assert max(report["rms_px"].values()) < 0.5
    assert len(read_boards(lab).views) == 8
    before = (lab / "dome/calibration/board_4_c00.png").read_bytes()
    assert record(lab, "board", placements=5)["frames"] == 10
    assert (lab / "dome/calibration/board_4_c00.png").read_bytes() == before


def test_record_target__frames_are_in_the_layout_that_calibrate_reads(small_lab):
    lab = small_lab
    counts = {"white": 16, "ball": 16, "dark": 16, "flat": 28, "chart": 14}
    counts["response"] = 14
    for kind, count in counts.items():
        report = record(lab, kind, **({"placements": 2} if kind == "ball" else {}))
        assert report["frames"] == count
    dome = placeholder_dome(lab)
    frames = read_calibration_frames(dome)
    assert list(frames.ball.outlines) == ["1", "2"]
    assert frames.kinds["dark"].repeats == 8
    assert len(frames.exposures) == 7
    for kind in ("flat", "chart", "response"):
        read = frames.read(frames.kinds[kind].frames, dome.cameras[0], frames.exposures)
        # each exposure is half as long
        levels = [float(np.max(one[0])) - 1024 for one in read]
        assert (np.diff(levels) < 0).all()
    assert json.loads((lab / "dome/dome.json").read_text())["white"]["frames"].endswith(
        "{light}_{camera}.png"
    )


@pytest.mark.parametrize(
    ("kind", "options", "said"),
    [
        ("board", {"subject": "S1"}, "--subject: belongs to the capture of a subject"),
        ("ball", {}, "must describe the ball by radius; found no radius"),
        ("board", {"placements": 3}, "--placements: must be at least 4 for a board"),
        ("dark", {"faults": ("dropped_frame=c09:1",)}, "those of the set-up"),
        (
            "white",
            {"faults": ("dome.dead_light=l002",)},
            "of white on it in one camera; found less of l002",
        ),
    ],
)
def test_record_target__faults_are_one_line(small_lab, kind, options, said):
    (small_lab / "dome/calibration.json").write_text("{}")
    with pytest.raises(InputError, match=said):
        record(small_lab, kind, **options)


@pytest.mark.parametrize(
    "write",
    [
        lambda file: write_record(file, {"text": "x" * 2000}),
        lambda file: copy_frame(file.with_name("long.png"), file),
    ],
)
def test_record_target__a_file_that_finds_no_space_stays_as_before(tmp_path, write):
    file = tmp_path / "dome.json"
    file.write_text("before")
    (tmp_path / "long.png").write_bytes(bytes(2000))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as error:
            write(file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert error.value.filename == str(file)
    assert file.read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 2


def test_record_target__lost_frames_are_taken_again(small_lab):
    report = record(small_lab, "dark", faults=("dropped_frame=c01:11",))
    assert any("repeated" in note for note in report["notes"])
    assert report["frames"] == 16


def drawn(lab, tmp_path, kind, steps, seconds=SECONDS, number=1, edit=None):
    """Faults of drawn frames, which `edit` changes."""
    dome = placeholder_dome(lab)
    virtual, sensor = rehearsed_dome(dome)
    rng = np.random.default_rng(1)
    scene = TargetScene(virtual, sensor, kind, seconds, rng=rng)
    scene.number = number
    files = {}
    for camera in dome.camera_ids:
        for i, (light, exposure, _) in enumerate(steps):
            lit = {} if light == "-" else {light: 1.0}
            frame = scene.frame(camera, exposure, lit)
            files[camera, i] = tmp_path / f"{camera}_{i}.png"
            frame = frame if edit is None else edit(frame.astype(float))
            write_frame(files[camera, i], np.clip(frame, 0, 65520).astype(np.uint16))
            assert read_frame(files[camera, i]).shape == (200, 160, 3)
    target = Target(kind, number, seconds, BOARD)
    return target_faults(target, dome.cameras, steps, files)


BOARD_STEP = [("l000", "e0", 1)]
FLAT = {f"f{i}": 0.04 / 2**i for i in range(7)}
FLAT_STEPS = [("l000", name, 1) for name in FLAT]


@pytest.mark.parametrize(
    ("kind", "steps", "seconds"),
    [
        ("board", BOARD_STEP, SECONDS),
        ("white", [("l000", "e0", 1), ("l000", "e1", 1)], SECONDS),
        ("ball", [("l000", "e1", 1), ("l001", "e1", 1)], SECONDS),
        ("dark", [("-", "e0", 1)], SECONDS),
        ("flat", FLAT_STEPS, FLAT),
        ("chart", FLAT_STEPS, FLAT),
        ("response", FLAT_STEPS, FLAT),
    ],
)
def test_target_faults__none_of_good_frames(lab, tmp_path, kind, steps, seconds):
    assert drawn(lab, tmp_path, kind, steps, seconds) == []


def blurred(frame):
    return gaussian_filter(frame, (4, 4, 0))


def half_covered(frame):
    frame[:, :40] = 1024
    return frame


@pytest.mark.parametrize(
    ("kind", "steps", "seconds", "edit", "said"),
    [
        (
            "board",
            BOARD_STEP,
            {"e0": 0.04},
            lambda f: 0 * f,
            "found in the pictures of 2",
        ),
        ("board", BOARD_STEP, {"e0": 0.001}, None, "at least 5% of white"),
        ("board", BOARD_STEP, {"e0": 0.07}, None, "at most 2% may be saturated"),
        ("white", BOARD_STEP, {"e0": 0.0001}, None, "at least 5% of white"),
        ("white", BOARD_STEP, {"e0": 1.0}, None, "at most 2% may be saturated"),
        ("ball", BOARD_STEP, {"e0": 0.005}, lambda f: 0 * f + 9e3, "of 2 cameras"),
        ("dark", BOARD_STEP, SECONDS, None, "must be within 1% of black_level"),
        ("flat", FLAT_STEPS[:4], FLAT, None, "5 exposures must be between"),
        ("flat", FLAT_STEPS, FLAT, half_covered, "darkest pixels must have 20%"),
        ("chart", FLAT_STEPS, FLAT, blurred, "edges must reach 15%"),
    ],
)
def test_target_faults__names_what_is_wrong(
    lab, tmp_path, kind, steps, seconds, edit, said
):
    faults = drawn(lab, tmp_path, kind, steps, seconds, edit=edit)
    assert faults
    assert all(said in str(fault) for fault in faults)


@pytest.mark.slow  # records three targets and reads them
def test_calibrate__completes_a_dome_without_geometry(lab, tmp_path):
    for kind, places in (("board", 5), ("white", None), ("ball", 2)):
        record(lab, kind, placements=places)
    db = skindb.open(str(tmp_path / "db"), create=True)
    before = (lab / "dome/dome.json").read_text()
    calibration = json.loads((lab / "dome/calibration.json").read_text())
    ball = calibration.pop("ball")
    (lab / "dome/calibration.json").write_text(json.dumps(calibration))
    with pytest.raises(InputError, match="by a mirror ball; found no ball"):
        workflow.calibrate(db, lab, name="dome-a")
    # a radius of the wrong unit
    (lab / "dome/calibration.json").write_text(
        json.dumps({"ball": ball | {"radius": 3.0}})
    )
    with pytest.raises(InputError, match="must be those of a ball of radius 3 mm"):
        workflow.calibrate(db, lab, name="dome-a")
    assert (lab / "dome/dome.json").read_text() == before
    (lab / "dome/calibration.json").write_text(json.dumps({"ball": ball}))
    version = workflow.calibrate(db, lab, name="dome-a")
    dome = read_setup_dome(lab)
    truth, _ = rehearsed_dome(dome)
    corners = np.array(list(product((-60, 60), (-80, 80), (0, 60))), float)
    for camera, true in zip(dome.cameras, truth.cameras, strict=True):
        off = camera.project(corners) - true.project(corners)
        assert np.sqrt(np.mean(off**2)) < 0.5  # px; corners are found to 0.2
    for light, true in zip(dome.lights, truth.lights, strict=True):
        cosine = unit(light.position) @ unit(true.position)
        # highlights of a ball with a radius of 20 px are found to 0.1 px
        assert np.degrees(np.arccos(cosine)) < 2.0
    report = workflow.describe_calibration(db, version)
    assert report["boards"]["cameras"] == 2
    assert report["cameras"]["known points"]["reprojection_rms"] < 0.5
    completed = (lab / "dome/dome.json").read_text()
    workflow.calibrate(db, lab, name="dome-a")
    assert (lab / "dome/dome.1.json").read_text() == completed
    assert not (lab / "dome/dome.2.json").exists()
