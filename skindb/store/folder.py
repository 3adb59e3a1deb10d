"""A local folder as the place of a database: the seam behind which a bucket will fit."""

from __future__ import annotations

import hashlib
import os
import shutil
import uuid
from pathlib import Path

from zarr.storage import LocalStore


class Folder:
    """Everything the store asks of a place. Keys are relative, with "/" between their parts.

    Parameters
    ----------
    root
        Of the database; made by the first write.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    def zarr(self, key: str, *, read_only: bool = False) -> LocalStore:
        """A zarr store at a key."""
        return LocalStore(self.root / key, read_only=read_only)

    def url(self, key: str) -> str:
        """Where a person finds a key."""
        return str((self.root / key).resolve())

    def children(self, key: str) -> list[str]:
        """Names right below a key, sorted; none where there is nothing."""
        place = self.root / key
        return sorted(p.name for p in place.iterdir()) if place.is_dir() else []

    def files(self, key: str) -> list[str]:
        """Every file below a key, relative to it, sorted."""
        place = self.root / key
        return sorted(p.relative_to(place).as_posix() for p in place.rglob("*") if not p.is_dir())

    def read(self, key: str) -> bytes:
        """Contents of a small file."""
        return (self.root / key).read_bytes()

    def digest(self, key: str) -> str:
        """sha256 of a file, read in blocks."""
        with (self.root / key).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def size(self, key: str) -> int:
        """Bytes of a file."""
        return (self.root / key).stat().st_size

    def make_durable(self, key: str) -> None:
        """Flush what lies below a key, and the folders on the way to it, to the disk; zarr never does."""
        place = self.root / key
        for folder, _, names in os.walk(place, topdown=False):
            for name in names:
                _flush(Path(folder) / name)
            _flush(Path(folder))
        self._flush_way(place)

    def create(self, key: str, data: bytes) -> bool:
        """Write a file that must not exist; False, and nothing written, if it does. Durable when this returns."""
        final = self.root / key
        final.parent.mkdir(parents=True, exist_ok=True)
        temporary = final.parent / f".{uuid.uuid4().hex}.tmp"
        try:
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.link(temporary, final)  # fails if the name exists: the one atomic step of a commit
        except FileExistsError:
            return False
        finally:
            temporary.unlink(missing_ok=True)
        self._flush_way(final)
        return True

    def remove(self, key: str) -> None:
        """Delete what lies below a key; nothing if nothing does."""
        shutil.rmtree(self.root / key, ignore_errors=True)

    def _flush_way(self, place: Path) -> None:
        """The entries of the folders from `place` up to the one that holds the root."""
        for folder in place.parents:
            _flush(folder)
            if folder == self.root.parent:
                return


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
