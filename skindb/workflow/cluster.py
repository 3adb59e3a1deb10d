"""Takes on a Dask cluster: connecting to its scheduler, and one call for each take on its workers.

The scheduler imports this module, so it imports nothing large.
"""

from __future__ import annotations

import asyncio
import json
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cloudpickle
import dask

from skindb import __version__
from skindb.elementwise import thread_count
from skindb.errors import Fault, InputError
from skindb.files import make_private, private_file
from skindb.threads import one_blas_thread
from skindb.workflow.code_digest import package_digest
from skindb.workflow.executor import (
    KilledError,
    Outcome,
    Outcomes,
    Result,
    Take,
    defective,
    pickled_outcome,
)

if TYPE_CHECKING:
    from distributed import Client, Future, Worker

CONNECT_SECONDS = 10  # until a scheduler that does not answer counts as unreachable
# that a take waits for the one its worker is busy with, before it asks for another
# worker
WAIT_SECONDS = 20.0
# of a pickled call that is sent with every take; usual ones have some 300
MAX_REPEATED_BYTES = 4096
# a take uses all threads of its worker, and the setting of their number is shared
_ONE_TAKE = threading.Lock()


@dataclass(frozen=True)
class Expected:
    """What every worker must have in common with the process that sends it takes."""

    version: str
    code: str  # digest of the source of skindb
    token: str  # file in a folder that all share; empty for none

    def require(self, worker: str) -> None:
        """Raise an `InputError` if this process, which is the named worker, has something else."""
        if (self.version, self.code) != (__version__, package_digest()):
            rule = f"must run the same skindb as this process ({self.version})"
            finding = f"version {__version__}"
            finding += "" if __version__ != self.version else " with other source code"
            raise InputError(
                Fault(
                    f"worker {worker}",
                    rule,
                    finding,
                    "install the same version, restart the worker",
                )
            )
        if self.token and not Path(self.token).is_file():
            folder = str(Path(self.token).parent.parent)
            rule = f"must see the database {folder}"
            cure = "use a folder that all machines share"
            raise InputError(
                Fault(f"worker {worker}", rule, "no such folder, or another one", cure)
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
        rule = "needs the package distributed"
        cure = "run: pip install 'skindb[cluster]'"
        raise InputError(Fault("--scheduler", rule, str(error), cure)) from None
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
        rule = "a Dask scheduler must answer there"
        cure = "check the address, and that `dask scheduler` runs"
        raise InputError(
            Fault(
                address,
                rule,
                f"{type(error).__name__}: {str(error) or 'no answer'}",
                cure,
            )
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
        rule = "every worker must have skindb and answer"
        cure = "install it in the environment of the workers"
        raise InputError(
            Fault("cluster", rule, f"{type(error).__name__}: {error}", cure)
        ) from None
    if not checked:
        rule = "a study needs workers"
        cure = "start one: dask worker ADDRESS"
        raise InputError(Fault("cluster", rule, "the scheduler has none", cure))


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


def dashboard_link(client: Client) -> str:
    """Address of the page on which a cluster shows what it does; empty if it has none."""
    try:
        return str(client.dashboard_link or "")
    except KeyError:  # a scheduler without that service
        return ""


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
        """See `Executor`.

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
            message: Any = bytes(cloudpickle.dumps((expected, call)))
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
                    yield _received(future, futures[future], client)
                    future.release()
            finally:
                # without a scheduler there is nothing to cancel
                with suppress(Exception):
                    client.cancel([future for future in futures if not future.done()])


def _received(future: Future, take: Take, client: Client) -> Outcome[Take, Any]:
    from distributed import KilledWorker

    try:
        outcome: Outcome[Take, Any] = cloudpickle.loads(future.result())
    except InputError:
        raise
    except CancelledError:
        url = str(client.scheduler.address if client.scheduler else "the scheduler")
        rule = "the scheduler must answer until the work is done"
        cure = "start it, and run the command again"
        raise InputError(Fault(url, rule, "the connection was lost", cure)) from None
    except ImportError as error:
        rule = "every worker must have skindb"
        cure = "install it in the environment of the workers"
        raise InputError(Fault("cluster", rule, str(error), cure)) from None
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
