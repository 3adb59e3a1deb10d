"""The sequence of lights and exposures of a dome: its plan, its flashes and whether they are
safe, and the measurements that are stored with the capture.

Flashes at 3 to 30 per second provoke seizures in photosensitive people; guidelines
allow at most three in any second (WCAG 2.2, success criterion 2.3.1; Harding and
Jeavons 1994; ITU-R BT.1702). A flash is a pair of opposing changes of luminance of at
least 10 % of the brighter one. Every light that is switched on counts, even if another
one is switched off at the same time, because it shines from another direction.
"""

from __future__ import annotations

import binascii
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Any

from skindb.errors import Fault, InputError, input_error, require

DARK = "-"  # id in place of a light when all lights are off
# between two steps, while the lights are off and the cameras read out
GAP_SECONDS = 0.002
# for 150 lights and two exposures (Weyrich et al. 2005, section 5)
PAPER_SECONDS = 25.0
MAX_FLASHES = 3  # in any second
WINDOW_US = 1_000_000
MAX_JITTER_US = 1_000  # of a measured time


@dataclass(frozen=True)
class Step:
    """One light for one exposure; times in whole microseconds since the start, as the
    controller counts.
    """

    light: str  # DARK for none
    exposure: str
    on_us: int
    off_us: int
    marker: bool = False  # see `skindb.hw.frame_markers`

    @property
    def name(self) -> str:
        """Light and exposure for messages."""
        return f"light {self.light} exposure {self.exposure}"


@dataclass(frozen=True)
class Schedule:
    """Steps in order."""

    steps: tuple[Step, ...]

    @property
    def seconds(self) -> float:
        """Duration from the start until the last light is off."""
        return self.steps[-1].off_us / 1e6 if self.steps else 0.0

    @property
    def markers(self) -> int:
        """Number of its markers."""
        flags = [False, *(step.marker for step in self.steps)]
        return sum(b and not a for a, b in pairwise(flags))

    @property
    def digest(self) -> str:
        """CRC-32 over the lines of the steps, by which the controller identifies the
        plan that it holds.
        """
        lines = "".join(
            f"{step.light} {step.exposure} {step.on_us} {step.off_us}\n"
            for step in self.steps
        )
        return f"{binascii.crc32(lines.encode('ascii')):08X}"

    def subset(self, steps: Iterable[int]) -> Schedule:
        """Schedule of some of the steps, starting at zero, each followed by the same
        interval as in this one.
        """
        start = 0
        chosen = []
        for index in sorted(set(steps)):
            step = self.steps[index]
            length = step.off_us - step.on_us
            chosen.append(replace(step, on_us=start, off_us=start + length))
            after = step.off_us
            if index + 1 < len(self.steps):
                after = self.steps[index + 1].on_us
            start += max(after - step.on_us, length + round(GAP_SECONDS * 1e6))
        return Schedule(tuple(chosen))


@dataclass(frozen=True)
class Measured:
    """Measurements of one step, reported by the controller after the run."""

    on_us: int
    off_us: int
    triggers: int
    level: float  # current of the light while it was on, relative to its nominal one
    # current of all lights after it was switched off, relative to one light
    rest: float


