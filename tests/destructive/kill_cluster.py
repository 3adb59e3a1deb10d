"""Kills Dask workers, and the driver of a cluster or of local processes, while takes
are fitted, and runs it again.

    python tests/destructive/kill_cluster.py --cases 30 --seed 1

A `dask scheduler` and `dask worker --nworkers 2` run on this machine. Each case fits
all takes of a copy of a small database with the command `skindb fit`, and kills one
process with SIGKILL at a random moment of the work: a worker of the cluster, the
command with `--scheduler`, or the command with `--workers 2`. A command whose worker
was killed must fit every take; a command that was killed is given again. At once after
a kill, while others may still be at work, `verify` must find no damage, every model
that can be seen must be the one of a run that was not disturbed, and every take that
the command had named as finished must be there. At the end every take must be fitted
with the numbers of the undisturbed run, nothing may remain that `clean` does not list,
and no process of a killed command may be left. The program ends with 1 if that fails
once.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

from distributed import Client
from kill_fit import files_of, generations, unlisted
from planted_cohort import EVERYTHING, capture

import skindb
from skindb.store import Database
from skindb.workflow.derive import groups_of

TAKES = 4
START_S = 120.0
COMMAND_S = 600.0
# moment of a kill, as a fraction of the time of an undisturbed run: later ones often
# come too late
LATEST = 0.8
ORPHANS_S = 60.0  # time in which the processes of a killed command must end
COMMAND = [sys.executable, "-c", "from skindb.cli import main; main()", "fit"]
OPTIONS = [
    "--k",
    "2",
    "--rank",
    "4",
    "--hold-out-lights",
    "0.1",
    "--wait",
    "120",
    "--json",
    "--progress",
    "json",
]
VARIANTS = ("worker", "driver of a cluster", "driver of processes")
GOOD = ("killed", "ended before the kill")
BAD = (
    "half-written and visible",
    "acknowledged and lost",
    "command failed",
    "other numbers",
    "something left",
)


@dataclass
class Run:
    """A command that fits all takes, in a process of its own."""

    root: Path
    options: list[str]
    output: Path
    process: subprocess.Popen[bytes] = field(init=False)

    def __post_init__(self) -> None:
        with (
            self.output.open("wb") as errors,
            self.output.with_suffix(".json").open("wb") as lines,
        ):
            self.process = subprocess.Popen(
                [*COMMAND, str(self.root), *OPTIONS, *self.options],
                stdout=lines,
                stderr=errors,
            )

    def wait_until_working(self) -> float:
        """Wait for the first take, and return the time of its start."""
        end = time.monotonic() + START_S
        while not any((self.root / "leases/model").glob("*/*.json")):
            if self.process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"no take was begun: {self.said()}")
            time.sleep(0.01)
        return time.monotonic()

    def finished(self) -> set[str]:
        """Takes that the command has printed as finished."""
        found = set()
        for line in self.output.read_text(errors="replace").splitlines():
            with suppress(ValueError):  # a line that was cut by the kill
                said = json.loads(line)
                found |= {said["take"]} if said.get("stage") == "finished" else set()
        return found

    def end(self) -> int:
        """Wait for the end of the command, and return its exit status."""
        return self.process.wait(COMMAND_S)

    def said(self) -> str:
        """The last lines that the command printed."""
        return self.output.read_text(errors="replace")[-400:]


@dataclass
class Cluster:
    """A scheduler and two workers, whose nanny starts a killed one again."""

    client: Client
    address: str

    def workers(self) -> list[int]:
        """Process ids of both workers, as soon as there are two."""
        self.client.wait_for_workers(2, timeout=START_S)
        end = time.monotonic() + START_S
        while time.monotonic() < end:
            with suppress(Exception):  # a killed worker is still listed
                if len(found := sorted(self.client.run(os.getpid).values())) == 2:
                    return found
            time.sleep(0.2)
        raise RuntimeError("there are no two workers")


@contextmanager
def started_cluster(folder: Path) -> Iterator[Cluster]:
    """A cluster of the commands that docs/howto/cluster.md names."""
    file = folder / "scheduler.json"
    log = (folder / "cluster.txt").open("wb")
    dask = [sys.executable, "-m", "dask"]
    scheduler = [
        *dask,
        "scheduler",
        "--no-dashboard",
        "--port",
        "0",
        "--host",
        "127.0.0.1",
    ]
    worker = [
        *dask,
        "worker",
        "--scheduler-file",
        str(file),
        "--nworkers",
        "2",
        "--nthreads",
        "1",
        "--no-dashboard",
    ]
    with log:
        first = subprocess.Popen(
            [*scheduler, "--scheduler-file", str(file)], stdout=log, stderr=log
        )
        second = subprocess.Popen(
            [*worker, "--local-directory", str(folder)], stdout=log, stderr=log
        )
        try:
            end = time.monotonic() + START_S
            while not file.exists() and time.monotonic() < end:
                time.sleep(0.1)
            with Client(
                scheduler_file=str(file), timeout=START_S, set_as_default=False
            ) as client:
                yield Cluster(client, client.scheduler.address)
        finally:
            for process in (second, first):
                process.terminate()
                process.wait(START_S)


def prepare(root: Path) -> None:
    """A database of captures, one a subject."""
    db = skindb.open(str(root), create=True)
    for number in range(TAKES):
        take = f"S{number:02d}"
        tree = capture(
            take, {"traits": {"age": 20 + number}, "scope": list(EVERYTHING)}, number
        )
        with db.stage("capture", take) as stage:
            stage.write(groups_of(tree))
            stage.commit(tree.attrs)


def models(db: Database) -> dict[str, list[dict[str, list[object]]]]:
    """Digests of the files of every model that can be seen, by take."""
    takes = db.takes("model")
    return {
        take: [
            files_of(db, "model", take, one) for one in generations(db, "model", take)
        ]
        for take in takes
    }


def descendants(parent: int) -> set[int]:
    """Processes that a process has started, and theirs."""
    with suppress(OSError):
        text = "".join(
            path.read_text() for path in Path(f"/proc/{parent}/task").glob("*/children")
        )
        children = {int(word) for word in text.split()}
        return children.union(*(descendants(child) for child in children))
    return set()


def left_running(processes: set[int]) -> set[int]:
    """Processes that have not ended after the time limit; they are killed then."""
    end = time.monotonic() + ORPHANS_S
    while (
        alive := {one for one in processes if _is_alive(one)}
    ) and time.monotonic() < end:
        time.sleep(0.2)
    for one in alive:
        with suppress(ProcessLookupError):
            os.kill(one, signal.SIGKILL)
    return alive


def _is_alive(process: int) -> bool:
    try:
        return (
            Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
            not in "ZX"
        )
    except OSError:
        return False


def attempt(
    root: Path,
    variant: str,
    after: float,
    pick: random.Random,
    cluster: Cluster,
    expected: dict,
) -> tuple[str, str, int]:
    """Kill one process, check every promise and finish the work; returns outcome,
    detail and repeated fits.
    """
    options = (
        ["--workers", "2"]
        if variant == VARIANTS[2]
        else ["--scheduler", cluster.address]
    )
    workers = cluster.workers()
    run = Run(root, options, root.parent / "first.txt")
    run.wait_until_working()
    time.sleep(after)
    of_the_run = descendants(run.process.pid)
    was_at_work = run.process.poll() is None
    with suppress(ProcessLookupError):
        os.kill(
            pick.choice(workers) if variant == "worker" else run.process.pid,
            signal.SIGKILL,
        )
    if variant == "worker":
        return _judge(run, run, was_at_work, expected, skindb.open(str(root)))
    run.end()
    db = skindb.open(str(root))
    if bad := _visible_faults(db, run, expected):
        return *bad, 0
    if was_at_work and (alive := left_running(of_the_run)):
        return (
            BAD[4],
            f"{len(alive)} processes of the killed command after {ORPHANS_S:.0f} s",
            0,
        )
    return _judge(
        run, Run(root, options, root.parent / "second.txt"), was_at_work, expected, db
    )


def _visible_faults(db: Database, run: Run, expected: dict) -> tuple[str, str] | None:
    """Faults of the visible versions, while other processes may still work."""
    finished = run.finished()  # before the database is checked
    if faults := db.verify():
        return BAD[0], str(faults[0])
    seen = models(db)
    if others := [
        take
        for take, all_of_it in seen.items()
        if any(one != expected[take] for one in all_of_it)
    ]:
        return BAD[0], f"other values in models of {others}"
    if lost := finished - seen.keys():
        return BAD[1], f"{sorted(lost)}"
    return None


def _judge(
    first: Run, last: Run, was_at_work: bool, expected: dict, db: Database
) -> tuple[str, str, int]:
    """Check at once, wait for the end of the last command, and check again."""
    if bad := _visible_faults(db, first, expected):
        return *bad, 0
    if last.end():
        return BAD[2], last.said(), 0
    if bad := _visible_faults(db, last, expected):
        return *bad, 0
    seen = models(db)
    if lost := first.finished() - seen.keys():
        return BAD[1], f"{sorted(lost)}", 0
    if seen.keys() != expected.keys():
        return BAD[3], f"models of {sorted(seen)} only", 0
    db.clean()
    # temporary files stay for an hour
    left = [one.key for one in db.garbage() if not one.kept]
    if db.verify() or unlisted(db) or left or [*db.scratch().glob("*/log")]:
        return BAD[4], f"{db.verify()} {unlisted(db)} {left}", 0
    repeated = sum(len(one) - 1 for one in seen.values())
    return GOOD[0] if was_at_work else GOOD[1], "", repeated


def engine_of(variant: str) -> str:
    """The engine on which a variant runs."""
    return "processes" if variant == VARIANTS[2] else "cluster"


def undisturbed(root: Path, options: list[str]) -> tuple[float, dict]:
    """Duration of an undisturbed run in seconds, and the files of its models."""
    run = Run(root, options, root.parent / f"undisturbed-{len(options)}.txt")
    begin = run.wait_until_working()
    if run.end():
        raise RuntimeError(run.said())
    return time.monotonic() - begin, {
        take: files for take, (files,) in models(skindb.open(str(root))).items()
    }


def measured(
    folder: Path, cluster: Cluster, variants: set[str]
) -> tuple[dict[str, float], dict]:
    """Seconds of a run on each engine of these variants, and the files that every run
    must end with.
    """
    seconds = {}
    expected = {}
    given = {
        "cluster": ["--scheduler", cluster.address],
        "processes": ["--workers", "2"],
    }
    for name in sorted({engine_of(variant) for variant in variants}):
        options = given[name]
        for repeat in range(2):  # the first run compiles
            root = Path(
                shutil.copytree(folder / "source", folder / f"{name}-{repeat}" / "db")
            )
            seconds[name], files = undisturbed(root, options)
            expected = expected or files
            if files != expected or len(files) != TAKES:
                raise RuntimeError(f"undisturbed runs with {options} differ")
    return seconds, expected


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=9, help="Number of kills.")
    parser.add_argument(
        "--first", type=int, default=0, help="Number of the first case, to repeat one."
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="Random seed of the moments and of the workers.",
    )
    asked = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join(
        [str(HERE.parents[1]), os.environ.get("PYTHONPATH", "")]
    )
    rows = Counter[tuple[str, str]]()
    failures = []
    with tempfile.TemporaryDirectory() as name, started_cluster(Path(name)) as cluster:
        folder = Path(name)
        prepare(folder / "source")
        numbers = range(asked.first, asked.first + asked.cases)
        seconds, expected = measured(
            folder, cluster, {VARIANTS[number % len(VARIANTS)] for number in numbers}
        )
        print(f"undisturbed: {seconds}", file=sys.stderr, flush=True)
        for number in numbers:
            draw = random.Random(f"{asked.seed} {number}")
            variant = VARIANTS[number % len(VARIANTS)]
            after = draw.uniform(0, LATEST * seconds[engine_of(variant)])
            root = Path(
                shutil.copytree(folder / "source", folder / f"case-{number}" / "db")
            )
            outcome, detail, repeated = attempt(
                root, variant, after, draw, cluster, expected
            )
            print(
                f"case {number}, {variant} after {after:.1f} s: {outcome} {detail}",
                file=sys.stderr,
                flush=True,
            )
            rows[variant, "trials"] += 1
            rows[variant, outcome] += 1
            rows[variant, "repeated"] += repeated
            failures += [number] if outcome in BAD else []
            shutil.rmtree(root.parent)
    print("\n".join(table(rows)))
    sys.exit(bool(failures))


def table(rows: Counter[tuple[str, str]]) -> list[str]:
    """Trials and outcomes by what was killed."""
    columns = ("trials", *GOOD, "fits repeated", *BAD[:2], "other failures")
    lines = [f"| killed | {' | '.join(columns)} |", f"|---|{'---|' * len(columns)}"]
    for variant in VARIANTS:
        values = [
            rows[variant, name] for name in ("trials", *GOOD, "repeated", *BAD[:2])
        ]
        values.append(sum(rows[variant, name] for name in BAD[2:]))
        lines.append(f"| {variant} | {' | '.join(map(str, values))} |")
    return lines


if __name__ == "__main__":
    main()
