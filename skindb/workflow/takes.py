"""Processing of many takes, several at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from skindb.errors import Fault, InputError, system_fault
from skindb.workflow.audit import as_part
from skindb.workflow.cluster import Cluster
from skindb.workflow.executor import (
    Executor,
    KilledError,
    LocalProcesses,
    Outcome,
    Result,
    Take,
    ThisProcess,
)

if TYPE_CHECKING:
    from distributed import Client


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
    executor = _executor(min(workers or 1, len(takes)), client, shared)
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


def _executor(workers: int, client: Client | None, shared: Path | None) -> Executor:
    if client is not None:
        return Cluster(client, shared)
    return LocalProcesses(workers) if workers > 1 else ThisProcess()


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
