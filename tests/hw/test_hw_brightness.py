"""Brightness in the pictures: lights that failed."""

from __future__ import annotations

import os
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import trimesh
from devices_pair import BLACK, LIGHTS, OVERRIDE, Bench, is_frame, subject_folder

from skindb.format.dome import CameraRecord, DomeRecord, LightRecord
from skindb.format.frames import FrameKind
from skindb.format.sensor import SensorRecord
from skindb.hw.brightness import failed_lights
from skindb.hw.capture import CapturePlan, Devices, run_capture
from skindb.hw.capture_folder import Subject, read_setup
from skindb.hw.sequence import DARK, MAX_FLASHES, plan_schedule
from skindb.hw.session import with_dark_frames

EXPOSURES = {"long": 0.04, "short": 0.005}
WHITE = 2**16 - 1
SHORT_OF_LONG = EXPOSURES["short"] / EXPOSURES["long"]
SCHEDULE = with_dark_frames(plan_schedule(LIGHTS, EXPOSURES), count=1)
PERSON = Subject(
    "S1", "2026-01-01T10:00:00+00:00", {"scope": ["fit"], "reference": "none"}
)
SENSOR = SensorRecord(FrameKind(6, 4, 16), BLACK, WHITE, 0.0, np.inf)
CAMERA = CameraRecord(
    K=np.eye(3),
    R=np.eye(3),
    t=np.array([0.0, 0.0, -500.0]),
    distortion=np.zeros(5),
    id="c0",
    width=6,
    height=4,
    sensor=SENSOR,
    colour_matrix=np.eye(3),
    vignette=np.zeros(3),
)
DOME = DomeRecord(
    Path(),
    (CAMERA,),
    tuple(
        LightRecord(name, np.array([i - 5.0, 1, 9]), 0.0, None, np.eye(3)[2], 0.0)
        for i, name in enumerate(LIGHTS)
    ),
    EXPOSURES,
    "",
    None,
    None,
)


def _frames(folder, *, light=0.1, changed=None):
    """Frames of the schedule, at fractions of white in the long exposure; `changed` are
    levels of single lights.
    """
    frames = {}
    for i, step in enumerate(SCHEDULE.steps):
        level = 0.0
        if step.light != DARK:
            level = (changed or {}).get(step.light, light)
        level *= 1.0 if step.exposure == "long" else SHORT_OF_LONG
        value = min(BLACK + level * (WHITE - BLACK), WHITE)
        path = folder / f"{i}.png"
        path.write_bytes(
            imagecodecs.png_encode(np.full((4, 6, 3), round(value), np.uint16))
        )
        frames["c0", i] = path
    return frames


def _failed(frames):
    return failed_lights(SCHEDULE, frames, DOME)


def _step(light, exposure):
    return next(
        i
        for i, s in enumerate(SCHEDULE.steps)
        if (s.light, s.exposure) == (light, exposure)
    )


def test_failed_lights__none(tmp_path):
    assert _failed(_frames(tmp_path)) == {}


def test_failed_lights__one_that_is_dark(tmp_path):
    frames = _frames(tmp_path, changed={"l03": 0.005})
    assert [*_failed(frames)] == ["l03"]


def test_failed_lights__black_pictures_are_no_lights(tmp_path):
    """A lens cap: no picture is darker than the others."""
    failed = _failed(_frames(tmp_path, light=0.0))
    assert failed == dict.fromkeys(
        LIGHTS, "its picture is black, like those of most lights"
    )


def test_failed_lights__a_picture_that_cannot_be_read(tmp_path):
    frames = _frames(tmp_path)
    path = frames["c0", _step("l03", "long")]
    path.write_bytes(path.read_bytes()[:60] + path.read_bytes()[-12:])
    assert _failed(frames) == {"l03": "its picture cannot be read"}


def test_failed_lights__a_last_dark_frame_that_cannot_be_read(tmp_path):
    frames = _frames(tmp_path)
    path = frames["c0", len(SCHEDULE.steps) - 1]
    path.write_bytes(path.read_bytes()[:60] + path.read_bytes()[-12:])
    assert _failed(frames) == {
        DARK: "no readable picture in the last dark frame of camera c0"
    }


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    folder = subject_folder(tmp_path_factory.mktemp("lab"))
    trimesh.creation.icosphere(subdivisions=1).export(folder / "scan.ply")
    return folder


def test_run_capture__a_dark_frame_that_cannot_be_read_is_not_used(setup, tmp_path):
    """The mean of the other dark frames of that exposure is kept, and the session loses nothing."""
    with Bench(setup, tmp_path / "watched") as bench:
        trigger = bench.laboratory.dome._trigger

        def damage_the_second(*arguments):
            trigger(*arguments)
            path = bench.watched / "c0/IMG_00001.png"
            if path.exists():
                content = path.read_bytes()
                time = path.stat().st_mtime
                path.write_bytes(content[:40] + content[-12:])
                os.utime(path, (time, time))

        bench.laboratory.dome._trigger = damage_the_second
        devices = Devices(bench.dome, bench.cameras)
        files = {"mesh": setup / "scan.ply"}
        options = {"files": files, "override": OVERRIDE}
        run_capture(
            tmp_path / "C", read_setup(setup), PERSON, devices, CapturePlan(), **options
        )
    mean = imagecodecs.png_decode((tmp_path / "C/dome/dark/long_c0.png").read_bytes())
    assert is_frame(mean, BLACK)


def test_run_capture__more_flashes_than_planned_are_recorded(setup, tmp_path):
    """The controller is late at the beginning and then catches up."""
    with Bench(setup, tmp_path / "watched") as bench:
        device = bench.laboratory.dome
        report = device._report

        def catch_up(values):
            reply = report(values)
            lit = [step for step in device.steps if step.light != DARK]
            late = (
                0
                if reply["on"] < lit[7].on_us  # after two markers
                else max(lit[12].on_us - int(reply["on"]), 0)
            )
            return reply | {"on": reply["on"] + late, "off": reply["off"] + late}

        device._report = catch_up
        devices = Devices(bench.dome, bench.cameras)
        files = {"mesh": setup / "scan.ply"}
        found = run_capture(
            tmp_path / "C",
            read_setup(setup),
            PERSON,
            devices,
            CapturePlan(slow=True),
            files=files,
        )
    assert found["flashes_per_second"] > MAX_FLASHES
    assert (
        f"the controller flashed {found['flashes_per_second']} times in a second, "
        "and 3 were planned"
    ) in found["notes"]
