"""Brightness in the pictures: lights that failed, and the steady lamp beside which
flashes are safe.
"""

from __future__ import annotations

import os

import imagecodecs
import numpy as np
import pytest
import trimesh
from devices_pair import BLACK, CAMERAS, LIGHTS, OVERRIDE, Bench, subject_folder

from skindb.errors import InputError
from skindb.hw.brightness import (
    Levels,
    Picture,
    failed_lights,
    lamp_brightness,
    usable_exposure,
)
from skindb.hw.capture import CapturePlan, Devices, run_capture
from skindb.hw.capture_folder import Subject, read_setup
from skindb.hw.sequence import DARK, MAX_FLASHES, plan_schedule
from skindb.hw.session import with_dark_frames
from skindb.virtual.laboratory import LaboratoryFaults

EXPOSURES = {"long": 0.04, "short": 0.005}
WHITE = 2**16 - 1
SHORT_OF_LONG = EXPOSURES["short"] / EXPOSURES["long"]
SCHEDULE = with_dark_frames(plan_schedule(LIGHTS, EXPOSURES), count=1)
PERSON = Subject(
    "S1", "2026-01-01T10:00:00+00:00", {"scope": ["fit"], "reference": "none"}
)
DOME = {
    "cameras": [{"id": "c0", "R": np.eye(3), "t": [0, 0, -500], "black_level": BLACK}],
    "lights": [
        {"id": name, "position": [i - 5, 1, 9]} for i, name in enumerate(LIGHTS)
    ],
    "exposures": [
        {"id": name, "seconds": seconds} for name, seconds in EXPOSURES.items()
    ],
}


def _frames(folder, *, light=0.1, lamp=0.0, changed=None):
    """Frames of the schedule, at fractions of white in the long exposure; `changed` are
    levels of single lights.
    """
    frames = {}
    for i, step in enumerate(SCHEDULE.steps):
        level = lamp
        if step.light != DARK:
            level += (changed or {}).get(step.light, light)
        level *= 1.0 if step.exposure == "long" else SHORT_OF_LONG
        value = min(BLACK + level * (WHITE - BLACK), WHITE)
        path = folder / f"{i}.png"
        path.write_bytes(
            imagecodecs.png_encode(np.full((4, 6, 3), round(value), np.uint16))
        )
        frames["c0", i] = path
    return frames


def _failed(frames, *, lamp=False):
    return failed_lights(SCHEDULE, Levels(frames, DOME), DOME, lamp=lamp)


def _step(light, exposure):
    return next(
        i
        for i, s in enumerate(SCHEDULE.steps)
        if (s.light, s.exposure) == (light, exposure)
    )


def test_failed_lights__none(tmp_path):
    assert _failed(_frames(tmp_path)) == {}
    assert _failed(_frames(tmp_path, lamp=0.3), lamp=True) == {}


@pytest.mark.parametrize("lamp", [0.0, 0.3, 2.0])
def test_failed_lights__one_that_is_dark(tmp_path, lamp):
    """Beside a lamp that fills the long exposure, it is found in the short one."""
    frames = _frames(tmp_path, lamp=lamp, changed={"l03": 0.005})
    assert [*_failed(frames, lamp=lamp > 0)] == ["l03"]


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


def test_lamp_brightness__is_that_beside_the_brightest_light(tmp_path):
    levels = Levels(
        _frames(tmp_path, light=0.02, lamp=0.3, changed={"l07": 0.03}), DOME
    )
    assert usable_exposure(SCHEDULE, levels, DOME) == "long"
    assert lamp_brightness(SCHEDULE, levels, DOME) == pytest.approx(10.0, rel=0.01)


def test_lamp_brightness__in_an_exposure_that_it_does_not_fill(tmp_path):
    levels = Levels(_frames(tmp_path, light=0.2, lamp=3.0), DOME)
    assert usable_exposure(SCHEDULE, levels, DOME) == "short"
    assert lamp_brightness(SCHEDULE, levels, DOME) == pytest.approx(15.0, rel=0.01)


@pytest.mark.parametrize("lost", ["dark frame", "light", "last dark frame"])
def test_lamp_brightness__is_unknown_without_a_frame(tmp_path, lost):
    frames = _frames(tmp_path, light=0.02, lamp=0.3)
    steps = {
        "dark frame": (0, 1),
        "light": (_step("l03", "long"),),
        "last dark frame": (len(SCHEDULE.steps) - 1,),
    }
    for step in steps[lost]:
        del frames["c0", step]
    assert np.isnan(lamp_brightness(SCHEDULE, Levels(frames, DOME), DOME))


