"""A capture session in a real or virtual laboratory."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from skindb._types import Progress
from skindb.errors import Fault, InputError
from skindb.geometry.scan import read_scan
from skindb.hw.cameras import FolderCameras
from skindb.hw.capture import CapturePlan, Devices, planned_schedule, run_capture
from skindb.hw.capture_folder import Setup, Subject, capture_record, read_setup
from skindb.hw.dome import Dome
from skindb.hw.link import Link, open_port
from skindb.hw.probe import Probe
from skindb.hw.safety import Override, alternatives, assess
from skindb.ingest.fields import IDENTIFIER
from skindb.ingest.folder import record_faults
from skindb.ingest.json_file import read_json
from skindb.ingest.light_calibration import read_setup_dome
from skindb.virtual.devices import DeviceFaults
from skindb.virtual.laboratory import Laboratory, LaboratoryFaults
from skindb.workflow.simulation import simulate

SCOPES = ("fit", "statistics", "export", "publish")
VIRTUAL_SPEED, VIRTUAL_PROBE_SPEED = 10.0, 50.0  # of the clocks of emulated devices
VIRTUAL_SIZE: dict[str, Any] = {"cameras": 4, "lights": 24, "width": 160, "height": 200}
PROBABILITIES = ("garbage", "lost_replies")
MAX_FAULT = 1e6  # of any number of a fault
Ask = Callable[[str, int], None]


@dataclass(frozen=True)
class Addresses:
    """Addresses of the devices."""

    dome: str | None
    probe: str | None
    cameras: Path | None
    log: Path | None


def plan_session(
    out: Path, options: Mapping[str, Any], *, progress: Progress | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Plan a session without driving any device: duration, steps and flash rate, as values and as lines.

    Parameters
    ----------
    out, options, progress
        As in `capture_session`.
    """
    with ExitStack() as stack:
        laboratory = stack.enter_context(_laboratory(out, options, progress)) if options["virtual"] else None
        setup = read_setup(laboratory.subject if laboratory else _given(options, "setup"))
    plan = _plan(setup, options, virtual=laboratory is not None)
    schedule = planned_schedule(setup, plan)
    found, brackets = assess(schedule), setup.brackets
    lines = [f"{len(setup.lights)} lights, {len(setup.exposures)} exposures, {len(setup.cameras)} cameras: {found}"]
    if brackets:
        each = f"{len(brackets)} exposures of together {sum(brackets.values()):.0f} s"
        lines.append(f"probe: {each} at each of {len(plan.sites)} sites, {plan.placements} times")
    if not found.safe:
        lines += ["above 3 flashes in a second: needs --confirm-screening --operator ID, or", *alternatives(schedule)]
    about = {"seconds": found.seconds, "flashes_per_second": found.flashes_per_second, "safe": found.safe}
    return about | {"luminance_step": found.luminance_step, "steps": len(schedule.steps)}, lines


