"""Load of many takes on the scheduler of a cluster: tasks, bytes, memory, and takes per second.

    python -m benchmarks scheduler [--takes 1000] [--workers 2] [--out scheduler.json]

`dask scheduler` and `dask worker` are started as processes on 127.0.0.1. The task of
each take contains the call of `skindb fit` (`fit_with` with its database and
parameters), but reads the record of one of 1,000 small captures instead of fitting it,
so that only the scheduler is measured. The exit code is 1 if a limit is exceeded: two
tasks per take, 300 MB of memory of the scheduler, 4 kB of messages to it per take.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cloudpickle
from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

import skindb
from benchmarks.catalogue import about
from skindb import workflow

GIVEN = {"k": 4, "hold_out_lights": 0.1, "hold_out_cameras": 0.0, "seed": 0}
MAX_TASKS = 2.0
MAX_MEMORY_MB = 300.0
MAX_BYTES = 4096.0
START_SECONDS = 60.0


class CountTasks(SchedulerPlugin):
    """Counts all tasks of a scheduler; a task that is retried is counted once."""

    name = "tasks of the benchmark"

    def __init__(self) -> None:
        self.keys: set[Any] = set()

    def transition(
        self,
        key: Any,
        *_: Any,
        **__: Any,
    ) -> None:
        """Record a task."""
        self.keys.add(key)


def counted(dask_scheduler: Any) -> int:
    """Number of tasks so far, called on the scheduler."""
    return len(dask_scheduler.plugins[CountTasks.name].keys)


def fill(db: skindb.Database, takes: int) -> None:
    """Commit small captures."""
    for number in range(takes):
        attributes = about(number)
        with db.stage("capture", attributes["take"]) as stage:
            stage.commit(attributes)


def fit_call(
    db: skindb.Database, dictionary: Path | None = None
) -> Callable[[str], Any]:
    """The call that `skindb fit` sends."""
    return partial(
        workflow.fit_with,
        db,
        changes=GIVEN,
        refit=False,
        dictionary=dictionary,
        explain=False,
        wait=0.0,
    )


def look_up(call: Any, take: str) -> int:
    """Return the generation of a capture from its record, in place of a fit."""
    return int(call.args[0].record("capture", take).generation)


def memory_mb(process: int, name: str = "VmRSS") -> float:
    """Resident memory of a process [MB], or its peak with VmHWM."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    return next(
        int(line.split()[1]) * 1024 / 1e6
        for line in lines
        if line.startswith(f"{name}:")
    )


@contextmanager
def process(*arguments: str) -> Iterator[int]:
    """Context with the id of a process that is terminated at its end."""
    root = Path(__file__).parents[1]
    # the tests have what `benchmarks.catalogue` imports
    folders = [str(root), str(root / "tests"), os.environ.get("PYTHONPATH", "")]
    options: dict[str, Any] = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
    }
    with subprocess.Popen(
        [sys.executable, "-m", *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(folders)},
        **options,
    ) as child:
        try:
            yield child.pid
        finally:
            child.terminate()


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, int]]:
    """Context with the address and the process id of a scheduler with its workers."""
    file = folder / "scheduler.json"
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    with ExitStack() as stack:
        scheduler = [
            "distributed.cli.dask_scheduler",
            *local,
            "--port",
            "0",
            "--scheduler-file",
            str(file),
        ]
        number = stack.enter_context(process(*scheduler))
        wait_until(file.exists)
        address = str(json.loads(file.read_text())["address"])
        worker = [
            address,
            *local,
            "--nworkers",
            str(workers),
            "--nthreads",
            "1",
            "--local-directory",
            str(folder),
        ]
        stack.enter_context(process("distributed.cli.dask_worker", *worker))
        yield address, number


def wait_until(is_done: Callable[[], bool]) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + START_SECONDS
    while not is_done():
        if time.monotonic() > end:
            raise SystemExit("the cluster did not start")
        time.sleep(0.1)


def run(client: Client, scheduler: int, db: skindb.Database) -> dict[str, float]:
    """Send every take and measure."""
    client.register_plugin(CountTasks())
    takes = db.takes()
    call = partial(look_up, fit_call(db))
    before = memory_mb(scheduler)
    sent = client.scheduler_comm.byte_count
    begin = time.perf_counter()
    outcomes = list(workflow.map_takes(call, takes, client=client, shared=db.folder))
    seconds = time.perf_counter() - begin
    if any(outcome.result() != 1 for outcome in outcomes):
        raise SystemExit("a take has an unexpected generation")
    sent = client.scheduler_comm.byte_count - sent
    tasks = client.run_on_scheduler(counted)
    return {
        "takes": len(outcomes),
        "tasks per take": tasks / len(takes),
        "bytes sent to the scheduler": sent,
        "bytes per take": sent / len(takes),
        "scheduler before [MB]": before,
        "scheduler peak [MB]": memory_mb(scheduler, "VmHWM"),
        "scheduler after [MB]": memory_mb(scheduler),
        "takes per second": len(takes) / seconds,
        "bytes of the call": len(cloudpickle.dumps(fit_call(db))),
        "bytes of the call with --dictionary": len(
            cloudpickle.dumps(fit_call(db, Path("/shared/measured/brdfs")))
        ),
    }


def main(*, takes: int = 1000, workers: int = 2, out: Path | None = None) -> int:
    """Measure, print and compare with the limits."""
    with tempfile.TemporaryDirectory() as temporary:
        db = skindb.open(f"{temporary}/db", create=True)
        fill(db, takes)
        with (
            cluster(Path(temporary), workers) as (address, scheduler),
            workflow.connected(address) as client,
        ):
            client.wait_for_workers(workers, timeout=START_SECONDS)
            results = run(client, scheduler, db)
    for name, value in results.items():
        print(f"{name:36} {value:12,.1f}")
    if out:
        out.write_text(json.dumps(results, indent=1))
    reached = (
        results["tasks per take"] <= MAX_TASKS
        and results["scheduler peak [MB]"] <= MAX_MEMORY_MB
        and results["bytes per take"] <= MAX_BYTES
    )
    return 0 if reached else 1
