"""Calibrations of a dome and its probe: dated, versioned, and named by the captures
that used them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb.calibration.cameras import calibrate_cameras, calibrated_cameras
from skindb.calibration.fibres import calibrate_probe, calibrated_probe
from skindb.calibration.lights import (
    calibrate_lights,
    calibrate_positions,
    calibrated_dome,
    positioned_dome,
)
from skindb.calibration.setup import (
    read_calibration_frames,
    read_flat_frames,
    read_setup_dome,
)
from skindb.errors import Fault, InputError
from skindb.format.dome import DomeRecord
from skindb.format.fields import NAME
from skindb.format.folder import Capture
from skindb.parameters import CalibrationParameters
from skindb.store import CALIBRATION, Database, Record, require_text
from skindb.workflow.administration import superseded_calibrations
from skindb.workflow.audit import logged_action

# group of a calibration -> function that applies it to a dome
APPLIED: dict[str, Callable[..., DomeRecord]] = {
    "position_calibration": positioned_dome,
    "light_calibration": calibrated_dome,
    "camera_calibration": calibrated_cameras,
}


def calibrate(
    db: Database,
    setup: str | Path,
    *,
    name: str,
    **options: Any,
) -> Record:
    """Calibrate lights, cameras and probe of a set-up, and commit the result as the
    next version of that name.

    If the set-up has dome/calibration.json, the positions of the lights and the cameras
    are calibrated by the frames that it names. The intensities of the lights follow
    from the white target, as the calibrated cameras see it. The probe is calibrated if
    the set-up has contact/calibration.json.

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
        Of `skindb.parameters.CalibrationParameters`: `fit_falloff`, whether the angular
        fall-off of every light is fitted too, and `position_error`, the standard error
        of the position of a light relative to the white target along each axis, in mm.

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
    dome = read_setup_dome(Path(setup))
    groups = dict[str, xr.Dataset]()
    if frames := read_calibration_frames(dome):
        if frames.ball is not None:
            groups["position_calibration"] = calibrate_positions(dome, frames.ball)
            dome = positioned_dome(
                dome, groups["position_calibration"], where="the calibrated positions"
            )
        groups["camera_calibration"] = calibrate_cameras(dome, frames)
        dome = calibrated_cameras(
            dome, groups["camera_calibration"], where="the calibrated cameras"
        )
    groups["light_calibration"] = calibrate_lights(
        dome,
        fit_falloff=chosen.fit_falloff,
        position_error=chosen.position_error,
    )
    if (flat := read_flat_frames(Path(setup))) is not None:
        groups["probe_calibration"] = calibrate_probe(flat)
    parameters = {
        "setup": Path(setup).name,
        "fit_falloff": chosen.fit_falloff,
        "position_error": chosen.position_error,
    }
    about = {
        "command": "calibrate",
        "parameters": parameters,
        "seeds": {},
        "inputs": [],
    }
    with logged_action(db, "calibrate"), db.stage(CALIBRATION, key) as stage:
        stage.write(groups)
        return stage.commit(about)


def calibrated_capture(db: Database, capture: Capture) -> Capture:
    """The capture with the newest version of the calibration that it names, if it names one."""
    name = capture.calibration
    dome = capture.dome
    probe = capture.probe
    if not name or (dome is None and probe is None):
        return capture
    if not db.has(CALIBRATION, name):
        names = ", ".join(db.takes(CALIBRATION)) or "none"
        where = f"{capture.folder / 'capture.json'}[calibration]"
        rule = "the database must hold the calibration that it names"
        found = f"{name}; calibrations: {names}"
        raise InputError(Fault(where, rule, found, "run skindb calibrate first"))
    record = db.record(CALIBRATION, name)
    stored = db.read(CALIBRATION, name, generation=record.generation)
    groups = {group: child.to_dataset() for group, child in stored.children.items()}
    where = f"calibration {name}"
    for group, apply in APPLIED.items():
        if dome is not None and group in groups:
            dome = apply(dome, groups[group], where=where)
    if probe is not None and "probe_calibration" in groups:
        probe = calibrated_probe(probe, groups["probe_calibration"], where=where)
    return replace(capture, dome=dome, probe=probe, calibrated_by=record.as_input())


def describe_calibration(db: Database, record: Record) -> dict[str, Any]:
    """Largest relative errors of intensities, change since the version before, cameras,
    takes of earlier versions.
    """
    groups = _groups(db, record, record.generation)
    lights = groups["light_calibration"]
    intensity = lights["calibrated_intensity"]
    relative = (lights["calibrated_intensity_error"] / intensity).max("channel")
    position = lights["calibrated_intensity_position_error"]
    glare = lights["glare_fraction"]
    total = np.sqrt(relative**2 + position**2 + glare**2)
    about: dict[str, Any] = {
        "lights": lights.sizes["light"],
        "largest_relative_error": float(relative.max()),
        "position_error": float(position.median()),
        "glare": float(glare.median()),
        "total_relative_error": float(total.max()),
    }
    if record.generation > 1:
        before = _groups(db, record, record.generation - 1)["light_calibration"]
        # lights that both have
        ratio = intensity / before["calibrated_intensity"]
        change = abs(ratio - 1).max(dim="channel")
        if change.size:
            about |= {
                "largest_change": float(change.max()),
                "most_changed": str(change["light"].values[change.values.argmax()]),
            }
    if (positions := groups.get("position_calibration")) is not None:
        errors = positions["calibrated_position_error"]
        about["largest_position_error_mm"] = float(errors.max())
    if (fibres := groups.get("probe_calibration")) is not None:
        errors = fibres["calibrated_fibre_gain_error"] / fibres["calibrated_fibre_gain"]
        about["probe"] = {
            "fibres": fibres.sizes["fibre"],
            "largest_relative_error": float(errors.max()),
        }
    if (cameras := groups.get("camera_calibration")) is not None:
        about["cameras"] = _describe_cameras(cameras)
    return about | {"ingest_again": takes_of_earlier(db, record)}


def _groups(db: Database, record: Record, generation: int) -> dict[str, xr.Dataset]:
    """The groups of a version of a calibration, in memory."""
    stored = db.read(CALIBRATION, record.take, generation=generation)
    return {name: group.to_dataset().load() for name, group in stored.children.items()}


def _describe_cameras(calibration: xr.Dataset) -> dict[str, Any]:
    """How many cameras each calibration has, and the worst of each measure of it."""
    measures = {
        "dark frames": "defect_pixels",
        "response": "calibrated_response",
        "noise": "noise_chi_square",
        "vignette": "vignette_residual",
        "colour": "chart_difference",
        "edge": "edge_blur",
        "known points": "reprojection_rms",
    }
    about = dict[str, Any]()
    for name, variable in measures.items():
        values = calibration[variable]
        values = values.max(dim=[dim for dim in values.dims if dim != "camera"])
        if count := int(np.isfinite(values).sum()):
            about[name] = {"cameras": count, variable: float(values.max())}
    return about


def takes_of_earlier(db: Database, record: Record) -> list[str]:
    """Takes whose newest capture used an earlier version of a calibration."""
    return superseded_calibrations(db).get(record.take, [])
