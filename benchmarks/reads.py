"""Time of verified reads: digests of the record compared with zarr's crc32c codec and
with no check.

    python -m benchmarks reads [--surfels 20480] [--repeat 5]

Samples in the layout of the store (150 lights x 16 cameras) are read completely by
shards, and in part by chunks of 256 surfels, from the page cache. The three methods
alternate within one run; ratios of medians are printed.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec
from zarr.storage import LocalStore

from skindb.schema import dataset
from skindb.store import Database
from skindb.store import stage as stage_module
from skindb.store.verified import VerifiedStore

LIGHTS = 150
CAMERAS = 16
CHUNK = 256
NAME = "samples/reflectance_sample"


def samples(surfels: int) -> np.ndarray:
    """Half floats that are as smooth as those of a face; a third of them is missing."""
    rng = np.random.default_rng(0)
    wave = 1 + 0.3 * np.sin(np.arange(surfels) / 50)
    level = rng.uniform(0.05, 0.3, (1, LIGHTS, CAMERAS, 3)) * wave[:, None, None, None]
    out = (
        level
        * (1 + 0.01 * rng.standard_normal((surfels, LIGHTS, CAMERAS, 1), np.float32))
    ).astype(np.float16)
    out[:, rng.random((LIGHTS, CAMERAS)) < 0.33] = np.nan
    return np.asfortranarray(out)


def write_checksums(root: Path, values: np.ndarray) -> Path:
    """Write the samples in the layout of the store, with a checksum in every chunk."""
    layout = stage_module._encoding(
        dataset({"reflectance_sample": values})["reflectance_sample"]
    )
    array = zarr.create_array(
        LocalStore(root),
        name=NAME,
        shape=values.shape,
        dtype=values.dtype,
        chunks=layout["chunks"],
        shards=layout["shards"],
        filters=layout["filters"],
        compressors=[*layout["compressors"], Crc32cCodec()],
    )
    for start in range(0, len(values), stage_module.BLOCK_SURFELS):
        array[start : start + stage_module.BLOCK_SURFELS] = values[
            start : start + stage_module.BLOCK_SURFELS
        ]
    return root


def whole(array: zarr.Array) -> None:
    """Read every shard."""
    for start in range(0, array.shape[0], stage_module.BLOCK_SURFELS):
        array[start : start + stage_module.BLOCK_SURFELS]


def part(array: zarr.Array) -> None:
    """Read one chunk of every second shard, like a small sample of a face."""
    for start in range(0, array.shape[0], 2 * stage_module.BLOCK_SURFELS):
        array[start + 2 * CHUNK : start + 3 * CHUNK]


def main(*, surfels: int = 5 * stage_module.BLOCK_SURFELS, repeat: int = 5) -> None:
    """Measure and print."""
    zarr.config.set({"array.order": "F"})
    with tempfile.TemporaryDirectory() as folder:
        values = samples(surfels)
        summed = write_checksums(Path(folder) / "crc32c", values)
        db = Database(Path(folder) / "db")
        with db.stage("capture", "A1") as stage:
            stage.write({"samples": dataset({"reflectance_sample": values})})
            record = stage.commit({})
        plain = db.root / record.path
        stores = {
            "no check": lambda: LocalStore(plain, read_only=True),
            "crc32c of every chunk": lambda: LocalStore(summed, read_only=True),
            "digests of the record": lambda: VerifiedStore(db.place, record),
        }
        seconds: dict[tuple[str, str], list[float]] = {}
        for _ in range(repeat):
            for name, store in stores.items():
                for part_name, read in (("whole", whole), ("part", part)):
                    begin = time.perf_counter()
                    read(zarr.open_array(store(), path=NAME, mode="r"))
                    seconds.setdefault((name, part_name), []).append(
                        time.perf_counter() - begin
                    )
        stored = record.bytes / surfels
        print(
            f"{surfels} surfels, {values.nbytes / 1e6:.0f} MB, {stored:.0f} "
            "bytes stored per surfel"
        )
        for name in stores:
            row = [median(seconds[name, part_name]) for part_name in ("whole", "part")]
            base = [
                median(seconds["no check", part_name])
                for part_name in ("whole", "part")
            ]
            columns = zip(("whole", "part"), row, base, strict=True)
            ratios = " ".join(
                f"{part_name} {a:.3f} s ({a / b:.2f} x)" for part_name, a, b in columns
            )
            print(f"{name:<24} {ratios}")
