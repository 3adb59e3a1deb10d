"""A capture session in a real or virtual laboratory."""

import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from skindb.clock import SYSTEM_CLOCK, SimulatedClock, utc_time
from skindb.errors import Fault, counted, input_error, require_none
from skindb.files import Json, make_private, private_umask
from skindb.format.fields import IDENTIFIER, read_json
from skindb.format.folder import read_capture, record_faults
from skindb.geometry.scan import read_scan
from skindb.hw import conformance
from skindb.hw.cameras import Cameras, FolderCameras
from skindb.hw.capture import CapturePlan, Devices, planned_schedule, run_capture
from skindb.hw.capture_folder import (
    Setup,
    Subject,
    capture_record,
    one_session,
    read_setup,
)
from skindb.hw.dome import Dome
from skindb.hw.frame_markers import marker_light, with_markers
from skindb.hw.link import Link, close_port, open_port
from skindb.hw.probe import Probe
from skindb.hw.sequence import Override, Rehearsal, assess, slower_alternative
from skindb.hw.streaming import STREAMS, StreamingCameras
from skindb.parameters import VIRTUAL_SEED, SessionParameters
from skindb.schema.consent import SCOPES
from skindb.types import Progress, silent
from skindb.virtual.laboratory import Laboratory, laboratory_faults
from skindb.virtual.targets import rehearsed_dome
from skindb.workflow.simulation import simulate

NECESSARY_SCOPE = "fit"
# key in capture.json -> option
FILES = {"mesh": "scan", "landmarks": "landmarks", "regions": "regions"}
PLAN_NEEDS = ("setup",)
SESSION_NEEDS = ("setup", "dome", "cameras", "subject", "consent", "reference", "scan")
VIRTUAL_SIZE: Json = {"cameras": 4, "lights": 24, "width": 160, "height": 200}
Ask = Callable[[str], None]


def plan_session(
    out: Path, parameters: SessionParameters, *, progress: Progress = silent
) -> tuple[Json, list[str]]:
    """Plan a session without driving any device: duration, steps and flash rate, as
    values and as lines.

    Parameters
    ----------
    out, parameters, progress
        As in `capture_session`.
    """
    _require_parameters(parameters, PLAN_NEEDS)
    with private_umask(), _laboratory(out, parameters, progress) as laboratory:
        setup = _setup(parameters, laboratory)
    plan = _plan(setup, parameters)
    schedule = with_markers(planned_schedule(setup, plan), marker_light(setup.dome))
    assessment = assess(schedule)
    lines = [
        f"{counted(len(setup.dome.lights), 'light')}, "
        f"{counted(len(setup.dome.exposures), 'exposure')}, "
        f"{counted(len(setup.dome.cameras), 'camera')}: {assessment}"
    ]
    if brackets := setup.brackets:
        sites = "each site that --sites names"
        if plan.sites:
            sites = f"each of {len(plan.sites)} sites"
        lines.append(
            f"probe: {counted(len(brackets), 'exposure')} of "
            f"together {sum(brackets.values()):.0f} s, "
            f"placements: {plan.placements} at {sites}"
        )
    if not assessment.safe:
        lines += [
            "above 3 flashes in a second: needs --confirm-screening --operator ID, or",
            slower_alternative(schedule),
        ]
    return {
        "seconds": assessment.seconds,
        "flashes_per_second": assessment.flashes_per_second,
        "safe": assessment.safe,
        "steps": len(schedule.steps),
    }, lines


def check_device(url: str) -> tuple[str, list[Fault]]:
    """Kind of the device at a port, and what it does otherwise than docs/protocol.md; see
    `skindb.hw.conformance`.

    Raises
    ------
    InputError
        If there is no device at this address, or it closes its line.
    """
    port = open_port(url)
    try:
        return conformance.check_device(port)
    except OSError as error:  # of pyserial, too
        cure = "check its power and its cable"
        raise input_error(url, "must stay connected", str(error), cure) from None
    finally:
        close_port(port)


