"""Capture of a subject with dome and probe into the folder that `skindb ingest` reads."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError, few_names, input_error, require_none
from skindb.hw.brightness import failed_lights
from skindb.hw.cameras import Cameras
from skindb.hw.capture_folder import (
    Setup,
    Subject,
    Unfinished,
    identity,
    keep_frames,
    keep_site,
    open_unfinished,
    remaining_schedule,
    require_space,
    write_capture,
)
from skindb.hw.dome import Dome
from skindb.hw.frame_markers import marker_light, with_markers
from skindb.hw.probe import PRESSURE_KPA, PlacementError, Probe
from skindb.hw.sequence import (
    DARK,
    MAX_FLASHES,
    Override,
    Rehearsal,
    Schedule,
    plan_schedule,
    rehearsal_notes,
    require_safe,
    slowed_schedule,
)
from skindb.hw.session import (
    DomeRun,
    capture_dome,
    capture_site,
    forget_faulty_steps,
    recover_run,
    require_complete,
    with_dark_frames,
)
from skindb.types import Progress, silent

ATTEMPTS = 3  # to measure a site; if all fail, a device is broken


@dataclass(frozen=True)
class Devices:
    """Connected devices; a capture without a probe has no profiles."""

    dome: Dome
    cameras: Cameras
    probe: Probe | None = None
    probe_camera: Cameras | None = None


@dataclass(frozen=True)
class CapturePlan:
    """Settings of a capture."""

    # length of the sequence; by default as short as the exposures allow
    seconds: float | None = None
    # whether the sequence is slowed down until nobody needs to be screened
    slow: bool = False
    sites: tuple[str, ...] = ()  # sites that the probe measures
    placements: int = 1  # number of placements of the probe at each site
    pressure: float = PRESSURE_KPA  # kPa, of the gauge


def planned_schedule(setup: Setup, plan: CapturePlan) -> Schedule:
    """Schedule of all lights and exposures of a set-up, between dark frames.

    Raises
    ------
    InputError
        If the sequence cannot be completed in the wanted time.
    """
    exposures = setup.dome.exposures
    schedule = plan_schedule(setup.dome.light_ids, exposures, seconds=plan.seconds)
    if plan.slow:
        schedule = slowed_schedule(schedule)
        shortest = slowed_schedule(
            plan_schedule(setup.dome.light_ids, exposures)
        ).seconds
        if plan.seconds is not None and plan.seconds < shortest:
            raise input_error(
                "sequence",
                f"with at most {MAX_FLASHES} flashes in a second the sequence lasts at "
                f"least {shortest:.1f} s",
                f"{plan.seconds:g} s",
                "allow more time, or omit --slower",
            )
    return with_dark_frames(schedule)


def run_capture(
    out: Path,
    setup: Setup,
    subject: Subject,
    devices: Devices,
    plan: CapturePlan,
    *,
    files: Mapping[str, Path],
    override: Override | Rehearsal | None = None,
    place: Callable[[str, int], None] = lambda _site, _number: None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Photograph a subject, measure sites with the probe, and write the capture folder.

    If a capture is interrupted, its complete steps are kept, and the same call resumes
    with the remaining ones.

    Parameters
    ----------
    out
        Folder of the capture: a new one, or that of an unfinished capture.
    setup, subject, devices, plan
        The calibrated laboratory, the subject, the connected devices, and the settings.
    files
        "mesh", and optionally "landmarks" and "regions" -> file.
    override
        Confirmation of an operator for more than three flashes in a second, or a rehearsal.
    place
        Called with site and number before each placement of the probe; returns when the
        probe is in place.
    progress
        Called with the stage, the steps done and the steps in all.

    Returns
    -------
    dict
        Report with the numbers of steps and frames, the duration, figures of safety, and notes.

    Raises
    ------
    InputError
        If frames are missing or a light failed after all repeats (what was captured is
        kept), or if the folder holds an unfinished capture of another subject or under
        other conditions.
    """
    require_devices(setup, devices, plan)
    session = open_unfinished(out, identity(setup, subject))
    schedule = planned_schedule(setup, plan)
    light = marker_light(setup.dome)
    notes = _keep_interrupted(session, setup, devices)
    remaining = (
        remaining_schedule(schedule, session.sequence) if session.sequence else schedule
    )
    run = None
    if any(step.light != DARK for step in remaining.steps):
        require_space(out, setup, len(remaining.steps))
        if isinstance(override, Rehearsal):
            notes += rehearsal_notes(remaining, override)
        run = _run_lights(session, devices, remaining, light, override, progress)
        _keep_run(session, run, setup)
        require_complete(run, setup.dome.camera_ids)
        notes += run.notes
    notes += _measure_sites(session, setup, devices, plan, place, progress)
    write_capture(session, setup, subject, files=files)
    return _report(session, schedule, light, run, notes)


