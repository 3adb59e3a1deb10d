"""Time, memory and tasks of the cohort of a population of many takes.

    python -m benchmarks population DB TAKE --work FOLDER [--takes 10000]

In FOLDER a database is made from copies of the capture and the model of TAKE under new
names, with random attributes: records, attributes and manifests are written for each
take, other files are links. It holds the dome, the sample of surfels and the tables, and
is kept. Every step runs in a new process, whose imports are not timed.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xarray as xr

import skindb
from skindb.store import Database, Record
from skindb.store.log import Log
from skindb.store.record import record_to_json


def means(db: Database) -> np.ndarray:
    """Open the cohort, and compute the means of R_d of two groups."""
    values = db.cohort("tables").region_diffuse_reflectance
    return np.asarray(values.groupby("gender").mean().values)


GROUPS = {"capture": ("dome",), "model": ("sample",)}
STEPS: dict[str, Callable[[Database], Any]] = {
    "cohort, first time": lambda db: db.cohort("tables"),
    "cohort of tables": lambda db: db.cohort("tables"),
    "one variable, first time": means,
    "one variable of it": means,
    "cohort of surfels": lambda db: db.cohort("surfels", surfels=200),
    "one variable of one take": lambda db: (
        db.cohort("surfels", surfels=200).basis_weight.isel(take=-1).values
    ),
    "table": lambda db: db.table(),
}


def attributes(rng: np.random.Generator) -> dict[str, Any]:
    """Random traits."""
    return {
        "age": int(rng.integers(18, 90)),
        "gender": ("female", "male")[rng.integers(2)],
    }


def seed(source: Database, take: str, target: Database) -> list[Record]:
    """Commit the first take, which the others are copies of."""
    records: list[Record] = []
    for kind, names in GROUPS.items():
        tree = source.read(kind, take)
        tables = source.tables(source.record(kind, take)) if kind == "model" else None
        about = {name: tree.attrs[name] for name in tree.attrs if name != "generation"}
        about |= {"inputs": [record.as_input() for record in records]}
        about |= {"consent_scope": ["fit", "statistics"], "subject": "P0", "take": "P0"}
        with target.stage(kind, "P0") as stage:
            stage.write(
                {name: tree[name].to_dataset().load() for name in names}, tables=tables
            )
            records.append(stage.commit(about))
    return records


def copy(root: Path, record: Record, take: str, changes: dict[str, Any]) -> Record:
    """Write a copy of a version for another take, and its record."""
    path = record.path.replace("/P0/", f"/{take}/")
    provenance = record.provenance | changes
    manifest = json.loads((root / record.beside("manifest")).read_bytes())
    for name in manifest:
        file = root / path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if name != "zarr.json":
            os.link(root / record.path / name, file)
    metadata = json.loads((root / record.path / "zarr.json").read_bytes())
    content = json.dumps(metadata | {"attributes": provenance}).encode()
    (root / path / "zarr.json").write_bytes(content)
    manifest["zarr.json"] = [len(content), [hashlib.sha256(content).hexdigest(), []]]
    listed = json.dumps(manifest).encode()
    made = replace(
        record,
        take=take,
        path=path,
        provenance=provenance,
        bytes=sum(size for size, _ in manifest.values()),
        manifest=hashlib.sha256(listed).hexdigest(),
    )
    (root / made.beside("manifest")).write_bytes(listed)
    if record.tables:
        os.link(root / record.beside("tables"), root / made.beside("tables"))
    text, seal = record_to_json(made)
    log = Log(skindb.open(root).place, record.kind, take)
    for key, data in (
        (log.record_key(1), text),
        (log.head_key, log.head_content(1, seal)),
    ):
        (root / key).parent.mkdir(parents=True, exist_ok=True)
        (root / key).write_bytes(data)
    return replace(made, seal=seal)


def grow(source: Database, take: str, root: Path, takes: int) -> None:
    """Make the takes that the database does not have yet."""
    target = skindb.open(root, create=True)
    first = (
        seed(source, take, target)
        if not target.takes("capture")
        else [target.record(kind, "P0") for kind in GROUPS]
    )
    rng = np.random.default_rng(0)
    existing = {*target.takes("model")}
    for number in range(1, takes):
        name = f"P{number}"
        changes = {"subject": name, "take": name, "traits": attributes(rng)}
        if name not in existing:
            capture = copy(root, first[0], name, changes)
            copy(root, first[1], name, changes | {"inputs": [capture.as_input()]})


def run_step(url: str, name: str) -> None:
    """Run a step in this process, and print its figures."""
    db = skindb.open(url)
    wall = time.perf_counter()
    cpu = time.process_time()
    result = STEPS[name](db)
    figures = {
        "wall": time.perf_counter() - wall,
        "cpu": time.process_time() - cpu,
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    if isinstance(result, xr.Dataset):
        figures["tasks"] = len(result.__dask_graph__())
    print(json.dumps(figures))


def main(
    db: str = "",
    take: str = "",
    *,
    work: Path = Path(),
    takes: int = 10000,
    step: Annotated[Sequence[str], "Database and step; for internal use."] = (),
) -> None:
    """Measure and print."""
    if step:
        run_step(*step)
        return
    root = work / f"population{takes}"
    grow(skindb.open(db), take, root, takes)
    place = skindb.open(root).place
    for cache in ("catalogue", "gathered"):
        place.remove(cache)
    for name in STEPS:
        run = [
            sys.executable,
            "-m",
            "benchmarks",
            "population",
            "--step",
            str(root),
            name,
        ]
        done = subprocess.run(run, check=True, stdout=subprocess.PIPE)
        figures = json.loads(done.stdout)
        tasks = f", {figures['tasks']:,} tasks" if "tasks" in figures else ""
        print(
            f"{name:26} {figures['wall']:6.2f} s, CPU {figures['cpu']:6.2f} s, "
            f"{figures['peak']:,.0f} MiB{tasks}"
        )
