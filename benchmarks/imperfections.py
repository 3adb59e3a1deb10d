"""Captures of imperfect domes: accuracy of the recovered parameters, and coverage of
their stated errors.

    python -m benchmarks imperfections DB CAPTURE [CAPTURE...]
    python -m benchmarks imperfections DB CAPTURE [CAPTURE...] --refinement

Each capture folder has its truth beside it as <folder>.truth.npz (keys of
skindb.virtual.capture). The captures are ingested into DB, which must be new, and fitted
with a tenth of the lights held out; with --corrected, ingest uses --refine on and fit
--inter-reflection on, otherwise both are off. The Markdown table has one row per capture:
errors of normals and R_d, fraction of R_d within its 95 % interval, the median half-width
of the interval, errors at held-out lights, and notes of ingest. The lines after the table
pool the captures.

With --refinement, each capture is ingested with --refine off, on and auto. The table has
what auto chose and why, the median errors of the normals of a tenth of the surfels, fitted
up to the joint refinement, and the CPU times of the ingests.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xarray as xr

import skindb
from benchmarks.truth import Truth, read_truth
from benchmarks.validate import header
from skindb.errors import InputError
from skindb.fit import (
    FitParameters,
    estimate_diffuse_reflectance,
    estimate_normals,
    lumitexels,
    refine_jointly,
)
from skindb.schema import variables
from skindb.store import Database
from skindb.virtual.capture import (
    at_foot_points,
    foot_points,
    recovered_against_true,
)
from skindb.workflow import ingest_take
from skindb.workflow.fit import fit_take

COLUMNS = (
    "normal median, 95 % [deg]",
    "R_d error R G B [%]",
    "R_d bias R G B [%]",
    "in the 95 % interval of R_d [%]",
    "half-width of the interval R G B [%]",
    "held out, median, 95 % [%]",
    "obstructed [% of the scan]",
    "notes",
)
REFINEMENT_COLUMNS = (
    "choice of auto",
    "normals off [deg]",
    "on",
    "auto",
    "CPU time of ingest off [s]",
    "auto",
)
SURFEL_STEP = 10
MIN_SAMPLES = 16


def measure(db: Database, folder: Path, *, corrected: bool) -> dict[str, Any]:
    """Ingest, fit and compare one capture."""
    ingested = ingest_take(db, folder, calibration="note", refine=corrected)
    report = fit_take(
        db,
        ingested.take,
        FitParameters(hold_out_lights=0.1, inter_reflection=corrected),
    ).provenance
    model = db.read("model", ingested.take)
    recovered = recovered_against_true(model, read_truth(folder))
    fitted = recovered.fitted
    diffuse = model["fitted/diffuse_reflectance"].values[fitted]
    error = model["fitted/diffuse_reflectance_total_error"].values[fitted].astype(float)
    off = diffuse - recovered.true_diffuse[fitted]
    finite = np.isfinite(off).all(axis=1)
    return {
        "capture": folder.name,
        **recovered.summary(),
        "coverage": (np.abs(off[finite]) < 1.96 * error[finite]).mean(axis=0).tolist(),
        "half_width": np.median(
            1.96 * error[finite] / diffuse[finite], axis=0
        ).tolist(),
        "offset": np.median(off[finite], axis=0).tolist(),
        "held_out": report.get("held_out_error"),
        "status": report["status"],
        "notes": list(ingested.provenance["summary"]["notes"]),
        "suspects": report.get("suspects"),
    }


def measure_refinement(db: Database, folder: Path) -> dict[str, Any]:
    """Ingest one capture with each value of --refine, and compare the normals."""
    result: dict[str, Any] = {"capture": folder.name, "cpu": {}, "normals": {}}
    # the first one also loads compiled code; its time is not reported
    for refine in (True, False, "auto"):
        start = time.process_time()
        ingested = ingest_take(db, folder, calibration="note", refine=refine)
        result["cpu"][refine] = time.process_time() - start
        if refine != "auto":
            capture = db.read("capture", ingested.take)
            result["normals"][refine] = normal_error(capture, read_truth(folder))
    reason = ingested.provenance["summary"]["corrections"]["refine"]
    # the samples are those of one of the others
    result["normals"]["auto"] = result["normals"][reason.startswith("on")]
    return result | {"reason": reason}


def normal_error(capture: xr.DataTree, truth: Truth) -> float:
    """Median error [deg] of the normals of one in `SURFEL_STEP` surfels after the joint
    refinement.
    """
    count = capture["samples"]["sample_count"].values
    few = np.flatnonzero(count >= MIN_SAMPLES)[::SURFEL_STEP]
    samples = lumitexels(capture).isel(surfel=few).load()
    eta = FitParameters().eta
    fitted = estimate_normals(samples, eta=eta)
    fitted = fitted.merge(estimate_diffuse_reflectance(samples.merge(fitted), eta=eta))
    fitted = refine_jointly(samples.merge(fitted), eta=eta)
    face, corner = foot_points(samples, truth)
    true = at_foot_points(truth["normals"][truth["faces"][face]], corner)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    cosine = (fitted[variables.SHADING_NORMAL].values * true).sum(axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return float(np.nanmedian(angle[face >= 0]))


def refinement_row(r: dict[str, Any]) -> str:
    """One row of the table of refinements."""
    normals = [f"{r['normals'][refine]:.2f}" for refine in (False, True, "auto")]
    seconds = [f"{r['cpu'][refine]:.1f}" for refine in (False, "auto")]
    return f"| {r['capture']} | {' | '.join([r['reason'], *normals, *seconds])} |"


def row(r: dict[str, Any]) -> str:
    """One row of the table."""
    if "refused" in r:
        return f"| {r['capture']} | refused: {r['refused']} |" + " |" * (
            len(COLUMNS) - 1
        )
    light = r["held_out"]
    cells = (
        f"{r['normal_median_deg']:.1f}, {r['normal_95_deg']:.1f}",
        numbers(r["diffuse_median_percent"]),
        numbers(r["diffuse_bias_percent"], "+.1f"),
        f"{100 * np.mean(r['coverage']):.0f}",
        numbers(100 * np.array(r["half_width"]), ".0f"),
        f"{100 * light['median']:.1f}, {100 * light['p95']:.0f}" if light else "none",
        f"{100 * r['status'].get('obstructed', 0):.0f}",
        "; ".join(r["notes"]),
    )
    return f"| {r['capture']} | {' | '.join(cells)} |"


def numbers(values: Any, form: str = ".1f") -> str:
    """Formatted numbers separated by spaces."""
    return " ".join(f"{value:{form}}" for value in values)


def main(
    db: str,
    captures: Sequence[Path],
    *,
    corrected: Annotated[
        bool, "Ingest with --refine on, and fit with --inter-reflection on."
    ] = False,
    refinement: Annotated[bool, "Compare --refine off, on and auto instead."] = False,
    json_: Annotated[Path | None, "File for all results."] = None,
) -> None:
    """Measure and print."""
    db = skindb.open(db, create=True)
    results = []
    if refinement:
        print(header(*REFINEMENT_COLUMNS))
        for folder in captures:
            results.append(measure_refinement(db, folder))
            print(refinement_row(results[-1]), flush=True)
        save(results, json_)
        return
    print(header(*COLUMNS))
    for folder in captures:
        try:
            results.append(measure(db, folder, corrected=corrected))
        except InputError as error:
            results.append(
                {"capture": folder.name, "refused": str(error).splitlines()[0]}
            )
        print(row(results[-1]), flush=True)
    share = np.array([r["coverage"] for r in results if "coverage" in r])
    if len(share):
        means = share.mean(axis=1)
        width = np.median([r["half_width"] for r in results if "coverage" in r], axis=0)
        print(
            f"\nIn the 95 % interval of R_d: {100 * share.mean():.1f} % of all; "
            f"lowest {100 * means.min():.0f} %"
        )
        print(
            f"Median half-width of the interval, R G B: {numbers(100 * width, '.0f')} %"
        )
    save(results, json_)


def save(results: list[dict[str, Any]], file: Path | None) -> None:
    """Write all results to a file, if one is given."""
    if file:
        file.write_text(json.dumps(results, indent=1, default=str), encoding="utf-8")
