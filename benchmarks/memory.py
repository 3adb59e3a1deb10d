"""Peak memory and time of the fit of a take with many surfels, made by repeating a capture.

    python -m benchmarks memory DB TAKE [--surfels 600000]

Samples are read block by block from DB, as for a real take of that size. The model is
committed to a temporary database.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import xarray as xr
from dask.graph_manipulation import clone

import skindb
from benchmarks.stages import Stages, peak, stage_lines
from skindb.fit import FitParameters, fit_model
from skindb.store import Database
from skindb.workflow.fit import groups_of


def repeated(capture: xr.DataTree, surfels: int) -> xr.DataTree:
    """A capture that repeats the surfels of `capture`, lazily."""
    groups = groups_of(capture)
    for name in ("samples", "surfels"):
        group = groups[name]
        along = group[[str(v) for v in group.data_vars if "surfel" in group[v].dims]]
        # clones, because a block that many tasks share would be read once and kept in memory
        copies = [clone(along) for _ in range(-(-surfels // group.sizes["surfel"]))]
        many = xr.concat(copies, dim="surfel").isel(surfel=slice(surfels))
        groups[name] = many.merge(group.drop_dims("surfel"))
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = capture.attrs
    return tree


def main(
    db: str, take: str, *, surfels: int = 600000, hold_out_lights: float = 0.1
) -> None:
    """Measure and print."""
    capture = repeated(skindb.open(db).read("capture", take), surfels)
    parameters = FitParameters(hold_out_lights=hold_out_lights)
    before = peak()
    with tempfile.TemporaryDirectory() as folder, Stages() as stages:
        model = fit_model(capture, parameters, progress=stages)
        stages.end("rest")
        with Database(Path(folder)).stage("model", take) as stage:
            stage.write(groups_of(model))
            stage.commit({"take": take})
        stages.end("commit")
    print("\n".join(stage_lines(stages.table())))
    print("peaks of stages are anonymous memory, without memory-mapped files")
    lights, cameras = (capture["samples"].sizes[dim] for dim in ("light", "camera"))
    fitted = model.attrs["status"].get("fitted", 0.0)
    print(
        f"{surfels:,} surfels, {fitted:.1%} fitted, {lights} lights, {cameras} cameras"
    )
    print(f"peak resident memory: {peak():.2f} GiB ({before:.2f} before the fit)")
