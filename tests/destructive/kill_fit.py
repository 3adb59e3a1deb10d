"""Kills fits, refits and ingests at random moments, in a folder and in a bucket, and
runs them again.

    python tests/destructive/kill_fit.py --cases 210 --seed 1 [--bucket]

Each case works on a copy of a small database. A process fits the take, or ingests its
folder; it says which stage it has begun, and is killed within a stage that is chosen at
random, at a random moment. Then every promise is checked: `verify` finds no damage,
every version that can be seen is the one of a run that was not killed, a run that had
said it was done has its record, what no record names is listed as garbage. In every
second case `clean` runs. The same command runs again: it must not wait for the killed
one, continue after the first pass if that was kept, give the same numbers, and leave
nothing but what `clean` lists. The program ends with 1 if that fails once.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import apart
import numpy as np
from bucket_server import new_bucket, own_cache, s3_server, settings
from kill_withdraw import copy_objects
from planted_cohort import PARAMETERS, PEOPLE, capture, few_materials
from sphere import write_capture

import skindb
from skindb import workflow
from skindb.jit import reported_compilation
from skindb.store import Database
from skindb.store.stage import Stage
from skindb.workflow import captures as ingest_module
from skindb.workflow import fit as fit_module
from skindb.workflow.derive import groups_of

FIT = (
    "begin",
    "first pass",
    "keep first pass",
    "second pass",
    "write",
    "commit",
    "end",
)
INGEST = ("begin", "samples", "write", "commit", "end")
STAGES = {"fit": FIT, "refit": FIT, "ingest": INGEST}
KINDS = {"fit": "model", "refit": "model", "ingest": "capture"}
FIT_TAKE = "S01"
INGEST_TAKE = "T001"
GOOD = ("not yet committed", "committed", "ended before the kill")
BAD = (
    "half-written and visible",
    "acknowledged and lost",
    "not continued",
    "other numbers",
    "not listed as garbage",
)
Tell = Callable[[str], None]
# where a database is that belongs to the work in a folder
NewUrl = Callable[[Path], str]


def fit(db: Database, tell: Tell, _: Path | None = None) -> int:
    """Fit the take, report each stage, and return the generation of its model."""
    for name, stage in (
        ("first_pass", FIT[1]),
        ("_store_first_pass", FIT[2]),
        ("second_pass", FIT[3]),
    ):
        setattr(fit_module, name, _telling(getattr(fit_module, name), stage, tell))
    _tell_stages(db, "model", tell)
    return workflow.fit_take(
        db, FIT_TAKE, PARAMETERS, dictionary=few_materials()
    ).generation


def ingest(db: Database, tell: Tell, work: Path) -> int:
    """Ingest the folder below the working folder, report each stage, and return the
    generation of the capture.
    """
    ingest_module.ingest_capture = _telling(
        ingest_module.ingest_capture, INGEST[1], tell
    )
    _tell_stages(db, "capture", tell)
    return workflow.ingest_take(db, work / "folder", photographs=1).generation


WORK = {"fit": fit, "refit": fit, "ingest": ingest}


def _telling(call, stage: str, tell: Tell):
    @functools.wraps(call)  # whose code is recorded
    def called(*args, **options):
        tell(stage)
        return call(*args, **options)

    return called


def _tell_stages(db: Database, kind: str, tell: Tell) -> None:
    """Report when a version of a kind is written and committed, and what follows; the
    first pass of a fit has a database of its own, which is not reported.
    """
    write = Stage.write
    commit = Stage.commit

    def is_told(stage: Stage) -> bool:
        return stage.log.kind == kind and stage.place is db.place

    def writing(stage, *args, **options):
        if is_told(stage):
            tell("write")
        write(stage, *args, **options)

    def committing(stage, provenance):
        if not is_told(stage):
            return commit(stage, provenance)
        tell("commit")
        record = commit(stage, provenance)
        tell("end")
        return record

    Stage.write = writing
    Stage.commit = committing


def in_folder(work: Path) -> str:
    """URL of a database in a folder."""
    return str(work / "db")


def in_new_bucket(address: str, _: Path) -> str:
    """URL of a database in a new bucket of a server."""
    return f"s3://{new_bucket(address)}/faces"


def prepare(folder: Path, sources: Mapping[str, str]) -> None:
    """The databases that are copied for each case: with a capture, with a model too,
    and with nothing but a folder.
    """
    for name in sources:
        if name == "ingest":
            (folder / "ingest").mkdir()
            write_capture(folder / "ingest/folder")
            continue
        db = skindb.open(sources[name], create=True)
        tree = capture(FIT_TAKE, PEOPLE["S02"], 0)  # with one site
        with db.stage("capture", FIT_TAKE) as stage:
            stage.write(groups_of(tree))
            stage.commit(tree.attrs)
        if name == "refit":
            workflow.fit_take(
                db, FIT_TAKE, replace(PARAMETERS, k=1), dictionary=few_materials()
            )


def copied(source: Path, source_url: str, work: Path, new_url: NewUrl) -> str:
    """URL of a copy of a database and of the files beside it; a bucket is copied by a
    separate process.
    """
    url = new_url(work)
    if source.is_dir():
        shutil.copytree(source, work)
    if url.startswith("s3://"):
        apart.in_a_process(
            lambda: copy_objects(skindb.open(source_url), skindb.open(url, create=True))
        )
    return url


def measure(work: Path, url: str, variant: str, known_at: Path) -> None:
    """Run without a kill, and return the seconds of each stage and the files of the version."""
    compiled: list[bool] = []
    for _ in range(2):
        db = skindb.open(url, create=True)
        marks = [(STAGES[variant][0], time.monotonic())]
        with reported_compilation(lambda: compiled.append(True)):
            WORK[variant](
                db, lambda stage, to=marks: to.append((stage, time.monotonic())), work
            )
        marks.append(("done", time.monotonic()))
        # otherwise again, since the runs that are killed do not compile
        if not compiled:
            break
    seconds = {stage: end - begin for (stage, begin), (_, end) in pairwise(marks)}
    kind = KINDS[variant]
    take = FIT_TAKE if KINDS[variant] == "model" else INGEST_TAKE
    known = {
        "seconds": seconds,
        "files": files_of(db, kind, take, db.record(kind, take).generation),
    }
    known["before"] = [files_of(db, kind, take, 1)] if variant == "refit" else []
    known_at.write_text(json.dumps(known))


def files_of(
    db: Database, kind: str, take: str, generation: int
) -> dict[str, list[object]]:
    """Digest of every file of a version except for its provenance, and of its tables."""
    record = db.record(kind, take, generation)
    manifest = json.loads(db.place.read(record.beside("manifest")))
    manifest.pop("zarr.json")
    return manifest | {"tables": [record.tables]}


def attempt(
    work: Path,
    url: str,
    variant: str,
    stage: str,
    part: float,
    known: dict,
    *,
    clean: bool,
) -> apart.Outcome:
    """Kill a run within a stage, check every promise, and run it again."""
    kind = KINDS[variant]
    take = FIT_TAKE if KINDS[variant] == "model" else INGEST_TAKE
    marks = killed_within(
        work, url, variant, stage, part * known["seconds"].get(stage, 0.0)
    )
    # not before: threads of a client of a bucket must not be forked
    db = skindb.open(url, create=True)
    first = has_first_pass(db, take)
    before = known["before"]
    there = generations(db, kind, take)
    said = f"{variant}, killed in {marks[-1]}"
    if marks[-1] == "done" and len(there) == len(before):
        return BAD[1], said
    if faults := db.verify():
        return BAD[0], f"{said}: {faults[0]}"
    seen = [files_of(db, kind, take, one) for one in there]
    if seen not in (before, [*before, known["files"]]):
        return BAD[0], f"{said}: generations {there}, or other values"
    if "second pass" in marks and len(there) == len(before) and not first:
        return BAD[2], f"{said}: the first pass was lost"
    if lost := unlisted(db):
        return BAD[4], f"{said}: {lost}"
    if clean:
        db.clean()
        committed = len(there) > len(before)
        if (
            [one for one in db.garbage() if not one.kept]
            or db.verify()
            or has_first_pass(db, take) != (first and not committed)
        ):
            return BAD[
                4
            ], f"{said}: clean left {db.garbage()}, or removed what it must not"
    first = has_first_pass(db, take)
    stages = []
    following = WORK[variant](db, stages.append, work)
    if first and "first pass" in stages:
        return BAD[2], f"{said}: the first pass was repeated"
    if (
        following != len(there) + 1
        or files_of(db, kind, take, following) != known["files"]
    ):
        return BAD[3], f"{said}: generation {following}, or other values"
    db.clean()
    if (
        db.verify()
        or unlisted(db)
        or has_first_pass(db, take)
        or [*db.scratch().glob("*")]
    ):
        return BAD[4], f"{said}: after the second run"
    outcome = GOOD[2] if marks[-1] == "done" else GOOD[len(there) - len(before)]
    return outcome, json.dumps({"stage": marks[-1], "continued": first})


def has_first_pass(db: Database, take: str) -> bool:
    """Whether a first pass of a fit of a take was committed to its scratch folder."""
    return any(db.scratch().glob(f"{take}-*/log/model/{take}/*.json"))


def generations(db: Database, kind: str, take: str) -> list[int]:
    """Generations that can be seen."""
    return (
        [one.generation for one in db.history(kind, take)] if db.has(kind, take) else []
    )


def unlisted(db: Database) -> set[str]:
    """Versions that have no record and are not listed as garbage."""
    below = db.place.children
    keys = {
        f"data/{kind}/{take}"
        for kind in below("data")
        for take in below(f"data/{kind}")
    }
    there = {
        f"{key}/{name}" for key in keys for name in below(key) if name.endswith(".zarr")
    }
    named = {
        db.record(kind, take, n).path
        for kind in db.kinds()
        for take in db.takes(kind)
        for n in generations(db, kind, take)
    }
    listed = {one.key for one in db.garbage()}
    return there - named - listed


def killed_within(
    work: Path, url: str, variant: str, stage: str, seconds: float
) -> list[str]:
    """Kill a run so many seconds after it has begun a stage; the stages it had begun,
    and "done" at its end.
    """
    pipe, end = os.pipe()
    process = os.fork()
    if not process:
        with suppress(BaseException):
            os.close(pipe)
            tell = lambda name: os.write(end, f"{name}\n".encode())  # noqa: E731
            tell(STAGES[variant][0])
            WORK[variant](skindb.open(url, create=True), tell, work)
            tell("done")
        os._exit(0)
    os.close(end)
    marks: list[str] = []
    with os.fdopen(pipe) as lines:
        for line in lines:
            marks.append(line.strip())
            if marks[-1] == stage:
                time.sleep(seconds)
                os.kill(process, signal.SIGKILL)
                marks += [line.strip() for line in lines]
    os.waitpid(process, 0)
    return marks


def variant_of(number: int) -> str:
    """The kind of run that is killed in a case."""
    return list(STAGES)[number % len(STAGES)]


def cases(
    folder: Path, sources: Mapping[str, str], new_url: NewUrl, seed: int
) -> Callable[[int, Path], tuple[str, str, Callable[[], apart.Outcome]]]:
    """Function that makes a case from its number."""

    def make(number: int, work: Path):
        rng = np.random.default_rng([seed, number])
        variant = variant_of(number)
        known = json.loads((folder / f"{variant}.json").read_text())
        stage = STAGES[variant][rng.integers(len(STAGES[variant]))]
        part = float(rng.random())
        copy = work / "copy"
        url = copied(folder / variant, sources[variant], copy, new_url)
        clean = number // len(STAGES) % 2 == 1
        return (
            variant,
            f"{part:.0%} of {stage}",
            partial(attempt, copy, url, variant, stage, part, known, clean=clean),
        )

    return make


def table(done: list[apart.Case]) -> list[str]:
    """Trials by variant and stage in which they were killed."""
    rows = Counter[tuple[str, str, str]]()
    for case in done:
        told = (
            json.loads(case.detail)
            if case.outcome in GOOD
            else {"stage": "?", "continued": False}
        )
        row = (case.variant, told["stage"])
        rows[*row, "trials"] += 1
        rows[*row, case.outcome if case.outcome in (GOOD[1], *BAD) else "other"] += 1
        rows[*row, "continued"] += bool(told["continued"])
    columns = ("trials", GOOD[1], "continued", *BAD[:2], "other failures")
    lines = [
        f"| run | killed in | {' | '.join(columns)} |",
        f"|---|---|{'---|' * len(columns)}",
    ]
    for variant, stage in dict.fromkeys(
        (v, s) for v in STAGES for s in (*STAGES[v], "done", "?")
    ):
        count = {
            name: rows[variant, stage, name]
            for name in ("trials", GOOD[1], "continued", *BAD)
        }
        if count["trials"]:
            values = [
                *(count[name] for name in ("trials", GOOD[1], "continued", *BAD[:2])),
                sum(count[b] for b in BAD[2:]),
            ]
            lines.append(f"| {variant} | {stage} | {' | '.join(map(str, values))} |")
    return lines


def ready(
    folder: Path, new_url: NewUrl, variants: Iterable[str] = STAGES
) -> dict[str, str]:
    """Prepare and measure variants, and return the URLs of the databases to copy."""
    sources = {variant: new_url(folder / variant) for variant in variants}
    apart.in_a_process(partial(prepare, folder, sources))
    for variant in variants:
        work = folder / "measured" / variant
        url = copied(folder / variant, sources[variant], work, new_url)
        apart.in_a_process(
            partial(measure, work, url, variant, folder / f"{variant}.json")
        )
    return sources


def tell(case: apart.Case) -> None:
    """Print the outcome of a case immediately."""
    print(
        f"case {case.number}, {case.variant}, {case.damage}: {case.outcome}",
        file=sys.stderr,
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=30, help="Number of kills.")
    parser.add_argument(
        "--first", type=int, default=0, help="Number of the first case, to repeat one."
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="Random seed of the moments."
    )
    parser.add_argument(
        "--jobs", type=int, default=2, help="Number of processes at a time."
    )
    parser.add_argument(
        "--bucket", action="store_true", help="In a bucket of a server on this machine."
    )
    asked = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        new_url = in_folder
        if asked.bucket:
            address = stack.enter_context(s3_server("localbucket"))
            new_url = partial(in_new_bucket, address)
            os.environ |= settings(address) | {
                "SKINDB_CACHE": str(own_cache(folder / "cache"))
            }
        numbers = range(asked.first, asked.first + asked.cases)
        sources = ready(folder, new_url, {variant_of(number) for number in numbers})
        limits = apart.Limits(asked.jobs, seconds=300, tell=tell)
        done = apart.run(
            numbers, cases(folder, sources, new_url, asked.seed), folder, limits
        )
    print("\n".join(table(done)))
    bad = [case for case in done if case.outcome not in GOOD]
    for case in bad:
        print(
            f"case {case.number}, {case.variant}, {case.damage}: {case.outcome}: {case.detail}"
        )
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
