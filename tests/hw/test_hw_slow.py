"""Slow devices: a session completes or is refused in one clear line, and ends in either case."""

from __future__ import annotations

import re
import threading
import time
from contextlib import ExitStack

import imagecodecs
import pytest
from devices_pair import BRACKETS, CAMERAS, EXPOSURES, LIGHTS, OVERRIDE, SPEED, subject_folder, value_of

from skindb.errors import InputError
from skindb.hw.cameras import FolderCameras
from skindb.hw.dome import Dome
from skindb.hw.link import ATTEMPTS, REPLY_SECONDS, Link, open_port
from skindb.hw.probe import Probe
from skindb.hw.sequence import DARK, plan_schedule
from skindb.hw.session import capture_dome, capture_site, require_complete, with_dark_frames
from skindb.virtual.devices import DeviceFaults
from skindb.virtual.laboratory import Laboratory, LaboratoryFaults

SCHEDULE = with_dark_frames(plan_schedule(LIGHTS[:3], {"long": EXPOSURES["long"]}), count=1)
REFUSED = r"(dome|probe): must answer [A-Z]+ within 0\.9 s; found no reply.*; check its power and its cable"
# Requests of these small sessions: about 20 for what is planned, and those that ask whether a device is ready.
MAX_REQUESTS = 60
# What a session may take if every request needs all attempts, with the 10 s of the last frames.
MAX_SECONDS = MAX_REQUESTS * ATTEMPTS * REPLY_SECONDS + 10


@pytest.fixture(scope="module")
def subject(tmp_path_factory):
    return subject_folder(tmp_path_factory.mktemp("subject"))


def _outcome(session):
    """What a session returns, or the text of its refusal; fails if it does not end."""
    found = []

    def run():
        try:
            found.append(session())
        except InputError as error:
            found.append(str(error))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(MAX_SECONDS)
    assert not thread.is_alive(), "the session hangs"
    [outcome] = found  # none after another error, which pytest reports of the thread
    return outcome


def _dome_session(subject, watched, delay):
    with ExitStack() as stack:
        faults = LaboratoryFaults(dome=DeviceFaults(delay=delay))
        laboratory = stack.enter_context(Laboratory(subject, watched, faults, speed=SPEED))
        link = Link(open_port(laboratory.dome_url), "dome")
        stack.callback(link.close)
        run = capture_dome(Dome(link), FolderCameras(watched, CAMERAS, quiet=0.3), SCHEDULE, override=OVERRIDE)
        require_complete(run, CAMERAS)
        return run


def _site_session(subject, watched, delay):
    with ExitStack() as stack:
        faults = LaboratoryFaults(probe=DeviceFaults(delay=delay))
        laboratory = stack.enter_context(Laboratory(subject, watched, faults, probe_speed=SPEED))
        laboratory.place("cheek")
        link = Link(open_port(laboratory.probe_url), "probe")
        stack.callback(link.close)
        return capture_site(Probe(link), FolderCameras(watched, ["probe"], quiet=0.3), "cheek", BRACKETS)


@pytest.mark.parametrize("delay", [0.2, 0.28, 0.32, 0.45, 0.7, 1.0])
def test_capture_dome__a_slow_controller(subject, tmp_path, delay):
    """Two thirds of the deadline always complete; at the deadline the load of the machine decides."""
    run = _outcome(lambda: _dome_session(subject, tmp_path, delay))
    if isinstance(run, str):
        assert delay > 0.25
        assert re.search(REFUSED, run)
        assert "\n" not in run
        return
    assert delay < 0.9
    for (camera, i), path in run.frames.items():
        step = SCHEDULE.steps[i]
        if step.light != DARK:
            assert (imagecodecs.png_decode(path.read_bytes()) == value_of(step.light, camera, step.exposure)).all()


@pytest.mark.parametrize("delay", [0.2, 0.28, 0.45, 1.0])
def test_capture_site__a_slow_probe(subject, tmp_path, delay):
    run = _outcome(lambda: _site_session(subject, tmp_path, delay))
    if isinstance(run, str):
        assert delay > 0.25
        assert re.search(REFUSED, run)
        return
    assert delay < 0.9
    assert [*run.frames] == [*BRACKETS]


@pytest.mark.parametrize("delay", [0.29, 0.35, 0.85, 1.2])
def test_request__each_ends_within_its_deadline(subject, tmp_path, delay):
    """A device that answers requests late falls behind: it also answers their repetitions."""
    with Laboratory(subject, tmp_path, LaboratoryFaults(dome=DeviceFaults(delay=delay))) as laboratory:
        link = Link(open_port(laboratory.dome_url), "dome")
        for _ in range(3):
            before = time.monotonic()
            found = _outcome(lambda: link.request("BEAT"))
            assert time.monotonic() - before < ATTEMPTS * REPLY_SECONDS + 0.5  # what a busy machine adds
            assert not isinstance(found, str) or re.search(REFUSED, found)
        link.close()
