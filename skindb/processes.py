"""Work on several items at a time, each in a process of its own: what is not compiled runs on one core a process."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from skindb.errors import Fault, InputError

Item = TypeVar("Item")
Result = TypeVar("Result")
MOST = 4  # processes; a take of the demo needs 1.5 GB


def side_by_side(work: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Results of `work`, which another process can import, in the order of the items; on one core one by one.

    The first error ends everything: the other processes are stopped at once, and so they are by an interrupt.
    """
    processes = min(len(items), os.cpu_count() or 1, MOST)
    if processes < 2:
        yield from map(work, items)
        return
    # a forked process would hang where a thread of its parent held a lock; interrupts are for the parent alone
    start, quiet = multiprocessing.get_context("spawn"), (signal.SIGINT, signal.SIG_IGN)
    pool = ProcessPoolExecutor(processes, start, initializer=signal.signal, initargs=quiet)
    done = False
    try:
        yield from pool.map(work, items)
        done = True
    except BrokenProcessPool as error:
        rule, cure = "must run to its end", "close other programs: this is what a lack of memory looks like"
        raise InputError(Fault("a process", rule, "it was stopped from outside", cure)) from error
    finally:
        for child in [] if done else multiprocessing.active_children():
            child.terminate()
        pool.shutdown(cancel_futures=True)
