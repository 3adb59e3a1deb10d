"""The sequence of lights and exposures of a dome: its plan, and the measurements that
are stored with the capture.
"""

from __future__ import annotations

import binascii
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from skindb.errors import Fault, InputError

DARK = "-"  # id in place of a light when all lights are off
# between two steps, while the lights are off and the cameras read out
GAP_SECONDS = 0.002
# for 150 lights and two exposures (Weyrich et al. 2005, section 5)
PAPER_SECONDS = 25.0


@dataclass(frozen=True)
class Step:
    """One light for one exposure; times in whole microseconds since the start, as the
    controller counts.
    """

    light: str  # DARK for none
    exposure: str
    on_us: int
    off_us: int


@dataclass(frozen=True)
class Schedule:
    """Steps in order; `base` is the brightness of a steady lamp beside them, in units
    of one light.
    """

    steps: tuple[Step, ...]
    base: int = 0

    @property
    def seconds(self) -> float:
        """Duration from the start until the last light is off."""
        return self.steps[-1].off_us / 1e6 if self.steps else 0.0

    @property
    def digest(self) -> str:
        """CRC-32 over the lines of the steps, by which the controller identifies the
        plan that it holds.
        """
        return (
            f"{binascii.crc32(''.join(map(step_line, self.steps)).encode('ascii')):08X}"
        )

    def subset(self, steps: Iterable[int]) -> Schedule:
        """Schedule of some of the steps, starting at zero, each followed by the same
        interval as in this one.
        """
        start = 0
        chosen = list[Step]()
        for index in sorted(set(steps)):
            step = self.steps[index]
            length = step.off_us - step.on_us
            chosen.append(replace(step, on_us=start, off_us=start + length))
            after = (
                self.steps[index + 1].on_us
                if index + 1 < len(self.steps)
                else step.off_us
            )
            start += max(after - step.on_us, length + round(GAP_SECONDS * 1e6))
        return replace(self, steps=tuple(chosen))


@dataclass(frozen=True)
class Measured:
    """Measurements of one step, reported by the controller after the run."""

    on_us: int
    off_us: int
    triggers: int
    level: float  # current of the light while it was on, relative to its nominal one
    # current of all lights after it was switched off, relative to one light
    rest: float


def step_line(step: Step) -> str:
    """Line of a step in the digest of a plan."""
    return f"{step.light} {step.exposure} {step.on_us} {step.off_us}\n"


def plan_schedule(
    lights: Sequence[str],
    exposures: Mapping[str, float],
    *,
    seconds: float | None = None,
    period: float = 0.0,
) -> Schedule:
    """Plan a sequence of single lights: all lights with one exposure, then with the next.

    Parameters
    ----------
    lights
        Ids in the order in which they are switched on.
    exposures
        Id -> seconds.
    seconds
        Duration of the sequence; by default as short as the exposures allow.
    period
        Shortest time [s] from one light to the next.

    Raises
    ------
    InputError
        If the exposures take longer than `seconds`.
    """
    pairs = [(light, name) for name in exposures for light in lights]
    if not pairs:
        raise InputError(
            Fault(
                "sequence",
                "must have lights and exposures",
                "none",
                "name at least one of each",
            )
        )
    if bad := [name for name, time in exposures.items() if not 1e-6 <= time <= 60]:
        rule = "an exposure must last 1e-6 to 60 s"
        text = f"{exposures[bad[0]]} s for {bad[0]}"
        raise InputError(Fault("sequence", rule, text, ""))
    shortest = sum(max(exposures[name] + GAP_SECONDS, period) for _, name in pairs)
    if seconds is not None and seconds < shortest - 1e-9:
        cure = "allow more time, or shorten the exposures"
        raise InputError(
            Fault(
                "sequence",
                f"must last at least {shortest:.3f} s",
                f"{seconds:g} s",
                cure,
            )
        )
    stretch = 0.0 if seconds is None else (seconds - shortest) / len(pairs)
    steps = list[Step]()
    start = 0.0
    for light, name in pairs:
        on = round(start * 1e6)
        steps.append(Step(light, name, on, on + round(exposures[name] * 1e6)))
        start += max(exposures[name] + GAP_SECONDS, period) + stretch
    return Schedule(tuple(steps))


def sequence_entry(step: Step, measured: Measured) -> dict[str, Any]:
    """Entry of the list `sequence` of dome.json, with measured and planned times [s]."""
    return {
        "light": step.light,
        "exposure": step.exposure,
        "t_on": measured.on_us / 1e6,
        "t_off": measured.off_us / 1e6,
        "trigger_count": measured.triggers,
        "planned_on": step.on_us / 1e6,
        "planned_off": step.off_us / 1e6,
    }
