"""Executors: calls for many takes in this process, in local processes or on a cluster."""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures import Executor as Pool
from dataclasses import dataclass
from functools import partial
from pickle import PicklingError
from typing import Any, Generic, Protocol, TypeVar

import cloudpickle
import dask
from loky import get_reusable_executor
from loky.process_executor import BrokenProcessPool

from skindb.elementwise import thread_count
from skindb.errors import Fault, InputError
from skindb.threads import one_blas_thread

Take = TypeVar("Take")
Result = TypeVar("Result")
IDLE_SECONDS = 600  # after which an idle worker process ends
# between two checks of a worker process whether its parent is alive
PARENT_SECONDS = 0.5
# bytes that a worker may keep between takes: tables are 200 MB, and loky replaces
# workers that keep 300, with a warning
LOKY = {"LOKY_MAX_MEMORY_LEAK_SIZE": str(1 << 30)}


class KilledError(InputError):
    """The process of a take was killed, perhaps by a take beside it."""

    def __init__(self, take: Any) -> None:
        rule = "the process of a take must run to its end"
        cure = (
            "a lack of memory is the usual reason: close other programs, or use fewer "
            "workers"
        )
        super().__init__(Fault(str(take), rule, "it was killed", cure))


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


Outcomes = Generator[Outcome[Take, Result], None, None]


class Executor(Protocol):
    """Where the calls for takes run."""

    def outcomes(
        self, function: Callable[[Take], Result], takes: Sequence[Take]
    ) -> Outcomes[Take, Result]:
        """Call a function for every take; yield each outcome as soon as it is available.

        Where a process was killed, the takes that it and its neighbours were working on
        have a `KilledError`.
        """


class ThisProcess:
    """Calls one after the other."""

    def outcomes(
        self, function: Callable[[Take], Result], takes: Sequence[Take]
    ) -> Outcomes[Take, Result]:
        """See `Executor`."""
        for take in takes:
            yield _attempt(function, take)


@dataclass(frozen=True)
class LocalProcesses:
    """Calls in processes that stay warm for the next ones."""

    workers: int

    def outcomes(
        self, function: Callable[[Take], Result], takes: Sequence[Take]
    ) -> Outcomes[Take, Result]:
        """See `Executor`."""
        call = partial(
            pickled_outcome, function, max(1, thread_count() // self.workers)
        )
        waiting = deque(takes)
        running = dict[Future[bytes], Take]()
        pool = self._pool()
        try:
            while waiting or running:
                is_broken = not self._submit(pool, call, waiting, running)
                for future in _next_done(running):
                    outcome = _received(future, running.pop(future), function)
                    is_broken |= isinstance(outcome.error, KilledError)
                    yield outcome
                if is_broken:
                    for take in running.values():
                        yield Outcome(take, error=KilledError(take))
                    running.clear()
                    pool = self._pool()
        except BaseException:  # an interrupt, or the caller stopped
            pool.shutdown(wait=False, kill_workers=True)  # type: ignore[call-arg]
            raise

    def _pool(self) -> Pool:
        start = {"initializer": _start_worker, "initargs": (os.getpid(),)}
        pool: Pool = get_reusable_executor(
            self.workers, timeout=IDLE_SECONDS, env=LOKY, **start
        )
        return pool

    def _submit(
        self,
        pool: Pool,
        call: Callable[[Take], bytes],
        waiting: deque[Take],
        running: dict[Future[bytes], Take],
    ) -> bool:
        """Give every idle process a take; False if a process died while the caller was
        busy with an outcome.
        """
        try:
            while waiting and len(running) < self.workers:
                running[pool.submit(call, waiting[0])] = waiting[0]
                waiting.popleft()
        except BrokenProcessPool:
            return False
        return True


def _next_done(running: dict[Future[bytes], Take]) -> set[Future[bytes]]:
    return wait(running, return_when=FIRST_COMPLETED).done if running else set()


def _received(
    future: Future[bytes], take: Take, function: Callable[[Take], Result]
) -> Outcome[Take, Result]:
    try:
        outcome: Outcome[Take, Result] = cloudpickle.loads(future.result())
    except BrokenProcessPool:
        return Outcome(take, error=KilledError(take))
    except (AttributeError, ImportError, TypeError, PicklingError) as error:
        # the call cannot be sent
        return defective(take, _why_unsent(function, error))
    return outcome


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
        return defective(take, error, traceback.format_exc())


def defective(take: Take, error: BaseException, text: str = "") -> Outcome[Take, Any]:
    """Outcome of a take that shows a defect of the program, with its traceback."""
    rule = "a take must not end in an internal error"
    finding = f"{type(error).__name__}: {error}"
    cure = "this is a defect of skindb: report it with the traceback that -v shows"
    fault = Fault(str(take), rule, finding, cure)
    return Outcome(take, error=InputError(fault), traceback=text)


def pickled_outcome(
    function: Callable[[Take], Result], threads: int, take: Take
) -> bytes:
    """Outcome of a call in a worker process; a result that cannot be pickled is a fault
    of its take.
    """
    with dask.config.set(scheduler="threads", num_workers=threads):
        outcome = _attempt(function, take)
    try:
        return bytes(cloudpickle.dumps(outcome))
    except Exception as error:  # noqa: BLE001  whatever a result holds
        return bytes(cloudpickle.dumps(defective(take, error)))


def _why_unsent(function: Any, error: Exception) -> Exception:
    """The error of pickling a call, repeated here because an executor only reports that
    pickling failed.
    """
    try:
        cloudpickle.dumps(function)
    except Exception as cause:  # noqa: BLE001  whatever it holds
        return cause
    return error


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
