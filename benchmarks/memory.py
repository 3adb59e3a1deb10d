"""Peak memory and time of the fit of one take of many surfels: a fitted capture repeated until it has as many.

    python benchmarks/memory.py DB TAKE [--surfels 1000000]

The stages are those of `fit_take`; samples are read block by block from DB, results are kept in memory as there.
"""

from __future__ import annotations

import argparse
import resource
import threading
import time
from pathlib import Path

import numpy as np
import xarray as xr

import skindb
from skindb.fit._clock import Clock
from skindb.fit.lumitexels import lumitexels
from skindb.fit.outliers import find_outliers
from skindb.fit.run import _convolved, _disc_angle, _fit_surfels, _with


def resident() -> float:
    """Memory of this process now [GiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("db")
    parser.add_argument("take")
    parser.add_argument("--surfels", type=int, default=1_000_000)
    args = parser.parse_args()
    one = lumitexels(skindb.open(args.db).read("capture", args.take))
    seen = one.isel(surfel=np.flatnonzero(one["sample_count"].values > 0)) if "sample_count" in one else one
    times = -(-args.surfels // seen.sizes["surfel"])
    whole = xr.concat([seen] * times, dim="surfel", data_vars="minimal", coords="minimal", compat="override")
    whole = whole.isel(surfel=slice(args.surfels)).chunk(surfel=4096)
    peak, stop, before = [resident()], threading.Event(), resident()

    def watch() -> None:
        while not stop.wait(0.05):
            peak.append(resident())

    watcher = threading.Thread(target=watch)
    watcher.start()
    clock, start = Clock(None), time.perf_counter()
    tables = _convolved(None, _disc_angle(whole))
    fitted, basis = _fit_surfels(whole, clock, tables, k=4, mode="perceptual", rank=16, eta=1.3, seed=0)
    with clock.stage("outliers"):
        find_outliers(_with(whole, fitted), basis=basis, eta=1.3)
    took = time.perf_counter() - start
    stop.set()
    watcher.join()
    print({name: round(seconds, 1) for name, seconds in clock.seconds.items()})
    lights, cameras = whole.sizes["light"], whole.sizes["camera"]
    print(f"{args.surfels} surfels, {lights} lights, {cameras} cameras: {took:.0f} s,")
    print(f"peak {max(peak):.2f} GiB ({before:.2f} before)")


if __name__ == "__main__":
    main()
