"""Error against run time of every kernel of the fit, and the stress set; `skindb bench` runs both."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

from skindb.bench.names import KERNELS

if TYPE_CHECKING:
    from skindb.bench.run import run_bench, table_of

__all__ = ["KERNELS", "run_bench", "table_of"]

# the command line needs the names alone to offer its options
__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs={"run": ["run_bench", "table_of"]})
