"""Writing a session, complete or interrupted, as a capture folder (docs/capture_format.md,
version 2), with its lock, and with the file `unfinished.json` until it is complete.
"""

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from skindb.calibration.setup import PROBE_FILE, read_setup_dome
from skindb.errors import (
    Fault,
    InputError,
    add_filename,
    input_error,
    require,
    require_none,
)
from skindb.files import Attributes, Json, make_private, private_file
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.format.fields import Fields, read_json
from skindb.format.frames import (
    FrameKind,
    is_linear,
    read_exposures,
    read_frame,
    write_frame,
)
from skindb.hw.sequence import DARK, Schedule, Step, partial_schedule, sequence_entry
from skindb.hw.session import DomeRun, SiteRun
from skindb.limits import MAX_FIBRES

UNFINISHED = "unfinished.json"  # removed when the capture is complete
STEP_KEYS = {"light", "exposure", "t_on", "t_off", "trigger_count"}
SITE_KEYS = {"site", "number", "pressure", "suffix"}
FRAMES = "dome/frames/{exposure}/{light}_{camera}"  # without the suffix of the files
SITE_FRAMES = "contact/{site}/{exposure}-{placement}"


@dataclass
class Unfinished:
    """State of an unfinished capture; call `save` after every change."""

    folder: Path
    # values that must not change between the sessions of a capture
    identity: Json
    # complete steps, as dome.json keeps them
    sequence: list[Json] = field(default_factory=list)
    # complete placements of the probe
    sites: list[Json] = field(default_factory=list)
    # the confirmation for the session with the most flashes per second
    override: Json | None = None
    flashes_per_second: int = 0  # of the session with the most
    running: Json | None = None  # steps that are running, see `begin_run`

    @property
    def started(self) -> bool:
        """Whether the subject was photographed or measured; a session that was refused
        before has no subject.
        """
        recorded = self.sequence or self.sites or self.flashes_per_second
        folders = (self.folder / name for name in ("dome", "contact"))
        return bool(recorded) or any(folder.exists() for folder in folders)

    def save(self) -> None:
        """Replace the file atomically, so that a killed process leaves the old or the
        new content.
        """
        record = {name: value for name, value in vars(self).items() if name != "folder"}
        temporary = self.folder / f"{UNFINISHED}.new"
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(record, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self.folder / UNFINISHED)

    def count(self, flashes: int, override: Attributes | None) -> None:
        """Record, before a session begins, its flashes per second and their confirmation."""
        if flashes > self.flashes_per_second:
            self.flashes_per_second = flashes
            self.override = dict(override) if override is not None else self.override
        self.save()

    def begin_run(self, part: Schedule, now: float) -> None:
        """Record the steps that run from now on [s since 1970], in case this process is killed."""
        steps = [astuple(step) for step in part.steps]
        self.running = {"steps": steps, "started": now}
        self.save()

    def interrupted_run(self) -> tuple[Schedule, float] | None:
        """Steps that ran when the process was killed, and when they began [s since
        1970]; None without such a run.
        """
        if self.running is None:
            return None
        schedule = Schedule(tuple(Step(*step) for step in self.running["steps"]))
        return schedule, float(self.running["started"])


