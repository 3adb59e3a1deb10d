"""Time of two one-thread workers that fit two takes in parallel, compared with one
worker that fits them in sequence.

    python -m benchmarks workers DB TAKE [TAKE] [--repeats 3]

Every worker is a process with one thread on its own copy of DB; its start is timed,
compilation is not. Both methods alternate. The ratio of the wall times is only
meaningful on two idle cores, so the CPU time is printed as well: if it increases with
two workers, they compete for memory or caches.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from benchmarks.fit import DRIVER, ONE_THREAD, ROOT

WORKERS = 2


def start(folder: Path, take: str) -> subprocess.Popen[str]:
    """Start a worker that fits a take."""
    surroundings = os.environ | ONE_THREAD | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(DRIVER), "fit-one-thread", str(folder), take]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=surroundings
    )


def finish(worker: subprocess.Popen[str]) -> float:
    """Wait for a worker, and return the CPU time of its fit [s]."""
    printed, _ = worker.communicate()
    if worker.returncode:
        sys.exit("a worker failed")
    return float(json.loads(printed.splitlines()[-1])["stages"]["all"]["cpu"])


def timed(
    folders: Sequence[Path], takes: Sequence[str], *, together: bool
) -> tuple[float, float]:
    """Wall time and CPU time [s] of the fits of all takes."""
    begin = time.perf_counter()
    if together:
        workers = [start(*work) for work in zip(folders, takes, strict=True)]
        cpu = sum(finish(worker) for worker in workers)
    else:
        cpu = sum(finish(start(*work)) for work in zip(folders, takes, strict=True))
    return time.perf_counter() - begin, cpu


def main(
    db: Path,
    takes: Annotated[Sequence[str], "One take, which is fitted twice, or two takes."],
    *,
    repeats: int = 3,
) -> None:
    """Measure and print."""
    takes = (takes * WORKERS)[:WORKERS]
    with tempfile.TemporaryDirectory() as temporary:
        folders = [Path(temporary) / str(i) for i in range(WORKERS)]
        for folder in folders:
            shutil.copytree(db, folder)
        timed(folders[:1], takes[:1], together=False)  # compiles
        runs = [
            (
                timed(folders, takes, together=False),
                timed(folders, takes, together=True),
            )
            for _ in range(repeats)
        ]
    best = [
        [min(run[way][clock] for run in runs) for way in (0, 1)] for clock in (0, 1)
    ]
    for way, name in enumerate(("in sequence", "in parallel")):
        walls = ", ".join(f"{run[way][0]:.1f}" for run in runs)
        print(
            f"{name:<20} wall {best[0][way]:.1f} s ({walls})   CPU {best[1][way]:.1f} s"
        )
    print(
        f"parallel: {best[0][0] / best[0][1]:.2f} times as fast, CPU time "
        f"{best[1][1] / best[1][0]:.2f} times as high"
    )
