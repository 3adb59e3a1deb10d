"""A session as a capture folder (docs/capture_format.md, version 2), also if it did not come to its end."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from skindb.errors import Fault, InputError
from skindb.hw.sequence import DARK, Schedule, sequence_entries
from skindb.hw.session import DomeRun, SiteRun
from skindb.ingest.frames import FrameKind, frame_size, read_frame
from skindb.ingest.json_file import read_json

FRAMES = "dome/frames/{exposure}/{light}_{camera}"  # and the suffix of the files
SITE_FRAMES = "contact/{site}/{exposure}"
UNFINISHED = "unfinished.json"  # steps that were driven so far; removed when the capture is complete


@dataclass(frozen=True)
class Subject:
    """What capture.json says of the subject."""

    subject: str
    session: str
    consent: Mapping[str, Any]
    condition: str = "normal"
    traits: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Setup:
    """The laboratory as it was calibrated: a folder with dome/dome.json, its white frames, and contact/probe.json."""

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
        return {} if self.probe is None else {str(one["id"]): float(one["seconds"]) for one in self.probe["exposures"]}


def read_setup(folder: Path) -> Setup:
    """Read a set-up.

    Raises
    ------
    InputError
        If a file is missing, or no JSON object with lights, cameras and exposures.
    """
    faults = list[Fault]()
    dome = read_json(folder / "dome/dome.json", faults)
    there = (folder / "contact/probe.json").is_file()
    probe = read_json(folder / "contact/probe.json", faults) if there else None
    for name, record, keys in (("dome/dome.json", dome, ("cameras", "lights", "exposures")),
                               ("contact/probe.json", probe, ("exposures", "fibres"))):  # fmt: skip
        for key in keys if record is not None else ():
            items = record.get(key) if isinstance(record, dict) else None
            if not isinstance(items, list) or not items or not all(isinstance(i, dict) and "id" in i for i in items):
                rule = "must be a list of objects with an id"
                faults.append(Fault(f"{folder / name}[{key}]", rule, "something else", "see docs/hardware.md"))
    if faults or not isinstance(dome, dict):
        raise InputError(faults or [Fault(str(folder), "must hold dome/dome.json", "nothing", "see docs/hardware.md")])
    return Setup(folder, dome, probe if isinstance(probe, dict) else None)


def driven_steps(out: Path) -> list[dict[str, Any]]:
    """The entries of the steps of an unfinished capture, none of a new one.

    Raises
    ------
    InputError
        If the folder holds something else.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return []
    faults = list[Fault]()
    note = read_json(out / UNFINISHED, faults) if (out / UNFINISHED).is_file() else None
    if not isinstance(note, dict):
        rule, cure = "a capture is written into a new folder, or into that of an unfinished one", "choose another"
        raise InputError(faults or [Fault(str(out), rule, "something else", cure)])
    return list(note["sequence"])


def remaining(schedule: Schedule, entries: Sequence[Mapping[str, Any]]) -> Schedule:
    """The steps of a schedule that are not among these entries."""
    done = {(entry["light"], entry["exposure"]) for entry in entries}
    return schedule.only(i for i, step in enumerate(schedule.steps) if (step.light, step.exposure) not in done)


def keep_frames(out: Path, run: DomeRun, cameras: Sequence[str], before: Sequence[Mapping[str, Any]]) -> str:
    """Copy the frames of complete steps, and note them in `unfinished.json`; the template of the frames."""
    missing, entries = run.missing(cameras), list(before)
    offset = max((float(entry["t_off"]) for entry in before), default=0.0)
    suffix = next((path.suffix for path in run.frames.values()), ".png")
    for i, step in enumerate(run.schedule.steps):
        if i in missing or step.light == DARK:
            continue
        for camera in cameras:
            name = FRAMES.format(exposure=step.exposure, light=step.light, camera=camera)
            _copy(run.frames[camera, i], out / f"{name}{suffix}")
        [entry] = sequence_entries([step], [run.measured[i]])
        entries.append(entry | {key: entry[key] + offset for key in ("t_on", "t_off")})
    _keep_dark_frames(out, run, cameras, suffix)
    out.mkdir(parents=True, exist_ok=True)
    _dump(out / UNFINISHED, {"sequence": sorted(entries, key=lambda entry: float(entry["t_on"]))})
    return f"{FRAMES}{suffix}"


