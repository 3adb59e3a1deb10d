"""A port that replays the log of a session."""

from __future__ import annotations

import ast
from pathlib import Path

from skindb.clock import SYSTEM_CLOCK, Clock
from skindb.errors import Fault
from skindb.hw.link import READ_SECONDS, DeviceError

LOG_PRECISION_SECONDS = 1e-4


class ReplayPort:
    """A port that replays a recorded session at the times of the recording.

    Parameters
    ----------
    path
        Log of a `Link`.
    clock
        Clock of the replay; with a simulated one it takes no time.

    Raises
    ------
    DeviceError
        If a request differs from the recorded one.
    """

    def __init__(self, path: Path, *, clock: Clock = SYSTEM_CLOCK) -> None:
        self.path = path
        self._clock = clock
        self._start = clock.monotonic()
        self._left = list[tuple[float, str, bytes]]()
        for line in path.read_text(encoding="ascii").splitlines():
            seconds, direction, text = line.split(" ", 2)
            self._left.append((float(seconds), direction, _bytes(text)))

    def read(self, size: int) -> bytes:
        """Return the bytes that were recorded until now and before the next request of the host."""
        data = self._due()
        if data:
            return data
        self._clock.sleep(READ_SECONDS)
        return self._due()

    def _due(self) -> bytes:
        seconds = self._clock.monotonic() - self._start + LOG_PRECISION_SECONDS
        data = b""
        while self._left and self._left[0][0] <= seconds and self._left[0][1] == "<":
            data += self._left.pop(0)[2]
        return data

    def write(self, data: bytes) -> None:
        """Compare the data with the recorded request."""
        while self._left and self._left[0][1] == "<":  # late replies that were not used
            self._left.pop(0)
        recorded = self._left.pop(0)[2] if self._left else b"nothing more"
        if recorded != data:
            raise DeviceError(
                Fault(
                    str(self.path),
                    f"the next request of a replay must be {recorded!r}",
                    f"{data!r}",
                    "replay it with the same commands",
                )
            )

    def close(self) -> None:
        """Do nothing: no file is open."""


def _bytes(text: str) -> bytes:
    value = ast.literal_eval(text)
    if not isinstance(value, bytes):
        raise ValueError(text)
    return value
