"""Temporary file for the samples before they are stored; after a killed ingest, the
next run resumes from it.
"""

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

from skindb.errors import InputError, input_error
from skindb.files import PRIVATE_FILE, make_private, private_file
from skindb.ingest._sample_kernels import tally
from skindb.limits import RESUMABLE_SECONDS
from skindb.schema.label import BLOCK_SURFELS
from skindb.types import AnyArray, Bytes, Half, Values16

# between two entries of the journal: the most that a killed run loses
JOURNAL_INTERVAL_SECONDS = 5.0
STALE_SECONDS = RESUMABLE_SECONDS  # after which a spool that no run resumed is removed
REMOVED_SUFFIX = ".gone"  # of the folder of a spool that is being removed
JOURNAL = "journal"
SEAL_BYTES = 32  # length of the digest before the content of every small file
TILE = 64  # samples and surfels that are transposed together
STATES = 3  # usable, saturated, dark


class Spool:
    """Samples of n surfels by view (light, camera), written in any order by several
    threads, and their counts.

    The file holds (light, camera, channel, surfel) half floats. It is written, not
    memory-mapped, as mapped pages would count as memory of the process. Its journal
    lists the views that are on disk, with their counts and the digests of their frames;
    later views are computed again.

    Parameters
    ----------
    folder
        Folder for this spool alone; its name must contain a digest of everything the
        samples depend on.
    shape
        Numbers of lights, cameras and surfels.
    frames
        Size and date of each frame by name, which are compared with those in the journal.
    key
        Identifies the run: files in the folder with a digest of another key are ignored.
    """

    def __init__(
        self,
        folder: Path,
        shape: tuple[int, int, int],
        frames: Mapping[str, Any],
        *,
        key: str,
    ) -> None:
        lights, cameras, surfels = shape
        self.folder = folder
        self.shape = shape
        self._frames = dict(frames)
        self._key = key.encode()
        # whether later runs may use the views of this one
        self.resumable = True
        self.done = np.zeros((lights, cameras), bool)
        # number of samples of each view
        self.views = np.zeros((lights, cameras), np.int64)
        self.counts = np.zeros((STATES, surfels), np.int32)
        self.digests: dict[str, str] = {}
        self._guard = threading.Lock()
        self._turn = threading.Lock()
        self._written = time.monotonic()
        self._file = self._lock = -1

    def __enter__(self) -> Self:
        self._lock = _locked(self.folder)
        try:
            self._file = os.open(
                self.folder / "samples",
                os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW,
                PRIVATE_FILE,
            )
            size = 6 * int(np.prod(self.shape))
            # otherwise it is new, and its journal is invalid
            complete = os.fstat(self._file).st_size == size
            os.ftruncate(self._file, size)
            self._resume(complete=complete)
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None or not (self.resumable and self.done.any()):
                _remove(self.folder)
            else:
                # a full disk: the error that is being raised reports it
                with suppress(OSError):
                    self.checkpoint()
        finally:
            self._close()

    def put(
        self,
        light: int,
        camera: int,
        samples: Values16,
        outcome: Bytes,
        digests: Mapping[str, str],
    ) -> None:
        """Keep a view: (3, n) bits of half floats, the outcome for each surfel, and the
        digests of its frames.
        """
        self._write(light, camera, samples)
        with self._guard:
            self.views[light, camera] = tally(outcome, self.counts)
            self.done[light, camera] = True
            self.digests |= digests
            due = time.monotonic() - self._written > JOURNAL_INTERVAL_SECONDS
        if due and self.resumable:
            self.checkpoint()

    def keep(self, name: str, array: AnyArray) -> None:
        """Keep a small array beside the samples; the file is written atomically."""
        content = io.BytesIO()
        np.save(content, array)
        self._replace(f"{name}.npy", content.getbuffer())

    def kept(self, name: str) -> AnyArray | None:
        """An array of `keep`, possibly of an earlier run; None if it is absent."""
        content = self._sealed(f"{name}.npy")
        return None if content is None else np.load(content)

    def checkpoint(self) -> None:
        """Record the completed views, from which the run after a killed one resumes."""
        with self._turn:  # otherwise an older entry could replace a newer one
            with self._guard:
                self._written = time.monotonic()
                state = {"frames": self._frames, "digests": self.digests}
                content = io.BytesIO()
                np.savez(
                    content,
                    done=self.done,
                    views=self.views,
                    counts=self.counts,
                    state=np.array(json.dumps(state)),
                )
            # the samples first: the journal must not list views that are not on disk
            os.fsync(self._file)
            self._replace(JOURNAL, content.getbuffer())

    def restart(self) -> None:
        """Forget all views, but no small array."""
        # before the first sample is overwritten, as a later run would trust the journal
        (self.folder / JOURNAL).unlink(missing_ok=True)
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
        lazy: da.Array = da.map_blocks(  # type: ignore[no-untyped-call]
            shard, chunks=chunks, dtype=np.float16, meta=meta, name=name
        )
        return lazy

    def _write(self, light: int, camera: int, samples: Values16) -> None:
        content = np.ascontiguousarray(samples).data.cast("B")
        offset = (light * self.shape[1] + camera) * len(content)
        while content:  # a large write may be partial
            count = os.pwrite(self._file, content, offset)
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
                buffer = row.data.cast("B")
                if os.preadv(self._file, [buffer], 2 * (k * n + begin)) != row.nbytes:
                    file = str(self.folder / "samples")
                    raise OSError(errno.EIO, "samples are truncated", file)
            for j in range(0, len(samples), TILE):
                samples[j : j + TILE, i : i + TILE] = part[:, j : j + TILE].T
        return samples.reshape(-1, lights, cameras, 3)

    def _resume(self, *, complete: bool) -> None:
        """Resume from the journal if it is complete and belongs to these samples and frames."""
        content = self._sealed(JOURNAL)
        if content is not None and complete:
            with np.load(content) as journal:
                state = json.loads(str(journal["state"]))
                if state["frames"] == json.loads(json.dumps(self._frames)):
                    self.done = journal["done"]
                    self.views = journal["views"]
                    self.counts = journal["counts"]
                    self.digests |= state["digests"]
                    return
        for path in self.folder.glob("*.npy"):  # of other frames
            path.unlink()
        self.restart()

    def _sealed(self, name: str) -> io.BytesIO | None:
        """Content of `_replace`, behind its seal; None if it is absent, damaged, or of
        another run.
        """
        path = self.folder / name
        if path.is_symlink() or not path.is_file():
            return None
        sealed = path.read_bytes()
        seal = self._seal(name, memoryview(sealed)[SEAL_BYTES:])
        content = io.BytesIO(sealed)
        same = hmac.compare_digest(content.read(SEAL_BYTES), seal)
        return content if same else None

    def _seal(self, name: str, content: memoryview) -> bytes:
        digest = hmac.new(self._key, name.encode() + b"\0", "sha256")
        digest.update(content)
        return digest.digest()

    def _close(self) -> None:
        for descriptor in (self._file, self._lock):
            if descriptor >= 0:
                os.close(descriptor)
        self._file = self._lock = -1

    def _replace(self, name: str, content: memoryview) -> None:
        temporary = self.folder / f"{uuid.uuid4().hex}.tmp"
        with private_file(temporary).open("wb") as file:
            file.write(self._seal(name, content))
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self.folder / name)


