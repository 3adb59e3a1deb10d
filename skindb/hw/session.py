"""A session: runs a sequence, counts triggers and frames, and repeats the steps whose
frames are missing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from skindb.errors import Fault, InputError, few_names, require_none
from skindb.hw.cameras import Cameras
from skindb.hw.dome import STOPPED, Dome
from skindb.hw.frame_markers import exposures_problem, identify_frames, with_markers
from skindb.hw.link import DeviceError, RefusedError
from skindb.hw.probe import PRESSURE_KPA, Placement, PlacementError, Probe
from skindb.hw.sequence import (
    DARK,
    Measured,
    Override,
    Rehearsal,
    Schedule,
    Step,
    measured_flashes,
    partial_schedule,
    require_safe,
)
from skindb.types import Progress, silent

# runs after the first one; frames that are still missing then indicate a broken device
MAX_REPEATS = 3
# per exposure before the lights, of which the mean is kept: they take 1.5 s for two
# exposures
DARK_FRAMES = 4
PAUSE_US = 250_000  # around dark frames
# current of a light, relative to its nominal current
MIN_LEVEL = 0.9
MAX_LEVEL = 1.1
MAX_REST = 0.02  # current when all lights should be off, relative to one light
MAX_TIME_ERROR_US = 1_000  # of the measured time for which a light is on

Key = tuple[str, str]  # light, exposure


@dataclass
class DomeRun:
    """Frames and measured steps of a capture, complete or not."""

    schedule: Schedule
    measured: list[Measured | None]
    # camera, step -> file
    frames: dict[tuple[str, int], Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    # why frames of the last part that ran were not identified
    problems: list[str] = field(default_factory=list)
    # light -> description of its failure
    faulty_lights: dict[str, str] = field(default_factory=dict)
    stopped: str = ""  # reason if the run ended early
    flashes: int = 0  # largest measured number in a second
    # otherwise the controller may know more of the last part that ran
    is_reported: bool = True

    def forget(self, step: int) -> None:
        """Discard the measurements and frames of a step."""
        self.measured[step] = None
        self.frames = {key: path for key, path in self.frames.items() if key[1] != step}

    def missing(self, cameras: Sequence[str]) -> dict[int, list[str]]:
        """Cameras that lack a frame, by step."""
        steps = range(len(self.schedule.steps))
        lost = {
            i: [camera for camera in cameras if (camera, i) not in self.frames]
            for i in steps
        }
        return {i: names for i, names in lost.items() if names}


def with_dark_frames(schedule: Schedule, *, count: int = DARK_FRAMES) -> Schedule:
    """The schedule with `count` dark frames of every exposure before it, and one after
    it to detect stuck lights.
    """
    lengths = {step.exposure: step.off_us - step.on_us for step in schedule.steps}
    steps = list[Step]()
    start = 0
    for name, length in lengths.items():
        for _ in range(count):
            steps.append(Step(DARK, name, start, start + length))
            start += length + PAUSE_US
    for step in schedule.steps:
        steps.append(
            Step(step.light, step.exposure, start + step.on_us, start + step.off_us)
        )
    start = steps[-1].off_us + PAUSE_US
    shortest = min(lengths, key=lengths.__getitem__)
    steps.append(Step(DARK, shortest, start, start + lengths[shortest]))
    return Schedule(tuple(steps))


def capture_dome(
    dome: Dome,
    cameras: Cameras,
    schedule: Schedule,
    *,
    marker_light: str,
    override: Override | Rehearsal | None = None,
    begin: Callable[[Schedule], None] = lambda _part: None,
    progress: Progress = silent,
) -> DomeRun:
    """Run a sequence, and repeat the steps with missing frames while the subject is still seated.

    Parameters
    ----------
    dome, cameras
        The devices.
    schedule
        Steps to run, for example ``with_dark_frames(plan_schedule(...))``.
    marker_light
        Light that all cameras see, for the markers between which frames are identified.
    override
        Confirmation of an operator for more than three flashes in a second, or a rehearsal.
    begin
        Called with the steps that are about to run, with their markers: the whole
        schedule, and then those that are repeated.
    progress
        Called with the stage, the steps done and the steps in all.

    Returns
    -------
    DomeRun
        Frames and measurements. After an emergency stop, an opened interlock or a lost
        device, `stopped` gives the reason, the frames captured so far are kept, and the
        lights are off.

    Raises
    ------
    InputError
        If the sequence is not allowed or the controller refuses it, before any light is
        switched on. A refused repetition is not an error: `stopped` gives the reason,
        and the frames captured so far are kept.
    """
    require_safe(schedule, override)
    run = DomeRun(schedule, [None] * len(schedule.steps))
    clock = dome.link.clock
    remaining = list(range(len(schedule.steps)))
    begin_time = 0.0  # when the first run began
    markers = 0  # of the runs before
    for attempt in range(1 + MAX_REPEATS):
        part = partial_schedule(schedule, remaining) if attempt else schedule
        part = with_markers(part, marker_light, first=markers)
        markers += part.markers
        cameras.start()
        try:
            dome.upload(part)
            dome.arm(part, override)
        except InputError as error:
            # keep the captured frames if a repetition is refused
            if not attempt:
                raise
            run.stopped = _reason(error)
            break
        begin(part)
        now = clock.monotonic()
        begin_time = begin_time or now
        reports = _run_part(
            dome, part, partial(progress, "repeat" if attempt else "capture")
        )
        run.stopped = reports.stopped
        reports.shift(round(1e6 * (now - begin_time)))
        _collect(run, cameras, remaining, part, reports)
        missing = run.missing(cameras.ids)
        if run.stopped or not missing:
            break
        remaining = sorted(missing)
        run.notes.append(f"{_describe_missing(run, missing)}: repeated")
    if dome.link.damaged:
        run.notes.append(f"{dome.link.name}: {dome.link.damaged} damaged lines")
    run.faulty_lights = _faulty_lights(run)
    return run


def recover_run(
    dome: Dome, cameras: Cameras, schedule: Schedule, started: float
) -> DomeRun | None:
    """The part of a run that was finished when the process that drove it was killed.

    The watchdog of the controller has switched the lights off, and it still has the
    plan and the measured steps.

    Parameters
    ----------
    dome, cameras
        The devices.
    schedule, started
        The steps that ran, with their markers, and when they began [s since 1970].

    Returns
    -------
    DomeRun or None
        None if the controller does not hold this plan any more.
    """
    if not dome.holds(schedule):
        return None
    dome.stop()
    cameras.start(started)
    steps = tuple(step for step in schedule.steps if not step.marker)
    run = DomeRun(Schedule(steps), [None] * len(steps))
    reports = StepReports()
    reports.read(dome, schedule)
    _collect(run, cameras, range(len(steps)), schedule, reports)
    run.faulty_lights = _faulty_lights(run)
    return run


def _reason(error: BaseException) -> str:
    """Reason why a run ended, as a phrase within a message that has its own rule and cure."""
    if not isinstance(error, InputError):
        return "stopped by the operator"
    return "; ".join(
        f"{fault.where} {fault.rule}: {fault.found}" for fault in error.faults
    )


@dataclass
class StepReports:
    """What the controller reported of the steps of a part of a schedule."""

    measured: list[Measured] = field(default_factory=list)
    finished: int = 0  # number of finished steps
    stopped: str = ""  # reason if the part ended early
    # otherwise the controller may have continued after its last report
    complete: bool = True

    def read(self, dome: Dome, part: Schedule) -> None:
        """Read the missing reports, including that of an interrupted step."""
        self.finished = len(self.measured)
        try:
            self.finished = dome.state(len(part.steps)).step
            while len(self.measured) < min(self.finished + 1, len(part.steps)):
                self.measured.append(dome.report_step(part, len(self.measured)))
        except DeviceError as error:
            reported = len(self.measured)
            if isinstance(error, RefusedError) and reported == self.finished:
                return  # the step after the last one did not begin
            self.finished = min(self.finished, reported)
            self.stopped = self.stopped or _reason(error)
            self.complete = False

    def shift(self, since: int) -> None:
        """Count the times from an earlier start, by so many microseconds."""
        self.measured = [
            replace(step, on_us=step.on_us + since, off_us=step.off_us + since)
            for step in self.measured
        ]


def _run_part(
    dome: Dome, part: Schedule, progress: Callable[[int, int], None]
) -> StepReports:
    """Run the steps that were uploaded and armed, and read what the controller reports."""
    reports = StepReports()
    try:
        state = dome.run(part, progress, reports.measured)
        if state.state == "stopped":
            reason = STOPPED.get(state.reason, state.reason)
            reports.stopped = f"{dome.link.name}: {reason}"
    except (DeviceError, KeyboardInterrupt) as error:
        reports.stopped = _reason(error)
    reports.read(dome, part)
    return reports


def _collect(
    run: DomeRun,
    cameras: Cameras,
    indices: Sequence[int],
    part: Schedule,
    reports: StepReports,
) -> None:
    """Assign frames to the finished steps of a part with markers, whose other steps have
    these indices in the schedule; steps without a trigger have no frame.

    If reports are missing, the steps without one may have been triggered.
    """
    reported = reports.measured
    run.is_reported = reports.complete
    index = iter(indices)
    # of the steps of the part that are no markers
    places = {i: next(index) for i, step in enumerate(part.steps) if not step.marker}
    lost = [i for i, measured in enumerate(reported) if measured.triggers == 0]
    ran = len(reported) if reports.complete else len(part.steps)
    while ran - 1 in lost:
        ran -= 1
    lost = [i for i in lost if i < ran]
    run.flashes = max(run.flashes, measured_flashes(part, reported))
    for i, measured in enumerate(reported[: reports.finished]):
        if i in places:
            run.measured[places[i]] = measured
    try:
        taken = cameras.collect(ran - len(lost))
    except InputError as error:  # such as a folder that is gone
        run.stopped = run.stopped or _reason(error)
        return
    run.problems = []
    for camera, shots in taken.items():
        frames, problems = identify_frames(shots, part.steps[:ran], lost)
        run.problems += [f"camera {camera}: {problem}" for problem in problems]
        run.frames |= {
            (camera, places[i]): path
            for i, path in frames.items()
            if i < reports.finished
        }


def forget_faulty_steps(run: DomeRun) -> None:
    """Discard the frames of lights that failed, and all frames after a light stayed on,
    so that they are repeated.
    """
    measured = [
        (i, report) for i, report in enumerate(run.measured) if report is not None
    ]
    since = (i for i, report in measured if not report.rest <= MAX_REST)
    stuck = next(since, 0 if DARK in run.faulty_lights else len(run.measured))
    for i, step in enumerate(run.schedule.steps):
        if i >= stuck or step.light in run.faulty_lights:
            run.forget(i)


def require_complete(run: DomeRun, cameras: Sequence[str]) -> None:
    """Refuse a capture that lacks frames or in which lights failed, while the subject
    is still seated.

    Raises
    ------
    InputError
        With the frames to repeat, the lights that failed, and why the sequence was stopped.
    """
    cure = (
        "keep the subject or target in place and run the capture again; it resumes with the "
        "missing steps"
    )
    faults = list[Fault]()
    if run.stopped:
        faults.append(Fault("capture", "must run to its end", run.stopped, cure))
    elif lost := run.missing(cameras):
        rule = "every step must have a frame of every camera"
        faults.append(Fault("capture", rule, _describe_missing(run, lost), cure))
    for light, failure in run.faulty_lights.items():
        rule = (
            "all lights must be off"
            if light == DARK
            else "must be as bright as the others"
        )
        cure = "repair the light, and run the capture again; it repeats the frames of that light"
        faults.append(
            Fault(
                "dark frame" if light == DARK else f"light {light}", rule, failure, cure
            )
        )
    require_none(faults)


def _describe_missing(run: DomeRun, lost: Mapping[int, Sequence[str]]) -> str:
    """Number of missing frames, the first of them, and why they were not identified."""
    names = [
        f"{run.schedule.steps[i].name} camera {camera}"
        for i, cameras in lost.items()
        for camera in cameras
    ]
    reasons = few_names(run.problems, separator="; ")
    reasons = f" ({reasons})" if reasons else ""
    return f"{len(names)} missing frames: {few_names(names, 5, '; ')}{reasons}"


def _faulty_lights(run: DomeRun) -> dict[str, str]:
    """Lights with a wrong current or duration, with a description."""
    faulty = dict[str, str]()
    steady = 0.0  # current of a light that stayed on
    for step, measured in zip(run.schedule.steps, run.measured, strict=True):
        if measured is None:
            continue
        error = abs((measured.off_us - measured.on_us) - (step.off_us - step.on_us))
        level = measured.level - steady
        # the steps after it show the same light
        if not measured.rest <= MAX_REST and not steady:
            steady = measured.rest
            text = f"{measured.rest:.0%} of the current of a light after it was switched off"
            faulty.setdefault(step.light, text)
        elif step.light == DARK and not level <= MAX_REST:
            faulty.setdefault(
                DARK, f"{level:.0%} of the current of a light in a dark frame"
            )
        elif step.light != DARK and not MIN_LEVEL <= level <= MAX_LEVEL:
            faulty.setdefault(
                step.light, f"{measured.level:.0%} of its nominal current"
            )
        elif not error <= MAX_TIME_ERROR_US:
            faulty.setdefault(
                step.light, f"a duration that differs by {error} us from the plan"
            )
    return faulty


@dataclass(frozen=True)
class SiteRun:
    """Record and frames of one placement of the probe."""

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
    """Measure one site once.

    Parameters
    ----------
    probe, camera
        The devices.
    site
        Name of the site.
    exposures, pressure, progress
        As in `Probe.measure`.

    Raises
    ------
    PlacementError
        If the probe leaks or its camera lacks frames; the site must then be measured again.
    InputError
        If the probe does not answer, or sends what cannot be right.
    """
    camera.start()
    placement = probe.measure(exposures, pressure=pressure, progress=progress)
    [(name, shots)] = camera.collect(len(exposures)).items()
    triggers = sum(placement.triggers.values())
    problem = (
        f"{len(shots)} frames for {triggers} triggers and {len(exposures)} exposures"
    )
    if len(shots) == triggers == len(exposures):
        problem = exposures_problem(shots, [*exposures])
    if problem:
        raise PlacementError(
            Fault(
                f"camera {name}",
                "must take a frame of every exposure",
                problem,
                f"measure {site} again",
            )
        )
    paths = (shot.path for shot in shots)
    return SiteRun(site, placement, dict(zip(exposures, paths, strict=True)))
