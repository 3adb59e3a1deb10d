"""A process that drives a session is killed: what was finished is kept, and the next session takes the rest."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import imagecodecs
import pytest
import trimesh
from devices_pair import CAMERAS, EXPOSURES, LIGHTS, OVERRIDE, Bench, subject_folder, value_of

from skindb.hw.capture import CapturePlan, Devices, run_capture
from skindb.hw.capture_folder import Subject, read_setup
from skindb.hw.dome import Dome
from skindb.hw.link import Link, open_port
from skindb.hw.session import DARK_FRAMES

SECONDS = 20.0  # of the sequence; the devices run ten times as fast
PERSON = Subject("S1", "2026-01-01T10:00:00+00:00", {"scope": ["fit"], "reference": "none"})
DRIVE = """
import sys
from pathlib import Path
from test_hw_killed import drive
from skindb.hw.cameras import FolderCameras
from skindb.hw.dome import Dome
from skindb.hw.link import Link, open_port
from skindb.hw.session import DARK_FRAMES
from devices_pair import CAMERAS
url, watched, setup, out = sys.argv[1:]
drive(Dome(Link(open_port(url), "dome")), FolderCameras(watched, CAMERAS, quiet=0.3), Path(setup), Path(out))
"""


def drive(dome, cameras, setup, out):
    """The session, in the process that is killed and in the one that resumes."""
    plan, mesh = CapturePlan(seconds=SECONDS), setup / "scan.ply"
    devices = Devices(dome, cameras)
    return run_capture(out, read_setup(setup), PERSON, devices, plan, files={"mesh": mesh}, override=OVERRIDE)


@pytest.fixture
def setup(tmp_path):
    folder = subject_folder(tmp_path / "lab")
    trimesh.creation.icosphere(subdivisions=1).export(folder / "scan.ply")
    return folder


def _kill(bench, setup, out, frames):
    """Start a session in another process, and kill it when a camera has so many frames."""
    command = [sys.executable, "-c", DRIVE, bench.laboratory.dome_url, str(bench.watched), str(setup), str(out)]
    process = subprocess.Popen(command, env={"PYTHONPATH": ":".join(sys.path)})
    end = time.monotonic() + 60
    while len(list((bench.watched / "c1").glob("*.png"))) < frames:
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    while bench.laboratory.dome.state == "running":  # until the watchdog
        assert time.monotonic() < end
        time.sleep(0.05)
    assert bench.laboratory.dome.on is None


def _require_complete(out):
    for exposure in EXPOSURES:
        for light in LIGHTS:
            for camera in CAMERAS:
                found = imagecodecs.png_decode((out / f"dome/frames/{exposure}/{light}_{camera}.png").read_bytes())
                assert (found == value_of(light, camera, exposure)).all()
    assert not (out / "unfinished.json").exists()


@pytest.mark.parametrize("frames", [14, 24])
def test_run_capture__killed_process_loses_no_finished_step(setup, tmp_path, frames):
    out = tmp_path / "C"
    with Bench(setup, tmp_path / "watched") as bench:
        bench.dome.link.close()
        _kill(bench, setup, out, frames)
        before = bench.laboratory.dome._done
        bench.dome = Dome(Link(open_port(bench.laboratory.dome_url), "dome"))
        report = drive(bench.dome, bench.cameras, setup, out)
    _require_complete(out)
    dark = DARK_FRAMES * len(EXPOSURES)  # before the lights, in each session
    kept = before - dark
    assert kept >= frames - 2 - dark
    assert report["notes"][0] == f"{kept} steps were kept from the sequence that was interrupted"
    left = len(LIGHTS) * len(EXPOSURES) - kept
    assert report["frames_of_this_session"] == len(CAMERAS) * (dark + left + 1)  # and a last dark frame


def test_run_capture__controller_without_the_plan_repeats_everything(setup, tmp_path):
    out = tmp_path / "C"
    with Bench(setup, tmp_path / "watched") as bench:
        bench.dome.link.close()
        _kill(bench, setup, out, 14)
    with Bench(setup, tmp_path / "watched") as other:  # as after a loss of power
        report = drive(other.dome, other.cameras, setup, out)
    _require_complete(out)
    assert "the controller has forgotten the sequence that was interrupted" in report["notes"][0]
