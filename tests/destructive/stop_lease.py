"""Stops a fit for longer than its lease, lets another one take over, and then continues
the first one.

    python tests/destructive/stop_lease.py --cases 10 --seed 0

The first fit is stopped (SIGSTOP) in a stage that is chosen at random. The second one
waits until the lease has ended, fits the take with other parameters and commits. Then
the first one goes on (SIGCONT): it must end with one line that says who took over, and
must have committed nothing. In every second case it goes on while the second one is
still at work, which must then succeed. The program ends with 1 if that fails once.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from functools import partial, partialmethod
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent)]

import apart
import kill_fit
import numpy as np
from planted_cohort import PARAMETERS, few_materials

import skindb
from skindb import workflow
from skindb.errors import InputError
from skindb.store import Database, LeaseLost

SECONDS = 1.0  # of a lease
STAGES = kill_fit.FIT[1:6]
GOOD = ("refused in one line",)
BAD = ("committed over the new holder", "no line, or another", "second fit refused")


def stopped_in(root: Path, stage: str) -> tuple[int, int]:
    """Start a fit that stops itself at a stage, and return its process and a pipe with
    its last message.
    """
    pipe, end = os.pipe()
    process = os.fork()
    if not process:
        os.close(pipe)

        def stop(name):
            if name == stage:
                os.kill(os.getpid(), signal.SIGSTOP)

        try:
            said = ["committed", kill_fit.fit(skindb.open(root), stop)]
        except LeaseLost as error:
            said = ["lost", str(error)]
        except BaseException as error:  # noqa: BLE001  whatever it is
            said = [type(error).__name__, str(error)]
        os.write(end, json.dumps(said).encode())
        os._exit(0)
    os.close(end)
    os.waitpid(process, os.WUNTRACED)
    return process, pipe


def attempt(root: Path, stage: str, *, early: bool) -> apart.Outcome:
    """Stop one fit, and let another one take over."""
    Database.lease = partialmethod(Database.lease, seconds=SECONDS)
    first, pipe = stopped_in(root, stage)
    go_on = partial(os.kill, first, signal.SIGCONT)

    def progress(name: str, *_: int) -> None:
        if early and name == "reduced basis":
            go_on()

    db = skindb.open(root)
    other = replace(PARAMETERS, k=1)
    try:
        workflow.fit_take(
            db,
            kill_fit.FIT_TAKE,
            other,
            dictionary=few_materials(),
            wait=60,
            progress=progress,
        )
    except InputError as error:
        return BAD[2], str(error)
    go_on()
    with os.fdopen(pipe) as said:
        kind, text = json.loads(said.read())
    os.waitpid(first, 0)
    models = [
        record.provenance["parameters"]["k"]
        for record in db.history("model", kill_fit.FIT_TAKE)
    ]
    if kind == "committed" or models != [1]:
        return BAD[0], f"stopped in {stage}: {kind} {text}, models with k = {models}"
    if kind != "lost" or "\n" in text or "another run took over" not in text:
        return BAD[1], f"stopped in {stage}: {kind}: {text}"
    db.clean()
    faults = db.verify()
    left = kill_fit.unlisted(db)
    return (BAD[1], str(faults or left)) if faults or left else (GOOD[0], stage)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--cases", type=int, default=5, help="Number of fits that are stopped."
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="Random seed of the stages."
    )
    parser.add_argument(
        "--jobs", type=int, default=2, help="Number of cases at a time."
    )
    asked = parser.parse_args()

    def prepare(number: int, work: Path):
        stage = STAGES[
            np.random.default_rng([asked.seed, number]).integers(len(STAGES))
        ]
        root = Path(shutil.copytree(folder / "fit", work / "copy")) / "db"
        return "fit", stage, partial(attempt, root, stage, early=bool(number % 2))

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kill_fit.ready(folder, kill_fit.in_folder, ["fit"])  # which compiles
        done = apart.run(
            range(asked.cases), prepare, folder, apart.Limits(asked.jobs, seconds=300)
        )
    for outcome, count in Counter(case.outcome for case in done).items():
        print(f"{outcome:<32} {count:>6}")
    bad = [case for case in done if case.outcome not in GOOD]
    for case in bad:
        print(f"case {case.number}: {case.outcome}: {case.detail}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
