"""Processing of many takes, several at a time: one call for each in this process, in local
processes, or on the workers of a Dask cluster.

The scheduler of a cluster imports this module, so it imports nothing large.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import threading
import time
import traceback
import uuid
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Future,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures import Executor as Pool
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from pickle import PicklingError
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import cloudpickle
import dask
from loky import get_reusable_executor
from loky.process_executor import BrokenProcessPool

from skindb import __version__
from skindb.elementwise import thread_count
from skindb.errors import (
    Fault,
    InputError,
    input_error,
    require,
    require_none,
    system_fault,
)
from skindb.files import make_private, package_digest, private_file
from skindb.threads import one_blas_thread
from skindb.workflow.audit import as_part

if TYPE_CHECKING:
    from distributed import Client, Worker
    from distributed import Future as ClusterFuture

Take = TypeVar("Take")
Result = TypeVar("Result")
IDLE_SECONDS = 600  # after which an idle worker process ends
# between two checks of a worker process whether its parent is alive
PARENT_SECONDS = 0.5
# bytes that a worker may keep between takes: tables are 200 MB, and loky replaces
# workers that keep 300, with a warning
LOKY = {"LOKY_MAX_MEMORY_LEAK_SIZE": str(1 << 30)}
CONNECT_SECONDS = 10  # until a scheduler that does not answer counts as unreachable
# that a take waits for the one its worker is busy with, before it asks for another
# worker
WAIT_SECONDS = 20.0
# of a pickled call that is sent with every take; usual ones have some 300
MAX_REPEATED_BYTES = 4096
# a take uses all threads of its worker, and the setting of their number is shared
_ONE_TAKE = threading.Lock()


class KilledError(InputError):
    """The process of a take was killed, perhaps by a take beside it."""

    def __init__(self, take: Any) -> None:
        super().__init__(
            Fault(
                str(take),
                "the process of a take must run to its end",
                "it was killed",
                "a lack of memory is the usual reason: close other programs, or use fewer "
                "workers",
            )
        )


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


class ThisProcess:
    """Calls one after the other."""

    def outcomes(
        self, function: Callable[[Take], Result], takes: Sequence[Take]
    ) -> Outcomes[Take, Result]:
        """Call a function for every take; yield each outcome as soon as it is available.

        Where a process was killed, the takes that it and its neighbours were working on
        have a `KilledError`.
        """
        for take in takes:
            yield _attempt(function, take)


@dataclass(frozen=True)
class LocalProcesses:
    """Calls in processes that stay warm for the next ones."""

    workers: int

    def outcomes(
        self, function: Callable[[Take], Result], takes: Sequence[Take]
    ) -> Outcomes[Take, Result]:
        """See `ThisProcess`."""
        threads = max(1, thread_count() // self.workers)
        call = partial(pickled_outcome, function, threads)
        waiting = deque(takes)
        running = dict[Future[bytes], Take]()
        pool = self._pool()
        try:
            while waiting or running:
                is_broken = False
                try:
                    while waiting and len(running) < self.workers:
                        running[pool.submit(call, waiting[0])] = waiting[0]
                        waiting.popleft()
                except BrokenProcessPool:  # while the caller was busy with an outcome
                    is_broken = True
                for future in wait(running, return_when=FIRST_COMPLETED).done:
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
        pool: Pool = get_reusable_executor(
            self.workers,
            timeout=IDLE_SECONDS,
            env=LOKY,
            initializer=_start_worker,
            initargs=(os.getpid(),),
        )
        return pool


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
        filename = error.filename if error.filename is None else str(error.filename)
        return Outcome(
            take, error=OSError(error.errno, error.strerror or str(error), filename)
        )
    # a defect that one take shows must not stop the others
    except (Exception, SystemExit) as error:  # noqa: BLE001
        return defective(take, error, traceback.format_exc())


def defective(take: Take, error: BaseException, text: str = "") -> Outcome[Take, Any]:
    """Outcome of a take that shows a defect of the program, with its traceback."""
    fault = Fault(
        str(take),
        "a take must not end in an internal error",
        f"{type(error).__name__}: {error}",
        "this is a defect of skindb: report it with the traceback that -v shows",
    )
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


@dataclass(frozen=True)
class Expected:
    """What every worker must have in common with the process that sends it takes."""

    version: str
    code: str  # digest of the source of skindb
    token: str  # file in a folder that all share; empty for none

    def require(self, worker: str) -> None:
        """Raise an `InputError` if this process, which is the named worker, has something else."""
        other_code = " with other source code" if __version__ == self.version else ""
        require(
            (self.version, self.code) == (__version__, package_digest()),
            f"worker {worker}",
            f"must run the same skindb as this process ({self.version})",
            f"version {__version__}{other_code}",
            "install the same version, restart the worker",
        )
        token = Path(self.token)
        require(
            not self.token or token.is_file(),
            f"worker {worker}",
            f"must see the database {token.parent.parent}",
            "no such folder, or another one",
            "use a folder that all machines share",
        )


@contextmanager
def connected(address: str) -> Iterator[Client]:
    """A client of a running Dask scheduler.

    Parameters
    ----------
    address
        Such as tcp://127.0.0.1:8786, or the path of the .json that ``dask scheduler
        --scheduler-file`` writes.

    Raises
    ------
    InputError
        Without the package distributed, or if the scheduler does not answer.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise input_error(
            "--scheduler",
            "needs the package distributed",
            str(error),
            "run: pip install 'skindb[cluster]'",
        ) from None
    try:
        url = (
            json.loads(Path(address).read_text())["address"]
            if address.endswith(".json")
            else address
        )
        with ThreadPoolExecutor(1) as apart:  # a notebook has its own event loop
            apart.submit(asyncio.run, _greet(url)).result()
        client = Client(url, timeout=CONNECT_SECONDS, set_as_default=False)
    # of any kind: the file and the server are not ours
    except Exception as error:  # noqa: BLE001
        raise input_error(
            address,
            "a Dask scheduler must answer there",
            f"{type(error).__name__}: {str(error) or 'no answer'}",
            "check the address, and that `dask scheduler` runs",
        ) from None
    with client:
        yield client