def plan_schedule(
    lights: Sequence[str],
    exposures: Mapping[str, float],
    *,
    seconds: float | None = None,
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

    Raises
    ------
    InputError
        If the exposures take longer than `seconds`.
    """
    pairs = [(light, name) for name in exposures for light in lights]
    require(
        pairs,
        "sequence",
        "must have lights and exposures",
        "none",
        "name at least one of each",
    )
    if bad := [name for name, time in exposures.items() if not 1e-6 <= time <= 60]:
        raise input_error(
            "sequence",
            "an exposure must last 1e-6 to 60 s",
            f"{exposures[bad[0]]} s for {bad[0]}",
            "",
        )
    shortest = sum(exposures[name] + GAP_SECONDS for _, name in pairs)
    if seconds is not None and seconds < shortest - 1e-9:
        raise input_error(
            "sequence",
            f"must last at least {shortest:.3f} s",
            f"{seconds:g} s",
            "allow more time, or shorten the exposures",
        )
    stretch = 0.0 if seconds is None else (seconds - shortest) / len(pairs)
    steps = []
    start = 0.0
    for light, name in pairs:
        on = round(start * 1e6)
        steps.append(Step(light, name, on, on + round(exposures[name] * 1e6)))
        start += exposures[name] + GAP_SECONDS + stretch
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


@dataclass(frozen=True)
class Assessment:
    """Flashes of a sequence."""

    flashes_per_second: int  # largest number in any second
    seconds: float  # duration of the sequence

    @property
    def safe(self) -> bool:
        """Whether the sequence may run without screening the subject."""
        return self.flashes_per_second <= MAX_FLASHES

    def __str__(self) -> str:
        """Describe the assessment in words."""
        flashes = "flash" if self.flashes_per_second == 1 else "flashes"
        return (
            f"at most {self.flashes_per_second} {flashes} in any second, "
            f"{self.seconds:.1f} s"
        )


@dataclass(frozen=True)
class Override:
    """Confirmation of an operator that the subject was screened, gave consent, and
    keeps the eyes closed.
    """

    operator: str
    time: str  # ISO 8601
    screened: bool = True
    consented: bool = True
    eyes_closed: bool = True

    @property
    def complete(self) -> bool:
        """Whether a named operator confirmed all of it."""
        return all((self.operator, self.screened, self.consented, self.eyes_closed))

    def recorded(self, assessment: Assessment) -> dict[str, Any]:
        """Record that is stored with the capture."""
        return asdict(self) | {"flashes_per_second": assessment.flashes_per_second}


@dataclass(frozen=True)
class Rehearsal:
    """Nobody is present and the devices are emulated, so that nobody needs to be screened."""

    confirmation: Override | None = None  # that of the operator who rehearses
    operator: str = "rehearsal"  # for the emulated controller


def assess(schedule: Schedule, *, window_us: int = WINDOW_US) -> Assessment:
    """Flashes of a schedule, in any second or window of another length."""
    starts = sorted(entry.on_us for entry in schedule.steps if entry.light != DARK)
    flashes = 0
    begin = 0
    for end, start in enumerate(starts):
        while starts[begin] <= start - window_us:
            begin += 1
        flashes = max(flashes, end - begin + 1)
    return Assessment(flashes, schedule.seconds)


def measured_flashes(schedule: Schedule, measured: Sequence[Measured]) -> int:
    """Largest number of flashes in any second by the measured times of the first steps."""
    steps = [
        replace(step, on_us=times.on_us, off_us=times.off_us)
        for step, times in zip(schedule.steps, measured, strict=False)
    ]
    lit = Schedule(tuple(steps))
    return assess(lit, window_us=WINDOW_US - 2 * MAX_JITTER_US).flashes_per_second


def slowed_schedule(schedule: Schedule, flashes: int = MAX_FLASHES) -> Schedule:
    """The schedule with longer intervals, so that at most `flashes` lights are switched
    on in any second.
    """
    period = WINDOW_US // max(flashes, 1) + 1
    after = [step.on_us for step in schedule.steps[1:]] + [0]
    steps = []
    start = 0
    for step, following in zip(schedule.steps, after, strict=False):
        steps.append(
            replace(step, on_us=start, off_us=start + step.off_us - step.on_us)
        )
        start += max(period if step.light != DARK else 0, following - step.on_us)
    return Schedule(tuple(steps))


def partial_schedule(schedule: Schedule, steps: Iterable[int]) -> Schedule:
    """Schedule of some of the steps, with at most as many flashes in any second as the
    whole schedule.
    """
    part = schedule.subset(steps)
    allowed = assess(schedule).flashes_per_second
    if assess(part).flashes_per_second > allowed:
        return slowed_schedule(part, allowed)
    return part


def slower_alternative(schedule: Schedule) -> str:
    """Description of the alternative that needs no override, in one line, with its cost."""
    late = slowed_schedule(schedule)
    longer = late.seconds - schedule.seconds
    return f"slower (--slower): {assess(late)}, {longer:.1f} s longer"


def require_safe(
    schedule: Schedule, override: Override | Rehearsal | None
) -> Assessment:
    """Assess a schedule, and refuse one that needs an override and has none.

    Raises
    ------
    InputError
        If the schedule exceeds the limit of flashes and no operator has confirmed it.
    """
    assessment = assess(schedule)
    if assessment.safe or isinstance(override, Rehearsal):
        return assessment
    if override is not None and override.complete:
        return assessment
    raise InputError(_flash_fault(schedule, assessment))


def rehearsal_notes(schedule: Schedule, rehearsal: Rehearsal) -> list[str]:
    """How a real session would judge a schedule: its refusal, or whose confirmation allows it."""
    assessment = assess(schedule)
    if assessment.safe:
        return []
    confirmation = rehearsal.confirmation
    if confirmation is None or not confirmation.complete:
        return [
            f"a real session would be refused: {_flash_fault(schedule, assessment)}"
        ]
    return [
        f"a real session would run because {confirmation.operator} confirms screening, consent and "
        f"closed eyes for {assessment.flashes_per_second} flashes in a second"
    ]


def _flash_fault(schedule: Schedule, assessment: Assessment) -> Fault:
    longer = assess(slowed_schedule(schedule)).seconds - assessment.seconds
    return Fault(
        "sequence",
        "an operator must confirm screening, consent and closed eyes for more than "
        f"{MAX_FLASHES} flashes in a second",
        str(assessment),
        f"give --confirm-screening --operator ID, or --slower ({longer:.1f} s longer)",
    )
