"""Errors of fits of captures made by an independent renderer, relative to their truth
(docs/results).

    python -m benchmarks validate DB CAPTURE [CAPTURE...]

The truth of each capture folder is in <folder>.truth.npz (keys of
skindb.virtual.capture and benchmarks.truth). Each capture is ingested into a database of
its own in the folder DB, unless it was before, and fitted. Two Markdown tables are
printed: errors, with one row for all captures together, and surfels by status with times
and memory. The columns from "near mirror" on are of fitted surfels:

- near mirror: relative RMS error of held-out samples whose half vector is within 1.5
  degrees of the true normal, and their number;
- false highlights: fraction whose BRDF at theta_h = 0, theta_d = 25 degrees exceeds three
  times the true one;
- in the 95 % interval of R_d, half-width: of each channel;
- z of regions: mean and standard deviation of the errors of mean R_d of the true regions
  over the stated total errors;
- held-out samples: within 1.96 times `evaluate_error`, with half vectors farther from the
  normal than some fitted sample, and nearer.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xarray as xr

import skindb
from benchmarks.highlights import (
    NORMAL_95,
    PEAK_ANGLE,
    NearMirror,
    Stated,
    fitted_peaks,
    near_mirror,
    stated_errors,
)
from benchmarks.stages import Stages, stage_lines
from benchmarks.truth import Truth, mirror_bases, read_truth, regions
from skindb.analysis.summary import region_tables
from skindb.fit import FitParameters, lumitexels
from skindb.reflectance.kinds import surface_model
from skindb.schema import variables
from skindb.types import Array
from skindb.virtual.capture import (
    Recovery,
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
    "held out, median, 95 % [%]",
    "held-out cameras [%]",
    "sigma_tr per site, R G B [%]",
    "near mirror [%], samples",
    "false highlights [%]",
    "in the 95 % interval of R_d, R G B [%]",
    "half-width R G B [%]",
    "z of regions",
    "held-out samples in the 95 % interval, measured, extrapolated directions [%]",
)
FALSE_PEAK = 3.0  # times the true peak
MIN_REGION = 50  # surfels of a region whose mean is compared
STAGES = (
    "dictionary",
    "first pass",
    "reduced basis",
    "second pass",
    "translucency",
    "commit",
)


def measure(
    databases: Path, folder: Path, *, spacing: float, parameters: FitParameters
) -> dict[str, Any]:
    """Ingest, fit and compare one capture."""
    db = skindb.open(databases / folder.name, create=True)
    with Stages() as ingest:
        if not db.takes("capture"):
            ingest_take(db, folder, spacing_mm=spacing, progress=ingest)
        ingest.end("commit")
    (take,) = db.takes("capture")
    with Stages() as fit:
        report = fit_take(db, take, parameters, progress=fit).provenance
        fit.end("commit")
    model = db.read("model", take).load()
    truth = read_truth(folder)
    recovery = recovered_against_true(model, truth)
    samples = lumitexels(db.read("capture", take))
    stages = {"ingest": ingest.table(), "fit": fit.table()}
    return {
        "capture": folder.name,
        **report,
        **recovery.summary(),
        **highlights(samples, model, truth, recovery),
        **intervals(model, truth, recovery),
        "stages": stages,
    }


def highlights(
    samples: xr.Dataset, model: xr.DataTree, truth: Truth, recovery: Recovery
) -> dict[str, Any]:
    """Errors beside the mirror direction, and the fraction of false highlights, which is
    NaN if the truth holds no BRDFs.
    """
    fitted = model["fitted"].to_dataset()
    face, corner = foot_points(fitted, truth)
    corners = truth["faces"][face]
    used = recovery.fitted & (face >= 0)
    normal = at_foot_points(truth["normals"][corners], corner)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.maximum(length, 1e-12)
    false = np.nan
    if "surface_kind" in truth:
        weight = at_foot_points(truth["surface_weights"][corners], corner)
        surface = surface_model(model["basis"].to_dataset())
        eta = float(fitted[variables.REFRACTIVE_INDEX])
        peaks = fitted_peaks(surface, surface.parameters_of(fitted), eta=eta)
        highest = FALSE_PEAK * weight @ mirror_bases(truth, PEAK_ANGLE)
        false = float((peaks > highest)[used].mean())
    near = near_mirror(samples, model, normal, used)
    stated = stated_errors(samples, model, used)
    return {
        "near_mirror": near._asdict(),
        "false_highlights": false,
        "stated": stated._asdict(),
    }


def intervals(model: xr.DataTree, truth: Truth, recovery: Recovery) -> dict[str, Any]:
    """Coverage and half-widths of the 95 % intervals of R_d, and z of means of regions."""
    fitted = model["fitted"].to_dataset()
    face, corner = foot_points(fitted, truth)
    true = recovery.true_diffuse
    used = recovery.fitted & np.isfinite(true).all(axis=1)
    value = fitted[variables.DIFFUSE_REFLECTANCE].values
    half = NORMAL_95 * fitted[variables.DIFFUSE_REFLECTANCE_TOTAL_ERROR].values
    inside = np.abs(value - true) < half
    nearest = truth["faces"][face, corner.argmax(axis=1)]
    names = regions(truth)[nearest]
    masks = {str(name): used & (names == name) for name in np.unique(names[used])}
    stated = region_tables(fitted, masks)
    actual = region_tables(
        fitted.assign(diffuse_reflectance=(("surfel", "channel"), true)), masks
    )
    mean = variables.REGION_DIFFUSE_REFLECTANCE
    error = stated[variables.REGION_DIFFUSE_REFLECTANCE_TOTAL_ERROR]
    large = stated[variables.REGION_SURFELS].values >= MIN_REGION
    z = ((stated[mean] - actual[mean]) / error).values[large]
    return {
        "coverage": inside[used].mean(axis=0).tolist(),
        "half_width": np.nanmedian((half / value)[used], axis=0).tolist(),
        "region_z": z.tolist(),
    }


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
    near = NearMirror(**r["near_mirror"])
    cells = (
        f"{r['normal_median_deg']:.1f}, {r['normal_95_deg']:.1f}",
        _triple(r["diffuse_median_percent"], ".1f"),
        _triple(r["diffuse_bias_percent"], "+.1f"),
        f"{100 * light['median']:.1f}, {100 * light['p95']:.0f}" if light else "none",
        f"{100 * camera['median']:.1f}" if camera else "none",
        sites or "no probe",
        f"{100 * near.relative:.0f}, {near.samples:,}",
        f"{100 * r['false_highlights']:.1f}",
        *_interval_cells(r["coverage"], r["half_width"], r["region_z"]),
        _stated_cell(Stated(**r["stated"])),
    )
    return f"| {r['capture']} | {' | '.join(cells)} |"


def pooled_row(results: Sequence[dict[str, Any]]) -> str:
    """Row of all captures: means, but medians of normals, held-out errors and half-widths,
    and the sums of squares near the mirror direction.
    """

    def every(name: str) -> Array:
        return np.array([r[name] for r in results])

    near = NearMirror(*np.sum([tuple(r["near_mirror"].values()) for r in results], 0))
    light = [r["held_out_error"]["median"] for r in results if "held_out_error" in r]
    cells = (
        f"{np.median(every('normal_median_deg')):.1f}",
        _triple(every("diffuse_median_percent").mean(axis=0), ".1f"),
        _triple(every("diffuse_bias_percent").mean(axis=0), "+.1f"),
        f"{100 * np.median(light):.1f}" if light else "none",
        "",
        "",
        f"{100 * near.relative:.0f}, {near.samples:,.0f}",
        f"{100 * every('false_highlights').mean():.1f}",
        *_interval_cells(
            every("coverage").mean(axis=0),
            np.median(every("half_width"), axis=0),
            np.concatenate([r["region_z"] for r in results]),
        ),
        _stated_cell(
            Stated(*np.sum([tuple(r["stated"].values()) for r in results], 0))
        ),
    )
    return f"| all {len(results)} | {' | '.join(cells)} |"


def _interval_cells(coverage: Any, half_width: Any, z: Any) -> tuple[str, str, str]:
    return (
        _triple(100 * np.asarray(coverage), ".0f"),
        _triple(100 * np.asarray(half_width), ".0f"),
        f"{np.mean(z):+.2f}, {np.std(z):.2f}",
    )


def _stated_cell(stated: Stated) -> str:
    return (
        f"{100 * stated.measured_inside / max(stated.measured, 1):.0f} "
        f"{100 * stated.extrapolated_inside / max(stated.extrapolated, 1):.0f}"
    )


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
    db: Path,
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
        if json_:
            json_.write_text(json.dumps(results, indent=1, default=str), "utf-8")
    print(pooled_row(results))
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
