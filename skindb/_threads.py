"""Number of threads for the computations of one take."""

from __future__ import annotations

import dask
from dask.system import cpu_count


def thread_count() -> int:
    """Number of threads that this process may use.

    This is the number that Dask is configured to use, or else one per available core (a
    batch job may use only some cores of its machine). `skindb.workflow.map_takes` sets
    it, so that parallel takes do not use more threads than cores.
    """
    return int(dask.config.get("num_workers", None) or cpu_count() or 1)
