"""Kills withdrawals at random moments, in a folder and in a bucket, and runs them again.

    python tests/destructive/kill_withdraw.py --cases 40 --seed 1 [--bucket]

Each case withdraws a subject from a copy of a small database with studies, an edit and a release that used it. The
process is killed with SIGKILL at a random moment of its work. Then: `verify` finds nothing wrong with what others own;
the same command removes the rest; nothing of the subject is left in any byte; a withdrawal that had said it was done
had left nothing. The program ends with 1 if that fails once.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent)]

from bucket_server import new_bucket, s3_server, settings
from planted_population import TABLES, population

import skindb
from skindb import workflow
from skindb.errors import InputError
from skindb.store import Database
from skindb.workflow import study_inputs

SUBJECT, WORD = "A", "marker-of-nobody"
CHILD = """
import sys
sys.path[:0] = [{tests!r}]
from planted_population import TABLES
import skindb
from skindb import workflow
from skindb.workflow import study_inputs
study_inputs.dictionary_tables = lambda *_: TABLES
db = skindb.open({url!r})
db.users({subject!r})  # everything is imported
print("begin", flush=True)
workflow.withdraw(db, {subject!r}, wait=30)
print("done", flush=True)
"""


def fill(db: Database) -> None:
    for take, model in population().items():
        with db.stage("model", take) as stage:
            stage.write({str(name): node.to_dataset() for name, node in model.children.items()})
            stage.commit(model.attrs | ({"remark": WORD} if take.startswith(SUBJECT) else {}))
    workflow.translucency(db)
    workflow.traits(db, k=3)
    workflow.edit(db, "B", {"lotion": 0.5})
    db.create_release("r1")


def left(db: Database) -> list[str]:
    """Keys whose content or name contains data of the subject."""
    place, found = db._place, []
    for top in place.names() or []:
        below = [f"{top}/{name}" for name, size in place.sizes(top).items() if size >= 0]  # no empty folder
        files = below if place.file_type(top) == "folder" else [top]
        for key in files:
            names = {part.removesuffix(".json") for part in key.split("/")}
            content = place.read(key)
            if names & {"A", "A.lotion"} or WORD.encode() in content or b'"A"' in content or b'"A.lotion"' in content:
                found.append(key)
    return found


def copy_objects(old: Database, new: Database) -> None:
    for top in old._place.names() or []:
        for name in [name for name, size in old._place.sizes(top).items() if size >= 0]:
            new._place.replace(f"{top}/{name}", old._place.read(f"{top}/{name}"))


def one_case(url: str, after: float) -> str:
    code = CHILD.format(tests=str(HERE.parent), url=url, subject=SUBJECT)
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        if child.stdout.readline() != b"begin\n":
            raise RuntimeError(child.stderr.read().decode() if child.stderr else "")
        time.sleep(after)
        child.send_signal(signal.SIGKILL)
        said = child.stdout.read()
    db = skindb.open(url)
    if said == b"done\n":
        return "acknowledged, and something left" if left(db) else "ended before the kill"
    try:
        for take in ("B", "C"):
            db.read("model", take).load()  # every byte is compared
    except InputError as error:
        return f"damage of others: {error}"
    begun = bool(db.holdings(SUBJECT) or db.users(SUBJECT))
    if begun:
        workflow.withdraw(db, SUBJECT, wait=120)
    if where := left(db):
        return f"something left: {where[0]}"
    if faults := db.verify():
        return f"damage after the second run: {faults[0]}"
    if db.takes("model") != ["B", "C"]:
        return "a take of others lost"
    return "killed, finished by the second run" if begun else "killed when all was done"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--bucket", action="store_true", help="In a bucket of a server on this machine.")
    args = parser.parse_args()
    study_inputs.dictionary_tables = lambda *_: TABLES  # 8 of the 59
    draw, counts = random.Random(args.seed), Counter[str]()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        address = stack.enter_context(s3_server("localbucket")) if args.bucket else ""
        os.environ |= settings(address) if args.bucket else {}
        urls = (lambda _: f"s3://{new_bucket(address)}/faces") if args.bucket else (lambda n: str(folder / f"{n}"))
        first = skindb.open(urls("first"))
        fill(first)
        trial = skindb.open(urls("trial"))
        copy_objects(first, trial)
        start = time.perf_counter()
        workflow.withdraw(trial, SUBJECT)
        whole = time.perf_counter() - start
        for number in range(args.cases):
            case = skindb.open(urls(number))
            copy_objects(first, case)
            outcome = one_case(case.url, draw.uniform(0, whole))
            counts[outcome] += 1
            print(number, outcome, flush=True)
            if case.folder is not None:
                shutil.rmtree(case.folder)
    for outcome, count in counts.most_common():
        print(f"{count:5d}  {outcome}")
    good = ("ended before the kill", "killed, finished by the second run", "killed when all was done")
    sys.exit(any(outcome not in good for outcome in counts))


if __name__ == "__main__":
    main()
