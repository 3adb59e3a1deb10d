"""Temporary file for the samples before they are stored."""

import errno
import os
import threading
import uuid
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Self

import dask.array as da
import numpy as np

from skindb.files import make_private
from skindb.format.frames import Digests
from skindb.ingest._sample_kernels import tally
from skindb.schema.label import BLOCK_SURFELS
from skindb.types import Bytes, Float32, Half, Values16

TILE = 64  # samples and surfels that are transposed together
STATES = 3  # usable, saturated, dark


class Spool:
    """Samples of n surfels by view (light, camera), written in any order by several
    threads, their counts, and pictures of some views.

    The file holds (light, camera, channel, surfel) half floats. It has no name, so that
    it vanishes with the process, however that ends. It is written, not memory-mapped,
    as mapped pages would count as memory of the process.

    Parameters
    ----------
    folder
        On a disk with space for the samples.
    shape
        Numbers of lights, cameras and surfels.
    """

    def __init__(self, folder: Path, shape: tuple[int, int, int]) -> None:
        lights, cameras, surfels = shape
        self.folder = folder
        self.shape = shape
        self.done = np.zeros((lights, cameras), bool)
        # number of samples of each view
        self.views = np.zeros((lights, cameras), np.int64)
        self.counts = np.zeros((STATES, surfels), np.int32)
        self.digests = Digests()
        self.pictures: dict[str, Float32] = {}
        self._guard = threading.Lock()

    def __enter__(self) -> Self:
        make_private(self.folder)
        self._file = TemporaryFile(dir=self.folder)
        os.ftruncate(self._file.fileno(), 6 * int(np.prod(self.shape)))
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def put(
        self,
        light: int,
        camera: int,
        samples: Values16,
        outcome: Bytes,
        digests: Digests,
    ) -> None:
        """Keep a view: (3, n) bits of half floats, the outcome for each surfel, and the
        digests of its frames.
        """
        self._write(light, camera, samples)
        with self._guard:
            self.views[light, camera] = tally(outcome, self.counts)
            self.done[light, camera] = True
            self.digests |= digests

    def restart(self) -> None:
        """Forget all views, but no picture."""
        for array in (self.done, self.views, self.counts):
            array[:] = 0

    def samples(self) -> da.Array:
        """Samples (n, light, camera, 3), read lazily in the shards of the store."""
        lights, cameras, n = self.shape
        sizes = tuple(
            min(BLOCK_SURFELS, n - start) for start in range(0, n, BLOCK_SURFELS)
        )

        def shard(block_info: Any = None) -> Half:
            (begin, end), *_ = block_info[None]["array-location"]
            return self._read(begin, end)

        meta = np.empty((0, lights, cameras, 3), np.float16)
        chunks = (sizes, (lights,), (cameras,), (3,))
        name = f"spool-{uuid.uuid4().hex}"
        return da.map_blocks(  # type: ignore[no-untyped-call]
            shard, chunks=chunks, dtype=np.float16, meta=meta, name=name
        )

    def _write(self, light: int, camera: int, samples: Values16) -> None:
        content = np.ascontiguousarray(samples).data.cast("B")
        offset = (light * self.shape[1] + camera) * len(content)
        while content:  # a large write may be partial
            count = os.pwrite(self._file.fileno(), content, offset)
            content = content[count:]
            offset = offset + count

    def _read(self, begin: int, end: int) -> Half:
        """Samples (surfel, light, camera, 3)."""
        lights, cameras, n = self.shape
        samples = np.empty((end - begin, lights * cameras * 3), np.float16)
        # rows and tiles that fit into the cache of a core: a fourth of the time
        rows = np.empty((TILE, end - begin), np.float16)
        for i in range(0, samples.shape[1], TILE):
            part = rows[: samples.shape[1] - i]
            for k, row in enumerate(part, i):
                place = 2 * (k * n + begin)
                count = os.preadv(self._file.fileno(), [row.data.cast("B")], place)
                if count != row.nbytes:
                    raise OSError(errno.EIO, "samples are truncated", str(self.folder))
            for j in range(0, len(samples), TILE):
                samples[j : j + TILE, i : i + TILE] = part[:, j : j + TILE].T
        return samples.reshape(-1, lights, cameras, 3)
