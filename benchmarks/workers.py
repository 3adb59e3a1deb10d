"""Two one-thread workers that fit two takes at once, against one worker that fits one after the other.

    python benchmarks/workers.py DB TAKE [TAKE] [--repeats 3]

Every worker is a process of its own with one thread, on its own copy of DB; starting it is timed too, compilation is
not. The two ways take turns. The ratio of the wall times means something on two idle cores only, so the CPU time is
printed beside it: where it grows with two workers, they hinder each other in memory or caches.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from fit import DRIVER, ONE_THREAD, ROOT

WORKERS = 2


def start(folder: Path, take: str) -> subprocess.Popen[str]:
    """A worker that fits a take."""
    surroundings = os.environ | ONE_THREAD | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(DRIVER), "fit-one-thread", str(folder), take]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=surroundings)


def finish(worker: subprocess.Popen[str]) -> float:
    """CPU time of a worker's fit [s], when it is done."""
    printed, _ = worker.communicate()
    if worker.returncode:
        sys.exit("a worker failed")
    return float(json.loads(printed.splitlines()[-1])["stages"]["all"]["cpu"])


def timed(folders: Sequence[Path], takes: Sequence[str], *, together: bool) -> tuple[float, float]:
    """Wall time and CPU time [s] of the fits of all takes."""
    begin = time.perf_counter()
    if together:
        workers = [start(*work) for work in zip(folders, takes, strict=True)]
        cpu = sum(finish(worker) for worker in workers)
    else:
        cpu = sum(finish(start(*work)) for work in zip(folders, takes, strict=True))
    return time.perf_counter() - begin, cpu


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("db", type=Path)
    parser.add_argument("takes", nargs="+", help="one take, fitted twice, or two")
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    takes = (args.takes * WORKERS)[:WORKERS]
    with tempfile.TemporaryDirectory() as temporary:
        folders = [Path(temporary) / str(i) for i in range(WORKERS)]
        for folder in folders:
            shutil.copytree(args.db, folder)
        timed(folders[:1], takes[:1], together=False)  # compiles
        runs = [
            (timed(folders, takes, together=False), timed(folders, takes, together=True)) for _ in range(args.repeats)
        ]
    best = [[min(run[way][what] for run in runs) for way in (0, 1)] for what in (0, 1)]
    for way, name in enumerate(("one after the other", "two at once")):
        walls = ", ".join(f"{run[way][0]:.1f}" for run in runs)
        print(f"{name:<20} wall {best[0][way]:.1f} s ({walls})   CPU {best[1][way]:.1f} s")
    print(
        f"two workers: {best[0][0] / best[0][1]:.2f} times as fast as one, CPU time {best[1][1] / best[1][0]:.2f} times"
    )


if __name__ == "__main__":
    main()
