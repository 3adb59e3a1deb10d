"""Cameras that stream, on the fake GigE Vision camera of Aravis."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from skindb.errors import InputError, SkindbWarning
from skindb.format.frames import FrameKind, read_frame
from skindb.hw import streaming
from skindb.hw.aravis import counted, tiff_head
from skindb.hw.streaming import PYTHON, STREAMS, StreamingCameras

FAKE = "arv-fake-gv-camera-0.8"
ADDRESS = "127.0.0.1"
# ends with an error until the camera, which has just been started, is found
ANSWERS = f"""
import gi
gi.require_version("Aravis", "0.8")
from gi.repository import Aravis
Aravis.Camera.new("{ADDRESS}")
"""
WIDTH, HEIGHT = 512, 400
SIZE = f"Width={WIDTH} Height={HEIGHT}"
TRIGGERED = "TriggerMode=On TriggerSource=Software"


def _has_aravis():
    code = "import gi; gi.require_version('Aravis', '0.8')"
    try:
        done = subprocess.run([PYTHON, "-c", code], capture_output=True, check=False)
    except OSError:
        return False
    return done.returncode == 0 and shutil.which(FAKE) is not None


pytestmark = [
    pytest.mark.skipif(
        not _has_aravis(),
        reason="needs Debian's gir1.2-aravis-0.8, python3-gi and aravis-tools",
    ),
    pytest.mark.filterwarnings("ignore:camera c0 lost frames"),
]


@pytest.fixture(scope="module", params=[0])
def camera(request):
    command = [FAKE, "-i", ADDRESS, "-r", str(request.param)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while subprocess.run(
            [PYTHON, "-c", ANSWERS], stderr=subprocess.DEVNULL, check=False
        ).returncode:
            assert process.poll() is None, "the fake camera ended"
        yield
        process.terminate()


def _streams(tmp_path, features, device=ADDRESS):
    record = {"cameras": [{"id": "c0", "device": device, "features": features}]}
    (tmp_path / STREAMS).write_text(json.dumps(record))
    return StreamingCameras(tmp_path, ["c0"])


@pytest.mark.parametrize("first", [1, 65530, 10**12])
def test_counted__a_16_bit_number_begins_again_and_frames_may_be_late(first):
    truth = first + np.array([0, 1, 3, 2, 5, 4, 6, 90, 30_000, 60_000, 59_990, 80_000])
    last = None
    found = []
    for number in truth.tolist():
        sent = number if first > 1e9 else (number - 1) % 65535 + 1
        last = counted(sent, last)
        found.append(last)
    # the count begins at the number that the camera sent first
    np.testing.assert_array_equal(np.array(found) - found[0], truth - truth[0])


def _numbers(shots):
    return [int(re.search(r"_(\d+)\.tif", shot.path.name)[1]) for shot in shots]


@pytest.mark.parametrize("pixel_format", ["BayerRG8", "BayerGB8"])
def test_streaming_cameras__each_trigger_gives_its_frame(
    camera, tmp_path, pixel_format
):
    cameras = _streams(tmp_path, f"PixelFormat={pixel_format} {SIZE} {TRIGGERED}")
    try:
        cameras.start()
        cameras._quiet = 2.0  # a frame may be lost on a busy machine
        assert cameras.collect(0)["c0"] == []
        shots = []
        triggers = 0
        while len(shots) < 5:
            cameras.trigger()
            triggers += 1
            shots = cameras.collect(len(shots) + 1)["c0"]
            assert len(shots) <= triggers
        cameras.start()  # of the next run
        last = []
        while not last:
            cameras.trigger()
            last = cameras.collect(1)["c0"]
    finally:
        cameras.close()
    numbers = _numbers([*shots, *last])
    # this camera counts frame periods, and begins again after 65535
    assert numbers == sorted(set(numbers))
    assert not any(shot.is_doubtful for shot in shots)
    for shot in shots:
        assert shot.path.stat().st_mode & 0o077 == 0
        frame = read_frame(shot.path, FrameKind(WIDTH, HEIGHT, 8))
        assert frame.shape == (HEIGHT, WIDTH, 3)


def test_streaming_cameras__a_run_without_triggers_keeps_every_frame(camera, tmp_path):
    cameras = _streams(tmp_path, f"PixelFormat=BayerRG8 {SIZE} TriggerMode=Off")
    try:
        cameras.start()
        shots = cameras.collect(30)["c0"]
    finally:
        cameras.close()
    files = sorted((tmp_path / "c0").iterdir())
    numbers = [int(re.search(r"_(\d+)\.tif", path.name)[1]) for path in files]
    assert numbers == sorted(set(numbers))
    assert len(files) >= len(shots) >= 30
    head = len(tiff_head(WIDTH, HEIGHT, "BayerRG8"))
    assert {path.stat().st_size for path in files} == {head + WIDTH * HEIGHT}


@pytest.mark.parametrize(
    ("features", "device", "said"),
    [
        ("Gian=3", ADDRESS, r"camera c0: must stream; found \[Gian\] Not found; cor"),
        ("PixelFormat=RGB8", ADDRESS, "PixelFormat RGB8 is not Bayer with 8"),
        ("PixelFormat=Mono8", ADDRESS, "PixelFormat Mono8 is not Bayer with 8"),
        (SIZE, "127.0.0.77", "camera c0: must stream; found .*127.0.0.77"),
        ("", "", "must be text, and not empty; .*see docs/howto/capture.md"),
    ],
)
def test_streaming_cameras__a_wrong_setting_is_one_line(
    camera, tmp_path, features, device, said, capfd
):
    with pytest.raises(InputError, match=said):
        _streams(tmp_path, features, device)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("python", "said"),
    [
        (sys.executable, "found no Aravis for .*apt install gir1.2-aravis"),
        ("/absent/python3", "found no /absent/python3; Debian: apt install"),
    ],
)
def test_streaming_cameras__say_what_to_install(tmp_path, monkeypatch, python, said):
    monkeypatch.setattr(streaming, "PYTHON", python)
    with pytest.raises(InputError, match=said):
        _streams(tmp_path, SIZE)


@pytest.mark.parametrize("camera", [300], indirect=True)  # of 1,000 packets
def test_streaming_cameras__lost_packets_are_said(camera, tmp_path):
    cameras = _streams(tmp_path, f"PixelFormat=BayerRG8 {SIZE} {TRIGGERED}")
    try:
        cameras.start()
        cameras._quiet = 1.0
        cameras.trigger()
        with pytest.warns(SkindbWarning, match="camera c0 lost frames"):
            shots = cameras.collect(1)["c0"]
    finally:
        cameras.close()
    # only complete ones are kept
    head = len(tiff_head(WIDTH, HEIGHT, "BayerRG8"))
    assert all(shot.path.stat().st_size == head + WIDTH * HEIGHT for shot in shots)


def test_streaming_cameras__lines_that_come_together_are_all_answered(camera, tmp_path):
    cameras = _streams(tmp_path, f"PixelFormat=BayerRG8 {SIZE} {TRIGGERED}")
    try:
        cameras.start()
        cameras._tell("trigger\ntrigger")
        assert cameras.collect(0).keys() == {"c0"}
        # Ctrl-C reaches the group of this process
        streaming_process = cameras._processes["c0"]
        assert os.getpgid(streaming_process.pid) != os.getpgid(0)
    finally:
        cameras.close()


def test_streaming_cameras__a_camera_that_vanished_is_named(camera, tmp_path):
    cameras = _streams(tmp_path, f"PixelFormat=BayerRG8 {SIZE} {TRIGGERED}")
    cameras.start()
    cameras._processes["c0"].kill()
    cameras._quiet = 0.1
    try:
        with pytest.raises(InputError, match="camera c0: must stream; found a program"):
            cameras.collect(1)
    finally:
        cameras.close()
