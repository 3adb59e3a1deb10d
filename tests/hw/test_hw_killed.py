"""A process that drives a session is killed: what was finished is kept, and the next
session takes the rest.
"""

from __future__ import annotations

import signal
import subprocess
import sys
from contextlib import contextmanager

import imagecodecs
import pytest
import trimesh
from devices_pair import (
    CAMERAS,
    EXPOSURES,
    LIGHTS,
    OVERRIDE,
    is_frame,
    subject_folder,
    value_of,
)
from served_devices import Server
from waiting import wait_until

from skindb.clock import SYSTEM_CLOCK
from skindb.hw.cameras import FolderCameras
from skindb.hw.capture import CapturePlan, Devices, run_capture
from skindb.hw.capture_folder import Subject, read_setup
from skindb.hw.dome import Dome
from skindb.hw.link import Link, open_port
from skindb.hw.session import DARK_FRAMES
from skindb.virtual.devices import DeviceFaults
from skindb.virtual.laboratory import Laboratory

pytestmark = pytest.mark.slow

SECONDS = 1.2  # of the sequence
PERSON = Subject(
    "S1", "2026-01-01T10:00:00+00:00", {"scope": ["fit"], "reference": "none"}
)
DRIVE = """
import sys
from pathlib import Path
from test_hw_killed import drive
drive(*(Path(argument) for argument in sys.argv[2:]), url=sys.argv[1])
"""


def drive(watched, setup, out, *, url):
    """The session, in the process that is killed and in the one that resumes."""
    link = Link(open_port(url), "dome")
    devices = Devices(Dome(link), FolderCameras(watched, CAMERAS, quiet=0.5))
    plan = CapturePlan(seconds=SECONDS)
    files = {"mesh": setup / "scan.ply"}
    try:
        return run_capture(
            out,
            read_setup(setup),
            PERSON,
            devices,
            plan,
            files=files,
            override=OVERRIDE,
        )
    finally:
        link.close()


@pytest.fixture
def setup(tmp_path):
    folder = subject_folder(tmp_path / "lab")
    trimesh.creation.icosphere(subdivisions=1).export(folder / "scan.ply")
    return folder


@contextmanager
def _served_laboratory(setup, watched):
    """A laboratory in real time, whose controller is at a socket."""
    laboratory = Laboratory(setup, watched, clock=SYSTEM_CLOCK)
    with Server(laboratory.dome) as server:
        yield laboratory, server.url


def _kill(laboratory, url, setup, out, frames):
    """Start a session in another process, and kill it when a camera has so many frames,
    during that step.
    """
    laboratory.dome.faults = DeviceFaults(frozen_at=frames - 1)
    command = [
        sys.executable,
        "-c",
        DRIVE,
        url,
        str(laboratory.watched),
        str(setup),
        str(out),
    ]
    process = subprocess.Popen(command, env={"PYTHONPATH": ":".join(sys.path)})
    taken = laboratory.watched / "c1"
    wait_until(
        lambda: len(list(taken.glob("*.png"))) >= frames or process.poll() is not None
    )
    assert process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_until(lambda: laboratory.dome.state != "running")  # by the watchdog
    assert laboratory.dome.on is None
    laboratory.dome.faults = DeviceFaults()


def _require_complete(out):
    for exposure in EXPOSURES:
        for light in LIGHTS:
            for camera in CAMERAS:
                found = imagecodecs.png_decode(
                    (out / f"dome/frames/{exposure}/{light}_{camera}.png").read_bytes()
                )
                assert is_frame(found, value_of(light, camera, exposure))
    assert not (out / "unfinished.json").exists()


@pytest.mark.parametrize(("frames", "kept"), [(20, 0), (57, 24)])
def test_run_capture__killed_process_loses_no_finished_step(
    setup, tmp_path, frames, kept
):
    out = tmp_path / "C"
    with _served_laboratory(setup, tmp_path / "watched") as (laboratory, url):
        _kill(laboratory, url, setup, out, frames)
        report = drive(laboratory.watched, setup, out, url=url)
    _require_complete(out)
    dark = DARK_FRAMES * len(EXPOSURES)  # before the lights, in each session
    assert (
        report["notes"][0]
        == f"{kept} steps were kept from the sequence that was interrupted"
    )
    left = len(LIGHTS) * len(EXPOSURES) - kept
    # and a last dark frame
    taken = dark + left + 1 if left else 0
    assert report["frames_of_this_session"] == len(CAMERAS) * taken


def test_run_capture__controller_without_the_plan_repeats_everything(setup, tmp_path):
    out = tmp_path / "C"
    with _served_laboratory(setup, tmp_path / "watched") as (laboratory, url):
        _kill(laboratory, url, setup, out, 14)
    # as after a loss of power
    with _served_laboratory(setup, tmp_path / "watched") as (laboratory, url):
        report = drive(laboratory.watched, setup, out, url=url)
    _require_complete(out)
    assert (
        "the controller has forgotten the sequence that was interrupted"
        in report["notes"][0]
    )
