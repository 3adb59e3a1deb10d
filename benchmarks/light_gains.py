"""Estimation of planted gains of the lights in captures with known truth: residual
gains, and effect on the errors.

    python -m benchmarks light_gains DB CAPTURE [CAPTURE...]

Each capture folder has its truth beside it as <folder>.truth.npz (keys of
skindb.virtual.capture). The captures are ingested into DB; their samples are multiplied
by random gains and fitted without and with `light_gains`, a tenth of the cameras held
out. The Markdown table has one row for each capture and size of the gains; its last
column is what a fit chooses by itself, for gains and inter-reflection.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import skindb
from benchmarks.truth import read_truth
from benchmarks.validate import header
from skindb.fit import FitParameters, first_pass, fit_model
from skindb.virtual.capture import recovered_against_true
from skindb.workflow import ingest_take

COLUMNS = (
    "gains",
    "residual [%]",
    "normals, without, with [deg]",
    "held-out cameras, without, with [%]",
    "choice",
)
SPREADS = (0.0, 0.05, 0.15)


def planted(capture: xr.DataTree, gain: np.ndarray[Any, Any]) -> xr.DataTree:
    """The capture with the samples of each light multiplied by its gain."""
    samples = capture["samples"].to_dataset()
    out = capture.copy()
    sample = samples["reflectance_sample"]
    brighter = (
        sample.astype(np.float32) * xr.Variable("light", gain.astype(np.float32))
    ).astype(sample.dtype)
    out["samples"] = samples.assign(
        reflectance_sample=brighter.transpose(*sample.dims).assign_attrs(sample.attrs)
    )
    return out


def main(db: str, captures: Sequence[Path]) -> None:
    """Measure and print."""
    database = skindb.open(db, create=True)
    print(header(*COLUMNS))
    for folder in captures:
        take = ingest_take(database, folder, calibration="note").take
        capture = database.read("capture", take)
        truth = read_truth(folder)
        normal = (
            np.random.default_rng(5)
            .standard_normal(capture["samples"].sizes["light"])
            .clip(-2.5, 2.5)
        )
        for spread in SPREADS:
            gain = 1 + spread * normal
            wrong = planted(capture, gain)
            models = [
                fit_model(
                    wrong,
                    FitParameters(hold_out_cameras=0.1, light_gains=on),
                )
                for on in (False, True)
            ]
            angles = [
                recovered_against_true(model, truth).summary()["normal_median_deg"]
                for model in models
            ]
            errors = [
                100 * model.attrs["held_out_camera_error"]["median"] for model in models
            ]
            residual = (
                100 * np.log(models[1]["light_gains/light_gain"].values / gain).std()
            )
            cells = (
                f"{spread:.0%}",
                f"{residual:.1f}",
                "{:.1f}, {:.1f}".format(*angles),
                "{:.1f}, {:.1f}".format(*errors),
                "; ".join(first_pass(wrong).attrs["corrections"].values()),
            )
            print(f"| {folder.name} | {' | '.join(cells)} |", flush=True)
