"""Peak memory and time of the fit of a take with many surfels, made by repeating a capture.

    python benchmarks/memory.py DB TAKE [--surfels 600000]

Samples are read block by block from DB, as for a real take of that size. The model is
committed to a temporary database.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import xarray as xr
from dask.graph_manipulation import clone
from fit_driver import peak
from stages import Stages, stage_lines

import skindb
from skindb.fit import FitParameters, fit_model
from skindb.store import Database
from skindb.workflow.fit import groups_of


def repeated(capture: xr.DataTree, surfels: int) -> xr.DataTree:
    """A capture that repeats the surfels of `capture`, lazily."""
    groups = groups_of(capture)
    for name in ("samples", "surfels"):
        one = groups[name]
        along = one[[str(v) for v in one.data_vars if "surfel" in one[v].dims]]
        # clones, because a block that many tasks share would be read once and kept in memory
        copies = [clone(along) for _ in range(-(-surfels // one.sizes["surfel"]))]
        many = xr.concat(copies, dim="surfel").isel(surfel=slice(surfels))
        groups[name] = many.merge(one.drop_dims("surfel"))
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = capture.attrs
    return tree


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("db")
    parser.add_argument("take")
    parser.add_argument("--surfels", type=int, default=600_000)
    parser.add_argument("--hold-out-lights", type=float, default=0.1)
    args = parser.parse_args()
    capture = repeated(skindb.open(args.db).read("capture", args.take), args.surfels)
    parameters = FitParameters(hold_out_lights=args.hold_out_lights)
    before = peak()
    with tempfile.TemporaryDirectory() as folder, Stages() as stages:
        model = fit_model(capture, parameters, progress=stages)
        stages.end("rest")
        with Database(Path(folder)).stage("model", args.take) as stage:
            stage.write(groups_of(model))
            stage.commit({"take": args.take})
        stages.end("commit")
    print("\n".join(stage_lines(stages.table())))
    print("peaks of stages are anonymous memory, without memory-mapped files")
    lights, cameras = (capture["samples"].sizes[dim] for dim in ("light", "camera"))
    fitted = model.attrs["status"].get("fitted", 0.0)
    print(
        f"{args.surfels:,} surfels, {fitted:.1%} fitted, {lights} lights, {cameras} cameras"
    )
    print(f"peak resident memory: {peak():.2f} GiB ({before:.2f} before the fit)")


if __name__ == "__main__":
    main()