def _keep_dark_frames(out: Path, run: DomeRun, cameras: Sequence[str], suffix: str) -> None:
    """The first dark frame of every exposure and camera; the last ones only show that no light stays on."""
    for i, step in enumerate(run.schedule.steps):
        for camera in cameras if step.light == DARK else ():
            target = out / f"dome/dark/{step.exposure}_{camera}{suffix}"
            if (camera, i) in run.frames and not target.exists():
                _copy(run.frames[camera, i], target)


def write_capture(
    out: Path,
    setup: Setup,
    subject: Subject,
    sites: Sequence[SiteRun],
    *,
    files: Mapping[str, Path],
    template: str,
    override: Mapping[str, Any] | None = None,
) -> None:
    """Complete a capture folder whose frames of the dome are there.

    Parameters
    ----------
    out
        Folder.
    setup
        Its devices; white frames are copied from it.
    subject
        Whom it shows.
    sites
        What the probe measured.
    files
        "mesh", and perhaps "landmarks" and "regions" -> file.
    template
        Of the frames of the dome, from `keep_frames`.
    override
        Confirmation of the operator that was recorded.
    """
    entries = driven_steps(out)
    record: dict[str, Any] = {"format": "skindb-capture", "version": 2, "subject": subject.subject}
    record |= {"session": subject.session, "condition": subject.condition, "traits": dict(subject.traits)}
    record |= {"consent": dict(subject.consent), "dome": "dome/dome.json"}
    record |= {"override": dict(override)} if override else {}
    for key, path in files.items():
        name = f"scan{path.suffix}" if key == "mesh" else f"{key}{path.suffix}"
        _copy(path, out / name)
        record[key] = name
    dome = {key: value for key, value in setup.dome.items() if key not in ("frames", "dark", "sequence")}
    suffix = Path(template).suffix
    dark = f"dome/dark/{{exposure}}_{{camera}}{suffix}"
    has_dark = all((out / dark.format(exposure=e, camera=c)).is_file() for e in setup.exposures for c in setup.cameras)
    dome |= {"frames": template, "sequence": entries, "dark": dark if has_dark else None}
    _copy_white(setup, out)
    _dump(out / "dome/dome.json", dome)
    if sites and setup.probe is not None:
        _write_probe(out, setup.probe, sites)
        record["contact"] = "contact/probe.json"
    _dump(out / "capture.json", record)
    (out / UNFINISHED).unlink()


def _write_probe(out: Path, probe: Mapping[str, Any], sites: Sequence[SiteRun]) -> None:
    names = list(dict.fromkeys(site.site for site in sites))
    several = len(sites) > len(names)
    placements: dict[str, list[str]] = {name: [] for name in names}
    pressure: dict[str, Any] = {name: {} for name in names}
    suffix = next(iter(sites[0].frames.values())).suffix
    template = f"{SITE_FRAMES}-{{placement}}{suffix}" if several else f"{SITE_FRAMES}{suffix}"
    for one in sites:
        number = str(len(placements[one.site]) + 1)
        placements[one.site].append(number)
        log = np.round(one.placement.pressure, 4).tolist()
        pressure[one.site] = {**pressure[one.site], number: log} if several else log
        for exposure, path in one.frames.items():
            name = template.format(site=one.site, exposure=exposure, placement=number)
            _copy(path, out / name)
    record = {key: value for key, value in probe.items() if key not in ("frames", "sites", "pressure", "placements")}
    record |= {"sites": names, "frames": template, "pressure": pressure}
    _dump(out / "contact/probe.json", record | ({"placements": placements} if several else {}))


def _copy_white(setup: Setup, out: Path) -> None:
    """Frames of the white target belong to the set-up; every capture keeps its own copy."""
    white = setup.dome.get("white")
    if isinstance(white, dict) and isinstance(white.get("frames"), str):
        top = Path(white["frames"].split("{")[0]).parts[:2]
        if top and ".." not in top:
            shutil.copytree(setup.folder.joinpath(*top), out.joinpath(*top), dirs_exist_ok=True)


def _copy(path: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)


def _dump(path: Path, record: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1), encoding="utf-8")


def hot_pixels(path: Path, white: float, bits: int) -> int:
    """Pixels of a dark frame at half the white level or above in any channel: they belong to no skin."""
    size = frame_size(path)
    if size is None:
        return 0
    frame = read_frame(path, FrameKind(*size, bits))
    return int((frame >= white / 2).any(axis=-1).sum())
