"""A real session with GigE Vision cameras, in a network of its own:

    unshare --map-root-user --net python gige_session.py SETUP WORK KIND FAULTS ARGUMENT...

An emulated light controller at a TCP port triggers one fake camera of Aravis for each camera of
the laboratory SETUP, at 127.0.0.1, 127.0.0.2 and so on. They show a subject, or the calibration
target KIND unless it is empty. ``skindb capture ARGUMENT...`` takes their frames. What each
camera was made to deliver is kept in WORK/delivered/CAMERA/LIGHT_EXPOSURE_NUMBER.
"""

from __future__ import annotations

import fcntl
import json
import socket
import struct
import subprocess
import sys
from itertools import count
from pathlib import Path
from queue import Queue
from threading import Thread

import numpy as np
from served_devices import Server

from skindb.calibration.setup import read_setup_dome, with_placeholders
from skindb.clock import SYSTEM_CLOCK
from skindb.format.frames import read_frame
from skindb.hw.streaming import PYTHON, STREAMS
from skindb.virtual import devices
from skindb.virtual.laboratory import Laboratory, laboratory_faults
from skindb.virtual.targets import TargetScene, rehearsed_dome

PROGRAM = "from skindb.cli import main; main()"
CAMERAS = Path(__file__).with_name("gige_cameras.py")
FEATURES = (
    "Width={width} Height={height} PixelFormat=BayerRG16 TriggerMode=On "
    "TriggerSource=Software"
)
# of Linux, to give an interface an address and to switch it on
SIOCSIFADDR = 0x8916
SIOCSIFFLAGS = 0x8914
IFF_UP = 1


def add_addresses(addresses):
    """Switch on the loopback interface of this network, with further addresses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        fcntl.ioctl(port, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", IFF_UP))
        for i, address in enumerate(addresses[1:]):
            name = b"lo:%d" % i
            family = (socket.AF_INET, 0, socket.inet_aton(address))
            fcntl.ioctl(port, SIOCSIFADDR, struct.pack("16sHH4s8x", name, *family))


def sensor_values(frame):
    """Pixels (h, w) behind a colour filter array RGGB, of a frame (h, w, 3)."""
    values = frame[..., 1].copy()
    values[::2, ::2] = frame[::2, ::2, 0]
    values[1::2, 1::2] = frame[1::2, 1::2, 2]
    return values.astype("<u2")


class Delivery:
    """Sends the frames that a laboratory writes for its cameras, and keeps them.

    It has a thread, as the controller must answer while cameras read out.
    """

    def __init__(self, laboratory, cameras, folder):
        self._watched = {name: laboratory.watched / name for name in laboratory.cameras}
        self._cameras = cameras
        self._folder = folder
        self._photograph = laboratory.dome._trigger
        self._triggers = Queue()
        # called by the controller whenever it triggers the cameras
        laboratory.dome._trigger = lambda *light: self._triggers.put(light)
        for name in self._watched:
            (folder / name).mkdir(parents=True)
        Thread(target=self._run, daemon=True).start()

    def _run(self):
        for number in count():
            exposure, factors = self._triggers.get()
            self._photograph(exposure, factors)
            step = f"{'_'.join(factors)}_{exposure}_{number}"
            for i, (name, watched) in enumerate(self._watched.items()):
                # none, or two, of a camera with a fault
                for path in sorted(watched.glob("*.png")):
                    pixels = sensor_values(read_frame(path)).tobytes()
                    path.unlink()
                    (self._folder / name / step).write_bytes(pixels)
                    self._send(i, pixels)

    def _send(self, index, pixels):
        self._cameras.stdin.write(b"%d %d\n" % (index, len(pixels)) + pixels)
        self._cameras.stdin.flush()
        if self._cameras.stdout.readline() != b"sent\n":
            raise RuntimeError("the cameras ended")


def main(setup, work, kind, faults, *arguments):
    """Run the session; returns the status of the command."""
    setup = Path(setup)
    work = Path(work)
    record = json.loads((setup / "dome/dome.json").read_text())
    scene = None
    if kind:
        record.pop("white")
        dome = read_setup_dome(
            setup, white=False, dark=False, record=with_placeholders(record)
        )
        virtual, sensor = rehearsed_dome(dome)
        rng = np.random.default_rng(0)
        scene = TargetScene(virtual, sensor, kind, dome.exposures, rng=rng)
    devices.WATCHDOG_SECONDS = 60.0  # whatever else this machine does
    names = [camera["id"] for camera in record["cameras"]]
    lights = [light["id"] for light in record["lights"]]
    laboratory = Laboratory(
        setup,
        work / "pictures",
        laboratory_faults(faults.split(), lights, names),
        clock=SYSTEM_CLOCK,
        scene=scene,
    )
    addresses = [f"127.0.0.{i + 1}" for i in range(len(names))]
    add_addresses(addresses)
    streams = [
        {"id": camera["id"], "device": address, "features": FEATURES.format(**camera)}
        for camera, address in zip(record["cameras"], addresses, strict=True)
    ]
    (work / "frames").mkdir()
    (work / "frames" / STREAMS).write_text(json.dumps({"cameras": streams}))
    command = [PYTHON, str(CAMERAS), str(work / "genicam.xml"), *addresses]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as cameras:
        if cameras.stdout.readline() != b"ready\n":
            return 1
        Delivery(laboratory, cameras, work / "delivered")
        with Server(laboratory.dome) as port:
            ports = ["--dome", port.url, "--cameras", str(work / "frames")]
            session = [sys.executable, "-c", PROGRAM, "capture", *arguments, *ports]
            status = subprocess.run(session, check=False).returncode
        cameras.stdin.close()
    return status


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
