"""A local folder as the location of a database."""

import errno
import os
import shutil
import stat
import sys
import uuid
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from io import BufferedReader
from pathlib import Path

from zarr.storage import LocalStore

from skindb.errors import InputError, add_filename
from skindb.files import PRIVATE, make_private, open_regular
from skindb.limits import MAX_STORE_JSON_BYTES
from skindb.store.place import (
    BLOCK_BYTES,
    STAGING,
    Digests,
    Guard,
    digests_of,
    inside,
    unguarded,
)

# below a version; zarr creates group/array/c and a folder for each dim except the last
MAX_FOLDER_DEPTH = 16
# to write a file whose temporary file is removed, or to remove a folder in which files
# are written
MAX_ATTEMPTS = 10
FLUSHING_THREADS = 4  # more were not faster on ext4
# permissions of a database that its folders have too: those of owner and group, and the
# setgid bit, which new folders inherit
SHARED_MODES = 0o2770
TYPES = ((stat.S_ISDIR, "folder"), (stat.S_ISREG, "file"), (stat.S_ISLNK, "link"))


class Folder:
    """A folder; see `place`, also for its keys.

    Parameters
    ----------
    root
        Folder of the database, created by the first write.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.is_unlocked = False

    @property
    def name(self) -> str:
        """Name of the folder in messages."""
        return str(self.root)

    def writable(self, key: str) -> LocalStore:
        """A writable zarr store at a key; versions are read through `VerifiedStore`."""
        place = inside(self.root, key)
        self._make(place.parent)
        return LocalStore(place)

    def scratch(self) -> Path:
        """The folder for temporary files, inside the database."""
        return self.root / "tmp"

    def marker_file(self) -> Path:
        """The file beside the folder with the ending ".markers"."""
        root = self.root.resolve()
        return root.with_name(f"{root.name}.markers")

    def address(self) -> str:
        """URL by which another process finds the place."""
        # another process may have another working directory
        return str(self.root.absolute())

    def url(self, key: str) -> str:
        """Path of a key as shown to users."""
        return str(inside(self.root.resolve(), key))

    def where(self, key: str) -> str:
        """Name of a key in messages; the key may contain any characters."""
        return str(self.root / key)

    def names(self) -> list[str] | None:
        """Names at the top level; None if the folder does not exist."""
        return (
            sorted(entry.name for entry in os.scandir(self.root))
            if self.root.is_dir()
            else None
        )

    def children(self, key: str, *, links: bool = False) -> list[str]:
        """Names directly below a key, sorted; symbolic links are excluded unless `links` is set."""
        place = inside(self.root, key)
        entries = (_entries(place) or []) if place.is_dir() else []
        return sorted(
            entry.name for entry in entries if links or not entry.is_symlink()
        )

    def file_type(self, key: str) -> str:
        """Type of a key: "folder", "file", "link" or "other"; empty if it does not exist."""
        try:
            mode = (self.root / key).lstat().st_mode
        except OSError:
            return ""
        return next((name for test, name in TYPES if test(mode)), "other")

    def sizes(self, key: str) -> dict[str, int]:
        """Size in bytes of every file below a key, by its path relative to the key; -1
        if it is not a regular file.

        Empty folders, and folders nested deeper than those of zarr, are listed with -1.
        """
        place = inside(self.root, key)
        files = _walk(place) if place.is_dir() else {}
        return {name: identity[0] for name, identity in files.items()}

    def read(self, key: str, begin: int = 0, end: int | None = None) -> bytes:
        """Contents of a file from byte `begin`, counted from its end if negative, up to `end`."""
        with self._open(key, sys.maxsize) as file:
            file.seek(
                begin if begin >= 0 else max(file.seek(0, os.SEEK_END) + begin, 0)
            )
            return file.read() if end is None else file.read(max(end - begin, 0))

    def read_small(self, key: str) -> bytes:
        """Contents of a JSON file, whose size is limited."""
        with self._open(key, MAX_STORE_JSON_BYTES) as file:
            return file.read()

    def digests(self, key: str) -> Digests:
        """Digests of a file, read in blocks."""
        with self._open(key, sys.maxsize) as stream:
            return digests_of(iter(partial(stream.read, BLOCK_BYTES), b""))

    def identities(self, key: str) -> dict[str, tuple[Hashable, ...]]:
        """The identity of every file below a key, by its path relative to the key;
        (-1,) where `sizes` returns -1.
        """
        place = inside(self.root, key)
        return {**_walk(place)} if place.is_dir() else {}

    def modified(self, key: str) -> float:
        """Time in seconds, by the clock of the storage, when a file or the newest file
        below a key was written.
        """
        place = inside(self.root, key)
        times = [place.lstat().st_mtime]
        for folder, _, names in os.walk(place):
            times += [(Path(folder) / name).lstat().st_mtime for name in names]
        return max(times)

    def now(self) -> float:
        """Time of the clock of the storage, which is the same for all machines that share it."""
        temporary = self._new_temporary()
        try:
            with temporary.open("xb") as file:
                return os.fstat(file.fileno()).st_mtime
        finally:
            temporary.unlink(missing_ok=True)

    def make_durable(self, key: str) -> None:
        """Flush the files below a key and its parent folders, which zarr does not do."""
        place = inside(self.root, key)
        # zarr creates files and folders with the permissions of the umask
        folder_mode, file_mode = self._modes()
        modes: dict[Path, int] = {}
        for folder, _, names in os.walk(place):
            modes |= {Path(folder, name): file_mode for name in names}
            modes[Path(folder)] = folder_mode
        # many at once, of which a disk writes the journal once
        with ThreadPoolExecutor(FLUSHING_THREADS) as pool:
            for _ in pool.map(lambda path: flush_path(path, mode=modes[path]), modes):
                pass
        self._flush_parents(place)

    def create(self, key: str, data: bytes, *, guard: Guard = unguarded) -> bool:
        """Write a file durably if it does not exist yet; returns False and writes
        nothing if it exists.
        """
        # a link fails if the name exists; it is the only atomic step of a commit
        return self._write(key, data, os.link, guard)

    def replace(self, key: str, data: bytes, *, guard: Guard = unguarded) -> None:
        """Write or replace a small file atomically and durably."""
        self._write(key, data, os.replace, guard)

    def sweep(self) -> None:
        """Remove the temporary files of all writers, which write them again if their
        guards permit it.
        """
        for name in self.children(STAGING, links=True):
            path = self.root / STAGING / name
            # a foreign folder is reported by `verify`
            if path.is_symlink() or not path.is_dir():
                path.unlink(missing_ok=True)

    def remove(self, key: str) -> None:
        """Delete a file, or everything below a key, durably; missing files are ignored."""
        place = inside(self.root, key)
        if place.is_dir():
            remove_tree(place)
        else:
            place.unlink(missing_ok=True)
        if place.parent.is_dir():
            # otherwise a record could reappear after a power loss without its version
            flush_path(place.parent)

    def _open(self, key: str, most_bytes: int) -> BufferedReader:
        """Open a regular file without blocking; `OSError` for any other type of file."""
        path = inside(self.root, key)
        try:
            return open_regular(path, most_bytes)
        except InputError as error:
            raise OSError(errno.EINVAL, error.faults[0].found, str(path)) from None

    def _write(
        self,
        key: str,
        data: bytes,
        step: Callable[[Path, Path], None],
        guard: Guard,
    ) -> bool:
        """Write a temporary file, call the guard, and give the file its name by `step`;
        see `markers`.
        """
        final = inside(self.root, key)
        for _ in range(MAX_ATTEMPTS):
            try:
                if self._try_write(final, data, step, guard):
                    self._flush_parents(final)
                    return True
            except FileExistsError:
                return False
            except BaseException:
                # so that no empty folder with the name of a withdrawn subject remains
                with suppress(OSError):
                    final.parent.rmdir()
                raise
        raise OSError(
            errno.EAGAIN,
            "temporary files are removed repeatedly",
            str(self.root / STAGING),
        )

    def _try_write(
        self,
        final: Path,
        data: bytes,
        step: Callable[[Path, Path], None],
        guard: Guard,
    ) -> bool:
        """False if a withdrawal has removed the temporary file."""
        temporary = self._temporary(data, for_file=final)
        try:
            self._make(final.parent)
            guard()
            step(temporary, final)
        except FileNotFoundError:
            if temporary.exists() and final.parent.is_dir():
                raise
            return False
        finally:
            temporary.unlink(missing_ok=True)
        return True

    def _temporary(self, data: bytes, *, for_file: Path) -> Path:
        temporary = self._new_temporary()
        try:
            with add_filename(str(for_file)), temporary.open("xb") as file:
                os.fchmod(file.fileno(), self._modes()[1])
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        return temporary

    def _new_temporary(self) -> Path:
        """Path of a new temporary file; all of them are in one folder, which a
        withdrawal can empty.
        """
        temporary = inside(self.root, f"{STAGING}/.{uuid.uuid4().hex}.tmp")
        self._make(temporary.parent)
        return temporary

    def _make(self, folder: Path) -> None:
        """Create a folder of the database; a new database is accessible to its owner only."""
        make_private(self.root)
        # not for a folder with other files
        if not {entry.name for entry in os.scandir(self.root)} - {"tmp"}:
            self.root.chmod(PRIVATE)
        make_private(folder, self._modes()[0])

    def _modes(self) -> tuple[int, int]:
        """Permissions of folders and files: those of the root for owner and group, none
        for other users.
        """
        folders = self.root.stat().st_mode & SHARED_MODES
        return folders, folders & 0o660

    def _flush_parents(self, place: Path) -> None:
        """Flush the parent folders of `place`, up to that of the root."""
        for folder in place.parents:
            with suppress(FileNotFoundError):  # removed by a withdrawal
                flush_path(folder)
            if folder == self.root.parent:
                return


def _walk(
    place: str | Path, prefix: str = "", depth: int = MAX_FOLDER_DEPTH
) -> dict[str, tuple[int, ...]]:
    """Identity of every file by its path; (-1,) if it is not a regular file. What is
    removed meanwhile is not listed.
    """
    files: dict[str, tuple[int, ...]] = {}
    entries = _entries(place)
    if entries == [] and prefix:  # zarr creates no empty folders
        files[prefix.rstrip("/")] = (-1,)
    for entry in entries or []:
        name = f"{prefix}{entry.name}"
        if depth and entry.is_dir(follow_symlinks=False):
            files |= _walk(entry.path, f"{name}/", depth - 1)
            continue
        with suppress(FileNotFoundError):
            status = entry.stat(follow_symlinks=False)
            files[name] = (-1,)
            if stat.S_ISREG(status.st_mode):
                files[name] = status.st_size, status.st_mtime_ns, status.st_ino
    return files


def _entries(place: str | Path) -> list[os.DirEntry[str]] | None:
    """Entries of a folder; None if it was removed, for example by a withdrawal."""
    try:
        return list(os.scandir(place))
    except FileNotFoundError:
        return None


def remove_tree(place: Path) -> None:
    """Remove a folder, even if another process still writes or removes files below it."""
    for attempt in reversed(range(MAX_ATTEMPTS)):
        try:
            shutil.rmtree(place)
        except OSError:
            if place.exists() and not attempt:
                raise
        if not place.exists():
            return


def flush_path(path: Path, *, mode: int | None = None) -> None:
    """Flush a file or folder to the disk, and set its permissions if a mode is given."""
    handle = os.open(path, os.O_RDONLY)
    try:
        if mode is not None:
            os.fchmod(handle, mode)
        os.fsync(handle)
    finally:
        os.close(handle)
