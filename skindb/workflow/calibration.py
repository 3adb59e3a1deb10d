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
    POSITION_ERROR_MM,
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
from skindb.format.folder import Capture
from skindb.store import CALIBRATION, Database, Record, require_text
from skindb.workflow.audit import logged_action
from skindb.workflow.provenance import provenance
from skindb.workflow.superseded import superseded_calibrations

# group of a calibration -> function that applies it to a dome
APPLIED: dict[str, Callable[..., DomeRecord]] = {
    "position_calibration": positioned_dome,
    "light_calibration": calibrated_dome,
    "camera_calibration": calibrated_cameras,
}
NAME = r"[A-Za-z0-9_-]{1,64}"


def calibrate(
    db: Database,
    setup: str | Path,
    *,
    name: str,
    fit_falloff: bool = False,
    position_error: float = POSITION_ERROR_MM,
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
    fit_falloff
        Also fit the angular fall-off of every light.
    position_error
        Standard error of the position of a light relative to the white target along
        each axis, in mm.

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
        dome, fit_falloff=fit_falloff, position_error=position_error
    )
    if (flat := read_flat_frames(Path(setup))) is not None:
        groups["probe_calibration"] = calibrate_probe(flat)
    parameters = {
        "setup": Path(setup).name,
        "fit_falloff": fit_falloff,
        "position_error": position_error,
    }
    about = provenance("calibrate", [], parameters=parameters)
    with logged_action(db, "calibrate"), db.stage(CALIBRATION, key) as stage:
        stage.write(groups)
        return stage.commit(about)


def calibrated_capture(db: Database, capture: Capture) -> Capture:
    """The capture with the newest version of the calibration that it names, if it names one."""
    if not capture.calibration or (capture.dome is None and capture.probe is None):
        return capture
    if not db.has(CALIBRATION, capture.calibration):
        there = ", ".join(db.takes(CALIBRATION)) or "none"
        rule = "the database must hold the calibration that it names"
        cure = "run skindb calibrate first"
        where = f"{capture.folder / 'capture.json'}[calibration]"
        raise InputError(
            Fault(where, rule, f"{capture.calibration}; calibrations: {there}", cure)
        )
    record = db.record(CALIBRATION, capture.calibration)
    stored = db.read(CALIBRATION, capture.calibration, generation=record.generation)
    dome = capture.dome
    probe = capture.probe
    where = f"calibration {capture.calibration}"
    for group, apply in APPLIED.items():
        if dome is not None and group in stored.children:
            dome = apply(dome, stored[group].to_dataset(), where=where)
    if probe is not None and "probe_calibration" in stored.children:
        probe = calibrated_probe(
            probe, stored["probe_calibration"].to_dataset(), where=where
        )
    return replace(capture, dome=dome, probe=probe, calibrated_by=record.as_input())


def describe_calibration(db: Database, record: Record) -> dict[str, Any]:
    """Largest relative errors of intensities, change since the version before, cameras,
    takes of earlier versions.
    """
    stored = db.read(CALIBRATION, record.take, generation=record.generation)
    now = stored["light_calibration"].to_dataset().load()
    relative = (now["calibrated_intensity_error"] / now["calibrated_intensity"]).max(
        "channel"
    )
    about: dict[str, Any] = {
        "lights": now.sizes["light"],
        "largest_relative_error": float(relative.max()),
    }
    position = now["calibrated_intensity_position_error"]
    glare = now["glare_fraction"]
    total = np.sqrt(relative**2 + position**2 + glare**2)
    about |= {
        "position_error": float(position.median()),
        "glare": float(glare.median()),
        "total_relative_error": float(total.max()),
    }
    if record.generation > 1:
        before = db.read(CALIBRATION, record.take, generation=record.generation - 1)[
            "light_calibration"
        ].to_dataset()
        # lights that both have
        both = now["calibrated_intensity"] / before["calibrated_intensity"].load()
        change = abs(both - 1).max(dim="channel")
        if change.size:
            about |= {
                "largest_change": float(change.max()),
                "most_changed": str(change["light"].values[change.values.argmax()]),
            }
    if "position_calibration" in stored.children:
        positions = stored["position_calibration"].to_dataset().load()
        about["largest_position_error_mm"] = float(
            positions["calibrated_position_error"].max()
        )
    if "probe_calibration" in stored.children:
        probe = stored["probe_calibration"].to_dataset().load()
        error = probe["calibrated_fibre_gain_error"] / probe["calibrated_fibre_gain"]
        about["probe"] = {
            "fibres": probe.sizes["fibre"],
            "largest_relative_error": float(error.max()),
        }
    if "camera_calibration" in stored.children:
        about["cameras"] = _describe_cameras(
            stored["camera_calibration"].to_dataset().load()
        )
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
        "known points": "reprojection_rms",
    }
    about = dict[str, Any]()
    for name, variable in measures.items():
        values = found[variable].max(
            dim=[dim for dim in found[variable].dims if dim != "camera"]
        )
        if count := int(np.isfinite(values).sum()):
            about[name] = {"cameras": count, variable: float(values.max())}
    return about


def takes_of_earlier(db: Database, record: Record) -> list[str]:
    """Takes whose newest capture used an earlier version of a calibration."""
    return superseded_calibrations(db).get(record.take, [])
