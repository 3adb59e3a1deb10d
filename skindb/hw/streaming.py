"""Cameras that stream over GigE Vision or USB3 Vision (GenICam), by Aravis."""

import json
import subprocess
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from skindb.errors import Fault, SkindbWarning, require_none
from skindb.files import make_private
from skindb.format.fields import IDENTIFIER, Fields, read_json
from skindb.hw import aravis
from skindb.hw.cameras import FolderCameras, Shot
from skindb.limits import MAX_CAMERAS

STREAMS = "cameras.json"  # in the folder of the frames
PAGE = "docs/howto/capture.md"
PYTHON = "/usr/bin/python3"  # that has the bindings of Aravis
END_SECONDS = 10.0  # to write what was received


class StreamingCameras(FolderCameras):
    """Cameras of which processes write every frame into a folder of that camera.

    Parameters
    ----------
    root
        Folder with cameras.json, ``{"cameras": [{"id": "c00", "device": "192.168.0.10",
        "features": "PixelFormat=BayerRG12 TriggerMode=On TriggerSource=Line1"}, ...]}``:
        the name or address of the device, and GenICam features that are set in this order.
    ids
        Names of the cameras.

    Raises
    ------
    InputError
        If cameras.json has faults, or a camera is not found or refuses a feature.
    """

    def __init__(self, root: Path, ids: Sequence[str]) -> None:
        faults = list[Fault]()
        path = root / STREAMS
        fields = Fields(read_json(path, faults), str(path), faults, PAGE)
        streams = {
            item.text("id", rule=IDENTIFIER): (
                item.text("device"),
                item.text("features"),
            )
            for item in fields.items("cameras", maximum=MAX_CAMERAS)
        }
        fields.require_known("must be known", "remove it")
        if missing := [name for name in ids if name not in streams]:
            fields.fault(
                "cameras", "must have each camera", f"no {', '.join(missing)}", "add it"
            )
        if not Path(PYTHON).exists():
            fields.fault(
                "cameras", "are streamed by Aravis", f"no {PYTHON}", aravis.PACKAGES
            )
        require_none(faults)
        for name in ids:
            make_private(root / name)
        super().__init__(root, ids)
        self._processes = {
            name: subprocess.Popen(
                [PYTHON, aravis.__file__, device, str(root / name), features],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                start_new_session=True,  # Ctrl-C ends the lights, not what cameras send
            )
            for name, (device, features) in streams.items()
            if name in ids
        }
        answers = {name: self._answer(name) for name in self._processes}
        if faults := [
            Fault(f"camera {name}", "must stream", answer, f"correct {path}")
            for name, answer in answers.items()
            if answer != "armed"
        ]:
            self.close()
            require_none(faults)

    def collect(self, expected: int) -> dict[str, list[Shot]]:
        """Return the frames since `start`, see `FolderCameras`; a warning names cameras
        that lost some, and how many packets.
        """
        shots = super().collect(expected)
        faults = []
        self._tell("counts")
        for name in self._processes:
            answer = self._answer(name)
            if not answer.startswith("{"):
                cure = "check its cable and power, and run the same command again"
                faults.append(Fault(f"camera {name}", "must stream", answer, cure))
                continue
            counts = json.loads(answer)
            lost = {key: n for key, n in counts.items() if n and key in aravis.LOSSES}
            if lost:
                text = ", ".join(
                    f"{key.replace('_', ' ')} {n}" for key, n in lost.items()
                )
                warnings.warn(
                    f"camera {name} lost frames ({text}): raise net.core.rmem_max, allow "
                    "jumbo frames, or lower its rate",
                    SkindbWarning,
                    stacklevel=2,
                )
        require_none(faults)
        return shots

    def trigger(self) -> None:
        """Take one frame with every camera that has TriggerSource=Software, to try a set-up."""
        self._tell("trigger")

    def close(self) -> None:
        """End the streams; what was received is written before."""
        for process in self._processes.values():
            if process.stdin is not None:
                with suppress(BrokenPipeError):
                    process.stdin.close()
        for process in self._processes.values():
            with process:  # closes its output
                try:
                    process.wait(END_SECONDS)
                except subprocess.TimeoutExpired:
                    process.kill()

    def _tell(self, line: str) -> None:
        for process in self._processes.values():
            if process.stdin is not None:
                with suppress(BrokenPipeError):  # a program that ended has no answer
                    process.stdin.write(f"{line}\n")
                    process.stdin.flush()

    def _answer(self, name: str) -> str:
        """A line of the program of a camera."""
        stdout = self._processes[name].stdout
        line = stdout.readline().strip() if stdout is not None else ""
        return line or "a program that ended"