def capture_session(
    out: Path,
    parameters: SessionParameters,
    *,
    ask: Ask | None = None,
    progress: Progress = silent,
) -> Json:
    """Capture a subject with the dome and the probe; see `skindb.hw.capture.run_capture`.

    Parameters
    ----------
    out
        Folder of the capture.
    parameters
        The laboratory, the subject and the sequence.
    ask
        Called with a request before each placement of the probe; returns when it is done.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Raises
    ------
    InputError
        For parameters that are missing or contradict each other, and as `run_capture`.
    """
    _require_parameters(parameters, SESSION_NEEDS)
    with private_umask(), ExitStack() as stack:
        stack.enter_context(one_session(out))
        laboratory = stack.enter_context(_laboratory(out, parameters, progress))
        setup = _setup(parameters, laboratory)
        plan = _plan(setup, parameters)
        files = _files(parameters, laboratory)
        read_scan(files["mesh"])
        devices = connected_devices(setup, plan, parameters, laboratory)

        def place(site: str, number: int) -> None:
            if laboratory is not None:
                laboratory.place(site)
            elif ask is not None:
                ask(f"Place the probe on {site} ({number})")

        return run_capture(
            out,
            setup,
            _subject(parameters, laboratory),
            stack.enter_context(devices),
            plan,
            files=files,
            override=_override(parameters),
            place=place,
            progress=progress,
        )


def _require_parameters(parameters: SessionParameters, needed: Iterable[str]) -> None:
    """Report every fault of the parameters at once, before anything is simulated,
    connected or switched on.

    `needed` are those that a session in a real laboratory cannot do without.
    """
    faults = (
        rehearsal_faults(parameters)
        if parameters.virtual
        else real_session_faults(parameters, needed)
    )
    for site in _names(parameters.sites):
        if not re.fullmatch(IDENTIFIER.pattern, site):
            faults.append(
                Fault("--sites", f"a name {IDENTIFIER.text}", repr(site), "correct it")
            )
            break
    for key, path in _given_files(parameters).items():
        if not path.is_file():
            faults.append(
                Fault(
                    f"--{FILES[key]}", "must be a file", str(path), "correct the path"
                )
            )
    faults += _subject_faults(parameters) + _operator_faults(parameters)
    require_none(faults)


def rehearsal_faults(parameters: SessionParameters) -> list[Fault]:
    """Parameters that contradict a rehearsal."""
    cure = "omit one of them"
    faults = [
        Fault(f"--{name}", "belongs to a real laboratory", "--virtual", cure)
        for name in ("dome", "probe", "cameras")
        if getattr(parameters, name) is not None
    ]
    setup = parameters.setup
    replaced = setup is not None and (setup / "capture.json").is_file()
    if parameters.seed is not None and replaced:
        faults.append(
            Fault(
                "--seed",
                "makes a virtual subject, which a capture given by --setup replaces",
                "--setup",
                cure,
            )
        )
    return faults


def real_session_faults(
    parameters: SessionParameters, needed: Iterable[str]
) -> list[Fault]:
    """Parameters that a real session lacks, or that belong to a rehearsal."""
    faults = [
        Fault(f"--{name}", "belongs to --virtual", "a real laboratory", "omit it")
        for name, value in (("fault", parameters.faults), ("seed", parameters.seed))
        if value not in ((), None)
    ]
    faults += [
        Fault(
            f"--{name}",
            "a capture needs it",
            "nothing",
            f"give it, or rehearse with --virtual, which needs no --{name}",
        )
        for name in needed
        if getattr(parameters, name) in (None, "")
    ]
    return faults


