"""Processing of many takes: in this process, in local worker processes, or on a Dask cluster."""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from pickle import PicklingError
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import cloudpickle
import dask
from loky import get_reusable_executor
from loky.process_executor import BrokenProcessPool

from skindb.elementwise import thread_count
from skindb.errors import Fault, InputError, system_fault
from skindb.threads import one_blas_thread
from skindb.workflow.audit import as_part
from skindb.workflow.cluster import calls_on_cluster

if TYPE_CHECKING:
    from distributed import Client

Take = TypeVar("Take")
Result = TypeVar("Result")
IDLE_SECONDS = 600  # after which an idle worker process ends
# between two checks of a worker process whether its parent is alive
PARENT_SECONDS = 0.5
# bytes that a worker may keep between takes: tables are 200 MB, and loky replaces
# workers that keep 300, with a warning
LOKY = {"LOKY_MAX_MEMORY_LEAK_SIZE": str(1 << 30)}


@dataclass(frozen=True)
class Outcome(Generic[Take, Result]):
    """Outcome of one take: a result or an error."""

    take: Take
    value: Result | None = None
    error: InputError | OSError | None = None
    traceback: str = ""  # of an error that is a defect of the program
    # 2 if a process died while this take, or another one in the pool, was processed
    attempts: int = 1

    def result(self) -> Result:
        """The result; raises the error if there is one."""
        if self.error is not None:
            raise self.error
        return self.value  # type: ignore[return-value]


def map_takes(
    function: Callable[[Take], Result],
    takes: Iterable[Take],
    *,
    workers: int | None = None,
    client: Client | None = None,
    shared: Path | None = None,
) -> Iterator[Outcome[Take, Result]]:
    """Call a function for every take, several at a time, and yield each outcome as soon
    as it is available.

    A take that fails does not stop the others. Each call reads and commits its own data
    and returns a small result. The threads that a call uses are limited so that all
    workers together do not use more than there are cores.

    Parameters
    ----------
    function
        Called with one take. With `workers` or `client` it is pickled, by value if it
        was defined in a notebook.
    takes
        Names, folders, numbers: whatever `function` takes.
    workers
        Number of local processes; they stay warm for the next call. Default None and 1
        work in this process.
    client
        A Dask client to work on instead, see `connected`. A worker does one take at a
        time, with all its threads.
    shared
        With `client`: folder that every worker must see as the same one.

    Yields
    ------
    Outcome
        In the order in which the calls end. Where a process is killed (usually by a
        lack of memory), the takes that were being processed are tried again, one at a
        time; the one whose process is killed again fails. Before that, a cluster itself
        tries each take on more workers, by default three (its setting
        `distributed.scheduler.allowed-failures`).

    Raises
    ------
    InputError
        If workers of the cluster have another version of skindb, or another folder, or
        if its scheduler is lost.

    Examples
    --------
    >>> from functools import partial
    >>> fitted = map_takes(partial(fit_take, db), db.takes(), workers=4)  # doctest: +SKIP
    """
    takes = list(takes)
    function = as_part(function)
    if client is not None:
        yield from _on_cluster(function, takes, client, shared)
    elif workers is None or workers <= 1 or len(takes) <= 1:
        for take in takes:
            yield _attempt(function, take)
    else:
        yield from _in_processes(function, takes, min(workers, len(takes)))


def results_of(outcomes: Iterable[Outcome[Take, Result]]) -> Iterator[Result]:
    """The results; at the end one `InputError` with the faults of every take that failed."""
    faults: list[Fault] = []
    for outcome in outcomes:
        if outcome.error is None:
            yield outcome.result()
        else:
            faults += faults_of(outcome)
    if faults:
        raise InputError(faults)


def faults_of(outcome: Outcome[Take, Result]) -> list[Fault]:
    """Faults of a take that failed."""
    if isinstance(outcome.error, InputError):
        return list(outcome.error.faults)
    if outcome.error is None:
        return []
    return [system_fault(outcome.error, str(outcome.take))]


def _attempt(function: Callable[[Take], Result], take: Take) -> Outcome[Take, Result]:
    """Make one call, and return its result or error as an outcome."""
    try:
        with one_blas_thread():
            return Outcome(take, function(take))
    except InputError as error:
        return Outcome(take, error=error)
    except OSError as error:  # plain, so that it can be pickled whatever it was
        where = error.filename if error.filename is None else str(error.filename)
        return Outcome(
            take, error=OSError(error.errno, error.strerror or str(error), where)
        )
    # a defect that one take shows must not stop the others
    except (Exception, SystemExit) as error:  # noqa: BLE001
        return Outcome(
            take, error=_defect(take, error), traceback=traceback.format_exc()
        )


