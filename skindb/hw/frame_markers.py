"""Markers, which identify the frames of a run: coded flashes of one light that every camera
sees, before, between and after the steps.

A camera that drops one frame and repeats another delivers as many frames as there were
triggers, and clocks of cameras and files may be set at any time. So a frame is assigned
to a step only if it lies between two markers in the right place: the frames between them
must be as many as the steps, no two of them the same picture, and their order certain.
All others are taken again, also those after the last marker of a run that was stopped.

The marker light is on, off and on, then on or off for each bit of the marker's number, and
on: a marker is recognised by its pictures alone, and no dark frame beside it can take the
place of one of its own. Dark frames have a part of their own.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np

from skindb.errors import InputError, few_names
from skindb.format.dome import DomeRecord
from skindb.format.frames import read_frame
from skindb.hw.cameras import Shot
from skindb.hw.sequence import (
    DARK,
    GAP_SECONDS,
    MAX_FLASHES,
    Schedule,
    Step,
    assess,
    slowed_schedule,
)
from skindb.types import Float64, unit

INTERVAL = 25  # steps between two markers
BITS = 4  # of the number of a marker
MARKER = 4 + BITS  # steps of a marker
CELLS = 8  # a picture is compared by its means in CELLS x CELLS parts
# difference between pictures of the marker light in the same state, relative to that
# between on and off: a subject that moves by 3 mm causes up to 0.15
MAX_DIFFERENCE = 0.25
# difference between pictures of two lights, relative to how bright they are, below which
# they are two pictures of one. Neighbours among 59 to 96 real lights differ by 0.05 or more
# (Yale B, DiLiGenT), pictures of one lamp that flickers by 0.5 % by less than 0.02
MIN_DIFFERENCE = 0.03
# of the brightness of the marker light, below which noise hides such a difference
LIT_FRACTION = 0.03


def marker_light(dome: DomeRecord) -> str:
    """Id of the light that is nearest to the directions of all cameras."""
    towards = unit(np.array([camera.centre for camera in dome.cameras]))
    lights = unit(np.array([light.position for light in dome.lights]))
    return dome.lights[int((lights @ towards.T).min(axis=1).argmax())].id


def with_markers(schedule: Schedule, light: str, *, first: int = 0) -> Schedule:
    """The schedule with markers before, between and after its steps.

    Parameters
    ----------
    schedule
        Steps that have no markers.
    light
        Id of the marker light, which is on for the longest exposure of the schedule.
    first
        Number of the first marker: other than those of the run before, whose frames may
        arrive late.

    Returns
    -------
    Schedule
        With at most as many flashes in any second as the given one, or `MAX_FLASHES` if
        that is more.
    """
    longest = max(schedule.steps, key=lambda step: step.off_us - step.on_us)
    length = longest.off_us - longest.on_us
    gap = round(GAP_SECONDS * 1e6)
    # all numbers of one run differ
    interval = max(INTERVAL, math.ceil(len(schedule.steps) / (2**BITS - 4)))
    steps = []
    start = 0
    number = first
    begin = 0  # of the part
    before = None
    ends = [step.on_us for step in schedule.steps[1:]] + [schedule.steps[-1].off_us]
    for i, step in enumerate([*schedule.steps, None]):
        if (
            before is None
            or step is None
            or i - begin == interval
            or (step.light == DARK) != (before.light == DARK)
        ):
            for is_lit in _code(number % 2**BITS):
                name = light if is_lit else DARK
                flash = Step(name, longest.exposure, start, start + length, marker=True)
                steps.append(flash)
                start += length + gap
            number += 1
            begin = i
        before = step
        if step is not None:
            duration = step.off_us - step.on_us
            steps.append(replace(step, on_us=start, off_us=start + duration))
            start += max(ends[i] - step.on_us, duration + gap)
    marked = Schedule(tuple(steps))
    allowed = max(assess(schedule).flashes_per_second, MAX_FLASHES)
    if assess(marked).flashes_per_second > allowed:
        return slowed_schedule(marked, allowed)
    return marked


def _code(number: int) -> list[bool]:
    """Whether the light is on in each step of the marker with this number."""
    bits = [bool(number >> bit & 1) for bit in range(BITS)]
    return [True, False, True, *bits, True]


@dataclass(frozen=True)
class _Picture:
    """What is compared of a frame."""

    means: Float64  # (CELLS^2,) values in its parts; NaN if it cannot be decoded
    digest: int  # of its pixels
    is_even: bool = False  # whether all pixels are equal, as where all noise is clipped

    @classmethod
    def of(cls, shot: Shot) -> "_Picture":
        try:
            frame = read_frame(shot.path)
        except InputError:
            return cls(np.full(CELLS**2, np.nan), hash(shot.path))
        # decoding takes longer than all else
        interval = max(min(frame.shape[:2]) // (8 * CELLS), 1)
        frame = frame[::interval, ::interval]
        grey = frame.mean(axis=-1, dtype=float)
        rows, columns = (np.arange(CELLS) * size // CELLS for size in grey.shape)
        sums = np.add.reduceat(np.add.reduceat(grey, rows, axis=0), columns, axis=1)
        return cls(sums.ravel(), hash(frame.tobytes()), bool(np.ptp(frame) == 0))


@dataclass
class _Part:
    """Indices of the flashes of two markers and of the steps between them."""

    before: list[int] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    after: list[int] = field(default_factory=list)


def _parts(steps: Sequence[Step]) -> list[_Part]:
    """Parts of a schedule with markers; the last one may lack flashes after it."""
    parts = [_Part()]
    for i, step in enumerate(steps):
        if step.marker and not (i and steps[i - 1].marker):
            parts.append(_Part())
        if step.marker:
            parts[-2].after.append(i)
            parts[-1].before.append(i)
        else:
            parts[-1].steps.append(i)
    return [part for part in parts if part.steps]


def identify_frames(
    shots: Sequence[Shot], steps: Sequence[Step], lost: Collection[int] = ()
) -> tuple[dict[int, Path], list[str]]:
    """Frames of one camera by the step in which they were taken, and why others were not
    identified.

    Parameters
    ----------
    shots
        Frames of one camera, in the order in which they were taken.
    steps
        Steps of a schedule with markers, up to the last one with a trigger.
    lost
        Indices of steps without a trigger, by the report of the controller. It may have
        been another one near it.
    """
    if not shots:
        return {}, ["no frames"]
    with ThreadPoolExecutor() as pool:
        pictures = list(pool.map(_Picture.of, shots))
    markers = _markers(np.array([picture.means for picture in pictures]))
    if not markers:
        return {}, [f"no flashes of the marker light {steps[0].light}"]
    frames = dict[int, Path]()
    problems = []
    for part in _parts(steps):
        begin, end = (
            markers[_number([steps[i] for i in marker])]
            for marker in (part.before, part.after)
        )
        gaps = [(a, b) for a, b in product(begin, end) if a < b]
        fitting = [(a, b) for a, b in gaps if b - a - MARKER == len(part.steps)]
        indices = [*part.before, *part.steps, *part.after]
        if not set(indices).isdisjoint(lost):
            problem = "the controller reports lost triggers"
        elif len(fitting) == 1:
            [(a, b)] = fitting
            inside = slice(a, b + MARKER)
            names = [steps[i].name for i in indices]
            problem = _problem(shots[inside], pictures[inside], names) or _alike(
                shots[inside], np.array([one.means for one in pictures[inside]]), names
            )
        elif len(gaps) == 1:
            [(a, b)] = gaps
            problem = f"{b - a - MARKER} frames for {len(part.steps)} triggers"
        else:
            problem = "the markers around them are not seen"
        if not problem:
            frames |= {
                i: shots[j].path
                for j, i in enumerate(part.steps, a + MARKER)
                if np.isfinite(pictures[j].means).all()
            }
        else:
            ends = (steps[part.steps[end]].name for end in (0, -1))
            problems.append(f"{' to '.join(ends)}: {problem}")
    return frames, problems


def _number(marker: Sequence[Step]) -> int:
    """Number of a marker; -1 without some of its flashes."""
    if len(marker) != MARKER:
        return -1
    return sum((step.light != DARK) << bit for bit, step in enumerate(marker[3:-1]))


def _markers(means: Float64) -> Mapping[int, list[int]]:
    """Number of a marker -> where it begins in the pictures (n, CELLS^2)."""
    places = defaultdict[int, list[int]](list)
    level = means.sum(axis=-1)
    for begin in range(len(means) - MARKER + 1):
        on, off, again, *bits, last = means[begin : begin + MARKER]
        limit = MAX_DIFFERENCE * np.linalg.norm(on - off)
        from_on, from_off = (
            np.linalg.norm(np.array(bits) - state, axis=1) for state in (on, off)
        )
        is_on = from_on < limit
        if (
            level[begin] > level[begin + 1]
            and max(np.linalg.norm(again - on), np.linalg.norm(last - on)) < limit
            and (is_on | (from_off < limit)).all()
        ):
            places[int(is_on @ 2 ** np.arange(BITS))].append(begin)
    return places


def _problem(
    shots: Sequence[Shot], pictures: Sequence[_Picture], names: Sequence[str]
) -> str:
    """Why these frames cannot be those of steps with these names; empty if they can."""
    if doubtful := [shot.path.name for shot in shots if shot.is_doubtful]:
        return f"the order of its files is not certain, such as {few_names(doubtful)}"
    first = dict[int, int]()
    for i, picture in enumerate(pictures):
        before = first.setdefault(picture.digest, i)
        if before == i:
            continue
        files = f"{shots[before].path.name} and {shots[i].path.name}"
        if not picture.is_even:  # noise is never equal
            return f"{files} are the same picture"
        if not all(names[j].startswith(f"light {DARK} ") for j in (before, i)):
            cure = "set a black level above zero, or shorten the exposures"
            return f"{files} are equally black or white; {cure}"
    return ""


def _alike(shots: Sequence[Shot], means: Float64, names: Sequence[str]) -> str:
    """Neighbours that look like one light that was photographed twice, in frames that
    begin with a marker and have the means (n, CELLS^2).
    """
    level = np.linalg.norm(means - means[1], axis=1)
    step = np.linalg.norm(np.diff(means, axis=0), axis=1)
    equal = (step < MIN_DIFFERENCE * level[1:]) & (level[1:] > LIT_FRACTION * level[0])
    for i in np.flatnonzero(equal).tolist():
        if names[i] != names[i + 1]:
            files = (shots[i].path.name, shots[i + 1].path.name)
            return f"{' and '.join(files)} show the same light"
    return ""


def exposures_problem(shots: Sequence[Shot], exposures: Sequence[str]) -> str:
    """Why these frames cannot be those of the exposures in their order; empty if they can."""
    return _problem(shots, [_Picture.of(shot) for shot in shots], exposures)
