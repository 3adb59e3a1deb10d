"""Samples on their way into the store: a file that survives a killed ingest, so that the next run goes on with it."""

from __future__ import annotations

import errno
import fcntl
import hmac
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

from skindb._files import make_private
from skindb._limits import RESUMABLE_SECONDS
from skindb.errors import Fault, InputError
from skindb.ingest._sample_kernels import tally
from skindb.schema.blocks import SHARD

EVERY = 5.0  # seconds between two entries of the journal: what a kill costs at most
STALE = RESUMABLE_SECONDS  # after which what nobody went on with is removed
GONE = ".gone"  # ending of a spool that is being removed
JOURNAL = "journal"
SEAL_BYTES = 32  # before the contents of every small file
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
    key
        What identifies the run: files in the folder that are not sealed with it are ignored.
    """

    def __init__(self, folder: Path, shape: tuple[int, int, int], frames: Mapping[str, Any], *, key: str) -> None:
        lights, cameras, surfels = shape
        self.folder, self.shape, self._frames, self._key = folder, shape, dict(frames), key.encode()
        self.done = np.zeros((lights, cameras), bool)
        self.views = np.zeros((lights, cameras), np.int64)  # samples of each
        self.counts = np.zeros((STATES, surfels), np.int32)
        self.digests: dict[str, str] = {}
        self._guard, self._turn, self._written = threading.Lock(), threading.Lock(), time.monotonic()
        self._file = self._lock = -1

    def __enter__(self) -> Self:
        self._lock = _locked(self.folder)
        try:
            self._file = os.open(self.folder / "samples", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW)
            size = 6 * int(np.prod(self.shape))
            whole = os.fstat(self._file).st_size == size  # else it is new: a journal without its samples is no promise
            os.ftruncate(self._file, size)
            self._resume(whole=whole)
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None or not self.done.any():
                _remove(self.folder)
            else:
                with suppress(OSError):  # a full disk: the error on its way says so
                    self.checkpoint()
        finally:
            self._close()

    def put(
        self,
        light: int,
        camera: int,
        samples: NDArray[np.uint16],
        became: NDArray[np.uint8],
        digests: Mapping[str, str],
    ) -> None:
        """Keep a view: (3, n) bits of half floats, what became of each surfel, and the digests of its frames."""
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
        content = self._sealed(f"{name}.npy")
        return None if content is None else np.load(content)

    def checkpoint(self) -> None:
        """Note what is done; after a kill the next run begins here."""
        with self._turn:  # else an older note could replace a newer one
            with self._guard:
                self._written = time.monotonic()
                state = np.array(json.dumps({"frames": self._frames, "digests": self.digests}))
                content = io.BytesIO()
                np.savez(content, done=self.done, views=self.views, counts=self.counts, state=state)
            os.fsync(self._file)  # the samples first: the journal must not promise what is not there
            self._replace(JOURNAL, content.getvalue())

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
            row = rows[channel, camera, light]
            if os.preadv(self._file, [row.data.cast("B")], 2 * (i * n + begin)) != row.nbytes:
                raise OSError(errno.EIO, "samples are cut off", str(self.folder / "samples"))
        return rows.transpose()

    def _resume(self, *, whole: bool) -> None:
        """Go on where the journal ends, if it is whole, and samples and frames are those it was made from."""
        content = self._sealed(JOURNAL)
        if content is not None:
            with np.load(content) as journal:
                state = json.loads(str(journal["state"]))
                if whole and state["frames"] == json.loads(json.dumps(self._frames)):
                    self.done, self.views, self.counts = (journal[name] for name in ("done", "views", "counts"))
                    self.digests |= state["digests"]
                    return
        # before the first sample is overwritten: a later run with the old frames would believe it
        (self.folder / JOURNAL).unlink(missing_ok=True)

    def _sealed(self, name: str) -> io.BytesIO | None:
        """What `_replace` wrote under a name; None if it is absent, damaged, or of another run."""
        path = self.folder / name
        if path.is_symlink() or not path.is_file():
            return None
        seal, content = path.read_bytes()[:SEAL_BYTES], path.read_bytes()[SEAL_BYTES:]
        return io.BytesIO(content) if hmac.compare_digest(seal, self._seal(name, content)) else None

    def _seal(self, name: str, content: bytes) -> bytes:
        return hmac.digest(self._key, name.encode() + b"\0" + content, "sha256")

    def _close(self) -> None:
        for descriptor in (self._file, self._lock):
            if descriptor >= 0:
                os.close(descriptor)
        self._file = self._lock = -1

    def _replace(self, name: str, content: bytes) -> None:
        temporary = self.folder / f"{uuid.uuid4().hex}.tmp"
        with temporary.open("wb") as file:
            file.write(self._seal(name, content) + content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self.folder / name)


def remove_stale(own: Path) -> None:
    """Remove the spools beside this one that nobody has touched for a day, and what a killed run began to remove.

    Only for a folder that holds nothing but spools, as the folder tmp of a database.
    """
    for folder in own.parent.iterdir() if own.parent.is_dir() else ():
        if folder == own or not (folder.name.endswith(GONE) or time.time() - _touched(folder) > STALE):
            continue
        with suppress(InputError, OSError):  # in use, or removed by another process at this moment
            lock = _locked(folder, new=False)
            try:
                _remove(folder)
            finally:
                os.close(lock)


def _touched(folder: Path) -> float:
    """Time of the last change; infinity of what is not there any more."""
    marks = []
    for path in (folder, folder / JOURNAL):
        with suppress(OSError):
            marks.append(path.stat().st_mtime)
    return max(marks, default=np.inf)


def _remove(folder: Path) -> None:
    """Remove a spool at once: killed in the middle, no run finds a journal there without its samples."""
    gone = folder if folder.name.endswith(GONE) else folder.with_name(f"{uuid.uuid4().hex}{GONE}")
    with suppress(OSError):  # what cannot be removed is as good as new for the same call
        folder.rename(gone)
    shutil.rmtree(gone, ignore_errors=True)


def _locked(folder: Path, *, new: bool = True) -> int:
    """Descriptor of the lock of a folder, made if `new`; the system lets go of it however we die.

    Raises
    ------
    InputError
        If another process has it.
    """
    while True:
        if new:
            make_private(folder)
        lock = os.open(folder / "lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(lock), (folder / "lock").stat()):
                return lock
        except FileNotFoundError:  # removed between the opening and the locking: once more
            pass
        except BlockingIOError:
            os.close(lock)
            cure = "wait until the other one has ended"
            raise InputError(Fault(str(folder), "one process ingests a capture", "another one does", cure)) from None
        except OSError:
            os.close(lock)
            raise
        os.close(lock)
