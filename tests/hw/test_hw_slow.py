"""Slow devices: a session completes or is refused in one clear line, and ends in either case."""

from __future__ import annotations

import re

import imagecodecs
import pytest
from devices_pair import (
    BRACKETS,
    CAMERAS,
    EXPOSURES,
    LIGHTS,
    Bench,
    emulated_dome,
    is_frame,
    linked,
    subject_folder,
    value_of,
)

from skindb.errors import InputError
from skindb.hw.dome import Dome
from skindb.hw.link import ATTEMPTS, READ_SECONDS, REPLY_SECONDS
from skindb.hw.sequence import DARK, plan_schedule
from skindb.hw.session import (
    capture_site,
    require_complete,
    with_dark_frames,
)
from skindb.virtual.devices import DeviceFaults
from skindb.virtual.laboratory import LaboratoryFaults

SCHEDULE = with_dark_frames(
    plan_schedule(LIGHTS[:3], {"long": EXPOSURES["long"]}), count=1
)
REFUSED = (
    r"(dome|probe): must answer [A-Z]+ within 0\.9 s; found no reply.*; check its "
    r"power and its cable"
)
# Requests of these small sessions: about 20 for what is planned, and those that ask
# whether a device is ready.
MAX_REQUESTS = 60
# What a session may take if every request needs all attempts, with the 10 s of the last frames.
MAX_SECONDS = MAX_REQUESTS * ATTEMPTS * REPLY_SECONDS + 10


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    return subject_folder(tmp_path_factory.mktemp("subject"))


def _outcome(session):
    """What a session returns, or the text of its refusal."""
    try:
        return session()
    except InputError as error:
        return str(error)


def _dome_session(subject, watched, delay):
    faults = LaboratoryFaults(dome=DeviceFaults(delay=delay))
    with Bench(subject, watched, faults) as bench:
        run = bench.capture(SCHEDULE)
        assert bench.clock.monotonic() < MAX_SECONDS
    require_complete(run, CAMERAS)
    return run


@pytest.mark.parametrize("delay", [0.2, 0.28, 0.29, 0.31, 0.45, 0.7, 1.0])
def test_capture_dome__a_slow_controller(subject, tmp_path, delay):
    run = _outcome(lambda: _dome_session(subject, tmp_path, delay))
    if isinstance(run, str):
        assert delay > REPLY_SECONDS
        assert "\n" not in run
        assert re.search(REFUSED, run)
        return
    assert delay < REPLY_SECONDS
    for (camera, i), path in run.frames.items():
        step = SCHEDULE.steps[i]
        if step.light != DARK:
            found = imagecodecs.png_decode(path.read_bytes())
            assert is_frame(found, value_of(step.light, camera, step.exposure))


def _site_session(subject, watched, delay):
    with Bench(
        subject, watched, LaboratoryFaults(probe=DeviceFaults(delay=delay))
    ) as bench:
        bench.laboratory.place("cheek")
        run = capture_site(bench.probe, bench.probe_camera, "cheek", BRACKETS)
        assert bench.clock.monotonic() < MAX_SECONDS
        return run


@pytest.mark.parametrize("delay", [0.2, 0.28, 0.29, 0.31, 0.45, 1.0])
def test_capture_site__a_slow_probe(subject, tmp_path, delay):
    """The age of a reading counts from the request that switched the pump on, and so
    includes its delay.
    """
    run = _outcome(lambda: _site_session(subject, tmp_path, delay))
    if isinstance(run, str):
        assert delay > REPLY_SECONDS
        assert re.match(
            "probe: must (answer|have a reading of the gauge in the last 0.5 s)", run
        )
        return
    assert delay < REPLY_SECONDS
    assert [*run.frames] == [*BRACKETS]


@pytest.mark.parametrize("delay", [0.29, 0.35, 0.85, 1.2])
def test_request__each_ends_within_its_deadline(delay):
    """A device that answers requests late falls behind: it also answers their repetitions."""
    device = emulated_dome(DeviceFaults(delay=delay))
    link = linked(device)
    for _ in range(3):
        before = device.clock.monotonic()
        outcome = _outcome(lambda: link.request("BEAT"))
        assert device.clock.monotonic() - before <= ATTEMPTS * (
            REPLY_SECONDS + READ_SECONDS
        )
        assert not isinstance(outcome, str) or re.search(REFUSED, outcome)


def test_upload__ends_within_its_deadline(monkeypatch):
    """Every request is answered at the third attempt only."""
    device = emulated_dome()
    dome = Dome(linked(device))
    receive = device.receive
    heard = []

    def every_third(data):
        heard.append(data)
        if len(heard) % ATTEMPTS == 0:
            receive(data)

    monkeypatch.setattr(device, "receive", every_third)
    seconds = (len(SCHEDULE.steps) + 2) * REPLY_SECONDS
    before = device.clock.monotonic()
    with pytest.raises(
        InputError,
        match=rf"dome: must accept {len(SCHEDULE.steps)} steps within {seconds:.1f} s; found",
    ):
        dome.upload(SCHEDULE)
    assert device.clock.monotonic() - before <= seconds + ATTEMPTS * (
        REPLY_SECONDS + READ_SECONDS
    )
