"""The light controller: states, steps and reports that cannot be right end a run, and
the lights are off.
"""

from __future__ import annotations

import shutil

import imagecodecs
import pytest
from devices_pair import (
    EXPOSURES,
    LIGHTS,
    OVERRIDE,
    Bench,
    is_frame,
    linked,
    subject_folder,
    value_of,
)

from skindb.clock import SimulatedClock
from skindb.hw.dome import Dome
from skindb.hw.frame_markers import MARKER
from skindb.hw.link import SILENCE_SECONDS, SLACK_SECONDS, WATCHDOG_SECONDS, DeviceError
from skindb.hw.sequence import (
    DARK,
    Measured,
    Rehearsal,
    measured_flashes,
    plan_schedule,
    slowed_schedule,
)
from skindb.hw.session import with_dark_frames
from skindb.virtual.devices import DeviceFaults, EmulatedDome, RefusedError

SCHEDULE = with_dark_frames(plan_schedule(LIGHTS, EXPOSURES))


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    return subject_folder(tmp_path_factory.mktemp("subject"))


class OddDome(EmulatedDome):
    """A controller whose replies are changed by functions, by verb."""

    def __init__(self, faults=None, **changes):
        super().__init__(tuple(LIGHTS), lambda *_: None, faults, clock=SimulatedClock())
        self.changes = changes

    def handle(self, verb, values):
        try:
            reply = super().handle(verb, values)
        except RefusedError:
            if "REFUSED" not in self.changes:
                raise
            reply = {}
        return self.changes[verb](self, reply) if verb in self.changes else reply


def _run(device, done=None):
    """Run with a device; afterwards the lights are off."""
    dome = Dome(linked(device))
    dome.upload(SCHEDULE)
    dome.arm(SCHEDULE, OVERRIDE)
    begin = device.clock.monotonic()
    try:
        return dome.run(SCHEDULE, done=done)
    finally:
        assert device.on is None
        assert device.state != "running"
        assert device.clock.monotonic() - begin < SCHEDULE.seconds + SLACK_SECONDS + 3.0


def _in_run(**changed):
    """Change the values of a reply while a plan is running."""
    return lambda device, reply: reply | changed if device.state == "running" else reply


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"step": 999_999_999},
            "must send as step a whole number from 0 to 33; found '999999999'",
        ),
        ({"step": 34}, "must send as step a whole number from 0 to 33"),
        ({"step": -1}, "must send as step a whole number from 0 to 33"),
        ({"step": "nan"}, "must send as step a whole number from 0 to 33"),
        ({"step": "1.0"}, "must send as step a whole number from 0 to 33"),
        ({"step": 33}, r"cannot finish 33 steps in less than 3\.. s; found 0\.0 s"),
        ({"step": 2}, r"cannot finish 2 steps in less than 0\.3 s; found 0\.0 s"),
        (
            {"step": 0},
            r"must finish step 0 within 2\.0 s; found no progress after 2\.1 s",
        ),
        (
            {"state": "banana"},
            "must send as state one of idle, armed, running, done, stopped; found 'banana'",
        ),
        ({"state": "idle"}, "must be running, done or stopped after START; found idle"),
        (
            {"state": "armed"},
            "must be running, done or stopped after START; found armed",
        ),
        ({"state": "done"}, "must finish 33 steps before it is done; found 0 steps"),
        ({"interlock": "open"}, "must stop when the interlock is open; found running"),
        (
            {"interlock": "ajar"},
            "must send as interlock one of closed, open; found 'ajar'",
        ),
    ],
)
def test_run__a_state_that_cannot_be_right_ends_it(changed, said):
    with pytest.raises(DeviceError, match=f"dome: {said}"):
        _run(OddDome(STATUS=_in_run(**changed)))


def test_run__steps_never_become_fewer():
    def back(device, reply):
        return reply | {"step": 3} if device._done == 6 else reply

    with pytest.raises(
        DeviceError,
        match="must not count fewer finished steps than before; found 3 after ",
    ):
        _run(OddDome(STATUS=back))


