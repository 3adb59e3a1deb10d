"""The fault matrix: what goes wrong in a session is found, named, and repeated or
refused; no frame is mistaken.
"""

from __future__ import annotations

import imagecodecs
import numpy as np
import pytest
from devices_pair import (
    BRACKETS,
    CAMERAS,
    EXPOSURES,
    LIGHTS,
    OVERRIDE,
    Bench,
    is_frame,
    subject_folder,
    value_of,
)

from skindb.errors import Fault, InputError
from skindb.hw.cameras import Shot
from skindb.hw.probe import PlacementError
from skindb.hw.sequence import DARK, assess, plan_schedule, slowed_schedule
from skindb.hw.session import (
    DARK_FRAMES,
    capture_dome,
    capture_site,
    require_complete,
    with_dark_frames,
)
from skindb.virtual.devices import DeviceFaults
from skindb.virtual.laboratory import LaboratoryFaults

SCHEDULE = with_dark_frames(plan_schedule(LIGHTS, EXPOSURES))


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    return subject_folder(tmp_path_factory.mktemp("subject"))


def _run(subject, watched, faults=None):
    with Bench(subject, watched, faults) as bench:
        run = bench.capture(SCHEDULE)
        # all lights are off, except one that cannot be switched off
        assert bench.laboratory.dome.on in (None, "l03")
        return run


def _require_right_frames(run, but=()):
    """Every frame that is there is that of its light, camera and exposure."""
    for (camera, i), path in run.frames.items():
        step = SCHEDULE.steps[i]
        if step.light not in (DARK, *but):
            found = imagecodecs.png_decode(path.read_bytes())
            assert is_frame(found, value_of(step.light, camera, step.exposure))


def test_capture_dome__everything_works(subject, tmp_path):
    run = _run(subject, tmp_path)
    require_complete(run, CAMERAS)
    assert len(run.frames) == len(CAMERAS) * len(SCHEDULE.steps)
    assert (run.notes, run.faulty_lights, run.stopped) == ([], {}, "")
    _require_right_frames(run)
    assert all(done.triggers == 1 for done in run.measured)


REPEATED = {
    "a dropped frame in the middle": LaboratoryFaults(dropped_frames=(("c0", 9),)),
    "the first frame": LaboratoryFaults(dropped_frames=(("c0", 0),)),
    "the last frame": LaboratoryFaults(
        dropped_frames=(("c1", len(SCHEDULE.steps) - 1),)
    ),
    "the first frame of a light": LaboratoryFaults(dropped_frames=(("c0", 2),)),
    "frames of several cameras": LaboratoryFaults(
        dropped_frames=(("c0", 5), ("c1", 5), ("c1", 6), ("c1", 20))
    ),
    "a frame, and again when it is repeated": LaboratoryFaults(
        dropped_frames=(("c0", 5), ("c0", len(SCHEDULE.steps)))
    ),
    "lost triggers": LaboratoryFaults(dome=DeviceFaults(lost_triggers=(4, 17))),
}


@pytest.mark.parametrize("faults", REPEATED.values(), ids=REPEATED)
def test_capture_dome__missing_frames_are_repeated(subject, tmp_path, faults):
    run = _run(subject, tmp_path, faults)
    require_complete(run, CAMERAS)
    _require_right_frames(run)
    assert any("missing frames" in note and "repeated" in note for note in run.notes)


class OwnCameras:
    """Cameras of another make: frames are counted by the folder of the emulated ones,
    and numbered by their names.
    """

    ids = tuple(CAMERAS)

    def __init__(self, root):
        self.root = root

    def start(self, since=None):
        self.first = {
            name: len(list((self.root / name).iterdir())) for name in self.ids
        }

    def collect(self, expected):
        taken = {
            name: sorted((self.root / name).glob("*.png"))[self.first[name] :]
            for name in self.ids
        }
        return {name: [Shot(path) for path in files] for name, files in taken.items()}


def test_capture_dome__takes_any_cameras(subject, tmp_path):
    with Bench(subject, tmp_path) as bench:
        run = capture_dome(
            bench.dome,
            OwnCameras(tmp_path),
            SCHEDULE,
            marker_light=LIGHTS[0],
            override=OVERRIDE,
        )
    require_complete(run, CAMERAS)
    assert len(run.frames) == len(CAMERAS) * len(SCHEDULE.steps)
    _require_right_frames(run)


@pytest.mark.slow
def test_capture_dome__any_frames_may_be_lost(subject, tmp_path):
    """Up to a tenth of the frames, anywhere: those that are kept are always the right ones."""
    for seed in range(12):
        rng = np.random.default_rng(seed)
        count = int(rng.integers(1, 6))
        lost = {
            (str(rng.choice(CAMERAS)), int(rng.integers(len(SCHEDULE.steps))))
            for _ in range(count)
        }
        run = _run(subject, tmp_path, LaboratoryFaults(dropped_frames=tuple(lost)))
        assert run.missing(CAMERAS) == {}, seed
        _require_right_frames(run)


