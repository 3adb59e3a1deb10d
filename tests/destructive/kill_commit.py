"""Kills the writer of a model at every file-system call of its write and commit.

    python tests/destructive/kill_commit.py --every 1 --fits 20

A small model is written and killed at every n-th call; whole fits are killed at some
calls of theirs. After each kill the model before it must be readable as it was,
`verify` must pass, and the next model must be committed. The program ends with 1 if
that fails once.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
from functools import partial
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "store"), str(HERE)]

import apart
import numpy as np
from planted_cohort import PARAMETERS, PEOPLE, database, few_materials
from stored import groups

import skindb
from skindb import workflow
from skindb.schema import dataset
from skindb.store import Database

EVENTS = (
    "open",
    "os.mkdir",
    "os.link",
    "os.rename",
    "os.remove",
    "os.rmdir",
    "os.scandir",
    "os.listdir",
    "os.fsync",
)
PLACES = ("/data/model", "/log/model", "/heads/model")
TAKE = "S01"
BROKEN = "broken promise"


def count_calls(die_at: int) -> list[int]:
    """Count the calls that concern a model from now on, and kill the process at one of them."""
    calls = [0]
    lock = threading.Lock()  # files are flushed by several threads

    def count(event: str, args: tuple[object, ...]) -> None:
        if event in EVENTS and any(
            place in str(arg) for place in PLACES for arg in args[:2]
        ):
            with lock:
                calls[0] += 1
                if calls[0] == die_at:
                    os.kill(os.getpid(), signal.SIGKILL)

    def fsync(number: int, call=os.fsync) -> None:  # has no audit event
        count("os.fsync", (Path(f"/proc/self/fd/{number}").readlink(),))
        call(number)

    os.fsync = fsync
    sys.addaudithook(count)
    return calls


def write_small(db: Database) -> int:
    """Commit a model with few variables, and return its generation."""
    tables = dataset({"region_area": [1.0]}, coords={"region": ["face"]})
    with db.stage("model", TAKE) as stage:
        stage.write(groups(), tables=tables)
        return stage.commit({"seeds": [1]}).generation


def fit(db: Database) -> int:
    """Fit the take, and return the generation of its model."""
    return workflow.fit_take(
        db, TAKE, PARAMETERS, dictionary=few_materials()
    ).generation


WRITERS = {
    "small model": (write_small, "surfels/surfel_area"),
    "fit": (fit, "fitted/diffuse_reflectance"),
}


def attempt(
    root: Path, variant: str, number: int, before: list[float]
) -> apart.Outcome:
    """Write in a process that is killed at a given call, and check every promise."""
    writer, name = WRITERS[variant]
    db = skindb.open(str(root))
    process = os.fork()
    if not process:
        count_calls(number)
        writer(db)
        os._exit(0)
    if not os.WIFSIGNALED(os.waitpid(process, 0)[1]):
        return BROKEN, "the writer was not killed"
    if faults := db.verify():
        return BROKEN, str(faults[0])
    there = [record.generation for record in db.history("model", TAKE)]
    if there not in ([1], [1, 2]) or any(
        values(db, name, generation) != before for generation in there
    ):
        return BROKEN, f"generations {there}, or other values"
    following = writer(db)
    if following != len(there) + 1 or db.verify():
        return BROKEN, f"the next commit made generation {following}"
    return ("before", "after")[len(there) - 1], ""


def values(db: Database, name: str, generation: int) -> list[float]:
    """A variable of one version."""
    return (
        np.nan_to_num(
            db.read("model", TAKE, generation=generation)[name].values, nan=-1.0
        )
        .ravel()
        .tolist()
    )


def kill(variant: str, folder: Path, asked: argparse.Namespace) -> list[apart.Case]:
    """Kill the writer of one variant at many of its calls."""
    whole = folder / "db"
    kept = folder / "kept.json"
    writer, name = WRITERS[variant]

    def prepare_whole() -> None:
        if variant == "fit":
            database(folder, {TAKE: PEOPLE[TAKE]})
        else:
            write_small(skindb.open(str(whole), create=True))

    def count() -> None:
        db = skindb.open(str(shutil.copytree(whole, folder / "counted")))
        calls = count_calls(0)
        writer(db)
        kept.write_text(json.dumps([calls[0], values(db, name, 1)]))

    apart.in_a_process(prepare_whole)
    apart.in_a_process(count)
    calls, before = json.loads(kept.read_text())

    def prepare(number: int, work: Path):
        root = Path(shutil.copytree(whole, work / "db"))
        return (
            variant,
            f"call {number} of {calls}",
            partial(attempt, root, variant, number, before),
        )

    if variant == "fit":
        numbers = sorted(set(np.linspace(1, calls, asked.fits).astype(int).tolist()))
    else:
        numbers = list(range(calls, 0, -asked.every))
    return apart.run(numbers, prepare, folder, apart.Limits(asked.jobs, seconds=300))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--every",
        type=int,
        default=1,
        help="The small model is killed at every n-th call.",
    )
    parser.add_argument(
        "--fits", type=int, default=20, help="Number of fits that are killed."
    )
    parser.add_argument(
        "--jobs", type=int, default=2, help="Number of processes at a time."
    )
    asked = parser.parse_args()
    bad = []
    for variant in WRITERS if asked.fits else ["small model"]:
        with tempfile.TemporaryDirectory() as folder:
            cases = kill(variant, Path(folder), asked)
        count = [
            sum(case.outcome == one for case in cases) for one in ("before", "after")
        ]
        bad += [case for case in cases if case.outcome not in ("before", "after")]
        print(
            f"{variant}: {len(cases)} kills, the last at {cases[-1].damage}: "
            f"{count[0]} left the version before as "
            f"the current one, {count[1]} the new one"
        )
    for case in bad:
        print(f"{case.variant}, {case.damage}: {case.outcome}: {case.detail}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
