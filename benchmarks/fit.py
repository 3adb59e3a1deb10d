"""Time of the fit of one take, and its time and results compared with another revision.

    python -m benchmarks fit CAPTURE [--before REVISION] [--repeats 3] [--json OUT]
    [--folder FOLDER]

CAPTURE is ingested into a temporary database. With --before, a revision that has the
functions of benchmarks/programs/fit_driver.py is extracted from git, ingests CAPTURE,
and each side fits a copy. Every fit runs in its own process; the two sides alternate,
and medians are printed. Compilation is not timed.
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
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import numpy as np
import xarray as xr

import skindb
from skindb.schema import FitStatus

ROOT = Path(__file__).resolve().parent.parent
DRIVER = Path(__file__).parent / "programs/fit_driver.py"
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
    process = subprocess.run(
        command, check=False, capture_output=True, text=True, env=surroundings
    )
    if process.returncode:
        sys.exit(
            f"{' '.join(map(str, arguments))} with the code of {code} failed:\n{process.stderr}"
        )
    return dict(json.loads(process.stdout.splitlines()[-1]))


def turns(
    repeats: int, codes: Mapping[str, Path], measure: Callable[[str], dict[str, Any]]
) -> dict[str, list[dict[str, Any]]]:
    """`repeats` results of each side, measured alternately."""
    runs: dict[str, list[dict[str, Any]]] = {side: [] for side in codes}
    for _ in range(repeats):
        for side in codes:
            runs[side].append(measure(side))
            print(f"{side}: {json.dumps(runs[side][-1])}", file=sys.stderr, flush=True)
    return runs


def stage_median(runs: Sequence[dict[str, Any]], stage: str, clock: str) -> float:
    """Median of the time of a stage [s]."""
    return median(run["stages"].get(stage, {}).get(clock, 0.0) for run in runs)


def differences(before: xr.DataTree, after: xr.DataTree) -> dict[str, float]:
    """Medians over surfels, or over sites and channels, of the change divided by the
    stated error.
    """
    old = before["fitted"].to_dataset()
    new = after["fitted"].to_dataset()
    good = (old["fit_status"].values == FitStatus.FITTED) & (
        new["fit_status"].values == FitStatus.FITTED
    )
    normals = [side["shading_normal"].values.astype(float) for side in (old, new)]
    lengths = np.linalg.norm(normals, axis=2)
    cosine = (normals[0] * normals[1]).sum(axis=1) / lengths.prod(axis=0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    ratio = (angle / old["normal_error"].values)[good]
    medians = {"normal": float(np.nanmedian(ratio))}
    for name in ("diffuse_reflectance", "surface_reflectance"):
        ratio = _change(old, new, name, f"{name}_error")
        medians[name] = float(np.nanmedian(ratio[good]))
    if "translucency" in before.children:
        sites = [model["translucency"].to_dataset() for model in (before, after)]
        ratio = _change(*sites, "site_sigma_tr", "site_sigma_tr_error")
        medians["sigma_tr"] = float(np.nanmedian(ratio))
    changed = old["fit_status"].values != new["fit_status"].values
    medians["surfels with another status"] = float(changed.mean())
    return medians


def _change(old: xr.Dataset, new: xr.Dataset, name: str, error: str) -> np.ndarray:
    """Absolute change of a variable over its stated error."""
    change = new[name].values.astype(float) - old[name].values
    return np.asarray(np.abs(change) / old[error].values)


def _sides(results: Mapping[str, Any]) -> str:
    """The names of the sides, if there are two."""
    return " " + ", ".join(results) if len(results) > 1 else ""


def stage_table(fits: dict[str, list[dict[str, Any]]]) -> list[str]:
    """CPU and wall time of every stage of each side, and the peak of memory."""
    sides = _sides(fits)
    lines = [f"| stage | CPU{sides} [s] | wall{sides} [s] |", "|---|---|---|"]
    for stage in fits["after"][0]["stages"]:
        cells = [
            ", ".join(
                f"{stage_median(runs, stage, clock):.1f}" for runs in fits.values()
            )
            for clock in ("cpu", "wall")
        ]
        lines.append(f"| {stage} | {' | '.join(cells)} |")
    peaks = [f"{max(run['peak'] for run in runs):.2f}" for runs in fits.values()]
    return [*lines, "", f"Peak resident memory {', '.join(peaks)} GiB."]


def part_table(parts: dict[str, dict[str, float]]) -> list[str]:
    """CPU time of every part of a fit of each side."""
    lines = [f"| part, one thread | CPU{_sides(parts)} [us per surfel] |", "|---|---|"]
    for name in parts["after"]:
        times = ", ".join(f"{part[name]:.1f}" for part in parts.values())
        lines += [f"| {name} | {times} |"]
    spent = parts["after"]
    together = (spent["normals"] + spent["albedo"]) / spent["dictionary fit"]
    refits = 1e6 / spent["linear refit of 4 components"]
    return [
        *lines,
        "",
        f"Normals and albedo take {together:.2f} of the time of the dictionary fit.",
        f"Linear refit: {refits:,.0f} surfels per second and core.",
    ]


def report(results: dict[str, Any]) -> str:
    """Markdown tables of all results."""
    fits = results["fits"]
    lines = [*stage_table(fits), "", *part_table(results["parts"])]
    reading = {
        clock: 2 * results["read"][clock] / stage_median(fits["after"], "all", clock)
        for clock in ("cpu", "wall")
    }
    lines.append(
        f"Reading all samples twice: {reading['cpu']:.1%} of the CPU time, "
        f"{reading['wall']:.1%} of the wall time."
    )
    if "differences" in results:
        lines += ["", "| median change, in stated errors | |", "|---|---|"]
        for name, value in results["differences"].items():
            lines.append(f"| {name} | {value:.2g} |")
    return "\n".join(lines)


def measure(
    capture: Path, revision: str | None, repeats: int, folder: Path
) -> dict[str, Any]:
    """Run all measurements; code and databases that exist in the folder are reused."""
    codes = {"after": ROOT}
    if revision:
        codes = {"before": folder / "code", "after": ROOT}
        if not codes["before"].exists():
            extract(revision, codes["before"])
    databases = {side: folder / side for side in codes}
    source, *copies = databases.items()
    if not source[1].exists():
        drive(codes[source[0]], "ingest", source[1], capture)
    for _, copy in copies:
        if not copy.exists():
            shutil.copytree(source[1], copy)
    (take,) = skindb.open(source[1]).takes("capture")

    def run(action: str, side: str, threads: int | None = None) -> dict[str, Any]:
        return drive(codes[side], action, databases[side], take, threads=threads)

    parts = turns(repeats, codes, lambda side: run("parts", side, 1))
    turns(1, codes, partial(run, "fit"))  # compiles the remaining functions
    results: dict[str, Any] = {"fits": turns(repeats, codes, partial(run, "fit"))}
    reads = [run("read", "after") for _ in range(repeats)]
    results["read"] = {
        clock: median(r[clock] for r in reads) for clock in ("cpu", "wall")
    }
    results["parts"] = {
        side: {name: min(r[name] for r in runs) for name in runs[0]}
        for side, runs in parts.items()
    }
    if revision:
        models = [skindb.open(db).read("model", take) for db in databases.values()]
        results["differences"] = differences(*models)
    return results


def main(
    capture: Path,
    *,
    before: Annotated[str | None, "Revision to compare with."] = None,
    repeats: Annotated[int, "Number of timed runs per side."] = 3,
    json_: Annotated[Path | None, "File for all results."] = None,
    folder: Annotated[
        Path | None,
        "Folder that keeps the other code and the databases (default: temporary).",
    ] = None,
) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = (folder or Path(temporary)).resolve()
        results = measure(capture.resolve(), before, repeats, folder)
    print(report(results))
    if json_:
        json_.write_text(json.dumps(results, indent=1), encoding="utf-8")
