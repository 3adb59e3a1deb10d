"""Eight writers race for the lease of one take, and of eight takes, and some of them are killed.

    python tests/destructive/race_lease.py --commits 200 --kills 40

Each writer takes the lease, reads the newest version, and commits one whose value is
larger by one. Nothing may be lost: the values of the generations are 1, 2, 3 and so on,
every commit that was acknowledged is among them, and no writer meets another one's
commit (a conflict). Killed writers are replaced, and nobody waits for their leases to
end.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent / "store"), str(HERE)]

import numpy as np
from stored import groups

from skindb.store import Database
from skindb.store import lease as lease_module

WRITERS = 8
lease_module.POLL_SECONDS = 0.02  # otherwise a race consists mostly of waiting


def write(root: Path, takes: list[str], note: int, seed: int) -> None:
    """Commit until killed, and record every commit as soon as it is acknowledged."""
    db = Database(root)
    rng = np.random.default_rng(seed)
    while True:
        take = takes[rng.integers(len(takes))]
        with (
            db.lease(take, "capture", wait=600) as lease,
            db.stage("capture", take, lease) as stage,
        ):
            before = (
                db.read("capture", take)["surfels/surfel_area"].values[0]
                if stage.base
                else 0.0
            )
            stage.write(groups(before + 1, 1))
            os.write(note, f"{take} {stage.commit({}).generation}\n".encode())


def start(root: Path, takes: list[str], note: int, seed: int) -> int:
    """A writer in a process of its own, in whose place comes an error code if it fails."""
    process = os.fork()
    if not process:
        try:
            write(root, takes, note, seed)
        except Exception:
            traceback.print_exc()
            raise
        finally:
            os._exit(1)
    return process


def race(root: Path, takes: list[str], asked: argparse.Namespace) -> list[str]:
    """Let the writers race, and return the faults."""
    pipe, note = os.pipe()
    os.set_blocking(pipe, False)
    rng = np.random.default_rng([asked.seed, len(takes)])
    seeds = iter(range(10**6))
    running = [start(root, takes, note, next(seeds)) for _ in range(WRITERS)]
    text = ""
    kills = 0
    faults = []
    since = time.monotonic()
    while text.count("\n") < asked.commits:
        time.sleep(0.02)
        while True:
            try:
                text += os.read(pipe, 1 << 16).decode()
            except BlockingIOError:
                break
        if (
            kills < asked.kills
            and text.count("\n") > asked.commits * kills / asked.kills
        ):
            one = int(rng.integers(WRITERS))
            os.kill(running[one], signal.SIGKILL)
            os.waitpid(running[one], 0)
            running[one], kills = start(root, takes, note, next(seeds)), kills + 1
        for one, process in enumerate(running):
            if os.waitpid(process, os.WNOHANG)[0]:
                faults.append("a writer failed")
                running[one] = start(root, takes, note, next(seeds))
        if len(faults) > WRITERS:
            break
    seconds = time.monotonic() - since
    for process in running:
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
    with suppress(BlockingIOError):
        text += os.read(pipe, 1 << 20).decode()
    faults += _lost(Database(root), text)
    count = text.count("\n")
    print(
        f"{len(takes)} takes: {count} commits acknowledged in {seconds:.0f} s, "
        f"{kills} killed, {len(faults)} faults"
    )
    return faults


def _lost(db: Database, text: str) -> list[str]:
    acked = {(take, int(number)) for take, number in map(str.split, text.splitlines())}
    faults = [str(fault) for fault in db.verify()]
    for take in db.takes("capture"):  # of few commits, perhaps not every take has one
        history = db.history("capture", take)
        values = [
            float(
                db.read("capture", take, generation=one.generation)[
                    "surfels/surfel_area"
                ][0]
            )
            for one in history
        ]
        if values != [float(n + 1) for n in range(len(history))]:
            faults.append(f"{take}: values {values}")
        acked -= {(take, one.generation) for one in history}
    db.clean()
    return (
        faults
        + [f"lost: {one}" for one in sorted(acked)]
        + [str(fault) for fault in db.verify()]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--commits", type=int, default=60, help="Number of commits of each race."
    )
    parser.add_argument(
        "--kills",
        type=int,
        default=8,
        help="Number of writers that are killed in each race.",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="Random seed of who is killed."
    )
    asked = parser.parse_args()
    failed = False
    for count in (1, WRITERS):
        with tempfile.TemporaryDirectory() as folder:
            process = os.fork()  # its threads must not be forked again
            if not process:
                faults = race(
                    Path(folder) / "db",
                    [f"A{number}" for number in range(count)],
                    asked,
                )
                print(*faults, sep="\n", end="", flush=True)
                os._exit(bool(faults))
            failed |= bool(os.waitpid(process, 0)[1])
    sys.exit(failed)


if __name__ == "__main__":
    main()
