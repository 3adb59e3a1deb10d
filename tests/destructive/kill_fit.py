"""Kills fits, refits and ingests at random moments, and runs them again.

    python tests/destructive/kill_fit.py --cases 210 --seed 1

Each case works on a copy of a small database. A process fits the take, or ingests its folder; it says which stage it
has begun, and is killed within a stage that is chosen at random, at a random moment. Then every promise is checked:
`verify` finds no damage, every version that can be seen is the one of a run that was not killed, a run that had said it
was done has its record, what no record names is listed as garbage. In every second case `clean` runs. The same command
runs again: it must not wait for the killed one, continue after the first pass if that was kept, give the same numbers,
and leave nothing but what `clean` lists. The program ends with 1 if that fails once.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "ingest"), str(HERE)]

import apart
import numpy as np
from planted_cohort import PARAMETERS, PEOPLE, capture, few_materials
from sphere import write_capture

import skindb
from skindb import workflow
from skindb.ingest import spool
from skindb.store import Database
from skindb.store.stage import Stage
from skindb.workflow import fit as fit_module
from skindb.workflow import ingest as ingest_module
from skindb.workflow.provenance import groups_of

FIT = ("begin", "first pass", "keep first pass", "second pass", "write", "commit", "end")
INGEST = ("begin", "samples", "write", "commit", "end")
STAGES = {"fit": FIT, "refit": FIT, "ingest": INGEST}
KINDS = {"fit": "model", "refit": "model", "ingest": "capture"}
FIT_TAKE, INGEST_TAKE = "S01", "T001"
GOOD = ("not yet committed", "committed", "ended before the kill")
BAD = ("half-written and visible", "acknowledged and lost", "not continued", "other numbers", "not listed as garbage")
Tell = Callable[[str], None]


def fit(db: Database, tell: Tell) -> int:
    """Fit the take and tell each stage; the generation of its model."""
    for name, stage in (("first_pass", FIT[1]), ("keep_first_pass", FIT[2]), ("second_pass", FIT[3])):
        setattr(fit_module, name, _telling(getattr(fit_module, name), stage, tell))
    _tell_stages("model", tell)
    return workflow.fit_take(db, FIT_TAKE, PARAMETERS, dictionary=few_materials()).generation


def ingest(db: Database, tell: Tell) -> int:
    """Ingest the folder beside the database and tell each stage; the generation of the capture."""
    spool.EVERY = 0.0  # note each view as soon as it is there: a small capture ends before the first note
    ingest_module.ingest_capture = _telling(ingest_module.ingest_capture, INGEST[1], tell)
    _tell_stages("capture", tell)
    return workflow.ingest_take(db, db.root.parent / "folder", photographs=1).generation


WORK = {"fit": fit, "refit": fit, "ingest": ingest}


def _telling(call, stage: str, tell: Tell):
    def called(*args, **options):
        tell(stage)
        return call(*args, **options)

    return called


def _tell_stages(kind: str, tell: Tell) -> None:
    """Tell when a version of a kind is written and committed, and what follows."""
    write, commit = Stage.write, Stage.commit

    def writing(stage, *args, **options):
        if stage.log.kind == kind:
            tell("write")
        write(stage, *args, **options)

    def committing(stage, provenance):
        if stage.log.kind != kind:
            return commit(stage, provenance)
        tell("commit")
        record = commit(stage, provenance)
        tell("end")
        return record

    Stage.write, Stage.commit = writing, committing


def prepare(folder: Path) -> None:
    """The databases that are copied for each case: with a capture, with a model too, and with nothing but a folder."""
    for name in ("fit", "refit"):
        db = skindb.open(folder / name / "db")
        tree = capture(FIT_TAKE, PEOPLE[FIT_TAKE], 0)
        with db.stage("capture", FIT_TAKE) as stage:
            stage.write(groups_of(tree))
            stage.commit(tree.attrs)
    workflow.fit_take(db, FIT_TAKE, replace(PARAMETERS, k=1), dictionary=few_materials())
    (folder / "ingest").mkdir()
    write_capture(folder / "ingest/folder")


def measure(folder: Path, variant: str) -> None:
    """Run once without a kill: seconds of each stage, and the files of the version."""
    work = Path(shutil.copytree(folder / variant, folder / "measured" / variant))
    marks: list[tuple[str, float]] = []
    for _ in range(2):  # the first run compiles
        marks.clear()
        db = skindb.open(work / "db")
        marks.append((STAGES[variant][0], time.monotonic()))
        WORK[variant](db, lambda stage: marks.append((stage, time.monotonic())))
        marks.append(("done", time.monotonic()))
    seconds = {stage: end - begin for (stage, begin), (_, end) in pairwise(marks)}
    kind, take = KINDS[variant], FIT_TAKE if KINDS[variant] == "model" else INGEST_TAKE
    known = {"seconds": seconds, "files": files_of(db, kind, take, db.record(kind, take).generation)}
    known["before"] = [files_of(db, kind, take, 1)] if variant == "refit" else []
    (folder / f"{variant}.json").write_text(json.dumps(known))


def files_of(db: Database, kind: str, take: str, generation: int) -> dict[str, list[object]]:
    """Digest of every file of a version but for its provenance, and of its tables."""
    record = db.record(kind, take, generation)
    manifest = json.loads((db.root / record.beside("manifest")).read_text())
    manifest.pop("zarr.json")
    return manifest | {"tables": [record.tables]}


def attempt(root: Path, variant: str, stage: str, part: float, known: dict, *, clean: bool) -> apart.Outcome:
    """Kill a run within a stage, check every promise, and run it again."""
    kind, take = KINDS[variant], FIT_TAKE if KINDS[variant] == "model" else INGEST_TAKE
    marks = killed_within(root, variant, stage, part * known["seconds"].get(stage, 0.0))
    db = skindb.open(root)
    first = db.has("first", take)
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
            or db.has("first", take) != (first and not committed)
        ):
            return BAD[4], f"{said}: clean left {db.garbage()}, or removed what it must not"
    first, stages = db.has("first", take), []
    following = WORK[variant](db, stages.append)
    if first and "first pass" in stages:
        return BAD[2], f"{said}: the first pass was repeated"
    if following != len(there) + 1 or files_of(db, kind, take, following) != known["files"]:
        return BAD[3], f"{said}: generation {following}, or other values"
    db.clean()
    if db.verify() or unlisted(db) or db.has("first", take) or [*root.glob("tmp/*")]:
        return BAD[4], f"{said}: after the second run"
    outcome = GOOD[2] if marks[-1] == "done" else GOOD[len(there) - len(before)]
    return outcome, json.dumps({"stage": marks[-1], "continued": first})


def generations(db: Database, kind: str, take: str) -> list[int]:
    """Generations that can be seen."""
    return [one.generation for one in db.history(kind, take)] if db.has(kind, take) else []


def unlisted(db: Database) -> set[str]:
    """Versions that neither a record names nor the garbage lists."""
    there = {str(path.relative_to(db.root)) for path in db.root.glob("data/*/*/*.zarr")}
    named = {db.record(kind, take, n).path for kind in (*db.kinds(), "first") for take in db.takes(kind)
             for n in generations(db, kind, take)}  # fmt: skip
    listed = {one.key for one in db.garbage()}
    return {path for path in there - named - listed if "/first/" not in path}


def killed_within(root: Path, variant: str, stage: str, seconds: float) -> list[str]:
    """Kill a run so many seconds after it has begun a stage; the stages it had begun, and "done" at its end."""
    pipe, end = os.pipe()
    process = os.fork()
    if not process:
        with suppress(BaseException):
            os.close(pipe)
            tell = lambda name: os.write(end, f"{name}\n".encode())  # noqa: E731
            tell(STAGES[variant][0])
            WORK[variant](skindb.open(root), tell)
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


def cases(folder: Path, seed: int) -> Iterator[Callable[[int, Path], tuple[str, str, Callable[[], apart.Outcome]]]]:
    """How a case is made of its number."""
    known = {variant: json.loads((folder / f"{variant}.json").read_text()) for variant in STAGES}

    def make(number: int, work: Path):
        rng = np.random.default_rng([seed, number])
        variant = list(STAGES)[number % len(STAGES)]
        stage = STAGES[variant][rng.integers(len(STAGES[variant]))]
        part = float(rng.random())
        root = Path(shutil.copytree(folder / variant, work / "copy")) / "db"
        call = partial(attempt, root, variant, stage, part, known[variant], clean=number // len(STAGES) % 2 == 1)
        return variant, f"{part:.0%} of {stage}", call

    return make


def table(done: list[apart.Case]) -> list[str]:
    """Trials by variant and stage in which they were killed."""
    rows = Counter[tuple[str, str, str]]()
    for case in done:
        told = json.loads(case.detail) if case.outcome in GOOD else {"stage": "?", "continued": False}
        row = (case.variant, told["stage"])
        rows[*row, "trials"] += 1
        rows[*row, case.outcome if case.outcome in (GOOD[1], *BAD) else "other"] += 1
        rows[*row, "continued"] += bool(told["continued"])
    columns = ("trials", GOOD[1], "continued", *BAD[:2], "other failures")
    lines = [f"| run | killed in | {' | '.join(columns)} |", f"|---|---|{'---|' * len(columns)}"]
    for variant, stage in dict.fromkeys((v, s) for v in STAGES for s in (*STAGES[v], "done", "?")):
        count = {name: rows[variant, stage, name] for name in ("trials", GOOD[1], "continued", *BAD)}
        if count["trials"]:
            values = [
                *(count[name] for name in ("trials", GOOD[1], "continued", *BAD[:2])),
                sum(count[b] for b in BAD[2:]),
            ]
            lines.append(f"| {variant} | {stage} | {' | '.join(map(str, values))} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=30, help="Number of kills.")
    parser.add_argument("--first", type=int, default=0, help="Number of the first case, to repeat one.")
    parser.add_argument("--seed", type=int, default=0, help="Random seed of the moments.")
    parser.add_argument("--jobs", type=int, default=2, help="Number of processes at a time.")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        apart.in_a_process(partial(prepare, folder))
        for variant in STAGES:
            apart.in_a_process(partial(measure, folder, variant))
        ended = iter(range(1, asked.cases + 1))
        tell = lambda case: print(f"{next(ended)} of {asked.cases}: {case.outcome}", file=sys.stderr)  # noqa: E731
        limits = apart.Limits(asked.jobs, seconds=300, tell=tell)
        done = apart.run(range(asked.first, asked.first + asked.cases), cases(folder, asked.seed), folder, limits)
    print("\n".join(table(done)))
    bad = [case for case in done if case.outcome not in GOOD]
    for case in bad:
        print(f"case {case.number}, {case.variant}, {case.damage}: {case.outcome}: {case.detail}")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
