"""A session in a laboratory, real or virtual: what the command `capture` does."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from skindb._types import Progress
from skindb.errors import Fault, InputError
from skindb.hw.cameras import FolderCameras
from skindb.hw.capture import CapturePlan, Devices, planned_schedule, run_capture
from skindb.hw.capture_folder import Setup, Subject, read_setup
from skindb.hw.dome import Dome
from skindb.hw.link import Link, open_port
from skindb.hw.probe import Probe
from skindb.hw.safety import Override, alternatives, assess
from skindb.ingest.json_file import read_json
from skindb.virtual.devices import DeviceFaults
from skindb.virtual.laboratory import Laboratory, LaboratoryFaults
from skindb.workflow.simulation import simulate

SCOPES = ("fit", "statistics", "export", "publish")
VIRTUAL_SPEED, VIRTUAL_PROBE_SPEED = 10.0, 50.0  # of the clocks of emulated devices
VIRTUAL_SIZE: dict[str, Any] = {"cameras": 4, "lights": 24, "width": 160, "height": 200}
Ask = Callable[[str, int], None]


@dataclass(frozen=True)
class Addresses:
    """Where the devices are."""

    dome: str | None
    probe: str | None
    cameras: Path | None
    log: Path | None


def plan_session(
    out: Path, options: Mapping[str, Any], *, progress: Progress | None = None
) -> tuple[dict[str, Any], list[str]]:
    """What a session would do, and how often it flashes, as values and in lines; nothing is driven.

    Parameters
    ----------
    out, options, progress
        As in `capture_session`.
    """
    with ExitStack() as stack:
        laboratory = stack.enter_context(_laboratory(out, options, progress)) if options["virtual"] else None
        setup = read_setup(laboratory.subject if laboratory else _given(options, "setup"))
    plan = _plan(setup, options, all_sites=laboratory is not None)
    schedule = planned_schedule(setup, plan)
    found, brackets = assess(schedule), setup.brackets
    lines = [f"{len(setup.lights)} lights, {len(setup.exposures)} exposures, {len(setup.cameras)} cameras: {found}"]
    if brackets:
        each = f"{len(brackets)} exposures of together {sum(brackets.values()):.0f} s"
        lines.append(f"probe: {each} at each of {len(plan.sites)} sites, {plan.placements} times")
    if not found.safe:
        lines += ["above 3 flashes in a second: needs --confirm-screening --operator ID, or", *alternatives(schedule)]
    told = {"seconds": found.seconds, "flashes_per_second": found.flashes_per_second, "safe": found.safe}
    return told | {"luminance_step": found.luminance_step, "steps": len(schedule.steps)}, lines


def capture_session(
    out: Path, options: Mapping[str, Any], *, ask: Ask | None = None, progress: Progress | None = None
) -> dict[str, Any]:
    """Photograph and touch a subject; see `skindb.hw.capture.run_capture`.

    Parameters
    ----------
    out
        Folder of the capture.
    options
        Those of the command `skindb capture`, by their names.
    ask
        Called with site and number before each placement of the probe; returns when it is on.
    progress
        Called with the stage, the steps done and the steps in all.

    Raises
    ------
    InputError
        For options that are missing or contradict each other, and as `run_capture`.
    """
    if options["faults"] and not options["virtual"]:
        raise InputError(Fault("--fault", "belongs to --virtual", "a real laboratory", "leave it out"))
    with ExitStack() as stack:
        laboratory = stack.enter_context(_laboratory(out, options, progress)) if options["virtual"] else None
        setup = read_setup(laboratory.subject if laboratory else _given(options, "setup"))
        plan = _plan(setup, options, all_sites=laboratory is not None)
        subject, files = _subject(options, laboratory), _files(options, laboratory)
        override = _override(options, required=laboratory is None)
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


def _plan(setup: Setup, options: Mapping[str, Any], *, all_sites: bool) -> CapturePlan:
    sites = tuple(name.strip() for name in options["sites"].split(",") if name.strip())
    if all_sites and not sites and setup.probe is not None:
        sites = tuple(map(str, setup.probe.get("sites", ())))
    return CapturePlan(options["seconds"], options["slower"], options["base"], sites, options["placements"])


def _override(options: Mapping[str, Any], *, required: bool) -> Override | None:
    """The confirmation of the operator; nobody is dazzled in a rehearsal, whose capture says so."""
    if not required and not options["operator"]:
        return Override("rehearsal", datetime.now(UTC).isoformat(timespec="seconds"))
    if not options["confirm_screening"]:
        return None
    operator = options["operator"]
    if not operator:
        rule, cure = "a confirmation needs the ID of who gives it", "add --operator ID"
        raise InputError(Fault("--confirm-screening", rule, "no --operator", cure))
    return Override(operator, datetime.now(UTC).isoformat(timespec="seconds"))


def _subject(options: Mapping[str, Any], laboratory: Laboratory | None) -> Subject:
    now = datetime.now(UTC).isoformat(timespec="seconds")
    if laboratory is not None:
        faults = list[Fault]()
        record = read_json(laboratory.subject / "capture.json", faults) or {}
        name = options["subject"] or record["subject"]
        return Subject(name, now, record["consent"], options["condition"], record.get("traits", {}))
    scope = [name.strip() for name in _given(options, "consent").split(",")]
    if unknown := [name for name in scope if name not in SCOPES]:
        raise InputError(Fault("--consent", f"must be from {', '.join(SCOPES)}", unknown[0], "correct it"))
    consent = {"scope": scope, "reference": _given(options, "reference")}
    traits = dict(_trait(text) for text in options["traits"])
    return Subject(_given(options, "subject"), now, consent, options["condition"], traits)


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
def _devices(setup: Setup, plan: CapturePlan, where: Addresses) -> Iterator[Devices]:
    """Drivers, connected; their lines are closed at the end."""
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
            raise InputError(Fault(f"--{name}", "belongs to a real laboratory", "--virtual", "leave one of them out"))
    beside = out.parent / f"{out.name}.virtual"
    subject = beside / "subject"
    if not (subject / "capture.json").is_file():
        [made] = simulate(beside / "made", takes=1, seed=options["seed"], progress=progress, **VIRTUAL_SIZE)
        made.rename(subject)
    speeds = {"speed": VIRTUAL_SPEED, "probe_speed": VIRTUAL_PROBE_SPEED}
    with Laboratory(subject, beside / "frames", _faults(options["faults"]), **speeds) as laboratory:
        yield laboratory


def _faults(texts: tuple[str, ...]) -> LaboratoryFaults | None:
    """Faults by name: those of `DeviceFaults` for dome or probe, frames that are dropped, hot pixels."""
    known = {f.name: f.type for f in fields(DeviceFaults)}
    found: dict[str, dict[str, Any]] = {"dome": {}, "probe": {}, "": {}}
    for text in texts:
        name, _, value = text.partition("=")
        device, _, what = name.partition(".") if "." in name else ("", "", name)
        try:
            if device in ("dome", "probe") and what in known:
                found[device][what] = _fault_value(str(known[what]), value)
            elif what == "dropped_frame":
                camera, number = value.split(":")
                found[""]["dropped_frames"] = (*found[""].get("dropped_frames", ()), (camera, int(number)))
            elif what == "hot_pixels":
                found[""]["hot_pixels"] = int(value)
            else:
                raise ValueError
        except ValueError:
            names = ", ".join(f"dome.{n}" for n in known)
            rule = f"must be dropped_frame=CAMERA:NUMBER, hot_pixels=N, {names}, or the same with probe"
            raise InputError(Fault("--fault", rule, repr(text), "see docs/hardware.md")) from None
    if not texts:
        return None
    return LaboratoryFaults(DeviceFaults(**found["dome"]), DeviceFaults(**found["probe"]), **found[""])


def _fault_value(kind: str, value: str) -> Any:
    if kind.startswith("tuple"):
        return tuple(int(number) for number in value.split(":"))
    return value if kind == "str" else int(value) if kind == "int" else float(value)
