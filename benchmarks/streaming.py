"""Throughput of streaming cameras on this machine: writing frames to a folder, and receiving
those of Aravis' fake camera on 127.0.0.1.

python -m benchmarks streaming FOLDER
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import time
from pathlib import Path

from hw.test_hw_streaming import ADDRESS, ANSWERS, FAKE

from skindb.hw import aravis
from skindb.hw.streaming import PYTHON

SIZES = ((1300, 1030, 400), (4096, 3000, 60))  # width, height, frames
SECONDS = 10.0


def main(folder: Path) -> None:
    """Print MB per second of wall time and of a core; the folder is on the disk to measure."""
    folder.mkdir(parents=True, exist_ok=True)
    for width, height, count in SIZES:
        pixels = os.urandom(2 * width * height)
        start, used = time.perf_counter(), time.process_time()
        for i in range(count):
            head = aravis.tiff_head(width, height, "BayerRG12")
            (folder / f"{i}.tif").write_bytes(head + pixels)
        core = time.process_time() - used
        os.sync()
        megabytes = count * len(pixels) / 1e6
        wall = time.perf_counter() - start
        print(
            f"writing {width} x {height}: {megabytes / core:.0f} MB/s of a core, "
            f"{megabytes / wall:.0f} MB/s on the disk"
        )
        for i in range(count):
            (folder / f"{i}.tif").unlink()
    _receive(folder)


def _receive(folder: Path) -> None:
    features = "PixelFormat=BayerRG8 Width=2048 Height=2048 TriggerMode=Off"
    with subprocess.Popen([FAKE, "-i", ADDRESS], stdout=subprocess.DEVNULL) as camera:
        while subprocess.run(
            [PYTHON, "-c", ANSWERS], stderr=subprocess.DEVNULL, check=False
        ).returncode:
            time.sleep(0.1)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        with subprocess.Popen(
            [PYTHON, aravis.__file__, ADDRESS, str(folder), features],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as stream:
            time.sleep(SECONDS)
            said, _ = stream.communicate("counts\n")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        camera.terminate()
    frames = json.loads(said.splitlines()[1])["frames"]
    core = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"receiving and writing: {frames * 2048**2 / 1e6 / core:.0f} MB/s of a core")
    for file in folder.glob("*.tif"):
        file.unlink()
