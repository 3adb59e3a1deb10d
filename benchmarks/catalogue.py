"""Times of queries over the catalogue of many takes, in a folder and in buckets with
different delays.

    python -m benchmarks catalogue [--takes 1000] [--delay-ms 0 20] [--repeat 3] [--out
    catalogue.json]

Captures and models have realistic records (about 10 kB of provenance) and no data. The
bucket is a copy of the folder in an S3 server on this machine, in its own process; the
delay is added to every request. Every query runs in a new process, whose start and
imports are not timed: without the cache `catalogue/` (cold), with it (later), and
after one take was fitted again (refitted). "CPU" is the CPU time of the process.
Medians are printed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from bucket_server import new_bucket, s3_server, settings
from faulty_proxy import faulty_proxy

import skindb
from skindb.store import Database
from skindb.store.bucket import Bucket
from skindb.store.entries import CATALOGUE

QUERY = "condition == 'lotion' and age > 40 and fit_k == 4 and status_fitted > 0.5"
QUERIES: dict[str, Callable[[Database], Any]] = {
    "takes(where)": lambda db: db.takes(where=QUERY),
    "table": lambda db: db.table(),
    "info(where)": lambda db: db.info(where=QUERY),
    "info": lambda db: db.info(),
    "takes": lambda db: db.takes(),
}


def about(number: int) -> dict[str, Any]:
    """Take and provenance of a capture."""
    subject = f"S{number // 2:04d}"
    condition = ("normal", "lotion")[number % 2]
    take = subject if condition == "normal" else f"{subject}.{condition}"
    traits = {
        "age": 20 + number % 60,
        "gender": ("female", "male")[number % 3 % 2],
        "hair": "dark",
    }
    scope = ["fit", "statistics"]
    padding = {"digests": {f"file{i}": "0" * 64 for i in range(100)}}
    return {
        "subject": subject,
        "condition": condition,
        "take": take,
        "consent_scope": scope,
        "traits": traits,
        "summary": padding,
    }


def refit(db: Database, number: int) -> None:
    """Commit a model of a take."""
    attributes = about(number)
    fit = {
        "parameters": {"k": 4 + number % 5, "rank": 16},
        "status": {"fitted": 0.93, "obstructed": 0.07},
    }
    with db.stage("model", attributes["take"]) as stage:
        stage.commit(
            attributes
            | fit
            | {"inputs": [db.record("capture", attributes["take"]).as_input()]}
        )


def fill(db: Database, takes: int) -> None:
    """Commit captures and models."""
    for number in range(takes):
        attributes = about(number)
        with db.stage("capture", attributes["take"]) as stage:
            stage.commit(attributes)
        refit(db, number)


def copied(folder: Path, url: str) -> None:
    """Put every file of a database into a bucket."""
    place = Bucket(url)
    names = [
        path
        for path in folder.rglob("*")
        if path.is_file() and path.parent.name != CATALOGUE
    ]
    with ThreadPoolExecutor(8) as pool:
        list(
            pool.map(
                lambda path: place.replace(
                    path.relative_to(folder).as_posix(), path.read_bytes()
                ),
                names,
            )
        )


def time_query(url: str, name: str) -> None:
    """Run a query in this process, and print its time."""
    db = skindb.open(url)
    wall = time.perf_counter()
    cpu = time.process_time()
    QUERIES[name](db)
    print(
        json.dumps(
            {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}
        )
    )


def in_new_process(url: str, name: str) -> dict[str, float]:
    """Times of a query that runs in a new process."""
    run = [sys.executable, "-m", "benchmarks", "catalogue", "--query", url, name]
    return dict(
        json.loads(subprocess.run(run, check=True, stdout=subprocess.PIPE).stdout)
    )


def measure(
    url: str, repeat: int, requests: list[Any]
) -> Iterator[tuple[str, dict[str, float]]]:
    """Median times and requests of every query."""
    for name in QUERIES:
        for state in ("cold", "later", "refitted") if name != "takes" else ("later",):
            times = []
            for number in range(repeat):
                place = skindb.open(url).place
                if state == "cold":
                    place.remove(CATALOGUE)
                elif state == "refitted":
                    refit(skindb.open(url), number)
                requests.clear()
                times.append(in_new_process(url, name) | {"requests": len(requests)})
            yield (
                f"{name}, {state}",
                {key: median(figures[key] for figures in times) for key in times[0]},
            )


@contextmanager
def bucket_of(folder: Path, delay_s: float) -> Iterator[tuple[str, list[Any]]]:
    """A copy of a database in a bucket, and the requests; without a delay there is no
    proxy and none are recorded.
    """
    with s3_server("localbucket") as address:
        os.environ.update(settings(address))
        url = f"s3://{new_bucket(address)}/db"
        copied(folder, url)
        if not delay_s:
            yield url, []
            return
        with faulty_proxy(address, delay_s=delay_s) as proxy:
            os.environ.update(settings(proxy.address))
            yield url, proxy.requests


def main(
    *,
    takes: int = 1000,
    repeat: int = 3,
    delay_ms: Sequence[float] = (0.0, 20.0),
    out: Path | None = None,
    query: Annotated[Sequence[str], "Database and query; for internal use."] = (),
) -> None:
    """Measure and print."""
    if query:
        time_query(*query)
        return
    results: dict[str, dict[str, dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "db"
        fill(skindb.open(str(folder), create=True), takes)
        results["folder"] = dict(measure(str(folder), repeat, []))
        for delay in delay_ms:
            with bucket_of(folder, delay / 1000) as (url, requests):
                results[f"bucket, {delay:g} ms"] = dict(measure(url, repeat, requests))
    for place, queries in results.items():
        for name, figures in queries.items():
            wall, cpu, requests = (figures[key] for key in ("wall", "cpu", "requests"))
            counted = f", {requests:.0f} requests" if requests else ""
            print(f"{place:14} {name:24} {wall:6.2f} s, CPU {cpu:5.2f} s{counted}")
    if out:
        out.write_text(json.dumps({"takes": takes, "results": results}, indent=1))
