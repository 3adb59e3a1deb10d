"""Recordings of calibration targets by the devices of a laboratory, into the folder that
`calibrate` reads.
"""

import re
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields
from pathlib import Path

import numpy as np

from skindb.calibration import boards, setup
from skindb.clock import SimulatedClock
from skindb.errors import Fault, require, require_none
from skindb.files import Json, private_umask
from skindb.format.fields import read_json
from skindb.format.frames import filled
from skindb.hw.capture import CapturePlan, require_devices
from skindb.hw.capture_folder import Setup, copy_frame, one_session, write_record
from skindb.hw.frame_markers import marker_light
from skindb.hw.sequence import DARK, GAP_SECONDS, Schedule, Step, slowed_schedule
from skindb.hw.session import capture_dome, require_complete
from skindb.hw.target_checks import Taken, Target, target_faults
from skindb.parameters import VIRTUAL_SEED, SessionParameters
from skindb.types import Progress, silent
from skindb.virtual.laboratory import Laboratory, laboratory_faults
from skindb.virtual.targets import TargetScene, rehearsed_dome, write_laboratory
from skindb.workflow.session import (
    VIRTUAL_SIZE,
    Ask,
    connected_devices,
    real_session_faults,
    rehearsal_faults,
)

FOLDER = "dome/calibration"
# without the suffix of the frames
TEMPLATES = {
    "board": f"{FOLDER}/board_{{pose}}_{{camera}}",
    "white": setup.WHITE_FRAMES,
    "ball": f"{FOLDER}/ball_{{place}}_{{light}}_{{camera}}",
    "dark": f"{FOLDER}/dark_{{camera}}_{{repeat}}",
    "flat": f"{FOLDER}/flat_{{camera}}_{{exposure}}_{{repeat}}",
    "chart": f"{FOLDER}/chart_{{camera}}_{{exposure}}",
    "response": f"{FOLDER}/response_{{camera}}_{{exposure}}",
}
CHART_WHITE = f"{FOLDER}/white_{{camera}}_{{exposure}}"
PLACES = {"board": 12, "ball": 3, "chart": 2}
MIN_PLACES = {"board": boards.MIN_POSES, "ball": 2}  # that calibrate needs
DARK_FRAMES = 8
FLAT_FRAMES = 2
BRIGHTNESSES = 7  # exposures of these targets, each half of the one before
BRACKETED = ("flat", "chart", "response")
# what the files must state of each target: file, key, keys of the target
NEEDED = {
    "board": (boards.FILE, "", ("squares", "square", "marker")),
    "ball": (setup.FILE, "ball", ("radius",)),
    "chart": (setup.FILE, "chart", ("pitch",)),
    "white": ("dome/dome.json", "white", ("reflectance", "half_size")),
}
REQUESTS = {
    "board": "Move and tilt the board, by up to 30 degrees (pose {number} of {places})",
    "ball": "Put the ball at another place, with a grey card behind it ({number} of {places})",
    "white": "Put the white target into the holder",
    "dark": "Leave the dome empty, and darken the room",
    "flat": "Put an opal sheet before every lens",
    "chart": "Put the chart into the holder",
    "response": "Put things with dark and bright parts into the dome, which stand still",
}
FIRST = {
    "board": "Put the board upright into the holder, where its middle is the origin"
}
WHITE_SURFACE = "Put a white surface into the holder, in place of the chart"
# options that belong to a recording
OPTIONS = {"calibration", "dome", "cameras", "placements", "log", "virtual", "faults"}


