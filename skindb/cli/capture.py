"""The command that drives a dome and a probe, or a rehearsal without them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

import skindb
from skindb.cli.options import DB, PATH, Finite, common
from skindb.cli.shared import bar, emit
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

SCOPES = ("fit", "statistics", "export", "publish")
VIRTUAL_SPEED, VIRTUAL_PROBE_SPEED = 10.0, 50.0  # of the clocks of emulated devices
VIRTUAL_SIZE: dict[str, Any] = {"cameras": 4, "lights": 24, "width": 160, "height": 200}


@dataclass(frozen=True)
class Addresses:
    """Where the devices are."""

    dome: str | None
    probe: str | None
    cameras: Path | None
    log: Path | None


@click.command()
@click.argument("out", type=PATH)
@click.option("--setup", type=PATH, help="Folder with dome/dome.json and contact/probe.json of the laboratory.")
@click.option("--dome", help="Address of the light controller: /dev/ttyACM0 or socket://host:port.")
@click.option("--probe", help="Address of the probe.")
@click.option("--cameras", type=PATH, help="Folder with a folder of frames for each camera, and one named probe.")
@click.option("--subject", help="Pseudonym of the subject.")
@click.option("--condition", default="normal", help="Condition of the skin.")
@click.option("--trait", "traits", multiple=True, metavar="NAME=VALUE", help="Attribute (may be given several times).")
@click.option("--consent", help="Scopes that the subject consents to, separated by commas: fit, statistics, export.")
@click.option("--reference", help="Where the signed form is.")
@click.option("--scan", type=PATH, help="Triangle mesh of the face in mm.")
@click.option("--landmarks", type=PATH, help="Landmarks on the scan (.json).")
@click.option("--regions", type=PATH, help="Regions of the scan (.json).")
@click.option("--sites", default="", help="Sites that the probe measures, separated by commas.")
@click.option("--placements", type=click.IntRange(1, 64), default=1, help="Placements of the probe on each site.")
@click.option("--seconds", type=Finite(0, min_open=True), help="Length of the sequence.  [default: the shortest]")
@click.option("--slower", is_flag=True, help="Flash at most three times in a second.")
@click.option("--base-light", "base", type=click.IntRange(0), default=0, help="Steady lamp in units of one light.")
@click.option("--confirm-screening", is_flag=True, help="Subject was screened, consented, and keeps the eyes closed.")
@click.option("--operator", help="ID of the operator who confirms that.")
@click.option("--log", type=PATH, help="Folder for logs of all bytes of the devices.")
@click.option("--plan", "only_plan", is_flag=True, help="Tell the sequence and its safety; drive nothing.")
@click.option("--yes", is_flag=True, help="Do not wait for Enter before each placement of the probe.")
@click.option("--virtual", is_flag=True, help="Rehearse with emulated devices and a virtual subject.")
@click.option("--seed", type=click.IntRange(0), default=2005, help="Random seed for the virtual subject.")
@click.option("--fault", "faults", multiple=True, metavar="NAME=VALUE", help="Fault of an emulated device.")
@common
def capture(out: Path, **options: Any) -> None:
    """Drive a dome and a probe into a capture folder.

    The sequence is checked against photosensitive seizures before it runs. Triggers and frames are counted; what is
    missing is repeated while the subject is there. A capture that ended early is continued by the same command. With
    --virtual, emulated devices and a virtual subject take the place of the laboratory.
    """
    if options["faults"] and not options["virtual"]:
        raise InputError(Fault("--fault", "belongs to --virtual", "a real laboratory", "leave it out"))
    with ExitStack() as stack:
        laboratory = stack.enter_context(_laboratory(out, options)) if options["virtual"] else None
        setup = read_setup(laboratory.subject if laboratory else _given(options, "setup"))
        plan = _plan(setup, options, all_sites=laboratory is not None)
        if options["only_plan"]:
            _tell_plan(setup, plan)
            return
        subject = _subject(options, laboratory)
        files = _files(options, laboratory)
        override = _override(options, required=laboratory is None)
        devices = stack.enter_context(_devices(setup, plan, _addresses(options, laboratory)))
        place = laboratory.place if laboratory else None

        def placed(site: str, number: int) -> None:
            if place is not None:
                place(site)
            elif not options["yes"]:
                click.prompt(f"Place the probe on {site} ({number}), then press Enter", default="", show_default=False)

        found = run_capture(
            out, setup, subject, devices, plan, files=files, override=override, place=placed, progress=bar()
        )
    rate = f"at most {found['flashes_per_second']} flashes in a second"
    emit(found, [f"{out}: {found['frames']} frames in {found['seconds']:.1f} s, {rate}", *found["notes"]])


def _given(options: dict[str, Any], name: str) -> Any:
    """The value of an option that a real capture needs."""
    if options[name] in (None, ""):
        cure = f"give it, or rehearse with --virtual, which needs no --{name}"
        raise InputError(Fault(f"--{name}", "a capture needs it", "nothing", cure))
    return options[name]


def _plan(setup: Setup, options: dict[str, Any], *, all_sites: bool) -> CapturePlan:
    sites = tuple(name.strip() for name in options["sites"].split(",") if name.strip())
    if all_sites and not sites and setup.probe is not None:
        sites = tuple(map(str, setup.probe.get("sites", ())))
    return CapturePlan(options["seconds"], options["slower"], options["base"], sites, options["placements"])


def _tell_plan(setup: Setup, plan: CapturePlan) -> None:
    schedule = planned_schedule(setup, plan)
    found, brackets = assess(schedule), setup.brackets
    lines = [f"{len(setup.lights)} lights, {len(setup.exposures)} exposures, {len(setup.cameras)} cameras: {found}"]
    if brackets:
        each = f"{len(brackets)} exposures of together {sum(brackets.values()):.0f} s"
        lines.append(f"probe: {each} at each of {len(plan.sites)} sites, {plan.placements} times")
    if not found.safe:
        lines += ["above 3 flashes in a second: needs --confirm-screening --operator ID, or", *alternatives(schedule)]
    told = {"seconds": found.seconds, "flashes_per_second": found.flashes_per_second, "safe": found.safe}
    emit(told | {"luminance_step": found.luminance_step, "steps": len(schedule.steps)}, lines)


def _override(options: dict[str, Any], *, required: bool) -> Override | None:
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


def _subject(options: dict[str, Any], laboratory: Laboratory | None) -> Subject:
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


def _files(options: dict[str, Any], laboratory: Laboratory | None) -> dict[str, Path]:
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


def _addresses(options: dict[str, Any], laboratory: Laboratory | None) -> Addresses:
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
def _laboratory(out: Path, options: dict[str, Any]) -> Iterator[Laboratory]:
    """Emulated devices around a virtual subject, whose files lie beside the capture."""
    for name in ("dome", "probe", "cameras", "setup"):
        if options[name] is not None:
            raise InputError(Fault(f"--{name}", "belongs to a real laboratory", "--virtual", "leave one of them out"))
    beside = out.parent / f"{out.name}.virtual"
    subject = beside / "subject"
    if not (subject / "capture.json").is_file():
        [made] = skindb.workflow.simulate(
            beside / "made", takes=1, seed=options["seed"], progress=bar(), **VIRTUAL_SIZE
        )
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


@click.command()
@DB
@click.argument("setup", type=PATH)
@click.option("--name", required=True, help="Name by which captures call the calibration.")
@click.option("--fit-falloff", is_flag=True, help="Find the angular fall-off of every light too.")
@common
def calibrate(db: str, setup: Path, name: str, fit_falloff: bool) -> None:
    """Calibrate the lights of a dome from the frames of its white target.

    The result is a dated version in the database. Captures that name it (format version 2, key `calibration`) take
    the intensities of its newest version when they are ingested; earlier versions stay.
    """
    database = skindb.open(db)
    record = skindb.workflow.calibrate(database, setup, name=name, fit_falloff=fit_falloff)
    told = skindb.workflow.describe_calibration(database, record)
    lines = [f"{name}: calibration {record.generation} of {told['lights']} lights, {record.path}"]
    lines.append(f"  intensities are known to {told['largest_relative_error']:.2%} or better (noise alone)")
    if "largest_change" in told:
        lines.append(
            f"  largest change since {record.generation - 1}: {told['largest_change']:.2%}, {told['most_changed']}"
        )
    if told["ingest_again"]:
        lines.append(f"  captures of an earlier calibration, to be ingested again: {', '.join(told['ingest_again'])}")
    emit({"calibration": name, "generation": record.generation, "path": record.path} | told, lines)
