"""A capture session in a real or virtual laboratory."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from skindb.calibration.setup import read_setup_dome
from skindb.clock import SYSTEM_CLOCK, SimulatedClock
from skindb.errors import Fault, InputError
from skindb.files import make_private, private_file, private_umask
from skindb.format.fields import IDENTIFIER
from skindb.format.folder import read_capture, record_faults
from skindb.format.json_file import read_json
from skindb.geometry.scan import read_scan
from skindb.hw.cameras import FolderCameras
from skindb.hw.capture import CapturePlan, Devices, planned_schedule, run_capture
from skindb.hw.capture_folder import Setup, Subject, capture_record, read_setup
from skindb.hw.dome import Dome
from skindb.hw.link import Link, open_port
from skindb.hw.probe import Probe
from skindb.hw.safety import Override, Rehearsal, alternatives, assess
from skindb.types import Progress
from skindb.virtual.devices import GAUGE_FAULTS, DeviceFaults
from skindb.virtual.laboratory import Laboratory, LaboratoryFaults
from skindb.workflow.simulation import simulate

SCOPES = ("fit", "statistics", "export", "publish")
NECESSARY_SCOPE = "fit"
# key in capture.json -> option
FILES = {"mesh": "scan", "landmarks": "landmarks", "regions": "regions"}
PLAN_NEEDS = ("setup",)
SESSION_NEEDS = ("setup", "dome", "cameras", "subject", "consent", "reference", "scan")
VIRTUAL_SEED = 2005
VIRTUAL_SIZE: dict[str, Any] = {"cameras": 4, "lights": 24, "width": 160, "height": 200}
PROBABILITIES = ("garbage", "lost_replies")
MAX_FAULT = 1e6  # of any number of a fault
Ask = Callable[[str, int], None]


def plan_session(
    out: Path, options: Mapping[str, Any], *, progress: Progress | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Plan a session without driving any device: duration, steps and flash rate, as
    values and as lines.

    Parameters
    ----------
    out, options, progress
        As in `capture_session`.
    """
    _require_options(options, PLAN_NEEDS)
    with private_umask(), ExitStack() as stack:
        laboratory = (
            stack.enter_context(_laboratory(out, options, progress))
            if options["virtual"]
            else None
        )
        setup = read_setup(laboratory.subject if laboratory else options["setup"])
    plan = _plan(setup, options, virtual=laboratory is not None)
    schedule = planned_schedule(setup, plan)
    found = assess(schedule)
    brackets = setup.brackets
    lines = [
        (
            f"{len(setup.lights)} lights, {len(setup.exposures)} exposures, "
            f"{len(setup.cameras)} cameras: {found}"
        )
    ]
    if brackets:
        each = f"{len(brackets)} exposures of together {sum(brackets.values()):.0f} s"
        where = (
            f"each of {len(plan.sites)} sites"
            if plan.sites
            else "each site that --sites names"
        )
        lines.append(f"probe: {each}, placements: {plan.placements} at {where}")
    if plan.base:
        lines.append(
            "the lamp is measured before the lights flash; beside a darker one, "
            "they count as flashes"
        )
    if not found.safe:
        lines += [
            "above 3 flashes in a second: needs --confirm-screening --operator ID, or",
            *alternatives(schedule),
        ]
    about = {
        "seconds": found.seconds,
        "flashes_per_second": found.flashes_per_second,
        "safe": found.safe,
    }
    return about | {
        "luminance_step": found.luminance_step,
        "steps": len(schedule.steps),
    }, lines