def record_target(
    out: Path,
    parameters: SessionParameters,
    *,
    ask: Ask | None = None,
    progress: Progress = silent,
) -> Json:
    """Record a calibration target; poses and places whose frames exist are skipped.

    Parameters
    ----------
    out
        Folder of the laboratory, with a dome/dome.json that may lack all geometry.
    parameters
        `calibration`, the devices and `placements`.
    ask, progress
        As in `capture_session`.

    Returns
    -------
    dict
        path, kind, frames (number), places (number), notes, and rms_px by camera of a board.

    Raises
    ------
    InputError
        If frames are missing or lights failed after all repeats, or frames do not show the
        target sharp, with enough light and without saturation. Poses and places before are
        kept, and the same call continues.
    """
    kind = str(parameters.calibration)
    _require_options(parameters)
    with private_umask(), ExitStack() as stack:
        if parameters.virtual and not (out / "dome/dome.json").exists():
            write_laboratory(out, **VIRTUAL_SIZE)
        stack.enter_context(one_session(out))
        laboratory = _read_laboratory(out, kind)
        seconds = _exposures(laboratory, kind, out)
        scene = stack.enter_context(
            _virtual_targets(laboratory, kind, seconds, parameters)
        )
        plan = CapturePlan()
        devices = stack.enter_context(
            connected_devices(laboratory, plan, parameters, scene)
        )
        require_devices(laboratory, devices, plan)
        light = marker_light(laboratory.dome)
        steps = _steps(kind, laboratory, seconds, light)
        places = parameters.placements or PLACES.get(kind, 1)
        if kind == "chart":
            places = PLACES[kind]
        fewest = MIN_PLACES.get(kind, 1)
        rule = f"must be at least {fewest} for a {kind}"
        require(places >= fewest, "--placements", rule, f"{places}", "record more")
        notes = []
        board = read_json(out / boards.FILE, []) if kind == "board" else {}
        for number in range(1, places + 1):
            kept = _names(kind, number, laboratory.dome.camera_ids, steps, seconds)
            if all(any(out.glob(f"{name}.*")) for name in kept.values()):
                continue
            if scene is not None and scene.scene is not None:
                scene.scene.number = number
            elif ask is not None:
                ask(_request(kind, number, places))
            run = capture_dome(
                devices.dome,
                devices.cameras,
                _schedule(steps, seconds),
                marker_light=light,
                progress=progress,
            )
            require_complete(run, laboratory.dome.camera_ids)
            target = Target(kind, number, seconds, board)
            require_none(
                target_faults(target, laboratory.dome.cameras, steps, run.frames)
            )
            for key, name in kept.items():
                copy_frame(run.frames[key], out / f"{name}{run.frames[key].suffix}")
            notes += run.notes
        suffix = next(out.glob(f"{next(iter(kept.values()))}.*")).suffix
        report = _written(out, kind, places, laboratory, seconds, suffix)
        return report | {"notes": notes}


def _require_options(parameters: SessionParameters) -> None:
    faults = (
        rehearsal_faults(parameters)
        if parameters.virtual
        else real_session_faults(parameters, ("dome", "cameras"))
    )
    for spec in fields(parameters):
        if spec.name in OPTIONS or getattr(parameters, spec.name) == spec.default:
            continue
        name = {"traits": "trait"}.get(spec.name, spec.name).replace("_", "-")
        rule = "belongs to the capture of a subject"
        faults.append(Fault(f"--{name}", rule, "--calibration", "omit one of them"))
    require_none(list(dict.fromkeys(faults)))


def _read_laboratory(out: Path, kind: str) -> Setup:
    """The set-up, whose geometry need not be measured; the target must be described."""
    faults = list[Fault]()
    record = read_json(out / "dome/dome.json", faults)
    require_none(faults)
    if kind in NEEDED:
        file, key, names = NEEDED[kind]
        content = read_json(out / file, []) if (out / file).is_file() else {}
        described = content.get(key) if key else content
        missing = [name for name in names if name not in (described or {})]
        if missing:
            rule = f"must describe the {kind} by {', '.join(names)}"
            cure = "see docs/howto/calibrate.md"
            faults.append(
                Fault(f"{out / file}", rule, f"no {', '.join(missing)}", cure)
            )
    require_none(faults)
    # frames of the white target, which may not exist yet
    without = {key: value for key, value in record.items() if key != "white"}
    dome = setup.read_setup_dome(
        out, white=False, dark=False, record=setup.with_placeholders(without)
    )
    return Setup(out, dome, record, None, {})


def _exposures(laboratory: Setup, kind: str, out: Path) -> dict[str, float]:
    """Seconds of the exposures of a recording, by id."""
    own = dict(laboratory.dome.exposures)
    if kind not in BRACKETED:
        return own
    record = read_json(out / setup.FILE, []) if (out / setup.FILE).is_file() else {}
    if stated := (record or {}).get("exposures"):
        return {entry["id"]: float(entry["seconds"]) for entry in stated}
    longest = max(own.values())
    return {f"f{i}": longest / 2**i for i in range(BRIGHTNESSES)}


@contextmanager
def _virtual_targets(
    laboratory: Setup,
    kind: str,
    seconds: Mapping[str, float],
    parameters: SessionParameters,
) -> Iterator[Laboratory | None]:
    """Emulated devices whose cameras see the target; None in a real laboratory."""
    if not parameters.virtual:
        yield None
        return
    dome = laboratory.dome
    faults = laboratory_faults(parameters.faults, dome.light_ids, dome.camera_ids)
    virtual, sensor = rehearsed_dome(dome)
    rng = np.random.default_rng(VIRTUAL_SEED)
    scene = TargetScene(virtual, sensor, kind, seconds, rng=rng)
    watched = laboratory.folder.parent / f"{laboratory.folder.name}.virtual/frames"
    clock = SimulatedClock(time.time())
    try:
        yield Laboratory(laboratory.folder, watched, faults, clock=clock, scene=scene)
    finally:
        shutil.rmtree(watched.parent, ignore_errors=True)


