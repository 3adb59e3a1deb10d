"""One measurement of the fit in its own process, by the code on PYTHONPATH.

    PYTHONPATH=CODE python benchmarks/programs/fit_driver.py ingest DB CAPTURE
    PYTHONPATH=CODE python benchmarks/programs/fit_driver.py fit DB TAKE
    PYTHONPATH=CODE python benchmarks/programs/fit_driver.py fit-one-thread DB TAKE
    PYTHONPATH=CODE python benchmarks/programs/fit_driver.py parts DB TAKE
    PYTHONPATH=CODE python benchmarks/programs/fit_driver.py read DB TAKE

`benchmarks/fit.py` and `benchmarks/workers.py` call it. The last printed line is the
result as JSON.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dask
import numpy as np
import xarray as xr
from dask.delayed import delayed
from threadpoolctl import threadpool_limits

from skindb.fit import (
    FitParameters,
    estimate_diffuse_reflectance,
    estimate_normals,
    fit_surface,
    reduce_basis,
)
from skindb.fit.lumitexels import block_of, disc_angle, lumitexels
from skindb.fit.surface import NEEDED, noise_floor, refit_and_evaluate
from skindb.reflectance._lumitexel_kernels import MIN_SAMPLES_GLOSS
from skindb.reflectance.dictionary import disc_dictionary
from skindb.reflectance.kinds import surface_model
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Comparison, Judgement
from skindb.schema import dataset
from skindb.store import Database
from skindb.workflow import ingest_take
from skindb.workflow.fit import fit_take

# by its path: `benchmarks` may be that of another revision
sys.path.append(str(Path(__file__).parents[1]))
from stages import Stages, peak

SPACING = 1.5  # mm between surfels
HOLD_OUT = 0.1  # fraction of the lights
SURFELS = 2048  # for the measurement of parts of the fit
ROUNDS = 3
COMPONENTS = 4
FITTED = (
    "shading_normal",
    "normal_error",
    "diffuse_reflectance",
    "diffuse_reflectance_error",
)


def ingest(db: Any, capture: str) -> dict[str, Any]:
    """Ingest a capture folder, and return the name of its take."""
    return {"take": ingest_take(db, Path(capture), spacing_mm=SPACING).take}


def fit(db: Any, take: str) -> dict[str, Any]:
    """Fit and commit a take; returns CPU time, wall time and memory of each stage, and
    peak resident memory.
    """
    with Stages() as stages:
        fit_take(db, take, FitParameters(hold_out_lights=HOLD_OUT), progress=stages)
        stages.end("commit")
    return {"stages": stages.table(), "peak": peak()}


def fit_one_thread(db: Any, take: str) -> dict[str, Any]:
    """`fit` on one thread, like one of several workers."""
    with threadpool_limits(1), dask.config.set(scheduler="synchronous"):
        return fit(db, take)


def read(db: Any, take: str) -> dict[str, Any]:
    """CPU time and wall time of reading every block of samples once."""
    blocks = (
        db.read("capture", take)["samples"]["reflectance_sample"]
        .data.to_delayed()
        .ravel()
    )
    start = time.perf_counter(), time.process_time()
    dask.compute(*(delayed(np.size)(block) for block in blocks))  # type: ignore[no-untyped-call]
    return {
        "wall": time.perf_counter() - start[0],
        "cpu": time.process_time() - start[1],
    }


def parts(db: Any, take: str) -> dict[str, float]:
    """CPU time per surfel [us] of the parts of a fit, on one thread and on samples in memory."""
    dask.config.set(scheduler="synchronous")
    capture = db.read("capture", take)
    samples = lumitexels(capture)
    seen = np.flatnonzero(capture["samples"]["sample_count"].values > 0)
    chosen = seen[np.linspace(0, len(seen) - 1, min(SURFELS, len(seen))).astype(int)]
    work = samples.isel(surfel=chosen).load()
    spent: dict[str, float] = {}
    tables = disc_dictionary(None, disc_angle(samples))

    def timed(name: str, part: Callable[[], Any]) -> Any:
        part()  # compiles
        times = []
        for _ in range(ROUNDS):
            begin = time.process_time()
            result = part()
            times.append(time.process_time() - begin)
        spent[name] = 1e6 * min(times) / len(chosen)
        return result

    normals = timed("normals", lambda: estimate_normals(work))
    lit = work.merge(normals)
    albedo = timed("albedo", lambda: estimate_diffuse_reflectance(lit))
    fitted = work.merge(normals.merge(albedo)[list(FITTED)])
    mixture = Mixture.of_dictionary(tables)
    surface = timed("dictionary fit", lambda: fit_surface(fitted, surface=mixture))
    weighted = surface.merge(work[["surfel_area"]])
    rng = np.random.default_rng(0)
    basis = reduce_basis(weighted, dictionary=tables, k=COMPONENTS, rng=rng)
    timed("second pass", _second_pass(fitted, basis))
    timed("linear refit of 4 components", _linear_refit(fitted, basis))
    return spent


def _second_pass(fitted: xr.Dataset, basis: xr.Dataset) -> Callable[[], Any]:
    """Refit with its errors, held-out errors, and outliers."""
    lights = np.arange(fitted.sizes["light"]) % round(1 / HOLD_OUT) == 0
    cameras = np.zeros(fitted.sizes["camera"], np.bool_)
    held_out = dataset({"light_held_out": lights, "camera_held_out": cameras})
    return lambda: refit_and_evaluate(
        fitted, held_out=held_out, basis=basis, mode="perceptual", eta=1.3
    )


def _linear_refit(fitted: xr.Dataset, basis: xr.Dataset) -> Callable[[], Any]:
    """Weights and residuals without their errors."""
    arrays = {name: fitted[name].values for name in NEEDED}
    block = block_of(arrays)
    comparison = Comparison("linear", 1.3, noise_floor(fitted), MIN_SAMPLES_GLOSS)
    surface = surface_model(basis)
    return lambda: surface.fit(block, comparison, Judgement())


ACTIONS = {
    "ingest": ingest,
    "fit": fit,
    "fit-one-thread": fit_one_thread,
    "read": read,
    "parts": parts,
}

if __name__ == "__main__":
    if len(sys.argv) != 4 or sys.argv[1] not in ACTIONS:
        print(__doc__)
        sys.exit(0 if "--help" in sys.argv else 2)
    action, folder, name = sys.argv[1:]
    print(json.dumps(ACTIONS[action](Database(folder), name)))
