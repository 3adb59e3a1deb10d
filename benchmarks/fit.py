"""Time and results of the fit of one take, by an earlier revision and by the current code.

    python -m benchmarks fit CAPTURE [--before df1cf9e] [--repeats 3] [--json OUT] [--folder FOLDER]

The earlier revision is extracted from git and ingests CAPTURE into a temporary
database, of which each side fits a copy. Every fit runs in its own process; the two
sides alternate, and medians are printed. Compilation is not timed.
"""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import xarray as xr

import skindb
from skindb.schema import FitStatus

ROOT = Path(__file__).resolve().parent.parent
DRIVER = Path(__file__).parent / "programs/fit_driver.py"
SIDES = ("before", "after")
STAGES = {  # stage of the current code -> stages of the earlier revision
    "dictionary": ("dictionary",),
    "first pass": ("normals", "diffuse reflectance", "surface"),
    "reduced basis": ("reduced basis",),
    "second pass": ("refit", "held out", "outliers"),
    "translucency": ("translucency",),
    "commit": ("write", "commit"),
    "all": ("all",),
}
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)


def extract(revision: str, folder: Path) -> Path:
    """Extract the files of a revision to a folder."""
    archive = subprocess.run(
        ["git", "-C", ROOT, "archive", revision], check=True, capture_output=True
    ).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(folder, filter="data")
    return folder


def drive(
    code: Path, *arguments: str | Path, threads: int | None = None
) -> dict[str, Any]:
    """Result of the driver in a process that imports skindb from `code`."""
    surroundings = (
        os.environ | {"PYTHONPATH": str(code)} | (ONE_THREAD if threads == 1 else {})
    )
    command = [sys.executable, str(DRIVER), *map(str, arguments)]
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, env=surroundings
    )
    if done.returncode:
        sys.exit(
            f"{' '.join(map(str, arguments))} with the code of {code} failed:\n{done.stderr}"
        )
    return dict(json.loads(done.stdout.splitlines()[-1]))


def medians(runs: Sequence[dict[str, Any]], stage: str, what: str) -> float:
    """Median of a stage of the current code, or of its counterparts in the earlier revision."""
    names = {stage, *STAGES[stage]}
    return median(
        sum(table[what] for name, table in run["stages"].items() if name in names)
        for run in runs
    )


def turns(
    repeats: int, side: Callable[[str], dict[str, Any]]
) -> dict[str, list[dict[str, Any]]]:
    """`repeats` results of each side, measured alternately."""
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in SIDES}
    for _ in range(repeats):
        for name in SIDES:
            runs[name].append(side(name))
            print(f"{name}: {json.dumps(runs[name][-1])}", file=sys.stderr, flush=True)
    return runs


def differences(before: xr.DataTree, after: xr.DataTree) -> dict[str, float]:
    """Medians over surfels, or over sites and channels, of the change divided by the
    stated error.
    """
    old = before["fitted"].to_dataset()
    new = after["fitted"].to_dataset()
    good = (old["fit_status"].values == FitStatus.FITTED) & (
        new["fit_status"].values == FitStatus.FITTED
    )
    cosine = (
        old["shading_normal"].values.astype(float) * new["shading_normal"].values
    ).sum(1)
    lengths = [
        np.linalg.norm(one["shading_normal"].values.astype(float), axis=1)
        for one in (old, new)
    ]
    angle = np.degrees(np.arccos(np.clip(cosine / (lengths[0] * lengths[1]), -1, 1)))
    found = {"normal": float(np.nanmedian((angle / old["normal_error"].values)[good]))}
    for name in ("diffuse_reflectance", "surface_reflectance"):
        change = (
            np.abs(new[name].values.astype(float) - old[name].values)
            / old[f"{name}_error"].values
        )
        found[name] = float(np.nanmedian(change[good]))
    if "translucency" in before.children:
        sites, now = (model["translucency"].to_dataset() for model in (before, after))
        change = (
            np.abs(now["site_sigma_tr"].values - sites["site_sigma_tr"].values)
            / sites["site_sigma_tr_error"].values
        )
        found["sigma_tr"] = float(np.nanmedian(change))
    found["surfels with another status"] = float(
        (old["fit_status"].values != new["fit_status"].values).mean()
    )
    return found


