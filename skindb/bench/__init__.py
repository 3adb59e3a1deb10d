"""Curves of error against CPU time for every kernel of the fit, and the stress set;
`skindb bench` runs both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

from skindb.bench.names import KERNELS

if TYPE_CHECKING:
    from skindb.bench.run import run_bench, table_of

__all__ = ["KERNELS", "run_bench", "table_of"]

# imported lazily, because the command line only needs the names for its options
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__, submod_attrs={"run": ["run_bench", "table_of"]}
)
