"""Calibrations of a dome: dated, versioned, and named by the captures that used them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.ingest.camera_calibration import calibrate_cameras, calibrated_cameras
from skindb.ingest.camera_frames import read_calibration_frames
from skindb.ingest.folder import Capture
from skindb.ingest.light_calibration import calibrate_lights, calibrated_dome, read_setup_dome
from skindb.store import CALIBRATION, Database, Record, require_text
from skindb.workflow.provenance import provenance
from skindb.workflow.superseded import superseded_calibrations

NAME = r"[A-Za-z0-9_-]{1,64}"


def calibrate(db: Database, setup: str | Path, *, name: str, fit_falloff: bool = False) -> Record:
    """Calibrate cameras and lights of a dome, and commit the result as the next version of that name.

    Cameras are calibrated if the set-up has dome/calibration.json, lights always, from the white target as the
    calibrated cameras see it.

    Parameters
    ----------
    db
        Database to write to.
    setup
        Folder with dome/dome.json, the frames of the white target, and perhaps dome/calibration.json with the frames
        that it names, see docs/howto/calibrate.md.
    name
        Name by which captures refer to it.
    fit_falloff
        Also fit the angular fall-off of every light.

    Returns
    -------
    Record
        Of the commit. Earlier versions are kept: a capture records which one it used.

    Raises
    ------
    InputError
        With every fault of the folder.
    """
    key = require_text(name, NAME, "name of a calibration")
    dome, groups = read_setup_dome(Path(setup)), dict[str, xr.Dataset]()
    if frames := read_calibration_frames(dome):
        groups["camera_calibration"] = calibrate_cameras(dome, frames)
        dome = calibrated_cameras(dome, groups["camera_calibration"], where="the calibrated cameras")
    groups["light_calibration"] = calibrate_lights(dome, fit_falloff=fit_falloff)
    about = provenance("calibrate", [], parameters={"setup": Path(setup).name, "fit_falloff": fit_falloff})
    with db.stage(CALIBRATION, key) as stage:
        stage.write(groups)
        return stage.commit(about)


def calibrated_capture(db: Database, capture: Capture) -> Capture:
    """The capture with cameras and lights of the newest version of the calibration that it names, if it names one."""
    if not capture.calibration or capture.dome is None:
        return capture
    if not db.has(CALIBRATION, capture.calibration):
        there = ", ".join(db.takes(CALIBRATION)) or "none"
        rule, cure = "the database must hold the calibration that it names", "run skindb calibrate first"
        where = f"{capture.folder / 'capture.json'}[calibration]"
        raise InputError(Fault(where, rule, f"{capture.calibration}; calibrations: {there}", cure))
    record = db.record(CALIBRATION, capture.calibration)
    stored, name = db.read(CALIBRATION, capture.calibration, generation=record.generation), capture.calibration
    dome = calibrated_dome(capture.dome, stored["light_calibration"].to_dataset(), where=f"calibration {name}")
    if "camera_calibration" in stored.children:
        dome = calibrated_cameras(dome, stored["camera_calibration"].to_dataset(), where=f"calibration {name}")
    return replace(capture, dome=dome, calibrated_by=record.as_input())


def describe_calibration(db: Database, record: Record) -> dict[str, Any]:
    """Largest relative error of an intensity, change since the version before, cameras, takes of earlier versions."""
    stored = db.read(CALIBRATION, record.take, generation=record.generation)
    now = stored["light_calibration"].to_dataset().load()
    relative = now["calibrated_intensity_error"] / now["calibrated_intensity"]
    about: dict[str, Any] = {"lights": now.sizes["light"], "largest_relative_error": float(relative.max())}
    if record.generation > 1:
        before = db.read(CALIBRATION, record.take, generation=record.generation - 1)["light_calibration"].to_dataset()
        both = now["calibrated_intensity"] / before["calibrated_intensity"].load()  # lights that both have
        change = abs(both - 1).max(dim="channel")
        if change.size:
            about |= {
                "largest_change": float(change.max()),
                "most_changed": str(change["light"].values[change.values.argmax()]),
            }
    if "camera_calibration" in stored.children:
        about["cameras"] = _describe_cameras(stored["camera_calibration"].to_dataset().load())
    return about | {"ingest_again": takes_of_earlier(db, record)}


def _describe_cameras(found: xr.Dataset) -> dict[str, Any]:
    """How many cameras each calibration has, and the worst of each measure of it."""
    measures = {
        "dark frames": "defect_pixels",
        "response": "calibrated_response",
        "noise": "noise_chi_square",
        "vignette": "vignette_residual",
        "colour": "chart_difference",
        "edge": "edge_blur",
    }
    about = dict[str, Any]()
    for name, variable in measures.items():
        values = found[variable].max(dim=[dim for dim in found[variable].dims if dim != "camera"])
        if count := int(np.isfinite(values).sum()):
            about[name] = {"cameras": count, variable: float(values.max())}
    return about


def takes_of_earlier(db: Database, record: Record) -> list[str]:
    """Takes whose newest capture used an earlier version of a calibration."""
    return superseded_calibrations(db).get(record.take, [])