@pytest.mark.parametrize("at", [0, 5, 20, 32])
def test_run__a_controller_without_progress_is_stopped(at):
    """It answers every request, which would keep its watchdog quiet for ever."""
    device = OddDome(DeviceFaults(frozen_at=at))
    with pytest.raises(
        DeviceError,
        match=rf"must finish step {at} within .* s; found no progress after",
    ):
        _run(device)
    assert device.reason == "stop"


def test_run__an_unfinished_state_is_stopped_after_all_steps():
    def never_done(device, reply):
        return reply | {"state": "running"} if reply["state"] == "done" else reply

    with pytest.raises(
        DeviceError, match=r"must finish step 33 within .* s; found no progress after"
    ):
        _run(OddDome(STATUS=never_done))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"level": "nan"},
            "must send as level a number from -0.1 to 10 of the nominal current; found 'nan'",
        ),
        ({"level": "inf"}, "must send as level a number"),
        ({"level": "-3"}, "must send as level a number"),
        (
            {"rest": "nan"},
            "must send as rest a number from -0.1 to 1,000 of the current of a light; found 'nan'",
        ),
        ({"rest": "1e99"}, "must send as rest a number"),
        (
            {"triggers": "7"},
            "must send as triggers a whole number from 0 to 1; found '7'",
        ),
        ({"triggers": "nan"}, "must send as triggers a whole number from 0 to 1"),
        ({"on": "-1"}, "must send as on a number from 1,362,170 to"),
        ({"on": "nan"}, "must send as on a number from 1,362,170 to"),
        ({"on": "999999999"}, "must send as on a number from 1,362,170 to"),
        ({"off": "0"}, "must send as off a number from"),
        ({"off": "999999999"}, "must send as off a number from"),
    ],
)
def test_run__a_report_that_cannot_be_right_ends_it(changed, said):
    """It keeps the reports before it."""

    def change(device, reply):
        return reply | changed if device._done >= 6 else reply

    done = []
    with pytest.raises(DeviceError, match=f"dome: {said}"):
        _run(OddDome(REPORT=change), done)
    assert 4 <= len(done) <= 7


def test_capture_dome__reports_of_steps_that_never_ran_are_not_asked_for(
    subject, tmp_path
):
    """The run was stopped at step 20; the controller answers reports of any step, for ever."""
    with Bench(subject, tmp_path) as bench:
        device = bench.laboratory.dome
        device.faults = DeviceFaults(open_interlock_at=20)
        report = device._report
        asked = []

        def any_step(values):
            asked.append(int(values["index"]))
            step = device.steps[asked[-1]]
            ready = {
                "on": step.on_us,
                "off": step.off_us,
                "triggers": 1,
                "level": 1.0,
                "rest": 0.0,
            }
            return report(values) if step.measured else ready

        device._report = any_step
        run = bench.capture(SCHEDULE)
    assert run.stopped == "dome: the interlock was opened"
    assert max(asked) == 20
    assert [i for i, measured in enumerate(run.measured) if measured is not None] == [
        *range(20 - MARKER - 4)  # and half of the second marker
    ]


def test_capture_dome__a_stop_without_a_reason_ends_the_run(subject, tmp_path):
    with Bench(subject, tmp_path) as bench:
        device = bench.laboratory.dome
        device.faults = DeviceFaults(open_interlock_at=20)
        status = device._status
        device._status = lambda values: status(values) | {"reason": ""}
        run = bench.capture(SCHEDULE)
    assert run.stopped == "dome: it gave no reason"


def test_capture_dome__current_in_a_dark_frame_is_named(subject, tmp_path):
    with Bench(subject, tmp_path) as bench:
        device = bench.laboratory.dome
        report = device._report

        def lit(values):
            dark = device.steps[int(values["index"])].light == DARK
            return report(values) | ({"level": "0.6"} if dark else {})

        device._report = lit
        run = bench.capture(SCHEDULE)
    assert run.faulty_lights == {DARK: "60% of the current of a light in a dark frame"}


