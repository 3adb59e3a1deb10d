"""How many threads work on one take."""

from __future__ import annotations

import os

import dask


def thread_count() -> int:
    """Threads that this process may compute with: what Dask is configured to use, else one for each core.

    `skindb.workflow.map_takes` configures it, so that several takes at a time do not use more threads than cores.
    """
    return int(dask.config.get("num_workers", None) or os.cpu_count() or 1)
