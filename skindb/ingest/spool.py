"""Samples on their way into the store: a file that survives a killed ingest, so that the next run goes on with it."""

from __future__ import annotations

import fcntl
import io
import json
import os
import shutil
import threading
import time
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import dask.array as da
import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.store.stage import SHARD

EVERY = 5.0  # seconds between two entries of the journal: what a kill costs at most
STALE = 24 * 3600.0  # seconds after which what nobody went on with is removed
STATES = 3  # usable, saturated, dark


class Spool:
    """Views (light, camera) of n surfels in any order, written by several threads, and what is known about them.

    The file holds (light, camera, channel, surfel) half floats. It is written, never mapped: mapped pages would count
    as memory of the process. Its journal names the views that are on the disc, with their counts and the digests of
    their frames; whatever came later is done again.

    Parameters
    ----------
    folder
        Of this spool alone; its name must contain a digest of everything the samples depend on.
    shape
        Lights, cameras, surfels.
    frames
        Frames of a view by name with what tells that they are the same, to be compared with those of the journal.
    """

    def __init__(self, folder: Path, shape: tuple[int, int, int], frames: Mapping[str, Any]) -> None:
        lights, cameras, surfels = shape
        self.folder, self.shape, self._frames = folder, shape, dict(frames)
        self.done = np.zeros((lights, cameras), bool)
        self.views = np.zeros((lights, cameras), np.int64)  # samples of each
        self.counts = np.zeros((STATES, surfels), np.int32)
        self.digests: dict[str, str] = {}
        self._guard, self._turn, self._written = threading.Lock(), threading.Lock(), time.monotonic()
        self._file = self._lock = -1

    def __enter__(self) -> Self:
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_stale(self.folder)
        self._lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the system lets go of it however we die
        except OSError:
            os.close(self._lock)
            cure = "wait until the other one has ended"
            raise InputError(
                Fault(str(self.folder), "one process ingests a capture", "another one does", cure)
            ) from None
        self._file = os.open(self.folder / "samples", os.O_RDWR | os.O_CREAT)
        os.ftruncate(self._file, 6 * int(np.prod(self.shape)))
        self._resume()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None and self.done.any():
            with suppress(OSError):  # a full disk: the error on its way says so
                self.checkpoint()
        os.close(self._file)
        if kind is None or not self.done.any():
            shutil.rmtree(self.folder, ignore_errors=True)
        os.close(self._lock)

    def put(
        self,
        light: int,
        camera: int,
        samples: NDArray[np.uint16],
        became: NDArray[np.uint8],
        digests: Mapping[str, str],
    ) -> None:
        """Keep a view: (3, n) bits of half floats, what became of each surfel, and the digests of its frames."""
        from skindb.ingest._sample_kernels import tally  # compiled at first use only

        self._write(light, camera, samples)
        with self._guard:
            self.views[light, camera] = tally(became, self.counts)
            self.done[light, camera] = True
            self.digests |= digests
            due = time.monotonic() - self._written > EVERY
        if due:
            self.checkpoint()

    def keep(self, name: str, array: NDArray[Any]) -> None:
        """A small array beside the samples, there whole or not at all."""
        content = io.BytesIO()
        np.save(content, array)
        self._replace(f"{name}.npy", content.getvalue())

    def kept(self, name: str) -> NDArray[Any] | None:
        """An array of `keep`, also of an earlier run."""
        path = self.folder / f"{name}.npy"
        return np.load(path) if path.exists() else None

    def checkpoint(self) -> None:
        """Note what is done; after a kill the next run begins here."""
        with self._turn:  # else an older note could replace a newer one
            with self._guard:
                self._written = time.monotonic()
                state = np.array(json.dumps({"frames": self._frames, "digests": self.digests}))
                content = io.BytesIO()
                np.savez(content, done=self.done, views=self.views, counts=self.counts, state=state)
            os.fsync(self._file)  # the samples first: the journal must not promise what is not there
            self._replace("journal.npz", content.getvalue())

    def samples(self) -> da.Array:
        """Samples (n, light, camera, 3), lazily read by shards of the store."""
        lights, cameras, n = self.shape
        sizes = tuple(min(SHARD, n - start) for start in range(0, n, SHARD))

        def shard(block_info: Any = None) -> NDArray[np.float16]:
            (begin, end), *_ = block_info[None]["array-location"]
            return self._read(begin, end)

        meta = np.empty((0, lights, cameras, 3), np.float16)
        chunks = (sizes, (lights,), (cameras,), (3,))
        name = f"spool-{uuid.uuid4().hex}"
        lazy: da.Array = da.map_blocks(  # type: ignore[no-untyped-call]
            shard, chunks=chunks, dtype=np.float16, meta=meta, name=name
        )
        return lazy

    def _write(self, light: int, camera: int, samples: NDArray[np.uint16]) -> None:
        content = np.ascontiguousarray(samples).data.cast("B")
        at = (light * self.shape[1] + camera) * len(content)
        while content:  # a large write may stop half way
            count = os.pwrite(self._file, content, at)
            content, at = content[count:], at + count

    def _read(self, begin: int, end: int) -> NDArray[np.float16]:
        """Samples (surfel, light, camera, 3) in the order of columns, as the store keeps them."""
        lights, cameras, n = self.shape
        rows = np.empty((3, cameras, lights, end - begin), np.float16)
        for i, (light, camera, channel) in enumerate(np.ndindex(lights, cameras, 3)):
            os.preadv(self._file, [rows[channel, camera, light].data.cast("B")], 2 * (i * n + begin))
        return rows.transpose()

    def _resume(self) -> None:
        """Go on where the journal ends, if the frames are still those it was made from."""
        path = self.folder / "journal.npz"
        if not path.exists():
            return
        with np.load(path) as journal:
            state = json.loads(str(journal["state"]))
            if state["frames"] != json.loads(json.dumps(self._frames)):
                return
            self.done, self.views, self.counts = journal["done"], journal["views"], journal["counts"]
            self.digests |= state["digests"]

    def _replace(self, name: str, content: bytes) -> None:
        temporary = self.folder / f"{uuid.uuid4().hex}.tmp"
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self.folder / name)


def remove_stale(own: Path) -> None:
    """Remove the spools beside this one that nobody has touched for a day."""
    for folder in own.parent.iterdir():
        marks = [path.stat().st_mtime for path in (folder, folder / "journal.npz") if path.exists()]
        if folder != own and marks and time.time() - max(marks) > STALE:
            shutil.rmtree(folder, ignore_errors=True)