def _defect(take: Any, error: BaseException) -> InputError:
    found = f"{type(error).__name__}: {error}"
    cure = "this is a defect of skindb: report it with the traceback that -v shows"
    return InputError(
        Fault(str(take), "a take must not end in an internal error", found, cure)
    )


def _in_worker(function: Callable[[Take], Result], threads: int, take: Take) -> bytes:
    """Pickle the outcome of a call in a worker process; a result that cannot be pickled
    is a fault of its take.
    """
    with dask.config.set(scheduler="threads", num_workers=threads):
        outcome = _attempt(function, take)
    try:
        return bytes(cloudpickle.dumps(outcome))
    except Exception as error:  # noqa: BLE001  whatever a result holds
        return bytes(cloudpickle.dumps(Outcome(take, error=_defect(take, error))))


def _in_processes(
    function: Callable[[Take], Result], takes: list[Take], workers: int
) -> Iterator[Outcome[Take, Result]]:
    waiting = deque(takes)
    running = dict[Future[bytes], Take]()
    # being processed when a process died: each is tried again alone
    suspects = deque[Take]()
    threads = max(1, thread_count() // workers)
    executor = _executor(workers)
    try:
        while waiting or running or suspects:
            queue, most = (suspects, 1) if suspects else (waiting, workers)
            broken = False
            while queue and len(running) < most and not broken:
                try:
                    running[
                        executor.submit(_in_worker, function, threads, queue[0])
                    ] = queue[0]
                    queue.popleft()
                except BrokenProcessPool:
                    # a process died while the caller was busy with an outcome
                    broken = True
            alone = most == 1
            for future in (
                wait(running, return_when=FIRST_COMPLETED).done if running else ()
            ):
                take = running.pop(future)
                try:
                    outcome = cloudpickle.loads(future.result())
                    yield replace(outcome, attempts=2) if alone else outcome
                except BrokenProcessPool:
                    broken = True
                    if alone:
                        yield Outcome(take, error=_killed(take), attempts=2)
                    else:
                        suspects.append(take)
                except (AttributeError, ImportError, TypeError, PicklingError) as error:
                    # the call cannot be sent
                    yield Outcome(
                        take, error=_defect(take, _why_unsent(function, error))
                    )
            if broken:
                suspects.extend(running.values())
                running.clear()
                executor = _executor(workers)
    except BaseException:  # an interrupt, or the caller stopped
        executor.shutdown(wait=False, kill_workers=True)  # type: ignore[call-arg]
        raise


def _why_unsent(function: Any, error: Exception) -> Exception:
    """The error of pickling a call, repeated here because an executor only reports that
    pickling failed.
    """
    try:
        cloudpickle.dumps(function)
    except Exception as cause:  # noqa: BLE001  whatever it holds
        return cause
    return error


def _executor(workers: int) -> Executor:
    start = {"initializer": _start_worker, "initargs": (os.getpid(),)}
    executor: Executor = get_reusable_executor(
        workers, timeout=IDLE_SECONDS, env=LOKY, **start
    )
    return executor


def _start_worker(parent: int) -> None:
    """Ignore interrupts, which the parent handles, and end this worker when the parent
    has ended.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(
        target=_end_with, args=(parent,), name="skindb parent", daemon=True
    ).start()


def _end_with(parent: int) -> None:
    """End this process soon after its parent, which may have been killed."""
    while os.getppid() == parent:
        time.sleep(PARENT_SECONDS)
    os._exit(1)


def _killed(take: Any) -> InputError:
    cure = "a lack of memory is the usual reason: close other programs, or use fewer workers"
    return InputError(
        Fault(
            str(take),
            "the process of a take must run to its end",
            "it was killed",
            cure,
        )
    )


def _on_cluster(
    function: Callable[[Take], Result],
    takes: list[Take],
    client: Client,
    shared: Path | None,
) -> Iterator[Outcome[Take, Result]]:
    from distributed import KilledWorker  # of the extra "cluster"

    call = bytes(cloudpickle.dumps(partial(_in_worker, function)))
    for take, answer, attempts in calls_on_cluster(call, takes, client, shared=shared):
        if isinstance(answer, bytes):
            yield replace(cloudpickle.loads(answer), attempts=attempts)
        elif isinstance(answer, KilledWorker):
            yield Outcome(take, error=_killed(take), attempts=attempts)
        else:
            yield Outcome(take, error=_defect(take, answer), attempts=attempts)