def _subject_faults(parameters: SessionParameters) -> list[Fault]:
    """Faults of the parameters that describe the subject, by the rules of ingest."""
    faults = list[Fault]()
    traits = Json()
    for text in parameters.traits:
        name, equals, _ = text.partition("=")
        if name and equals:
            traits |= _traits([text])
        else:
            cure = "write it like --trait age=34"
            faults.append(Fault("--trait", "must be NAME=VALUE", repr(text), cure))
    scope = _names(parameters.consent or NECESSARY_SCOPE)
    if unknown := [name for name in scope if name not in SCOPES]:
        rule = f"must be from {', '.join(SCOPES)}"
        faults.append(Fault("--consent", rule, unknown[0], "correct it"))
    elif NECESSARY_SCOPE not in scope:
        rule = (
            f"must contain {NECESSARY_SCOPE}, without which nothing may be computed "
            "from the photographs"
        )
        cure = "obtain this consent, or do not photograph"
        faults.append(Fault("--consent", rule, str(parameters.consent), cure))
    subject = Subject(
        parameters.subject or "S",
        utc_time(),
        {"scope": [NECESSARY_SCOPE], "reference": parameters.reference or "-"},
        parameters.condition,
        traits,
        parameters.calibrated_by or "",
    )
    return faults + [
        replace(fault, cure="correct the option")
        for fault in record_faults(capture_record(subject))
    ]


def _operator_faults(parameters: SessionParameters) -> list[Fault]:
    operator = parameters.operator
    confirmed = parameters.confirm_screening
    if operator is not None and not re.fullmatch(IDENTIFIER.pattern, operator):
        return [Fault("--operator", IDENTIFIER.text, repr(operator), "correct it")]
    if operator is None and confirmed:
        return [
            Fault(
                "--confirm-screening",
                "an operator must be responsible for it",
                "no --operator",
                "add --operator ID",
            )
        ]
    return []


