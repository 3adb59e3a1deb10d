"""Time as a parameter: the clock of this computer, and a simulated one for emulated devices."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Protocol

# of simulated time: a 115,200 baud line needs as long for a message
TICK_SECONDS = 0.005
SIMULATED_START = 1_700_000_000.0  # s since 1970


class Clock(Protocol):
    """A clock by which drivers, watched folders and emulated devices measure time and wait."""

    def monotonic(self) -> float:
        """Seconds since an arbitrary moment; never goes back."""

    def sleep(self, seconds: float) -> None:
        """Wait."""

    def time(self) -> float:
        """Seconds since 1970."""


class SimulatedClock:
    """A clock whose time passes only while somebody waits, and then at once.

    Parameters
    ----------
    start
        Time [s since 1970] at which it begins.
    """

    def __init__(self, start: float = SIMULATED_START) -> None:
        self._start = start
        self._seconds = 0.0
        self._actors = list[Callable[[], None]]()

    def attach(self, act: Callable[[], None]) -> None:
        """Call a function at every tick, for something that acts by itself, such as a device."""
        self._actors.append(act)

    def monotonic(self) -> float:
        """Simulated seconds since the clock was made."""
        return self._seconds

    def sleep(self, seconds: float) -> None:
        """Let time pass in ticks, at each of which the attached functions act."""
        end = self._seconds + seconds
        while self._seconds < end:
            self._seconds = min(self._seconds + TICK_SECONDS, end)
            with _uninterrupted():
                for act in self._actors:
                    act()

    def time(self) -> float:
        """Simulated seconds since 1970."""
        return self._start + self._seconds


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Context at whose end Ctrl-C takes effect: devices do not stop in the midst of an act."""
    is_main = threading.current_thread() is threading.main_thread()
    # None is a handler of another library, which cannot be set again
    if not is_main or signal.getsignal(signal.SIGINT) is None:
        yield
        return
    pressed = list[int]()
    handler = signal.signal(signal.SIGINT, lambda number, _: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if pressed:
            signal.raise_signal(signal.SIGINT)


SYSTEM_CLOCK: Clock = time  # that of this computer


def utc_time() -> str:
    """Present time by the clock of this computer, ISO 8601 in UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")
