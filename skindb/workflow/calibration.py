"""Calibrations of a dome: dated, versioned, and named by the captures that used them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError
from skindb.ingest.folder import Capture
from skindb.ingest.light_calibration import calibrate_lights, calibrated_dome, read_setup_dome
from skindb.store import CALIBRATION, Database, Record, require_text
from skindb.workflow.provenance import provenance

NAME = r"[A-Za-z0-9_-]{1,64}"


def calibrate(db: Database, setup: str | Path, *, name: str, fit_falloff: bool = False) -> Record:
    """Calibrate the lights of a dome from its white target, and commit the result as the next version of that name.

    Parameters
    ----------
    db
        Database to write to.
    setup
        Folder with dome/dome.json and the frames of the white target, see docs/hardware.md.
    name
        What captures call it by.
    fit_falloff
        Find the angular fall-off of every light too.

    Returns
    -------
    Record
        Of the commit. Earlier versions stay: a capture says which one it used.

    Raises
    ------
    InputError
        With every fault of the folder.
    """
    key = require_text(name, NAME, "name of a calibration")
    found = calibrate_lights(read_setup_dome(Path(setup)), fit_falloff=fit_falloff)
    about = provenance("calibrate", [], parameters={"setup": Path(setup).name, "fit_falloff": fit_falloff})
    with db.stage(CALIBRATION, key) as stage:
        stage.write({"light_calibration": found})
        return stage.commit(about)


def calibrated_capture(db: Database, capture: Capture) -> Capture:
    """The capture with the lights of the newest version of the calibration that it names, if it names one."""
    if not capture.calibration or capture.dome is None:
        return capture
    if not db.has(CALIBRATION, capture.calibration):
        there = ", ".join(db.takes(CALIBRATION)) or "none"
        rule, cure = "the database must hold the calibration that it names", "run skindb calibrate first"
        where = f"{capture.folder / 'capture.json'}[calibration]"
        raise InputError(Fault(where, rule, f"{capture.calibration}; calibrations: {there}", cure))
    record = db.record(CALIBRATION, capture.calibration)
    stored = db.read(CALIBRATION, capture.calibration, generation=record.generation)["light_calibration"].to_dataset()
    dome = calibrated_dome(capture.dome, stored, where=f"calibration {capture.calibration}")
    return replace(capture, dome=dome, calibrated_by=record.as_input())


def describe_calibration(db: Database, record: Record) -> dict[str, Any]:
    """Largest relative error of an intensity, change since the version before, takes that used an earlier version."""
    now = db.read(CALIBRATION, record.take, generation=record.generation)["light_calibration"].to_dataset().load()
    relative = now["calibrated_intensity_error"] / now["calibrated_intensity"]
    told: dict[str, Any] = {"lights": now.sizes["light"], "largest_relative_error": float(relative.max())}
    if record.generation > 1:
        before = db.read(CALIBRATION, record.take, generation=record.generation - 1)["light_calibration"].to_dataset()
        both = now["calibrated_intensity"] / before["calibrated_intensity"].load()  # lights that both have
        change = abs(both - 1).max(dim="channel")
        if change.size:
            told |= {
                "largest_change": float(change.max()),
                "most_changed": str(change["light"].values[change.values.argmax()]),
            }
    return told | {"ingest_again": takes_of_earlier(db, record)}


def takes_of_earlier(db: Database, record: Record) -> list[str]:
    """Takes whose newest capture used an earlier version of a calibration."""
    used = {take: db.record("capture", take).about.get("calibrated_by", {}) for take in db.takes("capture")}
    return [take for take, one in used.items()
            if one.get("take") == record.take and one["generation"] < record.generation]  # fmt: skip