@contextmanager
def computing_on(client: Client | None, shared: Path | None = None) -> Iterator[None]:
    """Context in which the workers of a cluster do the work of studies, take by take.

    Parameters
    ----------
    client
        See `connected`; None computes with the threads of this process.
    shared
        Folder that every worker must see as the same one.

    Raises
    ------
    InputError
        If a worker has another version of skindb or another folder, or if the cluster
        has no worker.

    Examples
    --------
    >>> with connected("tcp://127.0.0.1:8786") as client:  # doctest: +SKIP
    ...     with computing_on(client, db.root):
    ...         traits(db)
    """
    if client is None:
        yield
        return
    with shared_token(shared) as token:
        _require_workers(client, Expected(__version__, package_digest(), token))
    limited = f"skindb-{uuid.uuid4().hex}"
    client.run(_limit_blas, limited)
    try:
        with dask.config.set(scheduler=client):
            yield
    finally:
        with suppress(Exception):  # workers that are gone have nothing to restore
            client.run(_restore_blas, limited)


def _require_workers(client: Client, expected: Expected) -> None:
    try:
        checked = client.run(_checked, expected)
    except InputError:
        raise
    # workers without skindb, or that were lost
    except Exception as error:  # noqa: BLE001
        raise input_error(
            "cluster",
            "every worker must have skindb and answer",
            f"{type(error).__name__}: {error}",
            "install it in the environment of the workers",
        ) from None
    require(
        checked,
        "cluster",
        "a study needs workers",
        "the scheduler has none",
        "start one: dask worker ADDRESS",
    )


def _checked(expected: Expected, dask_worker: Worker) -> bool:
    """On every worker, which Dask hands over by that name."""
    expected.require(dask_worker.address)
    return True


def _limit_blas(name: str, dask_worker: Worker) -> None:
    """For all tasks of a worker, from its main thread: limits that task threads set and
    restore overlap.
    """
    setattr(dask_worker, name, one_blas_thread())


def _restore_blas(name: str, dask_worker: Worker) -> None:
    dask_worker.__dict__.pop(name).restore_original_limits()


async def _greet(address: str) -> None:
    """Fail soon where no scheduler is: a `Client` would wait, and leave a traceback
    when it is removed.
    """
    from distributed import Security
    from distributed.comm import connect

    how = Security().get_connection_args("client")
    comm = await asyncio.wait_for(
        connect(address, timeout=CONNECT_SECONDS, **how), CONNECT_SECONDS + 1
    )
    comm.abort()


@contextmanager
def shared_token(folder: Path | None) -> Iterator[str]:
    """Path of a new file in the folder of a database, by which workers see that it is
    the same folder.
    """
    if folder is None:
        yield ""
        return
    token = folder.absolute() / "tmp" / f".{uuid.uuid4().hex}.tmp"
    make_private(token.parent)
    private_file(token)
    try:
        yield str(token)
    finally:
        token.unlink(missing_ok=True)


