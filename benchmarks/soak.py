"""Soak test of many takes through every step with several workers: times, memory over
time, failures.

    python -m benchmarks soak OUT [--subjects 87] [--workers 2] [--scheduler ADDRESS]
    [--json soak.json]

Every subject is simulated twice (normal and with lotion), with small frames and few
lights. The aim is to find growing memory, files that stay open and takes that fail, not
to measure accuracy. Ingest, fit, registration and all studies follow. OUT receives the
captures (removed after ingest) and the database; 174 takes need 3 GB.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import skindb
from skindb import workflow
from skindb.virtual.capture import DEVICE_SEED, simulate_take
from skindb.virtual.dome import build_dome
from skindb.virtual.person import ANCESTRIES, Person

SAMPLED_SECONDS = 2.0
GIVEN = {"k": 3, "hold_out_lights": 0.1}


def people(subjects: int) -> list[Person]:
    """Every subject in two conditions."""
    rng = np.random.default_rng(87)
    persons = []
    for i in range(subjects):
        male = bool(rng.random() < 0.7)
        person = Person(
            f"P{i:03d}",
            float(rng.integers(13, 75)),
            "male" if male else "female",
            ANCESTRIES[i % 4],
            1000 + i,
            beard_density=float(rng.uniform(0, 0.8)) if male else 0.0,
            freckles=float(rng.uniform(0, 0.6)),
            melanin=float(rng.normal(0, 0.5)),
            blood=float(rng.normal(0, 0.4)),
            fullness=float(rng.uniform(0.3, 0.7)),
        )
        persons += [person, Person(**{**vars(person), "condition": "lotion"})]
    return persons


def memory_mib(process: int | str = "self") -> dict[str, float]:
    """Resident and anonymous memory of a process [MiB]; empty if it has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return {}
    names = {"VmRSS": "resident", "RssAnon": "anonymous"}
    parts = (line.split() for line in lines)
    return {
        names[p[0][:-1]]: int(p[1]) / 1024 for p in parts if p and p[0][:-1] in names
    }


def simulated(out: Path, size: dict[str, int], person: Person) -> Path:
    """Simulate a capture folder with small frames."""
    rng = np.random.default_rng(DEVICE_SEED)
    dome = build_dome(
        size["lights"],
        size["cameras"],
        width=size["width"],
        height=size["height"],
        rng=rng,
    )
    simulate_take(
        out / person.take,
        person,
        dome,
        rng=np.random.default_rng([person.seed, person.take == person.subject]),
    )
    return out / person.take


def ingested(db: Any, folder: Path) -> Any:
    """Ingest a capture and remove its folder; returns the take and the bytes read and written."""
    read = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    record = workflow.ingest_take(db, folder, spacing_mm=6.0)
    shutil.rmtree(folder)
    folder.with_name(folder.name + ".truth.npz").unlink()
    return {"take": record.take, "read": read, "written": record.bytes}


def fitted(db: Any, take: str) -> dict[str, Any]:
    """Fit a take; returns the bytes read (twice the capture) and written."""
    record = workflow.fit_with(db, take, changes=GIVEN)
    return {
        "take": take,
        "read": 2 * db.record("capture", take).bytes,
        "written": record.bytes,
    }


def timed(call: Callable[[Any], Any], item: Any) -> dict[str, Any]:
    """Result of a call, its times, and process, open files and memory at its end."""
    begin = time.perf_counter()
    cpu = time.process_time()
    value = call(item)
    seconds = {"wall": time.perf_counter() - begin, "cpu": time.process_time() - cpu}
    files = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    return {
        "value": value,
        "process": os.getpid(),
        "files": files,
        "end": time.time(),
        **seconds,
        **memory_mib(),
    }


class Watch:
    """Records the memory of this process and of its children every two seconds."""

    def __init__(self) -> None:
        self.samples: list[dict[str, Any]] = []
        self.stage = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        begin = time.monotonic()
        while not self._stop.wait(SAMPLED_SECONDS):
            memory = {"driver": memory_mib()} | {
                str(child): memory_mib(child) for child in children(os.getpid())
            }
            self.samples.append(
                {
                    "seconds": time.monotonic() - begin,
                    "stage": self.stage,
                    "memory": memory,
                }
            )


def children(parent: int) -> Iterator[int]:
    """Ids of all descendants of a process."""
    for task in Path(f"/proc/{parent}/task").glob("*/children"):
        try:
            children_ids = [
                int(word) for word in task.read_text(encoding="ascii").split()
            ]
        except OSError:
            continue
        for child in children_ids:
            yield child
            yield from children(child)


def worked(
    stage: str,
    call: Callable[[Any], Any],
    items: list[Any],
    watch: Watch,
    executor: dict[str, Any],
) -> dict[str, Any]:
    """Run a step over all takes; returns its wall time, tasks and failures."""
    watch.stage = stage
    begin = time.perf_counter()
    tasks = []
    failures = []
    for number, outcome in enumerate(
        workflow.map_takes(partial(timed, call), items, **executor), 1
    ):
        if outcome.error is None:
            tasks.append(outcome.result())
        else:
            failures.append(f"{outcome.take}: {outcome.error}")
            print(failures[-1], outcome.traceback, file=sys.stderr, flush=True)
        if number % 20 == 0 or number == len(items):
            print(
                f"{stage}: {number} of {len(items)}, {time.perf_counter() - begin:.0f} s",
                file=sys.stderr,
                flush=True,
            )
    return {"wall": time.perf_counter() - begin, "tasks": tasks, "failures": failures}


