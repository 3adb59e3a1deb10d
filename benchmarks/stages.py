"""Times and memory of every stage of a long call, from its progress reports."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass
class Spent:
    """Resources used by a stage."""

    wall: float = 0.0  # s
    cpu: float = 0.0  # s of all threads
    anonymous: float = 0.0  # MiB, peak without files in the page cache


class Stages:
    """Assigns all time to the stage that is reported next: `with Stages() as stages:
    call(progress=stages)`.
    """

    def __init__(self) -> None:
        self.spent: dict[str, Spent] = {}
        self._peak = 0.0
        self._stop = threading.Event()
        self._last = (time.monotonic(), time.process_time())
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Stages:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def __call__(self, stage: str, step: int, steps: int) -> None:
        """Receive progress; a stage ends with its last step."""
        if step == steps:
            self.end(stage)

    def end(self, stage: str) -> None:
        """Assign the time since the last end to this stage."""
        now = (time.monotonic(), time.process_time())
        spent = self.spent.setdefault(stage, Spent())
        spent.wall = spent.wall + now[0] - self._last[0]
        spent.cpu = spent.cpu + now[1] - self._last[1]
        spent.anonymous = max(spent.anonymous, self._peak, anonymous())
        self._peak = 0.0
        self._last = now

    def table(self) -> dict[str, dict[str, float]]:
        """Resources of every stage, and of "all"."""
        parts = self.spent.values()
        total = Spent(
            sum(p.wall for p in parts),
            sum(p.cpu for p in parts),
            max(p.anonymous for p in parts),
        )
        return {
            name: asdict(spent) for name, spent in {**self.spent, "all": total}.items()
        }

    def _watch(self) -> None:
        while not self._stop.wait(0.05):
            self._peak = max(self._peak, anonymous())


def anonymous() -> float:
    """Current anonymous memory of this process [MiB]."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (line,) = [line for line in lines if line.startswith("RssAnon")]
    return int(line.split()[1]) / 1024


def peak() -> float:
    """Peak resident memory of this process [GiB]; `ru_maxrss` would include that of the parent."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (line,) = [line for line in lines if line.startswith("VmHWM")]
    return int(line.split()[1]) / 2**20


def stage_lines(table: Mapping[str, Mapping[str, float]]) -> list[str]:
    """One line per stage."""
    lines = []
    for name, spent in table.items():
        peak = f"   peak {spent['anonymous']:6.0f} MiB" if "anonymous" in spent else ""
        lines.append(
            f"{name:<24} cpu {spent['cpu']:7.1f} s   wall {spent['wall']:7.1f} s{peak}"
        )
    return lines