def _run_lights(
    session: Unfinished,
    devices: Devices,
    remaining: Schedule,
    light: str,
    override: Override | Rehearsal | None,
    progress: Progress,
) -> DomeRun:
    """Run the remaining steps; the flashes and their confirmation are recorded before."""
    assessment = require_safe(remaining, override)
    confirmed = None
    if isinstance(override, Override) and not assessment.safe:
        confirmed = override.recorded(assessment)
    before = replace(session)
    session.count(assessment.flashes_per_second, confirmed)
    clock = devices.dome.link.clock
    try:
        run = capture_dome(
            devices.dome,
            devices.cameras,
            remaining,
            marker_light=light,
            override=override,
            begin=lambda part: session.begin_run(part, clock.time()),
            progress=progress,
        )
    except InputError:  # nothing was lit
        before.save()
        raise
    if run.flashes > assessment.flashes_per_second:
        session.count(run.flashes, confirmed)
        planned = f"{assessment.flashes_per_second} were planned"
        run.notes.append(
            f"the controller flashed {run.flashes} times in a second, and {planned}"
        )
    return run


def _keep_run(session: Unfinished, run: DomeRun, setup: Setup) -> None:
    """Keep the complete steps of a run whose lights did not fail."""
    failed = failed_lights(run.schedule, run.frames, setup.dome)
    run.faulty_lights = failed | run.faulty_lights
    forget_faulty_steps(run)
    if run.is_reported:
        session.running = None
    keep_frames(session, run, setup)


def _keep_interrupted(session: Unfinished, setup: Setup, devices: Devices) -> list[str]:
    """Keep the steps that were complete when an earlier process was killed; returns notes."""
    interrupted = session.interrupted_run()
    if interrupted is None:
        return []
    run = recover_run(devices.dome, devices.cameras, *interrupted)
    before = len(session.sequence)
    if run is None:
        session.running = None
        session.save()
        return [
            "the controller has forgotten the sequence that was interrupted; all "
            "of its steps were repeated"
        ]
    _keep_run(session, run, setup)
    return [
        f"{len(session.sequence) - before} steps were kept from the sequence that was interrupted"
    ]


def require_devices(setup: Setup, devices: Devices, plan: CapturePlan) -> None:
    """Require every light and camera of a set-up, and a probe if the plan has sites."""
    faults = []
    dome = devices.dome
    for where, kind, needed, present, cure in (
        (dome.link.name, "light", setup.dome.light_ids, dome.lights, "correct the ids"),
        (
            "cameras",
            "camera",
            setup.dome.camera_ids,
            devices.cameras.ids,
            "set up its folder",
        ),
    ):
        if missing := sorted(set(needed) - set(present)):
            rule = f"must have every {kind} of dome.json"
            faults.append(Fault(where, rule, f"no {kind} {few_names(missing)}", cure))
    if plan.sites and None in (devices.probe, devices.probe_camera, setup.probe):
        rule = "a probe, its camera and contact/probe.json must be present to measure sites"
        faults.append(
            Fault("probe", rule, "one of them missing", "connect it, or name no sites")
        )
    require_none(faults)


def _measure_sites(
    session: Unfinished,
    setup: Setup,
    devices: Devices,
    plan: CapturePlan,
    place: Callable[[str, int], None],
    report: Progress,
) -> list[str]:
    """Measure the placements of the probe that are missing.

    One that leaks or loses a frame is repeated; after any other failure of the probe, the session
    ends. Returns notes on those that were repeated.
    """
    notes = []
    complete = {(entry["site"], entry["number"]) for entry in session.sites}
    for site, number in product(plan.sites, range(1, plan.placements + 1)):
        for attempt in range(ATTEMPTS if (site, number) not in complete else 0):
            # `require_devices` asserts it
            assert devices.probe is not None
            assert devices.probe_camera is not None
            try:
                place(site, number)
                run = capture_site(
                    devices.probe,
                    devices.probe_camera,
                    site,
                    setup.brackets,
                    pressure=plan.pressure,
                    progress=partial(report, f"probe {site}"),
                )
                keep_site(session, run, number)
                break
            except KeyboardInterrupt:
                raise input_error(
                    "capture",
                    "must run to its end",
                    f"stopped by the operator at {site}, placement {number}",
                    "run the same command again; it resumes with this placement",
                ) from None
            except PlacementError as error:
                if attempt == ATTEMPTS - 1:
                    raise
                reason = "; ".join(map(str, error.faults))
                notes.append(f"{site}, placement {number}: measured again ({reason})")
    return notes


def _report(
    session: Unfinished,
    schedule: Schedule,
    light: str,
    run: DomeRun | None,
    notes: list[str],
) -> dict[str, Any]:
    return {
        "path": str(session.folder),
        "steps": len(schedule.steps),
        "frames": len(list((session.folder / "dome/frames").glob("*/*"))),
        "frames_of_this_session": 0 if run is None else len(run.frames),
        "seconds": with_markers(schedule, light).seconds,
        "flashes_per_second": session.flashes_per_second,
        "sites": sorted({entry["site"] for entry in session.sites}),
        "notes": notes,
    }
