"""Curves of error against CPU time for every kernel; `skindb bench` measures them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from skindb.bench.run import run_bench, table_of

__all__ = ["KERNELS", "run_bench", "table_of"]

# the command line needs only the names
KERNELS = (
    "surface",
    "refit",
    "normals",
    "albedo",
    "nmf",
    "probe",
    "inverse",
    "subsurface",
    "exposures",
    "pyramid",
    "textures",
)
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__, submod_attrs={"run": ["run_bench", "table_of"]}
)