def test_capture_dome__wrong_trigger_counts_do_not_exchange_frames(subject, tmp_path):
    """One trigger is lost and another one is reported as lost: there are as many frames
    as reported triggers.
    """
    with Bench(subject, tmp_path) as bench:
        device = bench.laboratory.dome
        device.faults = DeviceFaults(lost_triggers=(12,))
        report = device._report

        def exchanged(values):
            triggers = {12: 1, 16: 0}.get(int(values["index"]), 1)
            return report(values) | {"triggers": triggers}

        device._report = exchanged
        run = bench.capture(SCHEDULE)
    assert "repeated" in run.notes[-1]
    for (camera, i), path in run.frames.items():
        step = SCHEDULE.steps[i]
        if step.light != DARK:
            found = imagecodecs.png_decode(path.read_bytes())
            assert is_frame(found, value_of(step.light, camera, step.exposure))


def test_capture_dome__a_folder_of_a_camera_that_is_gone_ends_the_run(
    subject, tmp_path
):
    with Bench(subject, tmp_path) as bench:

        def unmount(stage, done, total):
            if done == total:
                shutil.rmtree(tmp_path / "c1")

        run = bench.capture(
            SCHEDULE,
            progress=unmount,
        )
    assert "must be readable and writable: No such file or directory" in run.stopped
    assert run.frames == {}


def test_measured_flashes__are_those_of_the_measured_times():
    """Each light is late by up to two seconds and the next ones follow at once; a
    jitter of 1 ms does not count.
    """
    slow = slowed_schedule(plan_schedule(LIGHTS, {"long": 0.01}))
    assert (
        measured_flashes(slow, _measured(slow, lambda i, on: on + (i % 2) * 1_000)) == 3
    )
    assert (
        measured_flashes(
            slow, _measured(slow, lambda i, on: max(on, 2_000_000 + 20_000 * i))
        )
        > 3
    )
    assert measured_flashes(slow, []) == 0


def _measured(schedule, on_us):
    starts = [on_us(i, step.on_us) for i, step in enumerate(schedule.steps)]
    return [Measured(start, start + 10_000, 1, 1.0, 0.0) for start in starts]


@pytest.mark.parametrize("stays", ["running", "banana"])
def test_run__a_stop_that_is_not_confirmed_is_left_to_the_watchdog(stays):
    """The host is silent until the controller has switched the lights off by itself."""
    device = OddDome(STATUS=_in_run(step=999_999_999, state=stays))
    halt = device._halt
    device._halt = lambda reason: {} if reason == "stop" else halt(reason)
    with pytest.raises(DeviceError) as error:
        _run(device)
    assert "dome: must confirm that it stopped; found" in str(error.value)
    assert "see that the lights are off, or switch off the power" in str(error.value)
    assert device.reason == "watchdog"
    assert device.clock.monotonic() - device.heard >= SILENCE_SECONDS > WATCHDOG_SECONDS


def test_run__a_start_whose_reply_is_lost_is_stopped(monkeypatch):
    """The controller runs although the host does not know it."""
    device = OddDome()
    begin = device._begin
    answer = device._answer

    def silent(message):
        reply = answer(message)
        return b"" if message.verb == "START" else reply

    monkeypatch.setattr(device, "_answer", silent)
    started = []
    device._begin = lambda values: started.append(1) or begin(values)
    with pytest.raises(DeviceError, match=r"must answer START within 0\.9 s"):
        _run(device)
    assert started
    assert device.state == "stopped"


def test_arm__a_rehearsal_never_runs_on_a_real_controller():
    device = OddDome(HELLO=lambda _, reply: reply | {"name": "north"})
    dome = Dome(linked(device))
    dome.upload(SCHEDULE)
    with pytest.raises(
        DeviceError,
        match=r"must be emulated in a rehearsal, .*; found 'north'; omit --virtual",
    ):
        dome.arm(SCHEDULE, Rehearsal())
    assert device.state == "idle"
