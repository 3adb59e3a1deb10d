"""Stream the frames of one GenICam camera (GigE Vision, USB3 Vision) to TIFF files by Aravis.

This is a program for the Python of the operating system, to which the bindings of Aravis
belong; it imports nothing of skindb. `skindb.hw.streaming` runs one for each camera:

    /usr/bin/python3 aravis.py DEVICE FOLDER "PixelFormat=BayerRG12 TriggerMode=On ..."

It prints "armed" or a line that says what is wrong. On its standard input, the line "trigger"
is a software trigger, other ones are answered by counts as JSON, and the end ends the stream.
"""

import json
import os
import re
import select
import struct
import sys
import time
from pathlib import Path
from typing import Any

PACKAGES = "Debian: apt install gir1.2-aravis-0.8 python3-gi"
BUFFER_BYTES = 1 << 28  # of the frames of a camera that wait for the disk
WAIT_US = 50_000
# 16-bit numbers of GigE Vision 1 go from 65535 to 1, later ones have 64 bits
WRAP = 65535
CFA = 32803  # photometric interpretation of TIFF
COLOURS = {"R": 0, "G": 1, "B": 2}
LOSSES = ("incomplete", "n_underruns", "n_missing_frames", "n_missing_packets")
PATTERNS = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}


def tiff_head(width: int, height: int, pixel_format: str) -> bytes:
    """Bytes of an uncompressed TIFF file before its pixels, which are those of the sensor;
    a colour filter array is described as in TIFF/EP (ISO 12234-2).

    Raises
    ------
    ValueError
        For formats other than Bayer with 8 to 16 bits in 1 or 2 bytes.
    """
    match = re.fullmatch(r"Bayer(RG|GR|GB|BG)(8|10|12|14|16)", pixel_format)
    if match is None:
        raise ValueError(
            f"PixelFormat {pixel_format} is not Bayer with 8, 10, 12, 14 or 16 bits; "
            "set another one, such as BayerRG12"
        )
    pattern, bits = match.groups()
    size = 1 if bits == "8" else 2
    colours = bytes(COLOURS[colour] for colour in PATTERNS[pattern])
    tags = [
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 1, 8 * size),
        (259, 3, 1, 1),
        (262, 3, 1, CFA),
        (273, 4, 1, 0),
        (277, 3, 1, 1),
        (278, 4, 1, height),
        (279, 4, 1, width * height * size),
        (281, 3, 1, 2 ** int(bits) - 1),
        (33421, 3, 2, 2 | 2 << 16),
        (33422, 1, 4, *struct.unpack("<I", colours)),
    ]
    begin = 8 + 2 + 12 * len(tags) + 4
    tags[5] = (273, 4, 1, begin)
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)


def counted(frame_id: int, last: int | None) -> int:
    """Number of a frame that does not begin again; frames may come out of order."""
    return frame_id + WRAP * round(((last or frame_id) - frame_id) / WRAP)


def say(line: str) -> None:
    """Print a line for the parent."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def stream(device: str, folder: Path, features: str) -> None:
    """Write every complete frame until standard input ends."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis
    except (ImportError, ValueError):
        raise RuntimeError(f"no Aravis for {sys.executable} ({PACKAGES})") from None

    camera = Aravis.Camera.new(device)
    camera.get_device().set_features_from_string(features)
    pixel_format = camera.get_pixel_format_as_string()
    tiff_head(1, 1, pixel_format)
    frames = camera.create_stream(None, None)
    if camera.is_gv_device():
        # otherwise bursts of packets are lost unless raw sockets are allowed
        frames.set_property("socket-buffer", Aravis.GvStreamSocketBuffer.FIXED)
        frames.set_property("socket-buffer-size", BUFFER_BYTES)
    payload = camera.get_payload()
    begin = time.strftime("%Y%m%dT%H%M%S", time.gmtime())
    camera.start_acquisition()
    # if they are, packets of other devices are counted until the socket has its filter
    before = _statistics(frames)
    for _ in range(min(max(BUFFER_BYTES // payload, 8), 500)):
        frames.push_buffer(Aravis.Buffer.new_allocate(payload))
    say("armed")
    counts = {"frames": 0, "incomplete": 0}
    number = None
    is_open = True
    while is_open or frames.get_n_buffers()[1]:
        buffer = frames.timeout_pop_buffer(WAIT_US)
        if buffer is not None and buffer.get_status() == Aravis.BufferStatus.SUCCESS:
            number = counted(buffer.get_frame_id(), number)
            name = f"{begin}_{number:010d}.tif"
            head = tiff_head(
                buffer.get_image_width(), buffer.get_image_height(), pixel_format
            )
            part = folder / f"{name}.part"
            part.write_bytes(head + buffer.get_data())
            part.rename(folder / name)
            counts["frames"] += 1
        elif buffer is not None:
            counts["incomplete"] += 1
        if buffer is not None:
            frames.push_buffer(buffer)
        if is_open and select.select([sys.stdin], [], [], 0)[0]:
            asked = os.read(sys.stdin.fileno(), 1 << 12)
            is_open = bool(asked)
            if not is_open:
                camera.stop_acquisition()
            for line in asked.split():
                if line == b"trigger":
                    camera.software_trigger()
                else:
                    after = _statistics(frames)
                    lost = {key: n - before[key] for key, n in after.items()}
                    say(json.dumps(counts | lost))


def _statistics(frames: Any) -> dict[str, int]:
    """Counts of the stream of Aravis that say what was lost."""
    names = {frames.get_info_name(i): i for i in range(frames.get_n_infos())}
    return {
        name: frames.get_info_uint64(i) for name, i in names.items() if name in LOSSES
    }


if __name__ == "__main__":
    os.umask(0o077)
    try:
        stream(sys.argv[1], Path(sys.argv[2]), sys.argv[3])
    except Exception as error:
        # errors of Aravis have the text without their domain
        say(str(getattr(error, "message", error) or type(error)).splitlines()[0])
        raise SystemExit(1) from error
