"""Fake GigE Vision cameras of Aravis on addresses of this machine, whose pictures come from
another process. It is a program for the Python of the operating system:

    /usr/bin/python3 gige_cameras.py GENICAM ADDRESS...

It writes a GenICam description with a Bayer format of 16 bits, which that of Aravis lacks, to
the file GENICAM, and prints "ready". Each line "INDEX SIZE" on standard input is a trigger of
that camera, which sends the picture of SIZE bytes that follows. The answer is "sent".
"""

import ctypes
import sys
import threading
from pathlib import Path

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402

# addresses of registers in the GenICam description
FRAME_PERIOD_US = 0x138
TRIGGER_SOFTWARE = 0x30C
LOOK_HZ = 1000.0  # how often a camera looks whether it was triggered
ENTRY = '<EnumEntry Name="Mono8" NameSpace="Standard">'
BAYER = '<EnumEntry Name="BayerRG16"><Value>0x0110002F</Value></EnumEntry>'

# the bindings keep no callback beyond a call, and give copies of the pixels
LIBRARY = ctypes.CDLL("libaravis-0.8.so.0")
LIBRARY.arv_buffer_get_data.restype = ctypes.c_void_p
LIBRARY.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
FILL = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, *[ctypes.c_uint32] * 3)


class Camera:
    """A camera that sends the picture of each trigger."""

    def __init__(self, address, genicam):
        self.device = Aravis.GvFakeCamera.new_full(address, address, genicam)
        if not self.device.is_running():
            raise SystemExit(f"no camera at {address}")
        self.registers = self.device.get_fake_camera()
        self.registers.write_register(FRAME_PERIOD_US, round(1e6 / LOOK_HZ))
        self.registers.set_trigger_frequency(LOOK_HZ)
        self.picture = b""
        self.is_sent = threading.Event()
        self.fill = FILL(self._fill)
        pointer = ctypes.c_void_p(hash(self.registers))
        LIBRARY.arv_fake_camera_set_fill_pattern(pointer, self.fill, None)

    def trigger(self, picture):
        """Send a picture."""
        self.picture = picture
        self.is_sent.clear()
        self.registers.write_register(TRIGGER_SOFTWARE, 1)
        self.is_sent.wait()

    def _fill(self, buffer, *_):
        size = self.registers.get_payload()
        if size == len(self.picture):
            ctypes.memmove(
                LIBRARY.arv_buffer_get_data(buffer, None), self.picture, size
            )
        else:
            sys.stderr.write(f"{len(self.picture)} bytes for a frame of {size}\n")
        self.is_sent.set()


def main(genicam, *addresses):
    """Serve cameras until standard input ends."""
    description = Aravis.FakeCamera.new("none").get_genicam_xml()[0]
    Path(genicam).write_text(description.replace(ENTRY, BAYER + ENTRY))
    cameras = [Camera(address, genicam) for address in addresses]
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while line := sys.stdin.buffer.readline():
        index, size = map(int, line.split())
        cameras[index].trigger(sys.stdin.buffer.read(size))
        sys.stdout.write("sent\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
