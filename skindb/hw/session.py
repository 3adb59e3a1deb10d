"""A session: run a sequence, match frames with triggers, repeat missing steps, and keep complete ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from skindb._types import Progress, silent
from skindb.errors import Fault, InputError
from skindb.hw.cameras import Cameras, match_frames
from skindb.hw.dome import STOPPED, Dome
from skindb.hw.link import DeviceError, RefusedError
from skindb.hw.probe import PRESSURE_KPA, Placement, Probe
from skindb.hw.safety import Assessment, Override, part_of, require_safe
from skindb.hw.sequence import DARK, Measured, Schedule, Step

MAX_REPEATS = 3  # runs after the first one; what is missing then is broken, not bad luck
FRAME_SECONDS = 10.0  # for the last frames to be written
LOST_FRAME_SECONDS = 1.0  # the same, if their number is unknown
DARK_FRAMES = 4  # of every exposure before the lights, whose mean is kept: they take 1.5 s for two exposures
PAUSE_US = 250_000  # around dark frames: uneven times show which frame is missing
MIN_LEVEL, MAX_LEVEL = 0.9, 1.1  # of the current of a light, relative to its nominal one
MAX_REST = 0.02  # of the current when all lights should be off
MAX_TIME_ERROR_US = 1_000  # of the measured time that a light is on

Key = tuple[str, str]  # light, exposure


@dataclass
class DomeRun:
    """Frames and measured steps of a capture, complete or not."""

    schedule: Schedule
    assessment: Assessment
    override: Override | None
    measured: list[Measured | None]
    frames: dict[tuple[str, int], Path] = field(default_factory=dict)  # camera, step -> file
    notes: list[str] = field(default_factory=list)
    faulty_lights: dict[str, str] = field(default_factory=dict)  # light -> what is wrong with it
    stopped: str = ""  # why it ended early

    def forget(self, step: int) -> None:
        """Remove the frames of a step."""
        self.measured[step] = None
        self.frames = {key: path for key, path in self.frames.items() if key[1] != step}

    def missing(self, cameras: Sequence[str]) -> dict[int, list[str]]:
        """Step -> cameras without a frame of it."""
        steps = range(len(self.schedule.steps))
        lost = {i: [camera for camera in cameras if (camera, i) not in self.frames] for i in steps}
        return {i: names for i, names in lost.items() if names}


def with_dark_frames(schedule: Schedule, *, count: int = DARK_FRAMES) -> Schedule:
    """The schedule after `count` dark frames of every exposure, and before one that shows lights that stay on."""
    lengths = {step.exposure: step.off_us - step.on_us for step in schedule.steps}
    steps, start = list[Step](), 0
    for name, length in lengths.items():
        for _ in range(count):
            steps.append(Step(DARK, name, start, start + length))
            start += length + PAUSE_US
    for step in schedule.steps:
        steps.append(Step(step.light, step.exposure, start + step.on_us, start + step.off_us))
    start = steps[-1].off_us + PAUSE_US
    shortest = min(lengths, key=lengths.__getitem__)
    steps.append(Step(DARK, shortest, start, start + lengths[shortest]))
    return Schedule(tuple(steps), schedule.base)


def capture_dome(
    dome: Dome,
    cameras: Cameras,
    schedule: Schedule,
    *,
    override: Override | None = None,
    progress: Progress | None = None,
) -> DomeRun:
    """Run a sequence; frames that are missing are repeated, while the subject is still there.

    Parameters
    ----------
    dome, cameras
        The devices.
    schedule
        What to do, for example ``with_dark_frames(plan_schedule(...))``.
    override
        Confirmation of an operator for more than three flashes in a second.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    DomeRun
        What was recorded. After an emergency stop, an opened interlock or a lost device, `stopped` is the reason and
        the frames so far are there; the lights are off.

    Raises
    ------
    InputError
        If the sequence is not allowed, or the controller refuses it: nothing was lit. A repetition that is refused is
        no error: `stopped` is the reason, and what was recorded is returned.
    """
    tell = progress or silent
    run = DomeRun(schedule, require_safe(schedule, override), override, [None] * len(schedule.steps))
    wanted = list(range(len(schedule.steps)))
    first = 0.0  # when the first run began
    for attempt in range(1 + MAX_REPEATS):
        part = part_of(schedule, wanted) if attempt else schedule
        stage = "repeat" if attempt else "capture"
        cameras.start()
        try:
            dome.upload(part)
            dome.arm(part, override)
        except InputError as error:  # of a repetition: what is there is kept
            if not attempt:
                raise
            run.stopped = _reason(error)
            break
        now = time.monotonic()
        first = first or now
        done = list[Measured]()
        try:
            state = dome.run(part, lambda number, total, stage=stage: tell(stage, number, total), done)  # type: ignore[misc]
            run.stopped = f"{dome.link.name}: {STOPPED.get(state.reason, state.reason)}" if state.reason else ""
        except (DeviceError, KeyboardInterrupt) as error:
            run.stopped = _reason(error)
        finished, lost_device = _read_reports(dome, done)
        run.stopped = run.stopped or lost_device
        since = round(1e6 * (now - first))
        done = [replace(one, on_us=one.on_us + since, off_us=one.off_us + since) for one in done]
        _collect(run, cameras, wanted, part, done, finished=finished, known=not lost_device)
        lost = run.missing(cameras.ids)
        if run.stopped or not lost:
            break
        wanted = sorted(lost)
        run.notes.append(f"{_named(schedule, lost)}: repeated")
    run.notes += [f"{dome.link.name}: {dome.link.damaged} damaged lines"] if dome.link.damaged else []
    run.faulty_lights = _faulty_lights(run)
    return run


def _reason(error: BaseException) -> str:
    """Why a run ended, as a phrase for a message with its own rule and cure."""
    if not isinstance(error, InputError):
        return "stopped by the operator"
    return "; ".join(f"{fault.where} {fault.rule}: {fault.found}" for fault in error.faults)


def _read_reports(dome: Dome, done: list[Measured]) -> tuple[int, str]:
    """Add the reports that are missing, also of a step that was cut short; how many are finished, what went wrong."""
    finished = len(done)
    try:
        finished = dome.state().step
        while True:
            done.append(dome.report_step(len(done)))
    except RefusedError:  # the step after the last one that began
        return finished, ""
    except DeviceError as error:
        return min(finished, len(done)), _reason(error)


def _collect(
    run: DomeRun,
    cameras: Cameras,
    wanted: Sequence[int],
    part: Schedule,
    done: Sequence[Measured],
    *,
    finished: int,
    known: bool,
) -> None:
    """Take in the frames of the finished steps of a part; those of steps without a trigger belong to no frame.

    `known` is whether the controller reported what it did. Otherwise it may have continued after its last report:
    frames are matched with the whole plan, and only those of steps that it reported are kept.
    """
    steps = [i for i, found in enumerate(done) if found.triggers > 0]
    if not known:
        steps += range(len(done), len(part.steps))
    times = [part.steps[i].on_us / 1e6 for i in steps]
    for index, found in zip(wanted, done[:finished], strict=False):
        run.measured[index] = found
    for camera, shots in cameras.collect(len(steps), FRAME_SECONDS if known else LOST_FRAME_SECONDS).items():
        if known and len(shots) != len(steps):
            run.notes.append(f"camera {camera}: {len(shots)} frames of {len(steps)} triggers")
        for i, path in zip(steps, match_frames(shots, times), strict=True):
            if path is not None and i < finished:
                run.frames[camera, wanted[i]] = path


def forget_faulty_steps(run: DomeRun) -> None:
    """Drop the frames of lights that failed, and all since a light stayed on: they must be taken again."""
    since = (i for i, done in enumerate(run.measured) if done is not None and done.rest > MAX_REST)
    stuck = next(since, 0 if DARK in run.faulty_lights else len(run.measured))
    for i, step in enumerate(run.schedule.steps):
        if i >= stuck or step.light in run.faulty_lights:
            run.forget(i)


def require_complete(run: DomeRun, cameras: Sequence[str]) -> None:
    """Refuse a capture that lacks frames or in which lights failed, while the subject is still there.

    Raises
    ------
    InputError
        With the frames to repeat, the lights that failed, or why the sequence was stopped.
    """
    cure = "keep the subject seated and run the capture again; it continues with what is missing"
    faults = [Fault("capture", "must run to its end", run.stopped, cure)] if run.stopped else []
    if lost := run.missing(cameras):
        faults.append(
            Fault("capture", "every step must have a frame of every camera", _named(run.schedule, lost), cure)
        )
    for light, what in run.faulty_lights.items():
        rule = "all lights must be off" if light == DARK else "must light as the others do"
        cure = "repair it, and run the capture again; it takes its frames again"
        faults.append(Fault("dark frame" if light == DARK else f"light {light}", rule, what, cure))
    if faults:
        raise InputError(faults)


def _named(schedule: Schedule, lost: Mapping[int, Sequence[str]]) -> str:
    """The first of the frames that are missing, and how many there are."""
    names = [
        f"light {schedule.steps[i].light} exposure {schedule.steps[i].exposure} camera {camera}"
        for i, cameras in lost.items()
        for camera in cameras
    ]
    return f"{len(names)} missing frames: {'; '.join(names[:5])}{'; ...' if len(names) > 5 else ''}"


def _faulty_lights(run: DomeRun) -> dict[str, str]:
    """Lights whose current or time was not what it should be."""
    found, stays = dict[str, str](), False
    for step, done in zip(run.schedule.steps, run.measured, strict=True):
        if done is None:
            continue
        error = abs((done.off_us - done.on_us) - (step.off_us - step.on_us))
        if done.rest > MAX_REST and not stays:  # the steps after it show the same light
            stays = True
            found.setdefault(step.light, f"{done.rest:.0%} of the current of a light flowed after it went off")
        elif step.light != DARK and not MIN_LEVEL <= done.level - (done.rest if stays else 0.0) <= MAX_LEVEL:
            found.setdefault(step.light, f"{done.level:.0%} of its nominal current")
        elif error > MAX_TIME_ERROR_US:
            found.setdefault(step.light, f"on for {error} us more or less than planned")
    return found


@dataclass(frozen=True)
class SiteRun:
    """One placement of the probe, and the frame of every exposure."""

    site: str
    placement: Placement
    frames: Mapping[str, Path]


def capture_site(
    probe: Probe,
    camera: Cameras,
    site: str,
    exposures: Mapping[str, float],
    *,
    pressure: float = PRESSURE_KPA,
    progress: Callable[[int, int], None] | None = None,
) -> SiteRun:
    """Measure one site; a missing frame, a leak or a lost device is an error, and the site is measured again.

    Raises
    ------
    InputError
        If the probe leaks or vanishes, or its camera lacks frames.
    """
    camera.start()
    placement = probe.measure(exposures, pressure=pressure, progress=progress)
    [(name, shots)] = camera.collect(len(exposures), FRAME_SECONDS).items()
    if len(shots) != len(exposures):
        found = f"{len(shots)} frames of {sum(placement.triggers.values())} triggers and {len(exposures)} exposures"
        raise InputError(Fault(f"camera {name}", "must take a frame of every exposure", found, f"measure {site} again"))
    return SiteRun(site, placement, dict(zip(exposures, (shot.path for shot in shots), strict=True)))
