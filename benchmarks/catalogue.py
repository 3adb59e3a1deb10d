"""Queries over the catalogue of many takes, in a folder and in a bucket of a server on this machine.

    python benchmarks/catalogue.py --takes 1000 [--bucket] [--out catalogue.json]

Captures and models have records like real ones (provenance of some 10 kB) and no data.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import skindb
from skindb.store import Database

QUERY = "condition == 'lotion' and age > 40 and fit_k == 4 and status_fitted > 0.5"


def fill(db: Database, takes: int) -> None:
    for number in range(takes):
        subject, condition = f"S{number // 2:04d}", ("normal", "lotion")[number % 2]
        take = subject if condition == "normal" else f"{subject}.{condition}"
        about = {"subject": subject, "condition": condition, "take": take, "consent_scope": ["fit", "statistics"]}
        about["traits"] = {"age": 20 + number % 60, "gender": ("female", "male")[number % 3 % 2], "hair": "dark"}
        padding = {"digests": {f"file{i}": "0" * 64 for i in range(100)}}
        with db.stage("capture", take) as stage:
            capture = stage.commit(about | {"summary": padding})
        fit = {"parameters": {"k": 4 + number % 5, "rank": 16}, "status": {"fitted": 0.93, "obstructed": 0.07}}
        with db.stage("model", take) as stage:
            stage.commit(about | fit | {"inputs": [capture.as_input()], "summary": padding})


def measure(url: str, takes: int) -> dict[str, float]:
    fill(skindb.open(url), takes)
    seconds = {}
    calls = {
        "takes(where)": lambda db: db.takes(where=QUERY),
        "takes(where), again": lambda db: db.takes(where=QUERY),
        "table": lambda db: db.table(),
        "info(takes=10)": lambda db: db.info(takes=db.takes()[:10]),
    }
    for name, call in calls.items():
        db, start = skindb.open(url), time.perf_counter()  # a new handle: nothing is known from before
        call(db)
        seconds[name] = time.perf_counter() - start
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--takes", type=int, default=1000)
    parser.add_argument("--bucket", metavar="s3://BUCKET/PREFIX", help="Also measure there; AWS_ENDPOINT_URL names it.")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = {"folder": measure(f"{folder}/db", args.takes)}
    if args.bucket:
        found["bucket"] = measure(args.bucket, args.takes)
    for place, seconds in found.items():
        for name, value in seconds.items():
            print(f"{place:8} {name:22} {value:6.2f} s")
    if args.out:
        args.out.write_text(json.dumps({"takes": args.takes, "seconds": found}, indent=1))


if __name__ == "__main__":
    main()
