"""Kills backups and restores at every file-system call that concerns the backup or the
restored database.

    python tests/destructive/kill_backup.py --every 1

A small database is backed up for the second time, after more versions were committed,
or restored from a backup. After each kill every state that the backup lists must be
whole and give the bytes of its database, and a half-restored database must refuse every
command in one line; the same command must then complete, and give the same bytes. The
program ends with 1 if that fails once.
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
from kill_commit import EVENTS
from stored import commit
from traces import contents

from skindb.errors import InputError
from skindb.store import Database, archive, backup_states, restore

BROKEN = "broken promise"
CACHES = ("catalogue/", "leases/", "staging/", "withdrawn/")
REFUSAL = "a restore that is not complete"
STEPS = ("backup", "restore")


def count_calls(place: Path, die_at: int) -> list[int]:
    """Count the calls that concern a folder from now on, and kill the process at one of them."""
    calls = [0]
    lock = threading.Lock()  # files are flushed by several threads

    def count(event: str, args: tuple[object, ...]) -> None:
        if event in EVENTS and any(str(place) in str(arg) for arg in args[:2]):
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


def state(root: Path) -> dict[str, bytes]:
    """Content of the files of a database, without caches and leases."""
    return {
        key: content
        for key, content in contents(root).items()
        if not key.startswith(CACHES)
    }


def prepare_whole(folder: Path) -> None:
    """A database, its backup, and what it held then and holds now."""
    root = folder / "db"
    for take in ("A", "B"):
        capture = commit(root, take=take, n=2)
        commit(root, 2.0, take, "model", n=2, inputs=[capture.as_input()])
    shutil.copytree(root, folder / "1")
    Database(root).backup(str(folder / "backup"))
    commit(root, 3.0, "B", "model", n=2)
    shutil.copytree(root, folder / "2")


def step(folder: Path, variant: str) -> Path:
    """Back up or restore in a copy of the folder; returns the place that is written."""
    archive.THREADS = 1  # so that calls have an order
    if variant == "backup":
        Database(folder / "db").backup(str(folder / "backup"))
        return folder / "backup"
    restore(str(folder / "backup"), str(folder / "copy"), markers=folder / "db.markers")
    return folder / "copy"


def attempt(folder: Path, variant: str, number: int) -> apart.Outcome:
    """Run in a process that is killed at a given call, and check every promise."""
    process = os.fork()
    if not process:
        count_calls(folder / ("backup" if variant == "backup" else "copy"), number)
        step(folder, variant)
        os._exit(0)
    if not os.WIFSIGNALED(os.waitpid(process, 0)[1]):
        return BROKEN, "the process was not killed"
    return after_backup(folder) if variant == "backup" else after_restore(folder)


def after_backup(folder: Path) -> apart.Outcome:
    """Check a backup whose second state was begun."""
    numbers = [one.number for one in backup_states(str(folder / "backup"))]
    if numbers not in ([1], [1, 2]):
        return BROKEN, f"states {numbers}"
    for number in numbers:
        restore(
            str(folder / "backup"),
            str(folder / f"of {number}"),
            number=number,
            markers=folder / "db.markers",
        )
        if state(folder / f"of {number}") != state(folder / str(number)):
            return BROKEN, f"state {number} differs"
    report = Database(folder / "db").backup(str(folder / "backup"), verify=True)
    if report.number != len(numbers) + 1 or report.faults:
        return BROKEN, f"the next backup is {report}"
    restore(str(folder / "backup"), str(folder / "last"), markers=folder / "db.markers")
    if state(folder / "last") != state(folder / "2"):
        return BROKEN, "the next state differs"
    return ("before", "after")[len(numbers) - 1], ""


def after_restore(folder: Path) -> apart.Outcome:
    """Check a database whose restore was begun."""
    copy = folder / "copy"
    is_complete = (copy / "log").exists() and not (
        copy / "withdrawn/restoring.json"
    ).exists()
    if not is_complete:
        if (copy / "log").exists() and not is_refused(copy):
            return BROKEN, "a half database can be read"
        step(folder, "restore")
    if state(copy) != state(folder / "1") or Database(copy).verify():
        return BROKEN, "the restored database differs"
    return ("after" if is_complete else "before"), ""


def is_refused(root: Path) -> bool:
    """Whether a database is refused by what reads and writes."""
    for use in (
        Database(root).takes,
        Database(root).verify,
        partial(commit, root, take="C", n=2),
    ):
        try:
            use()
        except InputError as error:
            if REFUSAL in str(error):
                continue
        return False
    return True


def kill(variant: str, folder: Path, asked: argparse.Namespace) -> list[apart.Case]:
    """Kill one variant at many of its calls."""
    whole = folder / "whole"

    def count() -> None:
        root = Path(shutil.copytree(whole, folder / "counted"))
        calls = count_calls(root / ("backup" if variant == "backup" else "copy"), 0)
        step(root, variant)
        (folder / "calls.json").write_text(json.dumps(calls[0]))

    apart.in_a_process(partial(prepare_whole, whole))
    apart.in_a_process(count)
    calls = json.loads((folder / "calls.json").read_text())

    def prepare(number: int, work: Path):
        copy = Path(shutil.copytree(whole, work / "copy"))
        return (
            variant,
            f"call {number} of {calls}",
            partial(attempt, copy, variant, number),
        )

    numbers = list(range(calls, 0, -asked.every))
    return apart.run(numbers, prepare, folder, apart.Limits(asked.jobs, seconds=300))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--every",
        type=int,
        default=1,
        help="Every n-th call is one at which a process is killed.",
    )
    parser.add_argument(
        "--jobs", type=int, default=2, help="Number of processes at a time."
    )
    asked = parser.parse_args()
    bad = []
    for variant in STEPS:
        with tempfile.TemporaryDirectory() as folder:
            cases = kill(variant, Path(folder), asked)
        count = [
            sum(case.outcome == one for case in cases) for one in ("before", "after")
        ]
        bad += [case for case in cases if case.outcome not in ("before", "after")]
        print(
            f"{variant}: {len(cases)} kills, {count[0]} before and {count[1]} "
            f"after its end, {len(bad)} failures"
        )
    for case in bad:
        print(f"{case.variant}, {case.damage}: {case.outcome}: {case.detail}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