def _names(text: str) -> list[str]:
    """Names in a list that is separated by commas."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def _setup(parameters: SessionParameters, laboratory: Laboratory | None) -> Setup:
    folder = parameters.setup or (laboratory.subject if laboratory else None)
    assert folder is not None  # a capture needs it
    return read_setup(folder)


def _plan(setup: Setup, parameters: SessionParameters) -> CapturePlan:
    sites = tuple(_names(parameters.sites))
    if parameters.virtual:
        probe = setup.probe or {}
        measured = tuple(map(str, probe.get("sites", ())))
        if unknown := [name for name in sites if name not in measured]:
            raise input_error(
                "--sites",
                f"the virtual subject has the sites {', '.join(measured)}",
                ", ".join(unknown),
                "name one of these",
            )
        sites = sites or measured
    return CapturePlan(
        parameters.seconds,
        parameters.slower,
        sites=sites,
        placements=parameters.placements or 1,
    )


def _override(parameters: SessionParameters) -> Override | Rehearsal | None:
    """Confirmation of the operator, or that it is a rehearsal, in which nobody is present."""
    override = None
    if parameters.confirm_screening:
        override = Override(str(parameters.operator), utc_time())
    return Rehearsal(override) if parameters.virtual else override


def _subject(parameters: SessionParameters, laboratory: Laboratory | None) -> Subject:
    """Metadata of the subject; in a rehearsal, parameters have priority over those of the
    virtual subject.
    """
    record: Json = {"subject": None, "consent": {}, "traits": {}}
    if laboratory is not None:
        record |= read_json(laboratory.subject / "capture.json", []) or {}
    consent = dict(record["consent"])
    if parameters.consent:
        consent["scope"] = _names(parameters.consent)
    if parameters.reference:
        consent["reference"] = parameters.reference
    return Subject(
        parameters.subject or record["subject"],
        utc_time(),
        consent,
        parameters.condition,
        {**record["traits"], **_traits(parameters.traits)},
        parameters.calibrated_by or "",
        "" if laboratory is None else laboratory.subject.name,
    )


def _traits(texts: Iterable[str]) -> Json:
    """Attributes given as NAME=VALUE, where a value is a number, true or false, or text."""
    traits = Json()
    for text in texts:
        name, _, value = text.partition("=")
        try:
            traits[name] = float(value)
        except ValueError:
            traits[name] = {"true": True, "false": False}.get(value.lower(), value)
    return traits


def _given_files(parameters: SessionParameters) -> dict[str, Path]:
    files = {key: getattr(parameters, name) for key, name in FILES.items()}
    return {key: path for key, path in files.items() if path}


def _files(
    parameters: SessionParameters, laboratory: Laboratory | None
) -> dict[str, Path]:
    """Files of the subject by their key in capture.json; parameters have priority over
    those of a virtual subject.
    """
    files = dict[str, Path]()
    if laboratory is not None:
        folder = laboratory.subject
        record = read_json(folder / "capture.json", []) or {}
        files = {key: folder / record[key] for key in FILES if record.get(key)}
    return files | _given_files(parameters)


@contextmanager
def connected_devices(
    setup: Setup,
    plan: CapturePlan,
    parameters: SessionParameters,
    laboratory: Laboratory | None,
) -> Iterator[Devices]:
    """Connect the drivers of the devices, and close their connections at the end."""
    log = parameters.log
    if log is not None:
        make_private(log)
    clock = SYSTEM_CLOCK
    watched = parameters.cameras
    if laboratory is not None:
        clock = laboratory.clock
        watched = laboratory.watched
    assert watched is not None  # a capture needs it
    with ExitStack() as stack:

        def link(name: str) -> Link:
            port = (
                open_port(getattr(parameters, name))
                if laboratory is None
                else laboratory.port(name)
            )
            path = None if log is None else log / f"{name}.log"
            connected = Link(port, name, clock=clock, log=path)
            stack.callback(connected.close)
            return connected

        def connected(ids: Sequence[str]) -> Cameras:
            if laboratory is not None or not (watched / STREAMS).is_file():
                return FolderCameras(watched, ids, clock=clock)
            cameras = StreamingCameras(watched, ids)
            stack.callback(cameras.close)
            return cameras

        cameras = connected(setup.dome.camera_ids)
        dome = Dome(link("dome"))
        if not plan.sites or (laboratory is None and not parameters.probe):
            yield Devices(dome, cameras)
            return
        probe = Probe(link("probe"))
        yield Devices(dome, cameras, probe, connected(["probe"]))


@contextmanager
def _laboratory(
    out: Path, parameters: SessionParameters, progress: Progress
) -> Iterator[Laboratory | None]:
    """Emulated devices around a virtual subject, or around an earlier capture that
    `--setup` names; None in a real laboratory.
    """
    if not parameters.virtual:
        yield None
        return
    beside = out.parent / f"{out.name}.virtual"
    subject = parameters.setup
    if subject is None or not (subject / "capture.json").is_file():
        size = _size_of(subject) if subject else VIRTUAL_SIZE
        subject = _virtual_subject(beside, parameters.seed, size, progress)
    dome = read_capture(subject).dome
    if dome is None or not dome.frames.endswith(".png"):
        frames = "no dome" if dome is None else dome.frames
        raise input_error(
            "--setup",
            "with --virtual it must be a capture with PNG frames, which the emulated "
            "cameras deliver",
            f"{frames} in {subject}",
            "name another capture; skindb simulate writes some",
        )
    lights = dome.light_ids
    cameras = dome.camera_ids
    faults = laboratory_faults(parameters.faults, lights, cameras)
    watched = beside / "frames"
    clock = SimulatedClock(time.time())
    try:
        yield Laboratory(subject, watched, faults, clock=clock)
    finally:
        shutil.rmtree(watched, ignore_errors=True)  # the capture has its own copies


def _size_of(folder: Path) -> Json:
    """Numbers of devices and size of the pictures of a set-up, as of `VIRTUAL_SIZE`."""
    dome = read_setup(folder).dome
    rehearsed_dome(dome)
    first = dome.cameras[0]
    return {
        "cameras": len(dome.cameras),
        "lights": len(dome.lights),
        "width": first.width,
        "height": first.height,
    }


def _virtual_subject(
    folder: Path, seed: int | None, size: Json, progress: Progress
) -> Path:
    """The capture of the simulated subject in a folder, simulated if it is absent."""
    seed = VIRTUAL_SEED if seed is None else seed
    subject = folder / f"subject-{seed}"
    if not (subject / "capture.json").is_file():
        # of a rehearsal that was interrupted
        shutil.rmtree(folder / "made", ignore_errors=True)
        [simulated] = simulate(
            folder / "made", takes=1, seed=seed, progress=progress, **size
        )
        simulated.rename(subject)
    return subject