@dataclass(frozen=True)
class Cluster:
    """Calls on the workers of a Dask cluster, each with a small task, one at a time on a
    worker.

    Parameters
    ----------
    client, shared
        See `map_takes`.
    """

    client: Client
    shared: Path | None = None

    def outcomes(
        self, function: Callable[[Take], Result], takes: Sequence[Take]
    ) -> Outcomes[Take, Result]:
        """See `ThisProcess`.

        Raises
        ------
        InputError
            If a worker has another skindb or another file system, or if the scheduler
            is lost: then no take can end well.
        """
        from distributed import as_completed

        client = self.client
        call = cloudpickle.dumps(partial(pickled_outcome, function))
        with shared_token(self.shared) as token:
            expected = Expected(__version__, package_digest(), token)
            message = bytes(cloudpickle.dumps((expected, call)))
            # its own task: the graph holds it once
            if len(message) > MAX_REPEATED_BYTES:
                message = client.submit(bytes, message, pure=False)
                # takes go where it is: if one worker had it, all to that one
                client.replicate(message)
            futures = {
                client.submit(_on_worker, message, take, pure=False): take
                for take in takes
            }
            try:
                for future in as_completed(list(futures), loop=client.loop):
                    yield _outcome_of(future, futures[future], client)
                    future.release()
            finally:
                # without a scheduler there is nothing to cancel
                with suppress(Exception):
                    client.cancel([future for future in futures if not future.done()])


def _outcome_of(
    future: ClusterFuture, take: Take, client: Client
) -> Outcome[Take, Any]:
    from distributed import KilledWorker

    try:
        outcome: Outcome[Take, Any] = cloudpickle.loads(future.result())
    except InputError:
        raise
    except CancelledError:
        url = str(client.scheduler.address if client.scheduler else "the scheduler")
        raise input_error(
            url,
            "the scheduler must answer until the work is done",
            "the connection was lost",
            "start it, and run the command again",
        ) from None
    except ImportError as error:
        raise input_error(
            "cluster",
            "every worker must have skindb",
            str(error),
            "install it in the environment of the workers",
        ) from None
    except KilledWorker:
        return Outcome(take, error=KilledError(take))
    # the call could not be sent
    except Exception as error:  # noqa: BLE001
        return defective(take, error)
    return outcome


def _on_worker(message: bytes, take: Any) -> bytes:
    """One take on a worker, whose threads compute its blocks; while the worker is busy
    with another, others wait.
    """
    from distributed import Reschedule, get_worker

    worker = get_worker()
    # libraries with more threads than cores crawl
    threads = max(1, min(worker.state.nthreads, thread_count()))
    expected, call = cloudpickle.loads(message)
    expected.require(worker.address)
    if not _ONE_TAKE.acquire(timeout=WAIT_SECONDS):
        raise Reschedule  # a worker that is free by now may take it
    try:
        return bytes(cloudpickle.loads(call)(threads, take))
    finally:
        _ONE_TAKE.release()


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
        lack of memory), the takes that were being processed are tried again at the end,
        one at a time; one whose process is killed again fails. Before that, a cluster
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
    executor: ThisProcess | LocalProcesses | Cluster = ThisProcess()
    if client is not None:
        executor = Cluster(client, shared)
    elif (processes := min(workers or 1, len(takes))) > 1:
        executor = LocalProcesses(processes)
    suspects = []
    with closing(executor.outcomes(function, takes)) as outcomes:
        for outcome in outcomes:
            if isinstance(outcome.error, KilledError):
                suspects.append(outcome.take)
            else:
                yield outcome
    for take in suspects:
        with closing(executor.outcomes(function, [take])) as outcomes:
            for outcome in outcomes:
                yield replace(outcome, attempts=2)


def results_of(outcomes: Iterable[Outcome[Take, Result]]) -> Iterator[Result]:
    """The results; at the end one `InputError` with the faults of every take that failed."""
    faults = []
    for outcome in outcomes:
        faults += faults_of(outcome)
        if outcome.error is None:
            yield outcome.result()
    require_none(faults)


def faults_of(outcome: Outcome[Take, Result]) -> list[Fault]:
    """Faults of a take that failed."""
    if isinstance(outcome.error, OSError):
        return [system_fault(outcome.error, str(outcome.take))]
    return list(outcome.error.faults) if outcome.error else []
