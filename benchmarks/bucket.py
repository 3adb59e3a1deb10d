"""Times of a database in a bucket compared with a folder: commit, read, a small sample
and verify of one capture.

    python -m benchmarks bucket [--surfels 20480] [--repeat 3] [--delay-ms 20]

The bucket is in an S3 server on this machine, in its own process, behind a proxy that
delays every request by `--delay-ms` like a network. Folder and bucket alternate within
one run; medians and requests are printed.
"""

from __future__ import annotations

import os
import tempfile
import time
from statistics import median

import numpy as np
from bucket_server import new_bucket, s3_server, settings
from faulty_proxy import faulty_proxy

from skindb.schema import dataset
from skindb.schema.label import BLOCK_SURFELS
from skindb.store import Database

LIGHTS = 150
CAMERAS = 16
NAME = "samples/reflectance_sample"


def samples(surfels: int) -> np.ndarray:
    """Half floats that are as smooth as those of a face; a third of them is missing."""
    rng = np.random.default_rng(0)
    level = rng.uniform(0.05, 0.3, (1, LIGHTS, CAMERAS, 3)).astype(np.float32)
    noise = 1 + 0.01 * rng.standard_normal((surfels, LIGHTS, CAMERAS, 1), np.float32)
    out = (level * noise).astype(np.float16)
    out[:, rng.random((LIGHTS, CAMERAS)) < 0.33] = np.nan
    return out


def steps(url: str, values: np.ndarray):
    """Yield name and duration of every step."""
    clock = time.perf_counter
    begin = clock()
    db = Database(url)
    with db.stage("capture", "A1") as stage:
        stage.write({"samples": dataset({"reflectance_sample": values})})
        stage.commit({})
    yield "commit", clock() - begin
    begin = clock()
    Database(url).read("capture", "A1")[NAME].count().compute()
    yield "read all", clock() - begin
    begin = clock()
    samples = Database(url).read("capture", "A1")[NAME]
    samples[:: BLOCK_SURFELS // 2, :3].compute()
    yield "read two chunks of every block", clock() - begin
    begin = clock()
    assert Database(url).verify() == []
    yield "verify", clock() - begin


def main(
    *, surfels: int = 5 * BLOCK_SURFELS, repeat: int = 3, delay_ms: float = 20.0
) -> None:
    """Measure and print."""
    values = samples(surfels)
    times: dict[tuple[str, str], list[float]] = {}
    requests: dict[str, int] = {}
    with (
        s3_server("localbucket") as address,
        faulty_proxy(address, delay_s=delay_ms / 1000) as proxy,
    ):
        os.environ.update(settings(proxy.address))
        for _ in range(repeat):
            with tempfile.TemporaryDirectory() as folder:
                for name, url in (
                    ("folder", folder),
                    ("bucket", f"s3://{new_bucket(address)}/db"),
                ):
                    proxy.requests.clear()
                    for step, seconds in steps(url, values):
                        times.setdefault((step, name), []).append(seconds)
                        if name == "bucket":
                            requests[step] = len(proxy.requests)
                            proxy.requests.clear()
    print(f"{values.nbytes / 1e6:.0f} MB of samples, {delay_ms:g} ms delay per request")
    for step, count in requests.items():
        folder = median(times[step, "folder"])
        bucket = median(times[step, "bucket"])
        print(
            f"{step:32} folder {folder:6.2f} s  bucket {bucket:6.2f} s  ratio "
            f"{bucket / folder:5.1f}  {count} requests"
        )