def capture_session(
    out: Path, options: Mapping[str, Any], *, ask: Ask | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Capture a subject with the dome and the probe; see `skindb.hw.capture.run_capture`.

    Parameters
    ----------
    out
        Folder of the capture.
    options
        Those of the command `skindb capture`, by their names.
    ask
        Called with site and number before each placement of the probe; returns when the probe is placed.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Raises
    ------
    InputError
        For options that are missing or contradict each other, and as `run_capture`.
    """
    if options["faults"] and not options["virtual"]:
        raise InputError(Fault("--fault", "belongs to --virtual", "a real laboratory", "omit it"))
    with ExitStack() as stack:
        stack.enter_context(one_session(out))
        laboratory = stack.enter_context(_laboratory(out, options, progress)) if options["virtual"] else None
        setup = read_setup(laboratory.subject if laboratory else _given(options, "setup"))
        read_setup_dome(setup.folder, white=False)  # what ingest cannot read is refused before the subject is there
        plan = _plan(setup, options, virtual=laboratory is not None)
        override = _override(options, required=laboratory is None)
        subject, files = _subject(options, laboratory), _files(options, laboratory)
        read_scan(files["mesh"])
        devices = stack.enter_context(_devices(setup, plan, _addresses(options, laboratory)))
        put = laboratory.place if laboratory else None

        def place(site: str, number: int) -> None:
            if put is not None:
                put(site)
            elif ask is not None:
                ask(site, number)

        return run_capture(
            out, setup, subject, devices, plan, files=files, override=override, place=place, progress=progress
        )


def _given(options: Mapping[str, Any], name: str) -> Any:
    """The value of an option that a real capture needs."""
    if options[name] in (None, ""):
        cure = f"give it, or rehearse with --virtual, which needs no --{name}"
        raise InputError(Fault(f"--{name}", "a capture needs it", "nothing", cure))
    return options[name]


def _plan(setup: Setup, options: Mapping[str, Any], *, virtual: bool) -> CapturePlan:
    sites = tuple(dict.fromkeys(name.strip() for name in options["sites"].split(",") if name.strip()))
    known = () if setup.probe is None else tuple(map(str, setup.probe.get("sites", ())))
    if bad := [name for name in sites if not re.fullmatch(IDENTIFIER.pattern, name)]:
        raise InputError(Fault("--sites", f"a name {IDENTIFIER.said}", repr(bad[0]), "correct it"))
    if virtual and (bad := [name for name in sites if name not in known]):
        rule = f"the virtual subject has the sites {', '.join(known)}"
        raise InputError(Fault("--sites", rule, ", ".join(bad), "name one of these"))
    if virtual and not sites:
        sites = known
    pace = {"seconds": options["seconds"], "slow": options["slower"], "base": options["base"]}
    return CapturePlan(**pace, operator=options["operator"] or "", sites=sites, placements=options["placements"])


def _override(options: Mapping[str, Any], *, required: bool) -> Override | None:
    """Confirmation of the operator; a rehearsal needs none, and its capture records that it is one."""
    operator, confirmed = options["operator"], options["confirm_screening"]
    if operator is not None and not re.fullmatch(IDENTIFIER.pattern, operator):
        raise InputError(Fault("--operator", IDENTIFIER.said, repr(operator), "correct it"))
    if not required and not operator:
        return Override("rehearsal", datetime.now(UTC).isoformat(timespec="seconds"))
    if operator is None and (confirmed or options["base"]):
        what = "--confirm-screening" if confirmed else "--base-light"
        rule, cure = "an operator must be responsible for it", "add --operator ID"
        raise InputError(Fault(what, rule, "no --operator", cure))
    return Override(operator, datetime.now(UTC).isoformat(timespec="seconds")) if confirmed else None


def _subject(options: Mapping[str, Any], laboratory: Laboratory | None) -> Subject:
    """The subject of the capture, checked by the rules of ingest."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    if laboratory is not None:
        faults = list[Fault]()
        record = read_json(laboratory.subject / "capture.json", faults) or {}
        name, consent, traits = options["subject"] or record["subject"], record["consent"], record.get("traits", {})
    else:
        scope = [name.strip() for name in _given(options, "consent").split(",")]
        if unknown := [name for name in scope if name not in SCOPES]:
            raise InputError(Fault("--consent", f"must be from {', '.join(SCOPES)}", unknown[0], "correct it"))
        name, consent = _given(options, "subject"), {"scope": scope, "reference": _given(options, "reference")}
        traits = dict(_trait(text) for text in options["traits"])
    subject = Subject(name, now, consent, options["condition"], traits, options["calibration"] or "")
    if found := record_faults(capture_record(subject)):
        raise InputError(replace(fault, cure="correct the option") for fault in found)
    return subject


def _trait(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise InputError(Fault("--trait", "must be NAME=VALUE", repr(text), "write it like --trait age=34"))
    try:
        return name, float(value)
    except ValueError:
        return name, {"true": True, "false": False}.get(value.lower(), value)


def _files(options: Mapping[str, Any], laboratory: Laboratory | None) -> dict[str, Path]:
    names = {"mesh": "scan", "landmarks": "landmarks", "regions": "regions"}
    own = {} if laboratory is None else {"mesh": "scan.ply", "landmarks": "landmarks.json", "regions": "regions.json"}
    found = {key: options[name] for key, name in names.items() if options[name]}
    if laboratory is not None:
        found = {key: laboratory.subject / name for key, name in own.items()} | found
    if "mesh" not in found:
        _given(options, "scan")
    for key, path in found.items():
        if not path.is_file():
            raise InputError(Fault(f"--{names[key]}", "must be a file", str(path), "correct the path"))
    return found


def _addresses(options: Mapping[str, Any], laboratory: Laboratory | None) -> Addresses:
    if laboratory is not None:
        return Addresses(laboratory.dome_url, laboratory.probe_url, laboratory.watched, options["log"])
    return Addresses(_given(options, "dome"), options["probe"], _given(options, "cameras"), options["log"])


@contextmanager
def one_session(out: Path) -> Iterator[None]:
    """Lock the folder of a capture; the system releases the lock however the session ends.

    Raises
    ------
    InputError
        If another session holds the lock, or the folder cannot be written to.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    path = out.parent / f".{out.name}.lock"
    with path.open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                raise FileNotFoundError  # the other session ended between opening and locking
        except (BlockingIOError, FileNotFoundError):
            rule, cure = "only one session at a time may write into a folder", "wait until the other session has ended"
            raise InputError(Fault(str(out), rule, "another session", cure)) from None
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


@contextmanager
def _devices(setup: Setup, plan: CapturePlan, where: Addresses) -> Iterator[Devices]:
    """Connect the drivers of the devices, and close their connections at the end."""
    if where.log is not None:
        where.log.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:

        def link(url: str, name: str) -> Link:
            made = Link(open_port(url), name, log=None if where.log is None else where.log / f"{name}.log")
            stack.callback(made.close)
            return made

        cameras = FolderCameras(where.cameras or Path(), setup.cameras)
        dome = Dome(link(where.dome or "", "dome"))
        probe = Probe(link(where.probe, "probe")) if where.probe and plan.sites else None
        camera = None if probe is None else FolderCameras(where.cameras or Path(), ["probe"])
        yield Devices(dome, cameras, probe, camera)


@contextmanager
def _laboratory(out: Path, options: Mapping[str, Any], progress: Progress | None) -> Iterator[Laboratory]:
    """Emulated devices around a virtual subject, whose files lie beside the capture."""
    for name in ("dome", "probe", "cameras", "setup"):
        if options[name] is not None:
            raise InputError(Fault(f"--{name}", "belongs to a real laboratory", "--virtual", "omit one of them"))
    beside = out.parent / f"{out.name}.virtual"
    subject = beside / "subject"
    if not (subject / "capture.json").is_file():
        shutil.rmtree(beside / "made", ignore_errors=True)  # of a rehearsal that was interrupted
        [made] = simulate(beside / "made", takes=1, seed=options["seed"], progress=progress, **VIRTUAL_SIZE)
        made.rename(subject)
    speeds = {"speed": VIRTUAL_SPEED, "probe_speed": VIRTUAL_PROBE_SPEED}
    faults = _faults(options["faults"], read_setup(subject))
    with Laboratory(subject, beside / "frames", faults, **speeds) as laboratory:
        yield laboratory


def _faults(texts: tuple[str, ...], setup: Setup) -> LaboratoryFaults | None:
    """Faults by name: those of `DeviceFaults` for dome or probe, frames that are dropped, hot pixels."""
    known = {f.name: f.type for f in fields(DeviceFaults)}
    found: dict[str, dict[str, Any]] = {"dome": {}, "probe": {}, "": {}}
    for text in texts:
        name, _, value = text.partition("=")
        device, _, what = name.partition(".") if "." in name else ("", "", name)
        try:
            if device in ("dome", "probe") and what in known:
                found[device][what] = _fault_value(what, str(known[what]), value, setup)
            elif what == "dropped_frame":
                camera, number = value.split(":")
                if camera not in setup.cameras:
                    raise ValueError
                found[""]["dropped_frames"] = (*found[""].get("dropped_frames", ()), (camera, _count(number)))
            elif what == "hot_pixels":
                found[""]["hot_pixels"] = _count(value)
            else:
                raise ValueError
        except ValueError:
            names = ", ".join(f"dome.{n}" for n in known)
            rule = f"must be dropped_frame=CAMERA:NUMBER, hot_pixels=N, {names}, or the same with probe"
            cure = "numbers are not negative, probabilities at most 1, lights and cameras those of the set-up"
            raise InputError(Fault("--fault", rule, repr(text), cure)) from None
    if not texts:
        return None
    return LaboratoryFaults(DeviceFaults(**found["dome"]), DeviceFaults(**found["probe"]), **found[""])


def _fault_value(what: str, kind: str, value: str, setup: Setup) -> Any:
    """The value of a fault of a device; ValueError if it can never happen."""
    if kind.startswith("tuple"):
        return tuple(_count(number) for number in value.split(":"))
    if kind == "str":
        if value not in setup.lights:
            raise ValueError(value)
        return value
    if kind == "int":
        return _count(value)
    number, most = float(value), 1.0 if what in PROBABILITIES else MAX_FAULT
    if not 0.0 <= number <= most:
        raise ValueError(value)
    return number


def _count(text: str) -> int:
    number = int(text)
    if number < 0 or number > MAX_FAULT:
        raise ValueError(text)
    return number