def open_unfinished(folder: Path, identity: Attributes) -> Unfinished:
    """Begin a capture in a new folder, or resume an unfinished one of the same subject.

    Parameters
    ----------
    folder
        Folder of the capture; created if it does not exist.
    identity
        Values of JSON types that must be the same in all sessions of a capture.

    Raises
    ------
    InputError
        If the folder has other contents, or a capture of another subject or under other conditions.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        folder.mkdir(parents=True, exist_ok=True)
        begun = Unfinished(folder, dict(identity))
        # also verifies that the folder is writable before any light is switched on
        begun.save()
        return begun
    path = folder / UNFINISHED
    faults = list[Fault]()
    note = read_json(path, faults) if path.is_file() else None
    require_none(faults)
    if note is None:
        text = (
            "a complete capture"
            if (folder / "capture.json").is_file()
            else "other files"
        )
        raise input_error(
            str(folder),
            "must be a new folder, or that of an unfinished capture",
            text,
            "choose another folder",
        )
    begun = _read(folder, path, note)
    if begun.started:
        _require_same(folder, begun.identity, identity)
    begun.identity = dict(identity)
    begun.save()
    return begun


def _read(folder: Path, path: Path, note: Any) -> Unfinished:
    try:
        begun = Unfinished(folder, **note)
        begun.interrupted_run()
        sound = isinstance(begun.identity, dict)
        sound &= all(step.keys() >= STEP_KEYS for step in begun.sequence)
        sound &= all(site.keys() >= SITE_KEYS for site in begun.sites)
    except (TypeError, ValueError, KeyError, AttributeError):
        sound = False
    require(
        sound,
        str(path),
        "must be the record of an unfinished capture",
        "other content",
        "choose another folder; the existing frames are kept",
    )
    return begun


def _require_same(folder: Path, before: Attributes, now: Attributes) -> None:
    """Refuse to mix subjects, or frames under different conditions."""
    faults = []
    for name in {**before, **now}:
        old, new = (
            json.dumps(record.get(name), sort_keys=True) for record in (before, now)
        )
        if old != new:
            faults.append(
                Fault(
                    str(folder),
                    f"an unfinished capture must be resumed with the same {name}",
                    f"{new}, and {old} before",
                    "give the earlier value, or choose another folder",
                )
            )
    require_none(faults)


def digest(*records: Any) -> str:
    """Short digest of the content of JSON records."""
    text = json.dumps(records, sort_keys=True)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]


@contextmanager
def one_session(out: Path) -> Iterator[None]:
    """Lock the folder of a capture; the system releases the lock however the session ends.

    Raises
    ------
    InputError
        If another session holds the lock, or the folder cannot be written to.
    """
    make_private(out.parent)
    path = out.parent / f".{out.name}.lock"
    with private_file(path).open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                # the other session ended between opening and locking
                raise FileNotFoundError
        except (BlockingIOError, FileNotFoundError):
            raise input_error(
                str(out),
                "only one session at a time may write into a folder",
                "another session",
                "wait until the other session has ended",
            ) from None
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


@dataclass(frozen=True)
class Subject:
    """Metadata of the subject in capture.json."""

    subject: str
    session: str
    consent: Attributes
    condition: str = "normal"
    traits: Attributes = field(default_factory=dict)
    calibration: str = ""  # name of the calibration that ingest reads from the database
    virtual: str = ""  # virtual subject of a rehearsal; empty in a real session


@dataclass(frozen=True)
class Setup:
    """The calibrated laboratory: a folder with dome/dome.json, its white frames, and
    contact/probe.json.
    """

    folder: Path
    dome: DomeRecord
    record: Attributes  # content of dome.json
    probe: Attributes | None  # content of probe.json
    brackets: Mapping[str, float]  # id of an exposure of the probe -> seconds


def read_setup(folder: Path) -> Setup:
    """Read the folder of a set-up; a session takes its own dark frames.

    Raises
    ------
    InputError
        With every fault of a file that ingest could not read.
    """
    dome = read_setup_dome(folder, white=False, dark=False)
    faults = list[Fault]()
    record = read_json(dome.file, faults)
    file = folder / PROBE_FILE
    probe = None
    brackets = {}
    if file.is_file() and (probe := read_json(file, faults)) is not None:
        fields = Fields(probe, str(file), faults)
        brackets = read_exposures(fields)
        fields.items("fibres", maximum=MAX_FIBRES)
    require_none(faults)
    return Setup(folder, dome, record, probe, brackets)


def identity(setup: Setup, subject: Subject) -> Json:
    """Record that must be the same in all sessions of a capture."""
    record = {
        "subject": subject.subject,
        "condition": subject.condition,
        "consent": dict(subject.consent),
        "set-up": digest(setup.record, setup.probe),
    }
    if subject.virtual:
        record["virtual subject"] = subject.virtual
    return record


def require_space(folder: Path, setup: Setup, steps: int) -> None:
    """Raise `InputError` with the needed and free space if the uncompressed frames do
    not fit on the disk.
    """
    pixels = sum(camera.width * camera.height for camera in setup.dome.cameras)
    needed = steps * pixels * 3 * 2  # bytes of three channels of 16 bits
    free = shutil.disk_usage(folder).free
    require(
        free >= needed,
        str(folder),
        f"{steps} steps of {len(setup.dome.cameras)} cameras need up to {needed / 1e9:.1f} GB",
        f"{free / 1e9:.1f} GB free",
        "free some space, or choose another disk",
    )


def remaining_schedule(schedule: Schedule, entries: Sequence[Attributes]) -> Schedule:
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
    cameras = setup.dome.camera_ids
    entries = session.sequence
    missing = run.missing(cameras)
    offset = max((float(entry["t_off"]) for entry in entries), default=0.0)
    suffix = next((path.suffix for path in run.frames.values()), ".png")
    added = []
    kept = {(entry["light"], entry["exposure"]) for entry in entries}
    for i, (step, measured) in enumerate(
        zip(run.schedule.steps, run.measured, strict=True)
    ):
        if i in missing or measured is None or step.light == DARK:
            continue
        if (step.light, step.exposure) in kept:
            continue
        for camera in cameras:
            name = FRAMES.format(
                exposure=step.exposure, light=step.light, camera=camera
            )
            copy_frame(run.frames[camera, i], session.folder / f"{name}{suffix}")
        entry = sequence_entry(step, measured)
        added.append(entry | {key: entry[key] + offset for key in ("t_on", "t_off")})
    _keep_dark_frames(session.folder, run, setup.dome.cameras, suffix)
    session.sequence = sorted(
        [*entries, *added], key=lambda entry: float(entry["t_on"])
    )
    session.save()


def keep_site(session: Unfinished, run: SiteRun, number: int) -> None:
    """Copy the frames of one placement of the probe, and record it in `unfinished.json`."""
    suffix = next(iter(run.frames.values())).suffix
    for exposure, path in run.frames.items():
        name = SITE_FRAMES.format(site=run.site, exposure=exposure, placement=number)
        copy_frame(path, session.folder / f"{name}{suffix}")
    entry = {
        "site": run.site,
        "number": number,
        "suffix": suffix,
        "pressure": np.round(run.placement.pressure, 4).tolist(),
    }
    session.sites.append(entry)
    session.save()


def _keep_dark_frames(
    out: Path,
    run: DomeRun,
    cameras: Sequence[CameraRecord],
    suffix: str,
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
                and (path := run.frames.get((camera.id, i)))
                and (i < last_step or not by_exposure)
            ):
                by_exposure.setdefault(step.exposure, []).append(path)
        for exposure, paths in by_exposure.items():
            target = out / f"dome/dark/{exposure}_{camera.id}{suffix}"
            if not target.exists():
                _write_mean(paths, target, camera.sensor.kind)


def _write_mean(paths: Sequence[Path], target: Path, kind: FrameKind) -> None:
    """Write the mean of those frames that can be decoded."""
    if len(paths) == 1 or is_linear(paths[0]):
        copy_frame(paths[0], target)
        return
    frames = []
    for path in paths:
        with suppress(InputError):
            frames.append(read_frame(path, kind))
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
    record = capture_record(subject)
    record["dome"] = "dome/dome.json"
    if session.override:
        record["override"] = session.override
    if subject.virtual:
        flashes = session.flashes_per_second
        record["rehearsal"] = {"person_present": False, "flashes_per_second": flashes}
    for key, path in files.items():
        name = f"scan{path.suffix}" if key == "mesh" else f"{key}{path.suffix}"
        copy_frame(path, out / name)
        record[key] = name
    dome = {
        key: value
        for key, value in setup.record.items()
        if key not in ("frames", "dark", "sequence")
    }
    suffix = next((out / "dome/frames").glob("*/*")).suffix
    dark = f"dome/dark/{{exposure}}_{{camera}}{suffix}"
    has_dark = all(
        (out / dark.format(exposure=e, camera=c)).is_file()
        for e in setup.dome.exposures
        for c in setup.dome.camera_ids
    )
    dome |= {
        "frames": f"{FRAMES}{suffix}",
        "sequence": session.sequence,
        "dark": dark if has_dark else None,
    }
    # every capture has its own frames of the white target
    for file in setup.dome.frame_files("white"):
        copy_frame(file, out / file.relative_to(setup.folder))
    write_record(out / "dome/dome.json", dome)
    if session.sites and setup.probe is not None:
        _write_probe(session, setup.probe)
        record["contact"] = "contact/probe.json"
    write_record(out / "capture.json", record)
    (out / UNFINISHED).unlink()


def capture_record(subject: Subject) -> Json:
    """Content of capture.json that describes the subject."""
    record = {
        "format": "skindb-capture",
        "version": 2,
        "subject": subject.subject,
        "session": subject.session,
        "condition": subject.condition,
        "traits": dict(subject.traits),
        "consent": dict(subject.consent),
    }
    if subject.calibration:
        record["calibration"] = subject.calibration
    if subject.virtual:
        record["virtual"] = True
    return record


def _write_probe(session: Unfinished, probe: Attributes) -> None:
    placements: dict[str, Json] = {}  # site -> number -> log of the pressure
    for entry in session.sites:
        numbers = placements.setdefault(str(entry["site"]), {})
        numbers[str(entry["number"])] = entry["pressure"]
    record = {
        key: value
        for key, value in probe.items()
        if key not in ("frames", "sites", "pressure", "placements")
    }
    record |= {
        "sites": list(placements),
        "frames": f"{SITE_FRAMES}{session.sites[0]['suffix']}",
        "placements": {site: list(numbers) for site, numbers in placements.items()},
        "pressure": placements,
    }
    write_record(session.folder / "contact/probe.json", record)


@contextmanager
def _complete(path: Path) -> Iterator[Path]:
    """A file beside this path, which takes its place when it is complete, so that a full disc
    or an interruption neither leaves a part nor harms the file before.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}")
    with add_filename(str(path)):
        try:
            yield part
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def copy_frame(path: Path, target: Path) -> None:
    """Copy a file, and make the folder of the copy."""
    with _complete(target) as part:
        part.write_bytes(path.read_bytes())


def write_record(path: Path, record: Attributes) -> None:
    """Write a JSON file, and make its folder."""
    with _complete(path) as part:
        part.write_text(json.dumps(record, indent=1), encoding="utf-8")
