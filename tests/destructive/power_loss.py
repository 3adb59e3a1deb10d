"""Cuts the power after every file-system call of a series of commits.

    python tests/destructive/power_loss.py --every 1 --torn 2 --seed 0

A series of commits under leases, two consents,
and the removal of old generations run once. Before every call that changes a folder or
flushes something, what the disk is sure to hold is noted: of a file what it held when
it was last flushed, of a folder the entries it had when it was last flushed. From that,
the database is put together as it would be after a power loss: with nothing else, and
(torn) with a random part of what was not flushed, whose files are whole, cut or empty.
Then every commit that had been acknowledged must be there, whole and with its values,
`verify` must find no damage but removals that `clean` completes, and the next commits
must succeed. The program ends with 1 if that fails once.
"""

from __future__ import annotations

import argparse
import os
import pickle
import resource
import shutil
import stat
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent / "store"), str(HERE)]

import apart
import numpy as np
from stored import groups

from skindb.schema import dataset
from skindb.store import Database
from skindb.store import folder as folders_of_the_store

CHANGES = ("os.mkdir", "os.link", "os.rename", "os.remove", "os.rmdir", "os.truncate")
Inode = int
# what was acknowledged: kind, take, generation -> the value it holds
Acked = dict[tuple[str, str, int], float]


@dataclass
class State:
    """What a disk certainly and possibly holds at one moment, and what had been
    acknowledged by then.
    """

    event: str
    entries: dict[Inode, dict[str, Inode]]  # of folders, when they were flushed
    contents: dict[Inode, bytes]  # of files, when they were flushed
    entries_now: dict[Inode, dict[str, Inode]]
    contents_now: dict[Inode, bytes]
    acked: Acked


@dataclass
class Disk:
    """Records what is flushed below a folder."""

    base: Path
    entries: dict[Inode, dict[str, Inode]] = field(default_factory=dict)
    contents: dict[Inode, bytes] = field(default_factory=dict)
    states: list[State] = field(default_factory=list)
    acked: Acked = field(default_factory=dict)
    # descriptors: the number of an inode is not given again
    held: list[int] = field(default_factory=list)
    folders: set[Inode] = field(default_factory=set)  # every folder that ever existed
    on: bool = False

    def start(self) -> None:
        """Record every change from now on."""
        # the same calls in the same order in every run
        folders_of_the_store.FLUSHING_THREADS = 1
        self.entries[self.base.stat().st_ino] = {}
        flush = os.fsync

        def fsync(number: int) -> None:
            flush(number)
            if self.on and str(
                path := Path(f"/proc/self/fd/{number}").readlink()
            ).startswith(str(self.base)):
                self.note(f"fsync {path.name}")
                self._flushed(number)

        def change(event: str, args: tuple[object, ...]) -> None:
            writing = (
                event == "open"
                and isinstance(args[2], int)
                and args[2] & (os.O_WRONLY | os.O_RDWR)
            )
            if (
                self.on
                and (writing or event in CHANGES)
                and any(str(self.base) in str(arg) for arg in args[:2])
            ):
                self.note(f"{event} {Path(str(args[0])).name}")

        os.fsync = fsync
        self.on = True
        sys.addaudithook(change)

    def note(self, event: str) -> None:
        """Record the present state."""
        self.on = False
        folders, entries, contents = _scan(self.base, self.contents)
        for inode, path in folders.items():
            if inode not in self.folders:
                self.folders.add(inode)
                self.held.append(os.open(path, os.O_RDONLY))
        self.states.append(
            State(
                event,
                dict(self.entries),
                dict(self.contents),
                entries,
                contents,
                dict(self.acked),
            )
        )
        self.on = True

    def _flushed(self, number: int) -> None:
        self.on = False
        self.held.append(os.dup(number))
        status = os.fstat(number)
        if stat.S_ISDIR(status.st_mode):
            with os.scandir(number) as found:
                self.entries[status.st_ino] = {
                    entry.name: entry.inode() for entry in found
                }
        else:
            self.contents[status.st_ino] = Path(f"/proc/self/fd/{number}").read_bytes()
        self.on = True


def _scan(
    base: Path, flushed: dict[Inode, bytes]
) -> tuple[dict[Inode, str], dict[Inode, dict[str, Inode]], dict[Inode, bytes]]:
    """Path and entries of every folder, and contents of files that were never flushed."""
    folders = {}
    entries = {}
    contents = {}
    for folder, _, names in os.walk(base):
        with suppress(FileNotFoundError), os.scandir(folder) as found:
            inode = Path(folder).stat().st_ino
            folders[inode], entries[inode] = (
                folder,
                {entry.name: entry.inode() for entry in found},
            )
        for name in names:
            path = Path(folder) / name
            with suppress(FileNotFoundError):  # zarr writes in several threads
                if path.stat().st_ino not in flushed:
                    contents[path.stat().st_ino] = path.read_bytes()
    return folders, entries, contents


