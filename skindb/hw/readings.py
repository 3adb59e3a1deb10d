"""Values that devices may send: finite numbers in their physical range, or words of a list."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

NUMBER = re.compile(
    r"[+-]?[0-9]{1,12}(\.[0-9]{1,12})?(e[+-]?[0-9]{1,2})?", re.IGNORECASE
)
SLACK_SECONDS = 2.0  # by which a device may take longer than planned
EARLY_SECONDS = 0.05  # by which it may take less
CLOCK_ERROR = 0.002  # relative, of its clock; one without a crystal is wrong by 0.01
INTEGER = re.compile(r"-?[0-9]{1,12}")


@dataclass(frozen=True)
class Range:
    """Numbers from `least` to `most`."""

    least: float
    most: float
    unit: str = ""

    def __str__(self) -> str:
        """Describe the range in words."""
        return f"a number from {self.least:,.12g} to {self.most:,.12g} {self.unit}".rstrip()

    def parse(self, text: str) -> float:
        """The number; raises ValueError if the text is not a finite number in this range."""
        number = float(text) if NUMBER.fullmatch(text) else math.nan
        if not self.least <= number <= self.most:
            raise ValueError(text)
        return number


@dataclass(frozen=True)
class Count:
    """Whole numbers from `least` to `most`."""

    least: int
    most: int

    def __str__(self) -> str:
        """Describe the numbers in words."""
        return f"a whole number from {self.least} to {self.most}"

    def parse(self, text: str) -> int:
        """The number; raises ValueError if the text is not one of these numbers."""
        number = int(text) if INTEGER.fullmatch(text) else self.least - 1
        if not self.least <= number <= self.most:
            raise ValueError(text)
        return number


@dataclass(frozen=True)
class Word:
    """One of a few words."""

    words: tuple[str, ...]

    def __str__(self) -> str:
        """Describe the words."""
        return f"one of {', '.join(self.words)}"

    def parse(self, text: str) -> str:
        """The word; raises ValueError if it is another one."""
        if text not in self.words:
            raise ValueError(text)
        return text


# of the light controller
STATES = Word(("idle", "armed", "running", "done", "stopped"))
INTERLOCKS = Word(("closed", "open"))
TRIGGERS = Count(0, 1)  # of the cameras, by step or exposure
# the zero of a current sensor may be off
CURRENT = Range(-0.1, 10.0, "of the nominal current")
# of all lights together
REST_CURRENT = Range(-0.1, 1_000.0, "of the current of a light")

# of the probe
PROBE_STATES = Word(("idle", "exposing"))
GAUGE_KPA = Range(-101.4, 1_000.0, "kPa")  # from a vacuum, as in docs/capture_format.md
GAUGE_SECONDS = Range(0.0, 3_600.0, "s")
