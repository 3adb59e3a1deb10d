"""From a capture folder to a version of kind capture; and calibrations of a dome and its probe:
dated, versioned, and named by the captures that used them.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from xarray import Dataset

from skindb.calibration.boards import FILE as BOARDS
from skindb.calibration.cameras import calibrate_cameras, calibrated_cameras
from skindb.calibration.fibres import calibrate_probe, calibrated_probe
from skindb.calibration.lights import (
    calibrate_lights,
    calibrated_dome,
    is_same_rig,
    positioned_dome,
    rig_dome,
    rig_positions,
)
from skindb.calibration.mirror_ball import calibrate_positions
from skindb.calibration.setup import FILE as CALIBRATION_FILE
from skindb.calibration.setup import (
    read_calibration_frames,
    read_flat_frames,
    read_setup_dome,
    with_placeholders,
)
from skindb.errors import Fault, InputError, add_filename, input_error, require
from skindb.files import Json, plain
from skindb.format.dome import DomeRecord
from skindb.format.fields import NAME, read_json, zoned_time
from skindb.format.frames import Digests
from skindb.ingest import (
    Capture,
    Crop,
    IngestParameters,
    ingest_capture,
    read_capture,
)
from skindb.ingest.report import capture_provenance
from skindb.parameters import CalibrationParameters
from skindb.schema import variables
from skindb.schema.cohort import NORMAL, take_name, visit_of
from skindb.schema.consent import CONSENT
from skindb.store import (
    CALIBRATION,
    Database,
    Record,
    WithdrawnError,
    require_text,
    subject_of,
)
from skindb.threads import one_blas_thread
from skindb.types import Progress, silent
from skindb.workflow.administration import superseded_calibrations
from skindb.workflow.audit import logged_action
from skindb.workflow.derive import code_digest, groups_of
from skindb.workflow.geometry import measured_cameras, write_geometry

RIG = "rig_calibration"  # group of a calibration from takes
# group of a calibration -> function that applies it to a dome
APPLIED: dict[str, Callable[..., DomeRecord]] = {
    "position_calibration": positioned_dome,
    "light_calibration": calibrated_dome,
    RIG: rig_dome,
    "camera_calibration": calibrated_cameras,
}


def ingest_take(db: Database, folder: str | Path, **options: Any) -> Record:
    """Ingest a capture folder and commit it; killed at any point, the same call
    continues where it was.

    Parameters
    ----------
    db
        Database to write to.
    folder
        Capture folder, format version 1.
    **options
        `crop`: what to keep of the scan, a box or the surroundings of the landmarks, by
        default all of it. `wait`: seconds to wait for another run that ingests or fits
        the same take. `visit`: of the subject in the condition, by default what
        capture.json states, or else by `next_visits`. `progress`: called with the stage,
        the number of finished steps and the total number of steps. Others are those of
        `skindb.ingest.IngestParameters`: spacing_mm, photographs, calibration, refine.

    Returns
    -------
    Record
        Of the commit.

    Raises
    ------
    InputError
        With every fault of the folder, before anything is visible; also without the
        consent to fit, if another run ingests or fits the take, or if the subject was
        withdrawn.
    """
    return ingest_if_changed(db, folder, again=True, **options)[0]


def ingest_if_changed(
    db: Database,
    folder: str | Path,
    *,
    again: bool = False,
    crop: Crop | None = None,
    visit: int | None = None,
    planned: Mapping[Path, int] | None = None,
    wait: float = 0.0,
    progress: Progress = silent,
    **parameters: Any,
) -> tuple[Record, bool]:
    """The record of a capture folder that is ingested, as by `ingest_take`, and True; or of
    the newest capture and False, if it was made of the same files, with the same
    parameters, by the same code. With `again` it is always ingested. Visits that
    `next_visits` planned for several folders are `planned`.
    """
    database = None if db.folder is None else db.folder.resolve()
    require(
        database is None or Path(folder).resolve() not in (database, *database.parents),
        db.url,
        "a database lies outside the captures it holds",
        f"the capture {folder} around it",
        "choose another folder for the database",
    )
    capture = calibrated_capture(db, read_capture(folder, crop=crop))
    is_stated = capture.visit is not None or visit is not None
    capture = _at_visit(db, capture, visit, planned or {})
    record = IngestParameters(**parameters)
    if not again:
        stored = _unchanged(db, capture, record)
        if stored is not None:
            return stored, False
    with logged_action(db, "ingest", [capture.take]):
        try:
            return _ingest(db, capture, record, wait, progress, is_stated), True
        except (OSError, InputError):
            _require_admitted(db, capture.take)
            raise


def _unchanged(
    db: Database, capture: Capture, parameters: IngestParameters
) -> Record | None:
    """The newest version of a capture if an ingest would make it again."""
    if not db.has("capture", capture.take):
        return None
    if "fit" not in db.consent(capture.take):
        return None  # the ingest refuses it
    record = db.record("capture", capture.take)
    stored = record.provenance
    if stored.get("code_digest") != _ingest_digest():
        return None
    expected = plain(capture_provenance(capture, asdict(parameters), Digests()))
    same = all(stored[key] == expected[key] for key in ("inputs", "parameters"))
    return record if same else None


def _at_visit(
    db: Database, capture: Capture, visit: int | None, planned: Mapping[Path, int]
) -> Capture:
    """The capture at its visit: the stated one, or what `next_visits` finds."""
    require(
        visit is None or capture.visit in (None, visit),
        f"{capture.folder / 'capture.json'}[visit]",
        "the visit must be stated once",
        f"{capture.visit}, and {visit} for this ingest",
        "omit one of them",
    )
    visit = visit or capture.visit or planned.get(capture.folder)
    return replace(
        capture, visit=visit or next_visits(db, [capture.folder])[capture.folder]
    )


def next_visits(db: Database, folders: Sequence[str | Path]) -> dict[Path, int]:
    """Visits of the capture folders that state none: that of the same session in the
    database, or else the next ones of their subject and condition, in the order of the
    sessions. Folders that cannot be read are omitted.
    """
    sessions = dict[tuple[str, str], list[tuple[datetime, Path, int | None]]]()
    for folder in map(Path, folders):
        record = read_json(folder / "capture.json", [])
        about = record if isinstance(record, dict) else {}
        time = zoned_time(str(about.get("session")))
        if time is not None:
            key = (str(about.get("subject")), str(about.get("condition", NORMAL)))
            stated = about.get("visit") if about.get("version") != 1 else None
            visit = stated if isinstance(stated, int) else None
            sessions.setdefault(key, []).append((time, folder, visit))
    takes = db.takes("capture")
    visits = dict[Path, int]()
    for key, captured in sessions.items():
        # of a damaged record, which the ingest of the folder reports
        with suppress(InputError) if len(folders) > 1 else nullcontext():
            known = {
                zoned_time(str(_session(db, take))): visit_of(take)[0]
                for take in reversed(takes)
                if take == take_name(*key, *visit_of(take))
            }
            known |= {time: visit for time, _, visit in captured if visit is not None}
            for time, folder, visit in sorted(captured, key=lambda one: one[0]):
                if visit is None:
                    following = max(known.values(), default=0) + 1
                    visits[folder] = known.setdefault(time, following)
    return visits


def _session(db: Database, take: str) -> str | None:
    """Time of the session of the newest capture of a take."""
    return db.record("capture", take).provenance.get("session")


def _ingest(
    db: Database,
    capture: Capture,
    parameters: IngestParameters,
    wait: float,
    progress: Progress,
    is_stated: bool,
) -> Record:
    lease = db.lease(
        capture.take, "capture", "model", wait=wait, command="skindb ingest"
    )
    scratch = db.scratch()
    # what is read names its file; what the disk refuses is written there
    with add_filename(str(scratch)), lease:
        # what was recorded since counts, not the folder
        if db.has(CONSENT, subject_of(capture.take)):
            db.require_consent(capture.take, "fit")
        notes = _notes_on_visit(db, capture, is_stated=is_stated)
        db.make_scratch(scratch)
        with (
            one_blas_thread(),
            ingest_capture(
                capture, parameters, scratch=scratch, progress=progress
            ) as tree,
            db.stage("capture", capture.take, lease) as stage,
        ):
            stage.write(groups_of(tree))
            progress("write", 1, 1)
            provenance = {str(name): value for name, value in tree.attrs.items()}
            provenance["code_digest"] = _ingest_digest()
            summary = provenance["summary"]
            provenance["summary"] = summary | {"notes": [*notes, *summary["notes"]]}
            return stage.commit(provenance)


def _notes_on_visit(db: Database, capture: Capture, *, is_stated: bool) -> list[str]:
    """A line on a visit that is new by its session, or on a session that replaces another."""
    take = capture.take
    if not db.has("capture", take):
        new = not is_stated and capture.visit != 1
        line = f"session {capture.session} is visit {capture.visit}: no visit is stated"
        return [f"{line}, and it is another session than those before"] if new else []
    earlier = _session(db, take)
    if earlier is None or zoned_time(earlier) == zoned_time(capture.session):
        return []
    require(
        is_stated,
        take,
        "a session without a stated visit must be a visit of its own",
        f"session {earlier}, which another run ingested in the meantime",
        "run the command again",
    )
    return [
        f"session {capture.session} takes the place of session {earlier} as the newest "
        "capture of this visit"
    ]


def _ingest_digest() -> str:
    """Digest of the code that reads a capture, applies its calibration and ingests it."""
    return code_digest(
        read_capture, calibrated_probe, *APPLIED.values(), ingest_capture
    )


def _require_admitted(db: Database, take: str) -> None:
    """Raise a `WithdrawnError` if the subject of a take is withdrawn."""
    entry = db.withdrawal(subject_of(take))
    if entry is not None:
        raise WithdrawnError(
            Fault(
                subject_of(take),
                "captures of a withdrawn subject must not be ingested",
                f"a withdrawal on {entry['withdrawn'][:10]}",
                "if the subject consented again, give it a new pseudonym",
            )
        )


def calibrate(
    db: Database,
    setup: str | Path,
    *,
    name: str,
    **options: Any,
) -> Record:
    """Calibrate lights, cameras and probe of a set-up, and commit the result as the
    next version of that name.

    If the set-up has dome/boards.json, the cameras are calibrated by the board, the lights by
    the mirror ball in its frame, and both are written into dome/dome.json, which may lack
    them; the white target stands where the board did. If it has dome/calibration.json, the
    positions of the lights and the cameras are calibrated by the frames that it names. The
    intensities of the lights follow from the white target, as the calibrated cameras see
    it. The probe is calibrated if the set-up has contact/calibration.json.

    Parameters
    ----------
    db
        Database to write to.
    setup
        Folder with dome/dome.json, the frames of the white target, and perhaps
        dome/calibration.json and contact/calibration.json with the frames that they
        name, see docs/howto/calibrate.md.
    name
        Name by which captures refer to it.
    **options
        Of `skindb.parameters.CalibrationParameters`: `position_error`, the standard
        error of the position of a light relative to the white target along each axis,
        in mm.

    Returns
    -------
    Record
        Of the commit. Earlier versions are kept: a capture records which one it used.

    Raises
    ------
    InputError
        With every fault of the folder, or of the options.
    """
    chosen = CalibrationParameters(name, **options)
    key = require_text(name, NAME.pattern, "name of a calibration")
    require_kind_of_calibration(db, key, rig=False)
    folder = Path(setup)
    geometry = Json()
    cameras = Json()
    if (folder / BOARDS).is_file():
        geometry, cameras = measured_cameras(folder)
        geometry = with_placeholders(geometry)
    dome = read_setup_dome(folder, record=geometry or None)
    groups = {}
    frames = read_calibration_frames(dome)
    require(
        not geometry or (frames and frames.ball),
        str(folder / CALIBRATION_FILE),
        "lights must be calibrated in the frame of the board, by a mirror ball",
        "no ball",
        f"photograph it (skindb capture --calibration ball), or remove {BOARDS}",
    )
    if frames:
        if frames.ball is not None:
            groups["position_calibration"] = calibrate_positions(dome, frames.ball)
            dome = positioned_dome(
                dome, groups["position_calibration"], where="the calibrated positions"
            )
        groups["camera_calibration"] = calibrate_cameras(dome, frames)
        if cameras:
            rms = [cameras[name]["rms_px"] for name in dome.camera_ids]
            groups["camera_calibration"][variables.REPROJECTION_RMS].values[:] = rms
        dome = calibrated_cameras(
            dome, groups["camera_calibration"], where="the calibrated cameras"
        )
    groups["light_calibration"] = calibrate_lights(
        dome, position_error=chosen.position_error
    )
    if (flat := read_flat_frames(folder)) is not None:
        groups["probe_calibration"] = calibrate_probe(flat)
    parameters = {
        "setup": folder.name,
        "position_error": chosen.position_error,
        **({"boards": cameras} if cameras else {}),
    }
    provenance = {
        "command": "calibrate",
        "parameters": parameters,
        "seeds": {},
        "inputs": [],
    }
    with logged_action(db, "calibrate"), db.stage(CALIBRATION, key) as stage:
        stage.write(groups)
        record = stage.commit(provenance)
    if geometry:
        write_geometry(folder, geometry, groups["position_calibration"])
    return record


def require_kind_of_calibration(db: Database, name: str, *, rig: bool) -> None:
    """Require that earlier versions of a calibration are from takes (`rig`) too, or from
    a set-up too.
    """
    is_rig = db.has(CALIBRATION, name) and RIG in db.record(CALIBRATION, name).contents
    require(
        not db.has(CALIBRATION, name) or is_rig == rig,
        f"calibration {name}",
        "all versions must be from takes, or all from set-ups",
        "earlier versions from " + ("takes" if is_rig else "set-ups"),
        "choose another name",
    )


def rigs_of(db: Database, dome: DomeRecord) -> list[str]:
    """Names of the calibrations from takes whose lights are those of a dome."""
    lights = {light.id: light.position for light in dome.lights}
    return [
        name
        for name in db.takes(CALIBRATION)
        if RIG in db.record(CALIBRATION, name).contents
        and is_same_rig(
            lights, rig_positions(db.read(CALIBRATION, name)[RIG].to_dataset())
        )
    ]


def calibrated_capture(db: Database, capture: Capture) -> Capture:
    """The capture with the newest version of the calibration that it names, or else of
    the only calibration from takes that has its lights.
    """
    name = capture.calibration
    dome = capture.dome
    probe = capture.probe
    if not name and dome is not None:
        rigs = rigs_of(db, dome)
        if len(rigs) > 1:
            line = (
                f"errors of the lights: calibrations {' and '.join(rigs)} have the same "
                "lights; name one in capture.json"
            )
            return replace(capture, skipped=(*capture.skipped, line))
        name = "".join(rigs)
    if not name or (dome is None and probe is None):
        return capture
    if not db.has(CALIBRATION, name):
        names = ", ".join(db.takes(CALIBRATION)) or "none"
        raise input_error(
            f"{capture.folder / 'capture.json'}[calibration]",
            "the database must hold the calibration that it names",
            f"{name}; calibrations: {names}",
            "run skindb calibrate first",
        )
    record = db.record(CALIBRATION, name)
    stored = db.version(record)
    groups = groups_of(stored)
    source = f"calibration {name}"
    for group, apply in APPLIED.items():
        if dome is not None and group in groups:
            dome = apply(dome, groups[group], where=source)
    if probe is not None and "probe_calibration" in groups:
        probe = calibrated_probe(probe, groups["probe_calibration"], where=source)
    return replace(capture, dome=dome, probe=probe, calibrated_by=record.as_input())


def describe_calibration(db: Database, record: Record) -> Json:
    """Largest relative errors of intensities, cameras, takes of earlier versions."""
    groups = groups_of(db.version(record).load())
    description = _describe_lights(groups["light_calibration"])
    if (positions := groups.get("position_calibration")) is not None:
        errors = positions[variables.CALIBRATED_POSITION_ERROR]
        description["largest_position_error_mm"] = float(errors.max())
    if (fibres := groups.get("probe_calibration")) is not None:
        errors = (
            fibres[variables.CALIBRATED_FIBRE_GAIN_ERROR]
            / fibres[variables.CALIBRATED_FIBRE_GAIN]
        )
        description["probe"] = {
            "fibres": fibres.sizes["fibre"],
            "largest_relative_error": float(errors.max()),
        }
    if (cameras := groups.get("camera_calibration")) is not None:
        description["cameras"] = _describe_cameras(cameras)
    if boards := record.provenance["parameters"].get("boards"):
        names = ("focal_error_px", "turn_error_degrees", "position_error_mm")
        description["boards"] = {"cameras": len(boards)} | {
            key: max(one[key] for one in boards.values()) for key in names
        }
    return description | {"ingest_again": takes_of_earlier(db, record)}


def _describe_lights(lights: Dataset) -> Json:
    """Number of the lights and errors of their intensities."""
    error = lights[variables.CALIBRATED_INTENSITY_ERROR]
    relative = (error / lights[variables.CALIBRATED_INTENSITY]).max("channel")
    position = lights[variables.CALIBRATED_INTENSITY_POSITION_ERROR]
    glare = lights[variables.GLARE_FRACTION]
    total = np.sqrt(relative**2 + position**2 + glare**2)
    return {
        "lights": lights.sizes["light"],
        "largest_relative_error": float(relative.max()),
        "position_error": float(position.median()),
        "glare": float(glare.median()),
        "total_relative_error": float(total.max()),
    }


def _describe_cameras(calibration: Dataset) -> Json:
    """How many cameras each calibration has, and the worst of each measure of it."""
    measures = {
        "dark frames": variables.DEFECT_PIXELS,
        "response": variables.CALIBRATED_RESPONSE,
        "noise": variables.NOISE_CHI_SQUARE,
        "vignette": variables.VIGNETTE_RESIDUAL,
        "colour": variables.CHART_DIFFERENCE,
        "known points": variables.REPROJECTION_RMS,
    }
    description = {}
    for name, variable in measures.items():
        values = calibration[variable]
        values = values.max(dim=[dim for dim in values.dims if dim != "camera"])
        if count := int(np.isfinite(values).sum()):
            description[name] = {"cameras": count, variable: float(values.max())}
    return description


def takes_of_earlier(db: Database, record: Record) -> list[str]:
    """Takes whose newest capture used an earlier version of a calibration."""
    return superseded_calibrations(db).get(record.take, [])
