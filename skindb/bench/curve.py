"""Work-precision curves, and the measurement of CPU time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

T = TypeVar("T")
# number of rounds, of which the best counts; no further round after this time [s]
ROUNDS = 3
LONG = 2.0


@dataclass(frozen=True)
class Point:
    """One method at one setting."""

    method: str
    parameter: str
    seconds: float  # CPU time of all threads; NaN where the time is not comparable
    error: float
    failure: str = ""  # reason why the method is unsuitable, if it is
    # other results of the same run
    more: dict[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Method and setting."""
        return f"{self.method}, {self.parameter}" if self.parameter else self.method


@dataclass(frozen=True)
class Curve:
    """Points of one kernel with comparable errors and CPU times."""

    kernel: str
    error_of: str
    reference: str
    seconds_of: str
    base: str  # name of the point to whose CPU time the others are compared
    points: tuple[Point, ...]

    def ratio(self, point: Point) -> float:
        """CPU time of a point over that of the base; below 1 is faster."""
        return point.seconds / next(
            p.seconds for p in self.points if p.name == self.base
        )


def cpu_time(work: Callable[[], T], per: float = 1.0) -> tuple[float, T]:
    """CPU time [s] divided by `per`, the best of up to three rounds, and the result;
    warm up before.
    """
    times: list[float] = []
    while len(times) < ROUNDS and sum(times) < LONG:
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return min(times) / per, result
