"""Errors at held-out lights and run time of both surface models on the same takes.

    python -m benchmarks surface_models DB [TAKE ...] [--surfels 4000]

Every take is fitted by a mixture of measured BRDFs and by one GGX lobe per surfel, on one
thread and without the lights that are held out. Nothing is committed.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import dask
import numpy as np
import xarray as xr

import skindb
from skindb.fit import fit_model
from skindb.parameters import FitParameters
from skindb.schema import FitStatus

MODELS = ("mixture", "ggx")
ERRORS = ("fit_residual", "held_out_error", "held_out_error_perceptual")
FEW = 48  # surfels of the fit that compiles the kernels


def part(capture: xr.DataTree, surfels: int) -> xr.DataTree:
    """A capture with evenly chosen surfels; its mesh keeps no triangle."""
    count = capture["samples"].sizes["surfel"]
    chosen = np.linspace(0, count - 1, min(surfels, count)).astype(int)
    groups = {
        name: node.to_dataset().isel(surfel=chosen, missing_dims="ignore")
        for name, node in capture.children.items()
        if name != "mesh"
    }
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = capture.attrs
    return tree


def fitted(capture: xr.DataTree, model: str) -> tuple[float, dict[str, float]]:
    """CPU time of a fit [ms per surfel], and medians of the errors of fitted surfels."""
    begin = time.process_time()
    tree = fit_model(capture, FitParameters(surface=model, hold_out_lights=0.1))
    spent = time.process_time() - begin
    surfels = tree["fitted"].to_dataset()
    good = surfels["fit_status"].values == FitStatus.FITTED
    medians = {name: float(np.nanmedian(surfels[name].values[good])) for name in ERRORS}
    return 1e3 * spent / surfels.sizes["surfel"], medians


def main(db: str, takes: Sequence[str] = (), *, surfels: int = 4000) -> None:
    """Print a row for each take and model."""
    dask.config.set(scheduler="synchronous")
    database = skindb.open(db)
    names = list(takes) or list(database.takes("capture"))
    for model in MODELS:
        fitted(part(database.read("capture", names[0]), FEW), model)
    print(f"{'take':24} {'model':8} ms/surfel  " + "  ".join(ERRORS))
    for take in names:
        # read once, so that reading does not count
        capture = part(database.read("capture", take), surfels).load()
        for model in MODELS:
            spent, medians = fitted(capture, model)
            row = "  ".join(f"{medians[name]:{len(name)}.4f}" for name in ERRORS)
            print(f"{take:24} {model:8} {spent:9.2f}  {row}", flush=True)