@contextmanager
def alone(name: str, watch: Watch, studies: dict[str, Any]) -> Iterator[None]:
    """Context that records times, memory and failure of a step in this process."""
    watch.stage = name
    begin = time.perf_counter()
    cpu = time.process_time()
    failure = ""
    try:
        yield
    except Exception as error:  # noqa: BLE001  reported at the end
        failure = f"{type(error).__name__}: {error}"
        print(f"{name}: {failure}", file=sys.stderr, flush=True)
    studies[name] = {
        "wall": time.perf_counter() - begin,
        "cpu": time.process_time() - cpu,
        "failure": failure,
    }
    studies[name] |= memory_mib()
    print(f"{name}: {studies[name]['wall']:.0f} s", file=sys.stderr, flush=True)


def growth(tasks: list[dict[str, Any]]) -> dict[str, float]:
    """Anonymous memory of workers [MiB] at the end of their takes: medians of the
    second and of the last quarter.
    """
    memory = [task["anonymous"] for task in sorted(tasks, key=lambda item: item["end"])]
    quarter = max(1, len(memory) // 4)
    early = memory[quarter : 2 * quarter] or memory
    late = memory[-quarter:]
    return {
        "early": float(np.median(early)),
        "late": float(np.median(late)),
        "largest": max(memory),
    }


def summary(name: str, stage: dict[str, Any]) -> str:
    """Row of the table for a stage."""
    tasks = stage["tasks"]
    wall, cpu = (np.array([task[key] for task in tasks]) for key in ("wall", "cpu"))
    memory = growth(tasks)
    files = max(task["files"] for task in tasks)
    return (
        f"{name:<10} {len(tasks):>5} {len(stage['failures']):>4} "
        f"{stage['wall']:>7.0f} {np.median(wall):>7.2f} "
        f"{np.quantile(wall, 0.95):>7.2f} {np.median(cpu):>7.2f} "
        f"{memory['early']:>7.0f} {memory['late']:>7.0f} "
        f"{memory['largest']:>7.0f} {files:>6} {len({task['process'] for task in tasks}):>9}"
    )


def run_studies(
    db: Any, watch: Watch, executor: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """Run registration, studies and verification, and return what each took."""
    studies: dict[str, dict[str, Any]] = {}
    with alone("register", watch, studies):
        workflow.register_takes(db, **executor)
    with alone("brdf", watch, studies):
        workflow.study(db, "brdf")
    for group in (None, "gender", "condition"):
        for name in ("albedo", "translucency"):
            with alone(f"{name} by {group}", watch, studies):
                workflow.study(db, name, group_by=group)
    with alone("traits", watch, studies):
        workflow.study(db, "traits")
    with alone("table", watch, studies):
        db.table()
    with alone("verify", watch, studies):
        if faults := db.verify():
            raise skindb.InputError(faults)
    return studies


def print_results(
    stages: dict[str, dict[str, Any]], studies: dict[str, dict[str, Any]]
) -> None:
    """Print a row for each step over takes and for each study."""
    print(
        f"{'step':<10} takes fail  wall s  median   p95 s   cpu s   early    late "
        "largest  files processes"
    )
    for name, stage in stages.items():
        print(summary(name, stage))
    for name, study in studies.items():
        outcome = study["failure"] or f"driver {study['anonymous']:.0f} MiB"
        times = f"wall {study['wall']:7.1f} s, CPU {study['cpu']:7.1f} s"
        print(f"{name:<26} {times}, {outcome}")


def main(
    out: Path,
    *,
    scheduler: str | None = None,
    json_: Path | None = None,
    subjects: int = 87,
    workers: int = 2,
    lights: int = 24,
    cameras: int = 3,
    width: int = 48,
    height: int = 60,
) -> None:
    """Run all steps, print the tables, and write the results."""
    out.mkdir(parents=True, exist_ok=True)
    size = {"lights": lights, "cameras": cameras, "width": width, "height": height}
    db = skindb.open(str(out.absolute() / "db"), create=True)
    with (
        Watch() as watch,
        workflow.connected(scheduler) if scheduler else nullcontext() as client,
    ):
        executor = {"client": client} if client else {"workers": workers}
        run = partial(worked, watch=watch, executor=executor)
        simulate = partial(simulated, out.absolute() / "captures", size)
        stages = {"simulate": run("simulate", simulate, people(subjects))}
        folders = [task["value"] for task in stages["simulate"]["tasks"]]
        stages["ingest"] = run("ingest", partial(ingested, db), folders)
        stages["fit"] = run("fit", partial(fitted, db), db.takes("capture"))
        studies = run_studies(db, watch, executor)
    print_results(stages, studies)
    driver = [sample["memory"]["driver"]["anonymous"] for sample in watch.samples]
    print(f"driver, peak anonymous memory: {max(driver):.0f} MiB")
    for kind in ("capture", "model", "registration"):
        sizes = [db.record(kind, take).bytes for take in db.takes(kind)]
        print(f"{kind}: {len(sizes)} versions, {np.mean(sizes) / 1e6:.2f} MB each")
    if json_:
        report = {
            "arguments": {"subjects": subjects, "workers": workers, **size},
            "stages": stages,
            "studies": studies,
            "memory": watch.samples,
        }
        json_.write_text(json.dumps(report, default=str), encoding="utf-8")