def report(results: dict[str, Any]) -> str:
    """Markdown tables of all results."""
    runs = results["fits"]
    old = results["parts"]["before"]
    new = results["parts"]["after"]
    lines = [
        "| stage | CPU before, after [s] | wall before, after [s] |",
        "|---|---|---|",
    ]
    for stage in STAGES:
        cells = [
            ", ".join(f"{medians(runs[s], stage, what):.1f}" for s in SIDES)
            for what in ("cpu", "wall")
        ]
        lines.append(f"| {stage} | {' | '.join(cells)} |")
    ratios = {what: ratio(runs, what) for what in ("cpu", "wall")}
    peaks = [max(run["peak"] for run in runs[s]) for s in SIDES]
    lines += [
        "",
        (
            f"CPU time {ratios['cpu']:.2f} times shorter, wall time "
            f"{ratios['wall']:.2f} times shorter."
        ),
    ]
    lines += [
        f"Peak resident memory {peaks[0]:.2f} GiB before, {peaks[1]:.2f} GiB after."
    ]
    lines += [
        "",
        "| part, one thread | before [us per surfel] | after |",
        "|---|---|---|",
    ]
    lines += [f"| {name} | {old[name]:.0f} | {new[name]:.1f} |" for name in old]
    together = (new["normals"] + new["albedo"]) / new["dictionary fit"]
    lines += [
        "",
        f"Normals and albedo take {together:.2f} of the time of the dictionary fit.",
    ]
    lines += [
        (
            f"Linear refit: {1e6 / new['linear refit of 4 components']:,.0f} surfels "
            "per second and core."
        )
    ]
    reading = {
        what: 2 * results["read"][what] / medians(runs["after"], "all", what)
        for what in ("cpu", "wall")
    }
    lines += [
        (
            f"Reading all samples twice: {reading['cpu']:.1%} of the CPU time, "
            f"{reading['wall']:.1%} of the wall time."
        )
    ]
    lines += ["", "| median change, in stated errors | |", "|---|---|"]
    return "\n".join(
        [
            *lines,
            *(
                f"| {name} | {value:.2g} |"
                for name, value in results["differences"].items()
            ),
        ]
    )


def ratio(runs: dict[str, list[dict[str, Any]]], what: str) -> float:
    """Time before over time after."""
    return medians(runs["before"], "all", what) / medians(runs["after"], "all", what)


def measure(capture: Path, revision: str, repeats: int, folder: Path) -> dict[str, Any]:
    """Run all measurements; code and databases that exist in the folder are reused."""
    code = {"before": folder / "code", "after": ROOT}
    if not code["before"].exists():
        extract(revision, code["before"])
    bases = {side: folder / side for side in SIDES}
    if not bases["before"].exists():
        drive(code["before"], "ingest", bases["before"], capture)
    (take,) = skindb.open(bases["before"]).takes("capture")
    if not bases["after"].exists():
        shutil.copytree(bases["before"], bases["after"])
    parts = turns(
        repeats, lambda side: drive(code[side], "parts", bases[side], take, threads=1)
    )
    # compiles the remaining functions
    turns(1, lambda side: drive(code[side], "fit", bases[side], take))
    fits = turns(repeats, lambda side: drive(code[side], "fit", bases[side], take))
    reads = [drive(ROOT, "read", bases["after"], take) for _ in range(repeats)]
    models = [skindb.open(bases[side]).read("model", take) for side in SIDES]
    return {
        "parts": {
            side: {
                name: min(run[name] for run in parts[side]) for name in parts[side][0]
            }
            for side in SIDES
        },
        "fits": fits,
        "read": {what: median(run[what] for run in reads) for what in ("cpu", "wall")},
        "differences": differences(*models),
    }


def main(
    capture: Path,
    *,
    before: Annotated[
        str, "Revision to compare with, from before schema version 2."
    ] = "df1cf9e",
    repeats: Annotated[int, "Number of timed runs per side."] = 3,
    json_: Annotated[Path | None, "File for all results."] = None,
    folder: Annotated[
        Path | None,
        "Folder that keeps the earlier code and the databases (default: temporary).",
    ] = None,
) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = (folder or Path(temporary)).resolve()
        results = measure(capture.resolve(), before, repeats, folder)
    print(report(results))
    if json_:
        json_.write_text(json.dumps(results, indent=1), encoding="utf-8")
