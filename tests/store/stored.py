"""Small versions for the tests of the store."""

from __future__ import annotations

import dask.array  # noqa: F401  so that processes that are forked need not import it
import numpy as np
import xarray as xr

from skindb.schema import dataset
from skindb.store import Database, Record


def groups(value: float = 1.0, n: int = 10) -> dict[str, xr.Dataset]:
    """Two groups of equal values; the first samples are missing."""
    sample = np.full((n, 3, 2, 3), value, np.float16)
    sample[0] = np.nan
    coords = {
        "light": ["l0", "l1", "l2"],
        "camera": ["c0", "c1"],
        "channel": ["R", "G", "B"],
    }
    return {
        "samples": dataset({"reflectance_sample": sample}, coords=coords),
        "surfels": dataset({"surfel_area": np.full(n, value)}),
    }


def commit(
    root,
    value: float = 1.0,
    take: str = "A1",
    kind: str = "capture",
    n: int = 10,
    **provenance,
) -> Record:
    """Commit a version, which names the takes of its inputs."""
    names = [one["take"] for one in provenance.get("inputs", [])]
    with Database(root).stage(kind, take, names=names) as stage:
        stage.write(groups(value, n))
        return stage.commit({"seeds": [1]} | provenance)
