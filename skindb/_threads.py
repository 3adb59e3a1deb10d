"""How many threads work on one take."""

from __future__ import annotations

import dask
from dask.system import cpu_count


def thread_count() -> int:
    """Threads that this process may compute with: what Dask is configured to use, else one for each core it may use
    (a job of a batch system gets a part of its machine).

    `skindb.workflow.map_takes` configures it, so that several takes at a time do not use more threads than cores.
    """
    return int(dask.config.get("num_workers", None) or cpu_count() or 1)
