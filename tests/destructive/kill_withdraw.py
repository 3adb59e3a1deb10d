"""Kills and suspends withdrawals at random moments, while studies, edits, releases,
caches and ingests are written.

    python tests/destructive/kill_withdraw.py --cases 100 --seed 1 [--bucket]

Each case copies a small database. Up to three writers that use or name the subject
begin and are suspended (SIGSTOP) at random moments. Then the subject is withdrawn, and
this process is killed (SIGKILL), suspended or left alone at a random moment. What it
left is completed by another withdrawal, by `refresh` or by `clean`. The writers are
continued (SIGCONT) or killed, before or after that, and `clean` runs. Then

- every version without a reference to the subject has the same bytes as before;
- nothing of the subject is in any file of the database, with every chunk decompressed,
  in the cache, in the folder for temporary files, or in a file that a process has open;
- `verify` finds nothing, and results of others exist or are requested.

The program ends with 1 if that fails once, or if a process ends with a traceback.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from unittest import mock

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import apart  # noqa: F401  its settings
import dask.array  # noqa: F401  see IMPORTED
from bucket_server import new_bucket, own_cache, s3_server, settings
from planted_population import TABLES, population
from sphere import write_capture
from traces import MARK, contents, traces

import skindb
from skindb import workflow
from skindb.errors import InputError
from skindb.store import Database
from skindb.workflow import studies

# so that the processes that are forked need not import what these use
IMPORTED = (workflow.edit, workflow.ingest_take, workflow.refresh, workflow.withdraw)
SUBJECT = "Xqz7"
LEASE_S = 1.0  # so that the lease of a suspended writer expires soon
END_S = 300.0  # after which a process hangs
NOT_BEGUN = ("killed, completed by clean", "killed, completed by refresh")
# exit codes of writers
REFUSED = 3
FAILED = 4
WRITERS: dict[str, Callable[[Database], object]] = {
    "study": lambda db: workflow.translucency(db, name="mine"),
    "traits": lambda db: workflow.traits(db, k=3, name="mine"),
    "edit": lambda db: workflow.edit(db, "B", {"age:older": 0.5}),
    "release": lambda db: db.create_release("r2"),
    "cache": lambda db: db.info(),
    "consent": lambda db: db.record_consent(SUBJECT, ["fit", "statistics"]),
    "ingest": lambda db: workflow.ingest_take(
        db, os.environ["CAPTURE"], spacing_mm=8.0, photographs=0
    ),
}
UNDISTURBED = WRITERS | {
    "erase": lambda db: db.erase(SUBJECT),
    "withdraw": lambda db: workflow.withdraw(db, SUBJECT),
}
COMPLETED_BY: dict[str, Callable[[Database], object]] = {
    "withdraw": lambda db: _withdraw_again(db),
    "refresh": lambda db: workflow.refresh(db),
    "clean": lambda db: db.clean(),
}


def fill(db: Database) -> None:
    """Takes of three subjects, and results of all of them and of the others alone."""
    for take, model in population().items():
        name = take.replace("A", SUBJECT)
        about = dict(model.attrs)
        if take.startswith("A"):
            about |= {"subject": SUBJECT, "remark": SUBJECT}
            fitted = model["fitted"].to_dataset()
            fitted["diffuse_reflectance"][3] = MARK
            model["fitted"] = fitted
        with db.stage("model", name) as stage:
            stage.write(
                {
                    str(group): node.to_dataset()
                    for group, node in model.children.items()
                }
            )
            stage.commit(about)
    workflow.translucency(db)
    workflow.translucency(db, takes=["B", "C"], name="others")
    workflow.traits(db, k=3)
    workflow.edit(db, "B", {"age:older": 0.5})
    db.create_release("r1")
    db.create_release("others", ["B", "C"])


def copy_objects(old: Database, new: Database) -> None:
    for top in old.place.names() or []:
        if old.place.file_type(top) == "file":
            new.place.replace(top, old.place.read(top))
        for name in [name for name, size in old.place.sizes(top).items() if size >= 0]:
            new.place.replace(f"{top}/{name}", old.place.read(f"{top}/{name}"))


def _withdraw_again(db: Database) -> None:
    try:
        workflow.withdraw(db, SUBJECT, wait=30)
    except InputError as error:
        if "nothing is left" not in str(error):
            raise


class Process:
    """A function in a process of its own, forked from this one, which has imported
    everything and used nothing.
    """

    def __init__(self, work: Callable[[], object], log: Path) -> None:
        self.log = log
        self.code = None
        self.number = os.fork()
        if not self.number:
            os._exit(_run(work, log))

    def signal(self, what: signal.Signals) -> None:
        """Send a signal, unless the process has ended."""
        if not self.has_ended():
            os.kill(self.number, what)

    def has_ended(self) -> bool:
        """Whether the process has ended."""
        if self.code is None:
            number, status = os.waitpid(self.number, os.WNOHANG)
            if number:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code is not None

    def wait(self) -> int:
        """Exit code of the process; a process that hangs is killed."""
        end = time.monotonic() + END_S
        while not self.has_ended():
            if time.monotonic() > end:
                self.log.write_text("hangs")
                os.kill(self.number, signal.SIGKILL)
                end += END_S
            time.sleep(0.005)
        return self.code


def _run(work: Callable[[], object], log: Path) -> int:
    try:
        work()
    except InputError as error:
        log.write_text(str(error))
        return REFUSED
    except BaseException:  # noqa: BLE001
        log.write_text(traceback.format_exc())
        return FAILED
    return 0


def _seconds(work: Callable[[], object], log: Path) -> float:
    start = time.monotonic()
    process = Process(work, log)
    if process.wait():
        raise RuntimeError(log.read_text())
    return time.monotonic() - start


class Trial:
    """One case.

    Parameters
    ----------
    url, folder
        Copy of the database, and a folder for the rest of the case.
    seconds
        How long a writer, and the part of a withdrawal in which it is killed, take
        undisturbed.
    draw
        Source of random choices.
    """

    def __init__(
        self,
        url: str,
        folder: Path,
        seconds: Callable[[str], float],
        draw: random.Random,
    ) -> None:
        self.url = url
        self.folder = folder
        self.writers = draw.sample(sorted(WRITERS), draw.randint(0, 3))
        self.part = draw.choice(["erase", "erase", "withdraw"])
        # measured before the case begins
        self.seconds = {name: seconds(name) for name in (*self.writers, self.part)}
        self.draw = draw
        self.processes: dict[str, Process] = {}

    def run(self) -> str:
        """What happened, in a few words."""
        for name in self.writers:
            self._begin(name, WRITERS[name])
            time.sleep(self.draw.uniform(0, 1.1 * self.seconds[name]))
            self.processes[name].signal(signal.SIGSTOP)
        before = [name for name in self.writers if self.draw.random() < 0.3]
        outcome = self._withdraw(before)
        self._end(self.writers)
        if outcome in NOT_BEGUN:  # perhaps it was killed before it changed anything
            self._complete("withdraw")
        self._complete("clean")
        return outcome

    def _withdraw(self, before: list[str]) -> str:
        self._begin("withdraw", lambda db: workflow.withdraw(db, SUBJECT, wait=30))
        time.sleep(self.draw.uniform(0, 1.2 * self.seconds[self.part]))
        what = self.draw.choice(["killed", "killed", "suspended", "left alone"])
        process = self.processes["withdraw"]
        if what != "left alone":
            process.signal(signal.SIGKILL if what == "killed" else signal.SIGSTOP)
        self._end(before)
        process.signal(signal.SIGCONT)
        code = process.wait()
        if what != "killed" or code == 0:
            return f"{what}, {'done' if code == 0 else 'failed'}"
        completed_by = self.draw.choice(sorted(COMPLETED_BY))
        self._complete(completed_by)
        return f"killed, completed by {completed_by}"

    def _end(self, writers: list[str]) -> None:
        """Continue or kill suspended writers, and wait for them."""
        for name in writers:
            self.processes[name].signal(
                self.draw.choice([signal.SIGCONT, signal.SIGKILL])
            )
        for name in writers:
            self.processes[name].wait()

    def _begin(self, name: str, work: Callable[[Database], object]) -> None:
        self.processes[name] = Process(
            lambda: work(skindb.open(self.url)), self.folder / f"{name}.log"
        )

    def _complete(self, name: str) -> None:
        process = Process(
            lambda: COMPLETED_BY[name](skindb.open(self.url)),
            self.folder / f"{name} again.log",
        )
        self.processes[f"{name} again"] = process
        process.wait()

    def faults(self) -> list[str]:
        """Processes that ended with a traceback or hang, and withdrawals that were refused."""
        found = []
        for name, process in self.processes.items():
            good = {
                0,
                *([-signal.SIGKILL] if name in (*WRITERS, "withdraw") else []),
                *([REFUSED] if name in WRITERS else []),
            }
            if process.code not in good:
                text = process.log.read_text() if process.log.exists() else ""
                found.append(f"{name} ended with {process.code}: {text}")
        return found


def _examine(
    url: str, download: Path, expected: dict[str, bytes], folders: list[Path]
) -> None:
    """Raise an error with everything that is wrong after a case."""
    db = skindb.open(url)
    root = db.folder or download
    if db.folder is None:
        copy_objects(db, Database(root))
    found = []
    left = contents(root)
    found += [
        f"changed: {key}"
        for key, content in expected.items()
        if left.get(key) != content
    ]
    for folder in (root, *folders):
        found += traces(folder, SUBJECT)
    base = str(download.parents[1])  # of all cases
    found += [
        f"open: {path}"
        for path in _open_files()
        if path.startswith(base) and SUBJECT in path
    ]
    found += [
        f"visible: {kind} of {take}"
        for kind in db.kinds()
        for take in db.takes(kind)
        if SUBJECT in take
    ]
    requested = {(request.kind, request.take) for request in db.requests()}
    results = [
        ("population", "translucency"),
        ("population", "traits.k-3"),
        ("edit", "B"),
        ("release", "r1"),
    ]
    found += [
        f"lost: {one}" for one in results if not db.has(*one) and one not in requested
    ]
    found += [str(fault) for fault in db.verify()]
    if found:
        raise RuntimeError("\n".join(found))


def _open_files() -> Iterator[str]:
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            yield str(link.readlink())
        except OSError:  # of another user, or closed meanwhile
            continue


def _without_reference(root: Path) -> dict[str, bytes]:
    """Content of all files of versions that do not refer to the subject."""
    files = contents(root)
    found = {}
    for key, content in files.items():
        if (
            key.startswith("log/")
            and SUBJECT.encode() not in content
            and SUBJECT not in key
        ):
            stem = json.loads(content)["path"].removesuffix(".zarr")
            found[key] = content
            found |= {
                name: text
                for name, text in files.items()
                if name.startswith(f"{stem}.")
            }
    return found


@contextmanager
def _environment(folder: Path, capture: Path) -> Iterator[list[Path]]:
    """An own cache, data folder and folder for temporary files, until the end; yields all."""
    temporary = folder / "tmp"
    cache = folder / "cache"
    share = folder / "share"
    temporary.mkdir(parents=True)
    own_cache(cache)
    variables = {
        "SKINDB_CACHE": str(cache),
        "TMPDIR": str(temporary),
        "CAPTURE": str(capture),
        "XDG_DATA_HOME": str(share),
    }
    tempfile.tempdir = None
    with mock.patch.dict(os.environ, variables):
        yield [temporary, cache, share]
    tempfile.tempdir = None


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--bucket", action="store_true", help="In a bucket of a server on this machine."
    )
    args = parser.parse_args()
    studies.dictionary_tables = lambda *_: TABLES  # 8 of the 59
    Database.lease = partial_lease(Database.lease)
    draw = random.Random(args.seed)
    counts = Counter[str]()
    failures = 0
    with ExitStack() as stack:
        folder = Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="kill-withdraw-"))
        )
        address = stack.enter_context(s3_server("localbucket")) if args.bucket else ""
        os.environ |= settings(address) if args.bucket else {}
        capture = folder / "capture"
        write_capture(capture)
        about = json.loads((capture / "capture.json").read_text())
        (capture / "capture.json").write_text(
            json.dumps(about | {"subject": SUBJECT, "condition": "wet"})
        )
        first = folder / "first"
        prepared = folder / "prepared"
        prepared.mkdir()
        stack.enter_context(_environment(prepared, capture))
        _seconds(lambda: fill(Database(first)), folder / "fill.log")
        expected = _without_reference(first)
        assert len(expected) > 100, len(expected)

        def new_case(number: int | str) -> str:
            url = (
                f"s3://{new_bucket(address)}/faces"
                if args.bucket
                else str(folder / f"case {number}")
            )
            _seconds(
                lambda: copy_objects(Database(first), skindb.open(url, create=True)),
                folder / "copy.log",
            )
            return url

        @functools.cache
        def seconds(name: str) -> float:
            with _environment(folder / name, capture):
                for attempt in range(1 + (name == "ingest")):  # the first one compiles
                    url = new_case(f"{name} {attempt}")
                    work = partial(lambda url: UNDISTURBED[name](skindb.open(url)), url)
                    taken = _seconds(work, folder / "time.log")
            return taken

        for number in range(args.cases):
            own = folder / f"own {number}"
            with _environment(own, capture) as folders:
                url = new_case(number)
                trial = Trial(url, own, seconds, draw)
                outcome = trial.run()
                examine = partial(_examine, url, own / "copy", expected, folders)
                examiner = Process(examine, own / "examine.log")
                faults = trial.faults()
                if examiner.wait():
                    faults.append((own / "examine.log").read_text())
            counts[outcome] += 1
            print(
                number,
                outcome,
                *sorted(name for name in trial.processes if name in WRITERS),
                flush=True,
            )
            for fault in faults:
                failures += 1
                print(f"  FAILED: {fault}", flush=True)
            shutil.rmtree(own)
            if not args.bucket:
                shutil.rmtree(url)
    for outcome, count in counts.most_common():
        print(f"{count:5d}  {outcome}")
    print(f"{failures:5d}  failures")
    sys.exit(failures > 0)


def partial_lease(lease: Callable) -> Callable:
    """The method `Database.lease` with short leases."""

    def short(self, take, *kinds, **options):
        return lease(self, take, *kinds, **{"seconds": LEASE_S} | options)

    return short


if __name__ == "__main__":
    main()