def remove_stale(own: Path) -> None:
    """Remove spools beside this one that are unchanged for a day, and those whose
    removal was interrupted.

    Only for a folder that contains nothing but spools, such as the folder tmp of a database.
    """
    for folder in own.parent.iterdir() if own.parent.is_dir() else ():
        if folder == own:
            continue
        # in use, or removed by another process at this moment
        with suppress(InputError, OSError):
            # also changed by each entry of the journal
            age = time.time() - folder.stat().st_mtime
            if age <= STALE_SECONDS and not folder.name.endswith(REMOVED_SUFFIX):
                continue
            lock = _locked(folder, new=False)
            try:
                _remove(folder)
            finally:
                os.close(lock)


def _remove(folder: Path) -> None:
    """Remove a spool, renaming it first: after a kill, no run finds a journal without
    its samples.
    """
    target = folder
    if not folder.name.endswith(REMOVED_SUFFIX):
        target = folder.with_name(f"{uuid.uuid4().hex}{REMOVED_SUFFIX}")
        with suppress(OSError):  # the next call tries again
            folder.rename(target)
    shutil.rmtree(target, ignore_errors=True)


def _locked(folder: Path, *, new: bool = True) -> int:
    """Descriptor of the lock of a folder, created if `new`; the system releases it when
    the process ends.

    Raises
    ------
    InputError
        If another process holds it.
    """
    file = folder / "lock"
    while True:
        if new:
            make_private(folder)
        lock = os.open(file, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, PRIVATE_FILE)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(lock), file.stat()):
                return lock
        except FileNotFoundError:  # removed between opening and locking: try again
            pass
        except BlockingIOError:
            os.close(lock)
            raise input_error(
                str(folder),
                "one process ingests a capture",
                "another one does",
                "wait until the other one has ended",
            ) from None
        except OSError:
            os.close(lock)
            raise
        os.close(lock)
