"""Speed of reading the samples of a capture: decompression alone, plain zarr, and the
store with its digests; objects and bytes of its versions.

    python -m benchmarks reads DB TAKE [--repeat 5]

All objects are read completely on one thread from the page cache, and in part by one
chunk of each. The methods alternate within one run; medians of the CPU time are printed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import numpy as np
import zarr
from numcodecs import blosc

import skindb
from skindb.schema.label import BLOCK_SURFELS
from skindb.store.arrays import CHECKSUM_BYTES, INDEX_BYTES, ShardedArray
from skindb.store.verified import VerifiedStore

NAME = "samples/reflectance_sample"


def decompression(store: VerifiedStore, array: zarr.Array) -> Callable[[], None]:
    """Decompression of all chunks, held in memory, into one buffer."""
    chunks = array.shards[0] // array.chunks[0]
    compressed = []
    for number in range(-(-array.shape[0] // array.shards[0])):
        content = store.read(f"{NAME}/c/{number}/0/0/0")
        index = content[-CHECKSUM_BYTES - chunks * INDEX_BYTES : -CHECKSUM_BYTES]
        for offset, length in np.frombuffer(index, "<u8").reshape(-1, 2).tolist():
            if offset < len(content):  # chunks beyond the end of the array have none
                compressed.append(content[offset : offset + length])
    buffer = np.empty(array.chunks, array.dtype)

    def run() -> None:
        for chunk in compressed:
            blosc.decompress(chunk, buffer)

    return run


def each(read: Callable[[int, int], np.ndarray], parts: list[tuple[int, int]]) -> None:
    """Read part by part; none is kept, because new memory takes time too."""
    for begin, end in parts:
        read(begin, end)


def measure(
    db: str, take: str, *, repeat: int = 5
) -> tuple[str, dict[str, tuple[float, float]]]:
    """Description of the samples; CPU time [s] and speed [MB/s] of every method."""
    database = skindb.open(db)
    record = database.record("capture", take)
    store = VerifiedStore(database.place, record)
    plain = zarr.open_array(f"{db}/{record.path}", path=NAME, mode="r")
    count = plain.shape[0]
    array = ShardedArray(
        store, NAME, plain.shape, plain.dtype, plain.chunks[0], plain.shards[0]
    )
    blocks = [
        (start, min(start + BLOCK_SURFELS, count))
        for start in range(0, count, BLOCK_SURFELS)
    ]
    chunk = plain.chunks[0]
    chunks = [(start, min(start + chunk, count)) for start, _ in blocks]
    methods = {
        "decompression alone": decompression(store, plain),
        "zarr, no digests": lambda: each(lambda a, b: plain[a:b], blocks),
        "the store, with digests": lambda: each(array.rows, blocks),
        "one chunk of each block, zarr": lambda: each(lambda a, b: plain[a:b], chunks),
        "one chunk of each block, the store": lambda: each(array.rows, chunks),
    }
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(repeat):
        for name, method in methods.items():
            begin = time.process_time()
            method()
            seconds[name].append(time.process_time() - begin)
    size = plain.dtype.itemsize * plain.size
    stored = sum(
        file.size for name, file in store.files.items() if name.startswith(f"{NAME}/c")
    )
    text = (
        f"{plain.shape} samples, {size / 1e6:,.0f} MB; {stored / count:,.0f} bytes "
        f"stored per surfel, {stored / plain.size:.3f} per sample"
    )
    results = {}
    for name, values in seconds.items():
        part = size if "chunk" not in name else size * chunk / BLOCK_SURFELS
        cpu = median(values)
        results[name] = cpu, part / 1e6 / cpu
    return text, results


def main(db: str, take: str, *, repeat: int = 5) -> None:
    """Measure and print."""
    text, results = measure(db, take, repeat=repeat)
    print(text)
    for name, (cpu, speed) in results.items():
        print(f"{name:<36} {cpu:.3f} s of CPU time, {speed:,.0f} MB/s")
    database = skindb.open(db)
    for kind in database.kinds(take):
        one = database.record(kind, take)
        files = VerifiedStore(database.place, one).files
        metadata = sum(name.endswith("zarr.json") for name in files)
        print(f"{kind}: {len(files)} objects, {metadata} of them metadata")
