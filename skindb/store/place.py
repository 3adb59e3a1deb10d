"""What a location of a database is, a local folder or a bucket, both of which store bytes
under keys: relative paths with "/" as the separator, which never lead outside.

A key that does raises an `InputError`, a missing file a `FileNotFoundError`, and a file
that cannot be read an `OSError`; both have a readable `strerror`.

The guard of a file to be written is called in the last step before the file exists. In a
bucket it is called again afterwards: if it raises then, a replaced file is removed, and
the caller must remove a created one.
"""

import hashlib
import os
import re
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias, TypeVar

from skindb.errors import Fault, InputError, input_error

if TYPE_CHECKING:
    from skindb.store.bucket import Bucket
    from skindb.store.folder import Folder

T = TypeVar("T")
R = TypeVar("R")
# two with the same name are the same; if it is unlocked, this process may work on a backup,
# or on a database that is being restored, see `markers.LOCKS`
Place: TypeAlias = "Bucket | Folder"
STUDY = "population"  # results of a study of many takes
RELEASE = "release"  # one version of every take under a name
CALIBRATION = "calibration"  # of the lights of a dome
# tables, samples or maps of a take with other parameters than those of its model
SUMMARY = "summary"
# whose takes are names of studies, releases and calibrations
KINDS_WITHOUT_SUBJECT = (STUDY, RELEASE, CALIBRATION)
# kinds that hold data of their own subject only; an input of them is of that subject,
# or a product that many share
KINDS_OF_ONE_SUBJECT = ("capture", "model", "consent")
# of a take, see `skindb.schema.cohort.take_name`, a study, a release or a calibration
TAKE = r"[A-Za-z0-9_-]{1,64}(\.[A-Za-z0-9_-]{1,64}(\.[1-9][0-9]{0,3}){0,2})?"
KIND = r"[a-z]{1,32}"
GROUP = r"[a-z_]{1,32}"
# start of the names of a version and of the files beside it
TIME_HEX = r"[0-9]{8}T[0-9]{6}-[0-9a-f]{8}"
STAGING = "staging"  # folder for temporary files of writers
AUDIT = "audit"  # folder of the audit log
VERSION = rf"data/{KIND}/{TAKE}/{TIME_HEX}\.zarr"
Guard = Callable[[], None]  # raises if a file must not be written any more
# that read small files; a bucket takes some 20 ms per file, whatever its size
READER_THREADS = 32
BLOCK_BYTES = 1 << 20  # of a file, the smallest part that is compared with a digest


class Digests(NamedTuple):
    """SHA-256 digests of a file, and of each of its blocks if there are several."""

    whole: str
    blocks: tuple[str, ...] = ()


def unguarded() -> None:
    """The guard of files that may always be written."""


def digests_of(parts: Iterable[bytes]) -> Digests:
    """Digests of the contents that these parts are together."""
    whole = hashlib.sha256()
    blocks = []
    rest = bytearray()
    for part in parts:
        whole.update(part)
        rest += part
        complete = len(rest) // BLOCK_BYTES * BLOCK_BYTES
        blocks += block_digests(rest[:complete])
        del rest[:complete]
    blocks += block_digests(rest)
    return Digests(whole.hexdigest(), tuple(blocks) if len(blocks) > 1 else ())


def block_digests(content: bytes | bytearray) -> list[str]:
    """SHA-256 digest of each block."""
    view = memoryview(content)
    starts = range(0, len(view), BLOCK_BYTES)
    return [
        hashlib.sha256(view[start : start + BLOCK_BYTES]).hexdigest()
        for start in starts
    ]


def in_parallel(
    function: Callable[[T], R], values: Iterable[T], threads: int = READER_THREADS
) -> list[R]:
    """Results of a function that reads files, in the order of the values."""
    with ThreadPoolExecutor(threads) as pool:
        # an error cancels the calls that wait: if a bucket does not answer one request,
        # it does not answer the others
        return list(pool.map(function, values))


def subject_of(take: str) -> str:
    """The subject of a take, the first part of its name."""
    return take.partition(".")[0]


def require_text(value: str, pattern: str, label: str) -> str:
    """Return `value` if it matches the whole pattern; otherwise raise an `InputError`."""
    if not isinstance(value, str) or not re.fullmatch(pattern, value):
        raise input_error(
            label, f"must match {pattern}", repr(value)[:200], "choose another name"
        )
    return value


def require_parts(root: Path | str, key: str) -> list[str]:
    """Names along a key; `InputError` if it leads outside the database at `root`."""
    parts = key.split("/")
    if any(part in ("", ".", "..") or "\0" in part or "\\" in part for part in parts):
        raise InputError(_outside_fault(root, key, "a path that leaves it"))
    return parts


def inside(root: Path, key: str) -> Path:
    """The path of a key below `root`.

    Parameters
    ----------
    root
        Folder of the database, which may itself be a symbolic link.
    key
        Relative path with "/" as the separator.

    Raises
    ------
    InputError
        If the key is empty or absolute, contains "..", or passes through a symbolic link.
    """
    parts = require_parts(root, key)
    # as text: `Path` takes four times as long, and a table of 1,000 takes needs 16,000
    # paths
    place = os.fspath(root)
    for number, part in enumerate(parts, 1):
        place = f"{place}/{part}"
        if os.path.islink(place):  # noqa: PTH114
            raise InputError(
                _outside_fault(
                    root, key, f"a symbolic link at {'/'.join(parts[:number])}"
                )
            )
    return Path(place)


def _outside_fault(root: Path | str, key: str, finding: str) -> Fault:
    return Fault(
        f"{root}: {key[:200]!r}",
        "every path must stay inside the database",
        finding,
        "restore the file that names this path from a backup",
    )


class Located(Protocol):
    """Something with a location, such as a database."""

    @property
    def place(self) -> Place:
        """Its location."""
