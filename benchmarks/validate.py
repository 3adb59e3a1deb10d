"""Errors of fits of captures made by an independent renderer, relative to their truth
(docs/validation.md).

    python -m benchmarks validate DB CAPTURE [CAPTURE...]

The truth of each capture folder is in <folder>.truth.npz (keys of
skindb.virtual.capture). The captures are ingested into DB and fitted. Two Markdown tables
are printed: errors, and surfels by status with times and memory.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import skindb
from benchmarks.stages import Stages, stage_lines
from benchmarks.truth import read_truth
from skindb.fit import FitParameters
from skindb.store import Database
from skindb.virtual.capture import recovered_against_true
from skindb.workflow import ingest_take
from skindb.workflow.fit import fit_take

COLUMNS = (
    "normal median, 95 % [deg]",
    "R_d error R G B [%]",
    "R_d bias R G B [%]",
    "held out, median, 95 % [%]",
    "held-out cameras [%]",
    "sigma_tr per site, R G B [%]",
)
STAGES = (
    "dictionary",
    "first pass",
    "reduced basis",
    "second pass",
    "translucency",
    "commit",
)


def measure(
    db: Database, folder: Path, *, spacing: float, parameters: FitParameters
) -> dict[str, Any]:
    """Ingest, fit and compare one capture."""
    with Stages() as ingest:
        take = ingest_take(db, folder, spacing_mm=spacing, progress=ingest).take
        ingest.end("commit")
    with Stages() as fit:
        report = fit_take(db, take, parameters, progress=fit).provenance
        fit.end("commit")
    model = db.read("model", take)
    recovered = recovered_against_true(model, read_truth(folder)).summary()
    stages = {"ingest": ingest.table(), "fit": fit.table()}
    return {"capture": folder.name, **report, **recovered, "stages": stages}


def header(*columns: str) -> str:
    """Header of a Markdown table."""
    return f"| capture | {' | '.join(columns)} |\n" + "|---" * (len(columns) + 1) + "|"


def error_row(r: dict[str, Any]) -> str:
    """Row of the table of errors."""
    sites = "; ".join(
        f"{name} {_triple(np.round(values) + 0.0, '+.0f')}"
        for name, values in r["sigma_tr_percent"].items()
    )
    light, camera = (
        r.get(name) for name in ("held_out_error", "held_out_camera_error")
    )
    cells = (
        f"{r['normal_median_deg']:.1f}, {r['normal_95_deg']:.1f}",
        _triple(r["diffuse_median_percent"], ".1f"),
        _triple(r["diffuse_bias_percent"], "+.1f"),
        f"{100 * light['median']:.1f}, {100 * light['p95']:.0f}" if light else "none",
        f"{100 * camera['median']:.1f}" if camera else "none",
        sites or "no probe",
    )
    return f"| {r['capture']} | {' | '.join(cells)} |"


def time_row(r: dict[str, Any]) -> str:
    """Row of the table of surfels by status, CPU times and memory."""
    status = ", ".join(
        f"{name.replace('_', ' ')} {100 * share:.1f}"
        for name, share in r["status"].items()
    )
    ingest = r["stages"]["ingest"]
    fit = r["stages"]["fit"]
    seconds = [
        ingest["all"]["cpu"],
        *(fit[name]["cpu"] if name in fit else 0.0 for name in STAGES),
    ]
    peak = max(ingest["all"]["anonymous"], fit["all"]["anonymous"]) / 1024
    cells = (f"{r['surfels']:,}", status, *(f"{s:.1f}" for s in seconds), f"{peak:.1f}")
    return f"| {r['capture']} | {' | '.join(cells)} |"


def _triple(values: Iterable[float], form: str) -> str:
    return " ".join(f"{value:{form}}" for value in values)


def main(
    db: str,
    captures: Sequence[Path],
    *,
    spacing: float = 1.5,
    hold_out_lights: float = 0.1,
    hold_out_cameras: float = 0.0,
    stages: Annotated[
        bool, "Print time and memory of every stage to standard error."
    ] = False,
    json_: Annotated[Path | None, "File for all results."] = None,
) -> None:
    """Measure and print."""
    db = skindb.open(db)
    results = []
    parameters = FitParameters(
        hold_out_lights=hold_out_lights, hold_out_cameras=hold_out_cameras
    )
    print(header(*COLUMNS))
    for folder in captures:
        results.append(measure(db, folder, spacing=spacing, parameters=parameters))
        print(error_row(results[-1]), flush=True)
        for name, table in results[-1]["stages"].items() if stages else ():
            print("\n".join([name, *stage_lines(table)]), file=sys.stderr)
    print(
        "\n"
        + header(
            "surfels",
            "percent per status",
            "ingest, CPU time [s]",
            *STAGES,
            "peak anonymous memory [GiB]",
        )
    )
    print("\n".join(time_row(result) for result in results))
    if json_:
        json_.write_text(json.dumps(results, indent=1, default=str), encoding="utf-8")