def test_capture_dome__a_camera_that_is_off_is_named(subject, tmp_path):
    every = tuple(("c1", i) for i in range(12 * len(SCHEDULE.steps)))
    run = _run(subject, tmp_path, LaboratoryFaults(dropped_frames=every))
    with pytest.raises(
        InputError,
        match=r"33 missing frames: light - exposure long camera c1; .* keep the subject",
    ):
        require_complete(run, CAMERAS)
    _require_right_frames(run)
    assert sum(camera == "c0" for camera, _ in run.frames) == len(SCHEDULE.steps)


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        (
            DeviceFaults(dim_light="l05"),
            "light l05: must be as bright as the others; found 50% of its nominal current",
        ),
        (
            DeviceFaults(stuck_light="l03"),
            "light l03: must be as bright as the others; found 100% of the current of a light",
        ),
        (DeviceFaults(open_interlock_at=9), "found dome: the interlock was opened"),
        (DeviceFaults(vanish_after=90), "found dome must "),
    ],
)
def test_capture_dome__what_cannot_be_repeated_is_named(
    subject, tmp_path, faults, said
):
    run = _run(subject, tmp_path, LaboratoryFaults(dome=faults))
    with pytest.raises(InputError) as error:
        require_complete(run, CAMERAS)
    assert said in str(error.value)
    _require_right_frames(
        run, but=LIGHTS if faults.stuck_light or faults.dim_light else ()
    )


@pytest.mark.parametrize(
    "faults",
    [
        DeviceFaults(garbage=0.3),
        DeviceFaults(lost_replies=0.03),
        DeviceFaults(delay=0.02),
    ],
)
def test_capture_dome__a_bad_line_costs_time_only(subject, tmp_path, faults):
    run = _run(subject, tmp_path, LaboratoryFaults(dome=faults))
    require_complete(run, CAMERAS)
    _require_right_frames(run)
    assert bool(run.notes) == bool(faults.garbage)


def test_capture_site__everything_works(subject, tmp_path):
    with Bench(subject, tmp_path) as bench:
        for site in ("cheek", "neck"):
            bench.laboratory.place(site)
            run = capture_site(bench.probe, bench.probe_camera, site, BRACKETS)
            for number, path in enumerate(run.frames.values()):
                value = 1000 * (1 + number) + (site == "neck")
                assert (imagecodecs.png_decode(path.read_bytes()) == value).all()
            pressure = run.placement.pressure
            assert (np.diff(pressure[:, 0]) > 0).all()
            assert np.abs(pressure[:, 1] + 5).max() < 0.5
            assert not bench.laboratory.probe.led


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        (LaboratoryFaults(probe=DeviceFaults(leak=2.0)), "so it leaks; press it on"),
        (
            LaboratoryFaults(dropped_probe_frames=(2,)),
            "4 frames for 5 triggers and 5 exposures; measure cheek again",
        ),
        (
            LaboratoryFaults(probe=DeviceFaults(lost_triggers=(2,))),
            "4 frames for 4 triggers and 5 exposures",
        ),
        (LaboratoryFaults(probe=DeviceFaults(vanish_after=6)), "probe: must "),
    ],
)
def test_capture_site__what_goes_wrong_is_named(subject, tmp_path, faults, said):
    with Bench(subject, tmp_path, faults) as bench:
        bench.laboratory.place("cheek")
        with pytest.raises(InputError) as error:
            capture_site(
                bench.probe, bench.probe_camera, "cheek", dict.fromkeys(BRACKETS, 2.0)
            )
        assert said in str(error.value)


def test_capture_site__a_frame_without_its_trigger_is_not_trusted(subject, tmp_path):
    with Bench(subject, tmp_path) as bench:
        bench.laboratory.place("cheek")
        handle = bench.laboratory.probe.handle
        changed = {"b02": {"triggers": 0}}

        def one_trigger_less(verb, values):
            reply = handle(verb, values)
            exposing = bench.laboratory.probe._exposing
            return reply | changed.get(exposing, {}) if verb == "STATUS" else reply

        bench.laboratory.probe.handle = one_trigger_less
        with pytest.raises(
            PlacementError,
            match="5 frames for 4 triggers and 5 exposures; measure cheek again",
        ):
            capture_site(bench.probe, bench.probe_camera, "cheek", BRACKETS)


def test_capture_dome__steps_before_the_controller_vanished_are_kept(subject, tmp_path):
    """What it reported while it ran is kept with its measured times; what it did not
    report is taken again.
    """
    for requests in range(72, 180, 6):  # 70 before the start, then about 105
        run = _run(
            subject,
            tmp_path,
            LaboratoryFaults(dome=DeviceFaults(vanish_after=requests)),
        )
        assert "the device has closed its line" in run.stopped
        _require_right_frames(run)
        assert {i for _, i in run.frames} <= {
            i for i, done in enumerate(run.measured) if done is not None
        }
        # the dark frames, which are between the first two markers
        if requests > 120:
            assert len(run.frames) >= len(CAMERAS) * DARK_FRAMES * len(EXPOSURES)


@pytest.mark.parametrize("slow", [False, True])
def test_capture_dome__a_repetition_that_is_refused_loses_nothing(
    subject, tmp_path, slow, monkeypatch
):
    schedule = with_dark_frames(
        slowed_schedule(plan_schedule(LIGHTS, EXPOSURES))
        if slow
        else plan_schedule(LIGHTS, EXPOSURES)
    )
    with Bench(
        subject, tmp_path, LaboratoryFaults(dropped_frames=(("c0", 9),))
    ) as bench:
        arm = bench.dome.arm
        armed = []

        def refuse_the_second(part, override):
            assert (
                assess(part).flashes_per_second <= assess(schedule).flashes_per_second
            )
            if armed:
                raise InputError(
                    Fault("dome", "must be armed", "the interlock is open", "")
                )
            armed.append(part)
            arm(part, override)

        monkeypatch.setattr(bench.dome, "arm", refuse_the_second)
        run = bench.capture(
            schedule,
            override=None if slow else OVERRIDE,
        )
    assert run.stopped == "dome must be armed: the interlock is open"
    # the dark frames of that camera before the lights
    assert len(run.frames) == len(CAMERAS) * len(schedule.steps) - DARK_FRAMES * len(
        EXPOSURES
    )
