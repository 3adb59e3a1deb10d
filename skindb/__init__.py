"""skindb: measurement and database of the appearance of human faces."""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

from skindb.errors import Fault, InputError

__version__ = "0.1.0"

if TYPE_CHECKING:
    from skindb import analysis, demo, export, fit, ingest, render, workflow

    # the first word of a notebook, as in xarray and zarr
    from skindb.store.database import open  # noqa: A004
    from skindb.workflow.simulation import simulate

__all__ = [
    "Fault",
    "InputError",
    "__version__",
    "analysis",
    "demo",
    "export",
    "fit",
    "ingest",
    "open",
    "render",
    "simulate",
    "workflow",
]

# SPEC 1: subpackages are imported at their first use, so that `import skindb` and the
# command line start fast
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submodules=[
        "analysis",
        "demo",
        "export",
        "fit",
        "ingest",
        "render",
        "workflow",
    ],
    submod_attrs={"store.database": ["open"], "workflow.simulation": ["simulate"]},
)