def _steps(
    kind: str, laboratory: Setup, seconds: Mapping[str, float], light: str
) -> list[Taken]:
    """Light, exposure and repeat of each step.

    Neighbours differ in their exposure or repeat a step, so that no two look like one light
    that was photographed twice: long exposures, which may be saturated, are between short
    ones.
    """
    falling = sorted(seconds, key=seconds.__getitem__, reverse=True)
    pairs = zip(falling, reversed(falling), strict=True)
    mixed = list(dict.fromkeys(name for pair in pairs for name in pair))
    if kind == "board":
        return [(light, falling[0], 1)]
    if kind == "dark":
        return [(DARK, falling[0], i + 1) for i in range(DARK_FRAMES)]
    if kind == "flat":
        return [(light, e, i + 1) for e in mixed for i in range(FLAT_FRAMES)]
    if kind in ("chart", "response"):
        return [(light, e, 1) for e in mixed]
    return [(one, e, 1) for one in laboratory.dome.light_ids for e in falling]


def _schedule(steps: list[Taken], seconds: Mapping[str, float]) -> Schedule:
    """The steps with at most three flashes in a second, which need no confirmation."""
    planned = []
    start = 0
    for light, exposure, _ in steps:
        length = round(1e6 * seconds[exposure])
        planned.append(Step(light, exposure, start, start + length))
        start += length + round(1e6 * GAP_SECONDS)
    return slowed_schedule(Schedule(tuple(planned)))


def _names(
    kind: str,
    number: int,
    cameras: list[str],
    steps: list[Taken],
    seconds: Mapping[str, float],
) -> dict[tuple[str, int], str]:
    """(camera, step) -> name, without the suffix, of the frames that are kept: those of the
    ball in the shortest exposure, and all others.
    """
    shortest = min(seconds, key=seconds.__getitem__)
    template = CHART_WHITE if (kind, number) == ("chart", 2) else TEMPLATES[kind]
    return {
        (camera, i): filled(
            template,
            camera=camera,
            light=light,
            exposure=exposure,
            repeat=str(repeat),
            pose=str(number),
            place=str(number),
        )
        for camera in cameras
        for i, (light, exposure, repeat) in enumerate(steps)
        if kind != "ball" or exposure == shortest
    }


def _request(kind: str, number: int, places: int) -> str:
    text = FIRST.get(kind, REQUESTS[kind]) if number == 1 else REQUESTS[kind]
    if (kind, number) == ("chart", 2):
        text = WHITE_SURFACE
    return text.format(number=number, places=places)


def _written(
    out: Path,
    kind: str,
    places: int,
    laboratory: Setup,
    seconds: Mapping[str, float],
    suffix: str,
) -> Json:
    """Name the frames in the file that `calibrate` reads; a board is calibrated."""
    cameras = laboratory.dome.camera_ids
    frames = {"frames": f"{TEMPLATES[kind]}{suffix}"}
    file = out / (NEEDED[kind][0] if kind in NEEDED else setup.FILE)
    record = read_json(file, []) if file.is_file() else {}
    if kind == "board":
        record |= frames | {"poses": places, "cameras": cameras}
    elif kind == "white":
        record["white"] = {"cameras": cameras} | record["white"] | frames
    else:
        more = {
            "dark": {"repeats": DARK_FRAMES},
            "flat": {"repeats": FLAT_FRAMES},
            "ball": {"places": places},
            "chart": {"white": f"{CHART_WHITE}{suffix}"},
            "response": {},
        }
        record[kind] = record.get(kind, {}) | frames | more[kind]
    if kind in BRACKETED:
        record["exposures"] = [{"id": e, "seconds": s} for e, s in seconds.items()]
    write_record(file, record)
    report = {"path": str(out), "kind": kind, "places": places}
    pattern = re.sub(r"\{.*?\}", "*", TEMPLATES[kind]) + suffix
    report["frames"] = len(list(out.glob(pattern)))
    if kind == "board":
        found = boards.calibrate_cameras(boards.read_boards(out))
        report["rms_px"] = {name: one.rms for name, one in found.items()}
    return report
