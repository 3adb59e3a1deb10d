"""Writing a session, complete or interrupted, as a capture folder
(docs/capture_format.md, version 2).
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from skindb.errors import Fault, InputError, system_fault
from skindb.format.fields import read_json
from skindb.format.frames import (
    Frame,
    FrameKind,
    frame_size,
    is_linear,
    read_frame,
    write_frame,
)
from skindb.hw.probe import Reading
from skindb.hw.safety import partial_schedule
from skindb.hw.sequence import DARK, Schedule, sequence_entry
from skindb.hw.session import DomeRun, SiteRun
from skindb.hw.unfinished import UNFINISHED, Unfinished, digest

FRAMES = "dome/frames/{exposure}/{light}_{camera}"  # without the suffix of the files
SITE_FRAMES = "contact/{site}/{exposure}-{placement}"
FAILED_PLACEMENTS = "contact/failed_placements.jsonl"  # one JSON object on each line


@dataclass(frozen=True)
class Subject:
    """Metadata of the subject in capture.json."""

    subject: str
    session: str
    consent: Mapping[str, Any]
    condition: str = "normal"
    traits: Mapping[str, Any] = field(default_factory=dict)
    calibration: str = ""  # name of the calibration that ingest reads from the database
    virtual: str = ""  # virtual subject of a rehearsal; empty in a real session


@dataclass(frozen=True)
class Setup:
    """The calibrated laboratory: a folder with dome/dome.json, its white frames, and
    contact/probe.json.
    """

    folder: Path
    dome: Mapping[str, Any]
    probe: Mapping[str, Any] | None

    @property
    def cameras(self) -> tuple[str, ...]:
        """Ids of the cameras."""
        return tuple(str(camera["id"]) for camera in self.dome["cameras"])

    @property
    def lights(self) -> tuple[str, ...]:
        """Ids of the lights."""
        return tuple(str(light["id"]) for light in self.dome["lights"])

    @property
    def exposures(self) -> dict[str, float]:
        """Id of an exposure of the dome -> seconds."""
        return {str(one["id"]): float(one["seconds"]) for one in self.dome["exposures"]}

    @property
    def brackets(self) -> dict[str, float]:
        """Id of an exposure of the probe -> seconds."""
        return (
            {}
            if self.probe is None
            else {
                str(one["id"]): float(one["seconds"]) for one in self.probe["exposures"]
            }
        )


def read_setup(folder: Path) -> Setup:
    """Read the folder of a set-up.

    Raises
    ------
    InputError
        If a file is missing or is not a JSON object with lights, cameras and exposures.
    """
    faults = list[Fault]()
    dome = read_json(folder / "dome/dome.json", faults)
    has_probe = (folder / "contact/probe.json").is_file()
    probe = read_json(folder / "contact/probe.json", faults) if has_probe else None
    for name, record, keys in (
        ("dome/dome.json", dome, ("cameras", "lights", "exposures")),
        ("contact/probe.json", probe, ("exposures", "fibres")),
    ):
        for key in keys if record is not None else ():
            items = record.get(key) if isinstance(record, dict) else None
            if (
                not isinstance(items, list)
                or not items
                or not all(isinstance(i, dict) and "id" in i for i in items)
            ):
                rule = "must be a list of objects with an id"
                faults.append(
                    Fault(
                        f"{folder / name}[{key}]",
                        rule,
                        "something else",
                        "see docs/howto/capture.md",
                    )
                )
    if faults or not isinstance(dome, dict):
        raise InputError(
            faults
            or [
                Fault(
                    str(folder),
                    "must contain dome/dome.json",
                    "no such file",
                    "see docs/howto/capture.md",
                )
            ]
        )
    return Setup(folder, dome, probe if isinstance(probe, dict) else None)


def identity(setup: Setup, subject: Subject, base: int) -> dict[str, Any]:
    """Record that must be the same in all sessions of a capture; `base` is the
    brightness of the steady lamp.
    """
    return {
        "subject": subject.subject,
        "condition": subject.condition,
        "consent": dict(subject.consent),
        "set-up": digest(setup.dome, setup.probe),
        "steady lamp": base,
    } | ({"virtual subject": subject.virtual} if subject.virtual else {})


def require_space(folder: Path, setup: Setup, steps: int) -> None:
    """Raise `InputError` with the needed and free space if the uncompressed frames do
    not fit on the disk.
    """
    pixels = sum(
        int(camera["width"]) * int(camera["height"]) for camera in setup.dome["cameras"]
    )
    needed = steps * pixels * 3 * 2  # bytes of three channels of 16 bits
    free = shutil.disk_usage(folder).free
    if free < needed:
        rule = f"{steps} steps of {len(setup.cameras)} cameras need up to {needed / 1e9:.1f} GB"
        raise InputError(
            Fault(
                str(folder),
                rule,
                f"{free / 1e9:.1f} GB free",
                "free some space, or choose another disk",
            )
        )


def remaining_schedule(
    schedule: Schedule, entries: Sequence[Mapping[str, Any]]
) -> Schedule:
    """Steps of a schedule that are not among these entries, with the intervals of the schedule."""
    complete = {(entry["light"], entry["exposure"]) for entry in entries}
    remaining = [
        i
        for i, step in enumerate(schedule.steps)
        if (step.light, step.exposure) not in complete
    ]
    return partial_schedule(schedule, remaining)


def keep_frames(session: Unfinished, run: DomeRun, setup: Setup) -> None:
    """Copy the frames of complete steps, and record them in `unfinished.json`."""
    cameras = setup.cameras
    entries = session.sequence
    missing = run.missing(cameras)
    offset = max((float(entry["t_off"]) for entry in entries), default=0.0)
    suffix = next((path.suffix for path in run.frames.values()), ".png")
    added = []
    for i, (step, measured) in enumerate(
        zip(run.schedule.steps, run.measured, strict=True)
    ):
        if i in missing or measured is None or step.light == DARK:
            continue
        for camera in cameras:
            name = FRAMES.format(
                exposure=step.exposure, light=step.light, camera=camera
            )
            _copy(run.frames[camera, i], session.folder / f"{name}{suffix}")
        entry = sequence_entry(step, measured)
        added.append(entry | {key: entry[key] + offset for key in ("t_on", "t_off")})
    bits = {
        str(camera_record["id"]): int(camera_record.get("bit_depth", 16))
        for camera_record in setup.dome["cameras"]
    }
    _keep_dark_frames(session.folder, run, cameras, suffix, bits)
    session.sequence = sorted(
        [*entries, *added], key=lambda entry: float(entry["t_on"])
    )
    session.save()


def keep_site(session: Unfinished, run: SiteRun, number: int) -> None:
    """Copy the frames of one placement of the probe, and record it in `unfinished.json`."""
    suffix = next(iter(run.frames.values())).suffix
    for exposure, path in run.frames.items():
        _copy(
            path,
            session.folder
            / f"{SITE_FRAMES.format(site=run.site, exposure=exposure, placement=number)}{suffix}",
        )
    placement = run.placement
    entry = {
        "site": run.site,
        "number": number,
        "suffix": suffix,
        "drift_kpa": placement.drift,
    }
    entry |= {
        "pressure": np.round(placement.pressure, 4).tolist(),
        "lost_readings": placement.lost_readings,
    }
    session.sites.append(entry)
    session.save()


def keep_failed_placement(
    session: Unfinished,
    site: str,
    number: int,
    error: InputError,
    readings: Sequence[Reading],
) -> None:
    """Record a failed placement of the probe with its readings of the gauge."""
    path = session.folder / FAILED_PLACEMENTS
    entry = {"site": site, "number": number, "reason": str(error)}
    entry |= {"pressure": np.round(readings, 4).tolist()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as problem:
        raise InputError([*error.faults, system_fault(problem, str(path))]) from None


def _keep_dark_frames(
    out: Path,
    run: DomeRun,
    cameras: Sequence[str],
    suffix: str,
    bits: Mapping[str, int],
) -> None:
    """Write the mean of the dark frames of every exposure and camera.

    The last dark frame is excluded: it only shows whether a light stayed on.
    """
    last_step = len(run.schedule.steps) - 1
    for camera in cameras:
        by_exposure = dict[str, list[Path]]()
        for i, step in enumerate(run.schedule.steps):
            if (
                step.light == DARK
                and (camera, i) in run.frames
                and (i < last_step or not by_exposure)
            ):
                by_exposure.setdefault(step.exposure, []).append(run.frames[camera, i])
        for exposure, paths in by_exposure.items():
            target = out / f"dome/dark/{exposure}_{camera}{suffix}"
            if not target.exists():
                _write_mean(paths, target, bits[camera])


def _write_mean(paths: Sequence[Path], target: Path, bits: int) -> None:
    """Write the mean of those frames that can be decoded."""
    size = frame_size(paths[0])
    if len(paths) == 1 or size is None or is_linear(paths[0]):
        _copy(paths[0], target)
        return
    frames = list[Frame]()
    for path in paths:
        with suppress(InputError):
            frames.append(read_frame(path, FrameKind(*size, bits)))
    if frames:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_frame(target, np.rint(np.mean(frames, axis=0)).astype(frames[0].dtype))


def write_capture(
    session: Unfinished, setup: Setup, subject: Subject, *, files: Mapping[str, Path]
) -> None:
    """Write the records of a capture folder that already has its frames, and remove its
    `unfinished.json`.

    Parameters
    ----------
    session
        Completed steps and placements.
    setup
        The set-up, from which the white frames are copied.
    subject
        Metadata of the subject.
    files
        "mesh", and optionally "landmarks" and "regions" -> file.
    """
    out = session.folder
    record: dict[str, Any] = capture_record(subject)
    record |= {"dome": "dome/dome.json"} | (
        {"override": session.override} if session.override else {}
    )
    if subject.virtual:
        flashes = session.flashes_per_second
        record["rehearsal"] = {"person_present": False, "flashes_per_second": flashes}
    for key, path in files.items():
        name = f"scan{path.suffix}" if key == "mesh" else f"{key}{path.suffix}"
        _copy(path, out / name)
        record[key] = name
    dome = {
        key: value
        for key, value in setup.dome.items()
        if key not in ("frames", "dark", "sequence")
    }
    suffix = next((out / "dome/frames").glob("*/*")).suffix
    dark = f"dome/dark/{{exposure}}_{{camera}}{suffix}"
    has_dark = all(
        (out / dark.format(exposure=e, camera=c)).is_file()
        for e in setup.exposures
        for c in setup.cameras
    )
    dome |= {
        "frames": f"{FRAMES}{suffix}",
        "sequence": session.sequence,
        "dark": dark if has_dark else None,
    }
    dome |= {"steady_lamp": session.lamp} if session.lamp else {}
    _copy_white(setup, out)
    _dump(out / "dome/dome.json", dome)
    if session.sites and setup.probe is not None:
        _write_probe(session, setup.probe)
        record["contact"] = "contact/probe.json"
    _dump(out / "capture.json", record)
    (out / UNFINISHED).unlink()


def capture_record(subject: Subject) -> dict[str, Any]:
    """Content of capture.json that describes the subject."""
    record = {
        "format": "skindb-capture",
        "version": 2,
        "subject": subject.subject,
        "session": subject.session,
    }
    record |= {
        "condition": subject.condition,
        "traits": dict(subject.traits),
        "consent": dict(subject.consent),
    }
    record |= {"calibration": subject.calibration} if subject.calibration else {}
    return record | ({"virtual": True} if subject.virtual else {})


def _write_probe(session: Unfinished, probe: Mapping[str, Any]) -> None:
    sites = dict.fromkeys(str(entry["site"]) for entry in session.sites)
    placements = {
        site: [entry for entry in session.sites if entry["site"] == site]
        for site in sites
    }
    record = {
        key: value
        for key, value in probe.items()
        if key not in ("frames", "sites", "pressure", "placements")
    }
    record |= {
        "sites": list(sites),
        "frames": f"{SITE_FRAMES}{session.sites[0]['suffix']}",
        "placements": {
            site: [str(entry["number"]) for entry in entries]
            for site, entries in placements.items()
        },
        "pressure": {
            site: {str(entry["number"]): entry["pressure"] for entry in entries}
            for site, entries in placements.items()
        },
    }
    _dump(session.folder / "contact/probe.json", record)


def _copy_white(setup: Setup, out: Path) -> None:
    """Copy the frames of the white target from the set-up, so that every capture has its own."""
    white = setup.dome.get("white")
    if isinstance(white, dict) and isinstance(white.get("frames"), str):
        top = Path(white["frames"].split("{")[0]).parts[:2]
        if top and ".." not in top:
            shutil.copytree(
                setup.folder.joinpath(*top), out.joinpath(*top), dirs_exist_ok=True
            )


def _copy(path: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)


def _dump(path: Path, record: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1), encoding="utf-8")


def count_hot_pixels(path: Path, white: float, bits: int) -> int:
    """Number of pixels of a dark frame that reach half the white level in any channel."""
    size = frame_size(path)
    if size is None:
        return 0
    frame = read_frame(path, FrameKind(*size, bits))
    return int((frame >= white / 2).any(axis=-1).sum())
