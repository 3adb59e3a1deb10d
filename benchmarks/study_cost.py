"""Time and peak memory of population studies of growing cohorts, each in its own process.

    python -m benchmarks study_cost DB --work FOLDER [--takes 22 44 87] [--studies
    albedo traits ...] [--subdivide N]

DB contains fitted takes with landmarks. In FOLDER a database with as many virtual
subjects as the largest cohort is created from copies of the models of DB under new
names, with random attributes and albedo scaled at random by 10 %. It is kept and reused
by the next run. Registration is one of the measured steps; because it stores maps and
samples, it is the only one that reads all surfels. --subdivide splits every triangle
into four, N times.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import xarray as xr

import skindb
from skindb.analysis import STUDIES
from skindb.store import Database
from skindb.workflow import register_takes, study
from skindb.workflow.cohorts import model_with_summary, summary_parameters
from skindb.workflow.derive import TABLES, groups_of

# brdf needs captures, of which there are none
STEPS = ("register", *(name for name in STUDIES if name != "brdf"))
GROUPED = ("groups", "maps", "surface")


def subdivided(groups: dict[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """Groups of a model with a new surfel at the middle of every edge."""
    triangle = groups["mesh"]["triangle"].values.astype(np.int64)
    edges = np.sort(triangle[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    edges, index = np.unique(edges, axis=0, return_inverse=True)
    fitted = groups["fitted"]
    middle = index.reshape(-1, 3) + groups["fitted"].sizes["surfel"]
    new = fitted.isel(surfel=edges[:, 0])
    for name in ("surfel_position", "surfel_uv", "diffuse_reflectance"):
        new[name] = (new[name] + fitted[name].isel(surfel=edges[:, 1])) / 2
    repeated = xr.concat(
        [fitted, new],
        "surfel",
        data_vars="minimal",
        coords="minimal",
        compat="override",
        join="override",
    )
    repeated["surfel_area"] = repeated["surfel_area"] / 4
    corners = (
        [triangle[:, 0], middle[:, 0], middle[:, 2]],
        [middle[:, 0], triangle[:, 1], middle[:, 1]],
    )
    midpoints = (
        [middle[:, 2], middle[:, 1], triangle[:, 2]],
        [middle[:, 0], middle[:, 1], middle[:, 2]],
    )
    finer = np.concatenate(
        [np.stack(corner, axis=1) for corner in (*corners, *midpoints)]
    ).astype(np.int32)
    rest = groups["mesh"].drop_dims("face")
    return groups | {
        "fitted": repeated.transpose("surfel", ...),
        "mesh": rest.assign(
            triangle=(("face", "corner"), finer, groups["mesh"]["triangle"].attrs)
        ),
    }


def grow(source: Database, target: Database, takes: int, subdivide: int) -> None:
    """Commit copies of models until the target has as many takes."""
    rng = np.random.default_rng(len(target.takes("model")))
    names = [take for take in source.takes("model") if "." not in take]
    for number in range(len(target.takes("model")), takes):
        model = source.read("model", names[number % len(names)]).load()
        groups = groups_of(model)
        for _ in range(subdivide):
            groups = subdivided(groups)
        scaled = groups["fitted"]["diffuse_reflectance"] * np.exp(
            0.1 * rng.standard_normal()
        )
        groups["fitted"] = groups["fitted"].assign(
            diffuse_reflectance=scaled.clip(0, 0.95).astype(np.float32)
        )
        traits = {
            "age": int(rng.integers(18, 80)),
            "gender": str(rng.choice(["female", "male"])),
        }
        take = f"C{number:03d}"
        attributes = {
            "subject": take,
            "condition": "normal",
            "traits": traits,
            "consent_scope": ["fit", "statistics"],
        }
        summarised = groups_of(model_with_summary(xr.DataTree.from_dict(groups)))
        tables = summarised.pop(TABLES)
        attributes |= {"take": take, "inputs": []}
        attributes["summary_parameters"] = summary_parameters()
        with target.stage("model", take) as stage:
            stage.write(summarised, tables=tables)
            stage.commit(model.attrs | attributes)


def measure(url: str, step: str, takes: int) -> None:
    """Run one step on the first takes, and print its wall time and peak memory."""
    db = skindb.open(url)
    names = db.takes("model")[:takes]
    start = time.perf_counter()
    if step == "register":
        register_takes(db, takes=names)
    else:
        options = {"group_by": "gender"} if step in GROUPED else {}
        study(db, step, takes=names, name=f"cost-{time.time_ns()}", **options)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"seconds": time.perf_counter() - start, "peak": peak}))


def main(
    db: str,
    *,
    work: Path,
    takes: Sequence[int] = (22, 44, 87),
    studies: Annotated[Sequence[str], STEPS] = tuple(STEPS),
    subdivide: int = 0,
    child: Annotated[Sequence[str], "Step and number of takes; for internal use."] = (),
) -> None:
    """Measure and print."""
    if child:
        step, count = child
        measure(db, step, int(count))
        return
    grow(
        skindb.open(db),
        skindb.open(str(work), create=True),
        max(takes),
        subdivide,
    )
    print("| step | " + " | ".join(f"{n} takes" for n in takes) + " |")
    print("|---|" + "---|" * len(takes))
    for step in studies:
        cells = []
        for count in takes:
            command = [
                sys.executable,
                "-m",
                "benchmarks",
                "study_cost",
                str(work),
                "--work",
                str(work),
                "--child",
                step,
                str(count),
            ]
            process = subprocess.run(
                command, capture_output=True, text=True, check=False
            )
            if process.returncode:
                cells.append(process.stderr.strip().splitlines()[-1][:80])
                continue
            figures = json.loads(process.stdout.splitlines()[-1])
            cells.append(f"{figures['seconds']:.0f} s, {figures['peak']:.0f} MiB")
        print(f"| {step} | " + " | ".join(cells) + " |", flush=True)