def test_levels__light_beside_a_lamp_from_another_side(tmp_path):
    """Differences are taken pixel by pixel, as the brightest pixels are those of the lamp."""
    beside = np.full((10, 10, 3), BLACK, np.uint16)
    lit = np.full((10, 10, 3), BLACK, np.uint16)
    beside[:, :5] += 20_000
    lit[:, 5:] += 8_000
    paths = {("c0", 0): tmp_path / "dark.png", ("c0", 1): tmp_path / "lit.png"}
    paths["c0", 0].write_bytes(imagecodecs.png_encode(beside))
    paths["c0", 1].write_bytes(imagecodecs.png_encode(beside + lit - BLACK))
    [level] = Levels(paths, DOME).of([Picture("c0", 1, 0)])
    assert level == pytest.approx(8_000 / (WHITE - BLACK), rel=1e-6)


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    folder = subject_folder(tmp_path_factory.mktemp("lab"))
    trimesh.creation.icosphere(subdivisions=1).export(folder / "scan.ply")
    return folder


def _session(setup, tmp_path, fraction, **options):
    """A session that states a lamp of ten lights; returns the refusal and when each
    light was switched on.

    With the fraction 1, the lamp is as bright as 12.4 times the brightest of the lights
    with which it is compared.
    """
    faults = LaboratoryFaults(lamp=fraction)
    with Bench(setup, tmp_path / "watched", faults, lamp=15.0) as bench:
        light = bench.laboratory.dome._light
        flashes = []

        def record(step):
            if step.light != DARK:
                flashes.append(bench.clock.monotonic())
            light(step)

        bench.laboratory.dome._light = record
        devices = Devices(bench.dome, bench.cameras)
        plan = CapturePlan(base=10, operator="OP-1")
        files = {"mesh": setup / "scan.ply"}
        try:
            run_capture(
                tmp_path / "C",
                read_setup(setup),
                PERSON,
                devices,
                plan,
                files=files,
                **options,
            )
        except InputError as error:
            return str(error), flashes
        return "", flashes


def _flashes_per_second(times):
    return max(
        (sum(start <= time < start + 1 for time in times) for start in times), default=0
    )


def test_run_capture__without_its_lamp_no_light_flashes(setup, tmp_path):
    refusal, flashes = _session(setup, tmp_path, 0.0)
    assert (
        "steady lamp: must be as bright as 10 lights; found dark frames of 0.0% of white"
        in refusal
    )
    assert flashes == []


@pytest.mark.parametrize(
    ("fraction", "said"),
    [
        (0.3, "at least 50% of that; found 3.7 lights"),
        (0.6, "luminance steps of 12%"),
        (0.75, "luminance steps of 10%"),
    ],
)
def test_run_capture__beside_a_lamp_that_is_too_dark_lights_flash_slowly_only(
    setup, tmp_path, fraction, said
):
    """A few lights are compared with the lamp at the safe rate; the sequence itself is refused."""
    refusal, flashes = _session(setup, tmp_path, fraction)
    assert said in refusal
    assert 3 <= len(flashes) <= 6
    assert _flashes_per_second(flashes) <= MAX_FLASHES


def test_run_capture__beside_its_lamp_the_lights_flash_fast(setup, tmp_path):
    refusal, flashes = _session(setup, tmp_path, 1.0)
    assert refusal == ""
    assert len(flashes) > len(LIGHTS) * len(EXPOSURES)
    assert _flashes_per_second(flashes) > MAX_FLASHES


def test_run_capture__an_operator_may_confirm_a_darker_lamp(setup, tmp_path):
    refusal, flashes = _session(setup, tmp_path, 0.6, override=OVERRIDE)
    assert refusal == ""
    assert _flashes_per_second(flashes) > MAX_FLASHES
    assert len(CAMERAS) * len(LIGHTS) * len(EXPOSURES) == len(
        [*(tmp_path / "C/dome/frames").glob("*/*")]
    )


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
    assert (mean == BLACK).all()


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
                if reply["on"] < lit[0].on_us
                else max(lit[5].on_us - int(reply["on"]), 0)
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
