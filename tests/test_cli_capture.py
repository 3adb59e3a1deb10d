"""`skindb capture`: a rehearsal from an empty folder to a capture that ingest reads, with faults and without."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from skindb.cli import cli
from skindb.errors import InputError
from skindb.ingest import read_capture


@pytest.fixture(scope="module")
def rehearsal(tmp_path_factory):
    """A complete one, whose virtual subject the others use again."""
    out = tmp_path_factory.mktemp("rehearsal") / "C"
    log = out.with_suffix(".log")
    result = CliRunner().invoke(cli, ["capture", str(out), "--virtual", "--sites", "cheek,neck", "--log", str(log)])
    assert result.exit_code == 0, result.output + str(result.exception)
    return out


def _again(rehearsal, tmp_path, *options):
    """A capture of the same subject with other options."""
    out = tmp_path / "C"
    beside = tmp_path / "C.virtual"
    if not beside.exists():
        beside.mkdir()
        (beside / "subject").symlink_to(rehearsal.parent / "C.virtual/subject")
    sites = () if "--sites" in options else ("--sites", "cheek")
    return out, CliRunner().invoke(cli, ["capture", str(out), "--virtual", *sites, *options])


def _same_frames(out, rehearsal):
    files = sorted(path.relative_to(rehearsal) for path in rehearsal.glob("dome/frames/*/*"))
    assert files == sorted(path.relative_to(out) for path in out.glob("dome/frames/*/*"))
    return all((out / name).read_bytes() == (rehearsal / name).read_bytes() for name in files)


def test_capture__rehearsal_is_a_capture(rehearsal):
    capture = read_capture(rehearsal)
    assert capture.override["operator"] == "rehearsal"
    assert capture.override["flashes_per_second"] > 3
    assert len(capture.dome.sequence.light) == len(capture.dome.lights) * 2
    assert (capture.dome.sequence.triggers == 1).all()
    assert capture.dome.dark is not None
    assert capture.probe.sites == ("cheek", "neck")
    log = capture.probe.pressure["cheek", ""]
    assert np.abs(log[:, 1] + 5).max() < 1
    subject = rehearsal.parent / "C.virtual/subject"
    assert _same_frames(rehearsal, subject)
    assert not (rehearsal / "unfinished.json").exists()
    assert "HELLO" in (rehearsal.with_suffix(".log") / "probe.log").read_text()


def test_capture__three_faults_cost_nothing_but_time(rehearsal, tmp_path):
    faults = ["dropped_frame=c02:11", "dome.lost_triggers=7", "hot_pixels=2", "probe.lost_triggers=4"]
    out, result = _again(rehearsal, tmp_path, *(part for fault in faults for part in ("--fault", fault)))
    assert result.exit_code == 0, result.output + str(result.exception)
    assert "repeated" in result.output
    assert "camera c00: 2 hot pixels in its dark frame" in result.output
    for light in (2, 9, 20):
        name = f"dome/frames/e0/l{light:03d}_c02.png"  # camera c00 has the hot pixels
        assert (out / name).read_bytes() == (rehearsal / name).read_bytes()
    assert read_capture(out).dome.sequence is not None


@pytest.mark.parametrize("fault", ["dome.open_interlock_at=20", "dome.vanish_after=75"])
def test_capture__continues_after_a_stop(rehearsal, tmp_path, fault):
    out, result = _again(rehearsal, tmp_path, "--fault", fault)
    assert isinstance(result.exception, InputError)
    assert "must run to its end" in str(result.exception)
    kept = len(json.loads((out / "unfinished.json").read_text())["sequence"])
    assert kept == (18 if "interlock" in fault else kept)
    out, result = _again(rehearsal, tmp_path)
    assert result.exit_code == 0, str(result.exception)
    assert _same_frames(out, rehearsal)
    assert (np.diff(read_capture(out).dome.sequence.on) >= 0).all()


def test_capture__a_leak_is_refused_and_the_dome_s_frames_are_kept(rehearsal, tmp_path):
    _, result = _again(rehearsal, tmp_path, "--fault", "probe.leak=0.05")
    assert "it leaks; press it on, check its seal" in str(result.exception)
    out, result = _again(rehearsal, tmp_path, "--placements", "2")
    assert result.exit_code == 0, str(result.exception)
    capture = read_capture(out)
    assert capture.probe.placements["cheek"] == ("1", "2")
    assert _same_frames(out, rehearsal)


def test_capture__plan_tells_and_drives_nothing(rehearsal, tmp_path):
    out, result = _again(rehearsal, tmp_path, "--plan", "--slower")
    assert "24 lights, 2 exposures, 4 cameras: at most 3 flashes in any second" in result.output
    assert not out.exists()
    _, result = _again(rehearsal, tmp_path, "--plan", "--json")
    told = json.loads(result.output)
    assert told["safe"] is False
    assert told["flashes_per_second"] > 10


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "--setup: a capture needs it"),
        (["--fault", "dropped_frame=c0:1"], "--fault: belongs to --virtual"),
        (["--virtual", "--dome", "/dev/x"], "--dome: belongs to a real laboratory"),
        (["--virtual", "--fault", "dome.earthquake=1"], "must be dropped_frame=CAMERA:NUMBER"),
        (["--virtual", "--fault", "hot_pixels=many"], "must be dropped_frame=CAMERA:NUMBER"),
    ],
)
def test_capture__mistakes(tmp_path, options, said):
    result = CliRunner().invoke(cli, ["capture", str(tmp_path / "C"), *options])
    assert said in str(result.exception)


def test_capture__mistakes_of_a_real_session(rehearsal, tmp_path):
    """The set-up of the rehearsal, and what is missing for a real one."""
    subject = rehearsal.parent / "C.virtual/subject"
    own = ["--setup", str(subject), "--subject", "S1", "--reference", "form 1", "--scan", str(subject / "scan.ply")]

    def said(*options):
        return str(CliRunner().invoke(cli, ["capture", str(tmp_path / "R"), *own, *options]).exception)

    assert "--consent: a capture needs it" in said()
    assert "--consent: must be from fit, statistics, export, publish; found sell" in said("--consent", "sell")
    assert "--trait: must be NAME=VALUE" in said("--consent", "fit", "--trait", "age")
    assert "needs the ID of who gives it" in said("--consent", "fit", "--confirm-screening")
    assert "--dome: a capture needs it" in said("--consent", "fit")
    (tmp_path / "frames").mkdir()
    cameras = ["--consent", "fit", "--cameras", str(tmp_path / "frames")]
    assert "every camera must have a folder of its name" in said(*cameras, "--dome", "socket://127.0.0.1:1")
    for name in ("c00", "c01", "c02", "c03"):
        (tmp_path / "frames" / name).mkdir()
    assert "a device must be at this address" in said(*cameras, "--dome", "socket://127.0.0.1:1")
    shutil.copytree(tmp_path / "frames", tmp_path / "R")
    result = CliRunner().invoke(cli, ["capture", str(tmp_path / "C"), "--setup", str(tmp_path), "--plan"])
    assert "dome.json" in str(result.exception)