def put_together(
    state: State,
    base: Inode,
    folders: set[Inode],
    out: Path,
    rng: np.random.Generator | None,
) -> None:
    """Write the database after a power loss: only what was flushed, or also a random
    part of the rest.
    """
    waiting = [(base, out)]
    while waiting:
        inode, folder = waiting.pop()
        folder.mkdir(exist_ok=True)
        sure = state.entries.get(inode, {})
        now = state.entries_now.get(inode, {})
        for name in sorted(sure.keys() | now.keys()):
            one = sure.get(name)
            if (
                rng is not None
                and sure.get(name) != now.get(name)
                and rng.random() < 0.5
            ):
                one = now.get(name)
            if one is None:
                continue
            if one in folders:
                waiting.append((one, folder / name))
            else:
                (folder / name).write_bytes(_content(state, one, rng))


def _content(state: State, inode: Inode, rng: np.random.Generator | None) -> bytes:
    if inode in state.contents:
        return state.contents[inode]
    content = state.contents_now.get(inode, b"")
    return (
        b""
        if rng is None
        else content[: int(rng.choice([0, len(content) // 2, len(content)]))]
    )


def work(db: Database, disk: Disk) -> None:
    """The series of commits; each is acknowledged as soon as its call returns."""

    def commit(kind: str, take: str, value: float) -> None:
        tables = (
            dataset({"region_area": [value]}, coords={"region": ["face"]})
            if kind == "model"
            else None
        )
        with db.lease(take, kind) as lease, db.stage(kind, take, lease) as stage:
            stage.write(groups(value, 3), tables=tables)
            disk.acked[kind, take, stage.commit({"seeds": [1]}).generation] = value

    for value, (kind, take) in enumerate(
        [("capture", "A1"), ("model", "A1"), ("capture", "A1"), ("capture", "B1")], 1
    ):
        commit(kind, take, float(value))
    for scope in ([], ["fit"]):
        db.record_consent("A1", scope)
    with db.lease("A1", "model") as lease, db.stage("model", "A1", lease) as stage:
        stage.write(groups(5.0, 3))
        disk.acked["model", "A1", stage.commit({}).generation] = 5.0
    disk.on = False
    for path in [*(db.root / "data").rglob("*"), db.root / "data"]:
        os.utime(path, (path.stat().st_atime, path.stat().st_mtime - 7200))
    disk.on = True
    for key in (("capture", "A1", 1), ("model", "A1", 1)):
        del disk.acked[key]  # being removed: both states are correct
    db.clean(generations=1)
    commit("model", "A1", 6.0)


def fault(root: Path, acked: Acked) -> str:
    """Fault of a database after a power loss; empty if there is none."""
    db = Database(root)
    if any("removal must be completed" in fault.rule for fault in db.verify()):
        db.clean()  # as the message of verify advises
    if faults := db.verify():
        return str(faults[0])
    for (kind, take, generation), value in acked.items():
        tree = db.read(kind, take, generation=generation)
        if float(tree["surfels/surfel_area"][0]) != value:
            return f"{kind} {generation} of {take} has another value"
    if db.has("capture", "A1"):
        # the power may have gone while consent was withdrawn
        db.record_consent("A1", ["fit"])
    for kind, take in (("capture", "A1"), ("model", "A1"), ("capture", "C1")):
        newest = max((g for k, t, g in acked if (k, t) == (kind, take)), default=0)
        with db.lease(take, kind) as lease, db.stage(kind, take, lease) as stage:
            stage.write(groups(7.0, 3))
            if stage.commit({}).generation <= newest:
                return f"the next {kind} took the place of an acknowledged one"
    db.clean()
    return str(faults[0]) if (faults := db.verify()) else ""


def run(folder: Path) -> None:
    """Run the series once and keep every state; the process ends, as by a power loss,
    so that its leases are free.
    """
    resource.setrlimit(
        resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2
    )
    disk = Disk(folder / "disk")
    disk.base.mkdir()
    disk.start()
    work(Database(disk.base / "db"), disk)
    disk.note("end")
    disk.on = False
    (folder / "states").write_bytes(
        pickle.dumps((disk.base.stat().st_ino, disk.folders, disk.states))
    )


def check(asked: argparse.Namespace, folder: Path) -> Counter[str]:
    """Check the disk after every call of the series."""
    rows = Counter[str]()
    apart.in_a_process(partial(run, folder))
    base, folders, states = pickle.loads((folder / "states").read_bytes())
    for number, state in enumerate(states):
        if number % asked.every and number < len(states) - 1:
            continue
        for torn in range(1 + asked.torn):
            rng = np.random.default_rng([asked.seed, number, torn]) if torn else None
            out = folder / f"{number}-{torn}"
            put_together(state, base, folders, out, rng)
            what = "torn" if torn else "flushed alone"
            rows[what] += 1
            said = (
                "no database"
                if state.acked and not (out / "db").exists()
                else fault(out / "db", state.acked)
            )
            if said:
                rows["failures"] += 1
                print(
                    f"after call {number} ({state.event}), {what} {torn}: {said}",
                    flush=True,
                )
            shutil.rmtree(out)
    rows["calls"] = len(states)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--every", type=int, default=1, help="The power is cut after every n-th call."
    )
    parser.add_argument(
        "--torn",
        type=int,
        default=1,
        help="Number of random parts of what was not flushed.",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="Random seed of these parts."
    )
    with tempfile.TemporaryDirectory() as name:
        rows = check(parser.parse_args(), Path(name).resolve())
    for name in ("calls", "flushed alone", "torn", "failures"):
        print(f"{name:<16} {rows[name]:>6}")
    sys.exit(bool(rows["failures"]))


if __name__ == "__main__":
    main()
