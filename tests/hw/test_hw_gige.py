"""Sessions by `skindb capture` in which cameras of GigE Vision send the frames."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest
from click.testing import CliRunner

from skindb.cli import cli
from skindb.hw.streaming import PYTHON
from skindb.virtual.targets import write_laboratory

NETWORK = ["unshare", "--map-root-user", "--net"]
ARAVIS = "import gi; gi.require_version('Aravis', '0.8')"
SIZE = {"lights": 8, "cameras": 2, "width": 24, "height": 30}


def _has_cameras():
    command = [*NETWORK, PYTHON, "-c", ARAVIS]
    try:
        return not subprocess.run(command, capture_output=True, check=False).returncode
    except OSError:
        return False


pytest.importorskip("cv2")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not _has_cameras(),
        reason="needs Debian's gir1.2-aravis-0.8 and python3-gi, and unshare --net",
    ),
]


def _capture(setup, work, *arguments, kind="", faults=""):
    """Output of a session."""
    program = str(Path(__file__).with_name("gige_session.py"))
    command = [*NETWORK, sys.executable, program, setup, work, kind, faults, *arguments]
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def _delivered(work):
    """Camera, light, exposure -> pixels that the camera was made to deliver."""
    pixels = defaultdict(list)
    for path in (work / "delivered").glob("*/*"):
        light, exposure, _ = path.name.rsplit("_", 2)
        pixels[path.parent.name, light, exposure].append(path.read_bytes())
    return pixels


def _require_equal(folder, work, count):
    """Every frame of a folder EXPOSURE/LIGHT_CAMERA.tif must be one of its step."""
    delivered = _delivered(work)
    files = sorted(folder.glob("*/*.tif"))
    assert len(files) == count
    for path in files:
        light, camera = path.stem.rsplit("_", 1)
        content = path.read_bytes()
        step = (camera, light, path.parent.name)
        assert any(content.endswith(pixels) for pixels in delivered[step]), step


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated")
    size = [str(word) for key, n in SIZE.items() for word in (f"--{key}", n)]
    command = ["simulate", str(folder), "--takes", "1", *size]
    assert CliRunner().invoke(cli, command).exit_code == 0
    return folder / "V001"


def test_capture__a_dropped_and_a_repeated_frame_are_taken_again(setup, tmp_path):
    """The camera delivers as many frames as there were triggers; ingest reads them."""
    subject = ["--setup", setup, "--scan", setup / "scan.ply", "--subject", "S1"]
    consent = ["--consent", "fit", "--reference", "form 1"]
    operator = ["--confirm-screening", "--operator", "OP-1"]
    said = _capture(
        setup,
        tmp_path,
        tmp_path / "C",
        *subject,
        *consent,
        *operator,
        faults="dropped_frame=c01:30 repeated_frame=c01:36",
    )
    # the frames between two markers
    assert re.search(r"16 missing frames: .* are the same picture\): repeated", said)
    assert "exposure e0 camera c00" not in said
    _require_equal(tmp_path / "C/dome/frames", tmp_path, 2 * 2 * 8)
    command = ["ingest", str(tmp_path / "DB"), str(tmp_path / "C"), "--spacing", "5"]
    result = CliRunner().invoke(cli, command)
    assert result.exit_code == 0, str(result.exception)
    assert "S1: capture 1" in result.output


def test_capture__a_white_target(tmp_path):
    write_laboratory(tmp_path / "LAB", **SIZE | {"lights": 4})
    target = ["--calibration", "white", "--yes"]
    said = _capture(tmp_path / "LAB", tmp_path, tmp_path / "LAB", *target, kind="white")
    assert "16 frames of white" in said
    _require_equal(tmp_path / "LAB/dome/white", tmp_path, 2 * 2 * 4)
