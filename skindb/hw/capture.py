"""The whole capture of a subject: dome, probe, and the folder that `skindb ingest` reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skindb._types import Progress, silent
from skindb.errors import Fault, InputError
from skindb.hw.cameras import Cameras
from skindb.hw.capture_folder import (
    FRAMES,
    Setup,
    Subject,
    driven_steps,
    hot_pixels,
    keep_frames,
    remaining,
    write_capture,
)
from skindb.hw.dome import Dome
from skindb.hw.probe import PRESSURE_KPA, Probe
from skindb.hw.safety import Assessment, Override, assess, slower
from skindb.hw.sequence import DARK, Schedule, plan_schedule
from skindb.hw.session import DomeRun, SiteRun, capture_dome, capture_site, require_complete, with_dark_frames

ATTEMPTS = 3  # to measure a site, after which something is broken


@dataclass(frozen=True)
class Devices:
    """What is connected; a capture without a probe has no profiles."""

    dome: Dome
    cameras: Cameras
    probe: Probe | None = None
    probe_camera: Cameras | None = None


@dataclass(frozen=True)
class CapturePlan:
    """What to do."""

    seconds: float | None = None  # of the sequence; default as short as the exposures allow
    slow: bool = False  # so slow that nobody needs to be screened
    base: int = 0  # brightness of a steady lamp in units of one light
    sites: tuple[str, ...] = ()  # that the probe measures
    placements: int = 1  # of the probe on each
    pressure: float = PRESSURE_KPA


def planned_schedule(setup: Setup, plan: CapturePlan) -> Schedule:
    """All lights and exposures of a set-up, between dark frames."""
    found = plan_schedule(setup.lights, setup.exposures, seconds=plan.seconds)
    found = Schedule(found.steps, plan.base)
    return with_dark_frames(slower(found) if plan.slow else found)


def run_capture(
    out: Path,
    setup: Setup,
    subject: Subject,
    devices: Devices,
    plan: CapturePlan,
    *,
    files: Mapping[str, Path],
    override: Override | None = None,
    place: Callable[[str, int], None] = lambda _site, _number: None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Photograph and touch a subject, and write the capture folder.

    A capture that ended early keeps its complete steps; the same call continues with the others.

    Parameters
    ----------
    out
        Folder of the capture: new, or that of an unfinished one.
    setup, subject, devices, plan
        The laboratory as calibrated, whom it shows, what is connected, what to do.
    files
        "mesh", and perhaps "landmarks" and "regions" -> file.
    override
        Confirmation of an operator for more than three flashes in a second.
    place
        Called with site and number before each placement of the probe; returns when it is on.
    progress
        Called with the stage, the steps done and the steps in all.

    Returns
    -------
    dict
        Frames, seconds, safety, notes: what is worth knowing.

    Raises
    ------
    InputError
        If frames are missing or a light failed after all repeats; nothing of what was taken is lost.
    """
    _require_devices(setup, devices, plan)
    before = driven_steps(out)
    schedule = planned_schedule(setup, plan)
    left = remaining(schedule, before) if before else schedule
    run = None
    if any(step.light != DARK for step in left.steps):
        run = capture_dome(devices.dome, devices.cameras, left, override=override, progress=progress)
        template = keep_frames(out, run, setup.cameras, before)
        require_complete(run, setup.cameras)
    else:
        template = _template(out)
    sites = _measure_sites(setup, devices, plan, place, progress or silent)
    found = assess(schedule)
    recorded = None if override is None or found.safe else override.recorded(found)
    write_capture(out, setup, subject, sites, files=files, template=template, override=recorded)
    notes = [*([] if run is None else run.notes), *_hot_pixel_notes(out, setup)]
    notes += [f"{one.site}: {one.placement.lost_readings} readings of the gauge were lost" for one in sites
              if one.placement.lost_readings]  # fmt: skip
    return _report(out, schedule, found, run, sites, notes)


def _require_devices(setup: Setup, devices: Devices, plan: CapturePlan) -> None:
    faults = []
    if unknown := sorted(set(setup.lights) - set(devices.dome.lights)):
        rule, cure = "the controller must have every light of dome.json", "correct the ids, or the wiring"
        faults.append(Fault(devices.dome.link.name, rule, f"none of {', '.join(unknown[:5])}", cure))
    if unknown := sorted(set(setup.cameras) - set(devices.cameras.ids)):
        cure = "set up their folders"
        faults.append(Fault("cameras", "every camera of dome.json must deliver", f"no {', '.join(unknown[:5])}", cure))
    if plan.sites and (devices.probe is None or devices.probe_camera is None or setup.probe is None):
        rule, cure = "sites need a probe, its camera and contact/probe.json", "connect it, or name no sites"
        faults.append(Fault("probe", rule, "one of them is missing", cure))
    if faults:
        raise InputError(faults)


def _measure_sites(
    setup: Setup, devices: Devices, plan: CapturePlan, place: Callable[[str, int], None], tell: Progress
) -> list[SiteRun]:
    """All placements of the probe; one that leaks or loses a frame is placed again."""
    runs = list[SiteRun]()
    for site in plan.sites:
        for number in range(1, plan.placements + 1):
            for attempt in range(ATTEMPTS):
                place(site, number)
                try:
                    runs.append(_one_site(setup, devices, plan, site, tell))
                    break
                except InputError:
                    if attempt == ATTEMPTS - 1:
                        raise
    return runs


def _one_site(setup: Setup, devices: Devices, plan: CapturePlan, site: str, tell: Progress) -> SiteRun:
    if devices.probe is None or devices.probe_camera is None:  # `_require_devices` asserts it
        raise InputError(Fault("probe", "sites need a probe", "none", "connect it"))

    def advance(done: int, total: int) -> None:
        tell(f"probe {site}", done, total)

    options: dict[str, Any] = {"pressure": plan.pressure, "progress": advance}
    return capture_site(devices.probe, devices.probe_camera, site, setup.brackets, **options)


def _template(out: Path) -> str:
    """The template of frames that are all there: a session that ended before the probe did."""
    first = next((out / "dome/frames").glob("*/*"))
    return f"{FRAMES}{first.suffix}"


def _hot_pixel_notes(out: Path, setup: Setup) -> list[str]:
    notes = []
    for camera in setup.dome["cameras"]:
        bits = int(camera.get("bit_depth", 16))
        white = float(camera.get("white_level", 2**bits - 1))
        dark = sorted((out / "dome/dark").glob(f"*_{camera['id']}.*"))
        if count := max((hot_pixels(path, white, bits) for path in dark), default=0):
            notes.append(f"camera {camera['id']}: {count} hot pixels in its dark frame")
    return notes


def _report(
    out: Path, schedule: Schedule, found: Assessment, run: DomeRun | None, sites: list[SiteRun], notes: list[str]
) -> dict[str, Any]:
    return {
        "path": str(out),
        "steps": len(schedule.steps),
        "frames": 0 if run is None else len(run.frames),
        "seconds": schedule.seconds,
        "flashes_per_second": found.flashes_per_second,
        "luminance_step": found.luminance_step,
        "sites": {one.site: {"pressure_drift_kpa": one.placement.drift} for one in sites},
        "notes": notes,
    }
