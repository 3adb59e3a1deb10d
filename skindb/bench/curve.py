"""What a work-precision measurement says, and how its seconds are taken."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

T = TypeVar("T")
ROUNDS, LONG = 3, 2.0  # best of so many, unless they take longer than this [s]


@dataclass(frozen=True)
class Point:
    """One method at one setting."""

    method: str
    parameter: str
    seconds: float  # of the processor, all threads; NaN where the time says nothing
    error: float
    failure: str = ""  # why the method does not do, if so
    more: dict[str, float] = field(default_factory=dict)  # other numbers of the same run

    @property
    def name(self) -> str:
        """Method and setting."""
        return f"{self.method}, {self.parameter}" if self.parameter else self.method


@dataclass(frozen=True)
class Curve:
    """Points of one kernel whose errors and seconds mean the same."""

    kernel: str
    error_of: str
    reference: str
    seconds_of: str
    base: str  # name of the point whose seconds the others are divided by
    points: tuple[Point, ...]

    def ratio(self, point: Point) -> float:
        """Seconds of a point over those of the base: below 1 is faster."""
        return point.seconds / next(p.seconds for p in self.points if p.name == self.base)


def seconds_of(work: Callable[[], T], per: float = 1.0) -> tuple[float, T]:
    """CPU time over `per`, the best of three rounds or of fewer long ones, and the result; warm up before."""
    times: list[float] = []
    while len(times) < ROUNDS and sum(times) < LONG:
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return min(times) / per, result