def capture_session(
    out: Path,
    options: Mapping[str, Any],
    *,
    ask: Ask | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Capture a subject with the dome and the probe; see `skindb.hw.capture.run_capture`.

    Parameters
    ----------
    out
        Folder of the capture.
    options
        Those of the command `skindb capture`, by their names.
    ask
        Called with site and number before each placement of the probe; returns when the
        probe is placed.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Raises
    ------
    InputError
        For options that are missing or contradict each other, and as `run_capture`.
    """
    _require_options(options, SESSION_NEEDS)
    with private_umask(), ExitStack() as stack:
        stack.enter_context(one_session(out))
        laboratory = (
            stack.enter_context(_laboratory(out, options, progress))
            if options["virtual"]
            else None
        )
        setup = read_setup(laboratory.subject if laboratory else options["setup"])
        # what ingest cannot read is refused before the subject is there; the session
        # takes its own dark frames
        read_setup_dome(setup.folder, white=False, dark=False)
        plan = _plan(setup, options, virtual=laboratory is not None)
        override = _override(options)
        subject = _subject(options, laboratory)
        files = _files(options, laboratory)
        read_scan(files["mesh"])
        devices = stack.enter_context(_devices(setup, plan, options, laboratory))
        put = laboratory.place if laboratory else None

        def place(site: str, number: int) -> None:
            if put is not None:
                put(site)
            elif ask is not None:
                ask(site, number)

        return run_capture(
            out,
            setup,
            subject,
            devices,
            plan,
            files=files,
            override=override,
            place=place,
            progress=progress,
        )


def _require_options(options: Mapping[str, Any], needed: tuple[str, ...]) -> None:
    """Report every fault of the options at once, before anything is simulated,
    connected or switched on.

    `needed` are the options that a session in a real laboratory cannot do without.
    """
    faults = list[Fault]()
    if options["virtual"]:
        real = [
            name for name in ("dome", "probe", "cameras") if options[name] is not None
        ]
        faults += [
            Fault(
                f"--{name}",
                "belongs to a real laboratory",
                "--virtual",
                "omit one of them",
            )
            for name in real
        ]
        if options["seed"] is not None and options["setup"] is not None:
            rule = "makes a virtual subject, which a capture given by --setup replaces"
            faults.append(Fault("--seed", rule, "--setup", "omit one of them"))
    else:
        virtual = [
            name
            for name, value in (("fault", options["faults"]), ("seed", options["seed"]))
            if value not in ((), None)
        ]
        faults += [
            Fault(f"--{name}", "belongs to --virtual", "a real laboratory", "omit it")
            for name in virtual
        ]
        for name in needed:
            if options[name] in (None, ""):
                cure = f"give it, or rehearse with --virtual, which needs no --{name}"
                faults.append(Fault(f"--{name}", "a capture needs it", "nothing", cure))
    if bad := [
        name
        for name in _names(options["sites"])
        if not re.fullmatch(IDENTIFIER.pattern, name)
    ]:
        faults.append(
            Fault("--sites", f"a name {IDENTIFIER.said}", repr(bad[0]), "correct it")
        )
    for key, path in _given_files(options).items():
        if not path.is_file():
            faults.append(
                Fault(
                    f"--{FILES[key]}", "must be a file", str(path), "correct the path"
                )
            )
    faults += _subject_faults(options) + _operator_faults(options)
    if faults:
        raise InputError(faults)


def _subject_faults(options: Mapping[str, Any]) -> list[Fault]:
    """Faults of the options that describe the subject, by the rules of ingest."""
    faults = list[Fault]()
    traits = dict[str, Any]()
    for text in options["traits"]:
        name, equals, _ = text.partition("=")
        if not name or not equals:
            faults.append(
                Fault(
                    "--trait",
                    "must be NAME=VALUE",
                    repr(text),
                    "write it like --trait age=34",
                )
            )
        else:
            traits |= _traits([text])
    scope = _names(options["consent"] or NECESSARY_SCOPE)
    if unknown := [name for name in scope if name not in SCOPES]:
        faults.append(
            Fault(
                "--consent",
                f"must be from {', '.join(SCOPES)}",
                unknown[0],
                "correct it",
            )
        )
    elif NECESSARY_SCOPE not in scope:
        rule = (
            f"must contain {NECESSARY_SCOPE}, without which nothing may be computed "
            "from the photographs"
        )
        faults.append(
            Fault(
                "--consent",
                rule,
                options["consent"],
                "obtain this consent, or do not photograph",
            )
        )
    consent = {"scope": [NECESSARY_SCOPE], "reference": options["reference"] or "-"}
    now = datetime.now(UTC).isoformat(timespec="seconds")
    name = options["subject"] or "S"
    subject = Subject(
        name, now, consent, options["condition"], traits, options["calibration"] or ""
    )
    return faults + [
        replace(fault, cure="correct the option")
        for fault in record_faults(capture_record(subject))
    ]


def _operator_faults(options: Mapping[str, Any]) -> list[Fault]:
    operator = options["operator"]
    confirmed = options["confirm_screening"]
    if operator is not None and not re.fullmatch(IDENTIFIER.pattern, operator):
        return [Fault("--operator", IDENTIFIER.said, repr(operator), "correct it")]
    if operator is None and (confirmed or (options["base"] and not options["virtual"])):
        what = "--confirm-screening" if confirmed else "--base-light"
        rule = "an operator must be responsible for it"
        cure = "add --operator ID"
        return [Fault(what, rule, "no --operator", cure)]
    return []


def _names(text: str) -> list[str]:
    """Names in a list that is separated by commas."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def _plan(setup: Setup, options: Mapping[str, Any], *, virtual: bool) -> CapturePlan:
    sites = tuple(_names(options["sites"]))
    known = () if setup.probe is None else tuple(map(str, setup.probe.get("sites", ())))
    if virtual and (bad := [name for name in sites if name not in known]):
        rule = f"the virtual subject has the sites {', '.join(known)}"
        raise InputError(Fault("--sites", rule, ", ".join(bad), "name one of these"))
    if virtual and not sites:
        sites = known
    pace = {
        "seconds": options["seconds"],
        "slow": options["slower"],
        "base": options["base"],
    }
    return CapturePlan(
        **pace,
        operator=options["operator"] or "",
        sites=sites,
        placements=options["placements"],
    )


def _override(options: Mapping[str, Any]) -> Override | Rehearsal | None:
    """Confirmation of the operator, or that it is a rehearsal, in which nobody is present."""
    override = None
    if options["confirm_screening"]:
        override = Override(
            options["operator"], datetime.now(UTC).isoformat(timespec="seconds")
        )
    return Rehearsal(override) if options["virtual"] else override


def _subject(options: Mapping[str, Any], laboratory: Laboratory | None) -> Subject:
    """Metadata of the subject; in a rehearsal, options have priority over those of the
    virtual subject.
    """
    record: dict[str, Any] = {"subject": None, "consent": {}, "traits": {}}
    if laboratory is not None:
        record |= read_json(laboratory.subject / "capture.json", []) or {}
    consent = dict(record["consent"])
    consent |= {"scope": _names(options["consent"])} if options["consent"] else {}
    consent |= {"reference": options["reference"]} if options["reference"] else {}
    return Subject(
        options["subject"] or record["subject"],
        datetime.now(UTC).isoformat(timespec="seconds"),
        consent,
        options["condition"],
        {**record["traits"], **_traits(options["traits"])},
        options["calibration"] or "",
        "" if laboratory is None else laboratory.subject.name,
    )


def _traits(texts: Iterable[str]) -> dict[str, Any]:
    """Attributes given as NAME=VALUE, where a value is a number, true or false, or text."""
    found = dict[str, Any]()
    for text in texts:
        name, _, value = text.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = {"true": True, "false": False}.get(value.lower(), value)
    return found


def _given_files(options: Mapping[str, Any]) -> dict[str, Path]:
    return {key: options[name] for key, name in FILES.items() if options[name]}


def _files(
    options: Mapping[str, Any], laboratory: Laboratory | None
) -> dict[str, Path]:
    """Files of the subject by their key in capture.json; options have priority over
    those of a virtual subject.
    """
    own = dict[str, Path]()
    if laboratory is not None:
        record = read_json(laboratory.subject / "capture.json", []) or {}
        own = {
            key: laboratory.subject / record[key] for key in FILES if record.get(key)
        }
    return own | _given_files(options)


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
            rule = "only one session at a time may write into a folder"
            cure = "wait until the other session has ended"
            raise InputError(Fault(str(out), rule, "another session", cure)) from None
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


@contextmanager
def _devices(
    setup: Setup,
    plan: CapturePlan,
    options: Mapping[str, Any],
    laboratory: Laboratory | None,
) -> Iterator[Devices]:
    """Connect the drivers of the devices, and close their connections at the end."""
    log: Path | None = options["log"]
    if log is not None:
        make_private(log)
    clock = SYSTEM_CLOCK if laboratory is None else laboratory.clock
    watched = options["cameras"] if laboratory is None else laboratory.watched
    with ExitStack() as stack:

        def link(name: str) -> Link:
            port = (
                open_port(options[name])
                if laboratory is None
                else laboratory.port(name)
            )
            path = None if log is None else log / f"{name}.log"
            connected = Link(port, name, clock=clock, log=path)
            stack.callback(connected.close)
            return connected

        cameras = FolderCameras(watched, setup.cameras, clock=clock)
        dome = Dome(link("dome"))
        if not plan.sites or (laboratory is None and not options["probe"]):
            yield Devices(dome, cameras)
            return
        probe = Probe(link("probe"))
        yield Devices(
            dome, cameras, probe, FolderCameras(watched, ["probe"], clock=clock)
        )


@contextmanager
def _laboratory(
    out: Path, options: Mapping[str, Any], progress: Progress | None
) -> Iterator[Laboratory]:
    """Emulated devices around a virtual subject, or around an earlier capture that
    `--setup` names.
    """
    beside = out.parent / f"{out.name}.virtual"
    subject: Path = options["setup"] or beside / f"subject-{_seed(options)}"
    if options["setup"] is None and not (subject / "capture.json").is_file():
        # of a rehearsal that was interrupted
        shutil.rmtree(beside / "made", ignore_errors=True)
        [made] = simulate(
            beside / "made",
            takes=1,
            seed=_seed(options),
            progress=progress,
            **VIRTUAL_SIZE,
        )
        made.rename(subject)
    dome = read_capture(subject).dome
    if dome is None or not dome.frames.endswith(".png"):
        rule = (
            "with --virtual it must be a capture with PNG frames, which the emulated "
            "cameras deliver"
        )
        found = (
            f"no dome in {subject}" if dome is None else f"{dome.frames} in {subject}"
        )
        raise InputError(
            Fault(
                "--setup",
                rule,
                found,
                "name another capture; skindb simulate writes some",
            )
        )
    faults = _faults(options["faults"], read_setup(subject))
    watched = beside / "frames"
    try:
        clock = SimulatedClock(time.time())
        yield Laboratory(subject, watched, faults, clock=clock, lamp=options["base"])
    finally:
        shutil.rmtree(watched, ignore_errors=True)  # the capture has its own copies


def _seed(options: Mapping[str, Any]) -> int:
    return VIRTUAL_SEED if options["seed"] is None else int(options["seed"])


def _faults(texts: tuple[str, ...], setup: Setup) -> LaboratoryFaults | None:
    """Faults by name: those of `DeviceFaults` for dome or probe, frames that are
    dropped, hot pixels.
    """
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
                found[""]["dropped_frames"] = (
                    *found[""].get("dropped_frames", ()),
                    (camera, _count(number)),
                )
            elif what == "hot_pixels":
                found[""]["hot_pixels"] = _count(value)
            elif what == "lamp":
                found[""]["lamp"] = _fault_value(what, "float", value, setup)
            else:
                raise ValueError
        except ValueError:
            names = ", ".join(f"dome.{n}" for n in known)
            own = "dropped_frame=CAMERA:NUMBER, hot_pixels=N, lamp=FRACTION"
            rule = f"must be {own}, {names}, or the same with probe"
            cure = (
                "numbers are not negative, probabilities at most 1, lights and cameras "
                "those of the set-up"
            )
            raise InputError(Fault("--fault", rule, repr(text), cure)) from None
    if not texts:
        return None
    return LaboratoryFaults(
        DeviceFaults(**found["dome"]), DeviceFaults(**found["probe"]), **found[""]
    )


def _fault_value(what: str, kind: str, value: str, setup: Setup) -> Any:
    """The value of a fault of a device; ValueError if it can never happen."""
    if kind.startswith("tuple"):
        return tuple(_count(number) for number in value.split(":"))
    if kind == "str":
        if value not in (GAUGE_FAULTS if what == "gauge" else setup.lights):
            raise ValueError(value)
        return value
    if kind == "int":
        return _count(value)
    number = float(value)
    most = 1.0 if what in PROBABILITIES else MAX_FAULT
    if not 0.0 <= number <= most:
        raise ValueError(value)
    return number


def _count(text: str) -> int:
    number = int(text)
    if number < 0 or number > MAX_FAULT:
        raise ValueError(text)
    return number
