"""Verified reading of a version: every block of a file is compared with its committed
digest before it is used.
"""

import asyncio
import hashlib
import math
import re
from collections import Counter
from collections.abc import AsyncIterator, Iterable, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from zarr.abc.store import (
    ByteRequest,
    OffsetByteRequest,
    RangeByteRequest,
    Store,
    SuffixByteRequest,
)
from zarr.core.buffer import Buffer, BufferPrototype

from skindb.errors import Fault, InputError, input_error, require, require_none
from skindb.store.place import BLOCK_BYTES, Digests, Place, block_digests
from skindb.store.record import Record, json_object

CURE = "restore this file from a backup, or compute the version again (ingest --again)"
AS_COMMITTED = "a version must be as it was committed"
CHANGED = "content that differs from what was committed"
DTYPE = r"string|bool|(u?int|float)[0-9]{1,2}"
STRING_BYTES = 16  # per element: a reference
# in memory; samples of 4,096 surfels with 300 lights and 32 cameras have 0.24 GB
MAX_CHUNK_BYTES = 1 << 32
MAX_DIMS = 8


class Committed(NamedTuple):
    """A file as it was committed."""

    size: int  # in bytes
    digests: Digests


Manifest = dict[str, Committed]


def read_manifest(place: Place, record: Record) -> Manifest:
    """Every file of a version as it was committed; `InputError` if the manifest is not
    the committed one.
    """
    content = read_beside(place, record, "manifest", record.manifest)
    try:
        return manifest_from_json(content)
    except (TypeError, ValueError):
        raise input_error(
            place.where(record.beside("manifest")),
            "a manifest must list the size and the digests of every file",
            "that of another release of skindb",
            "compute the version again: skindb ingest --again, then skindb fit --refit",
        ) from None


def manifest_from_json(content: bytes) -> Manifest:
    """The manifest in a file."""
    return {
        name: Committed(size, Digests(whole, tuple(blocks)))
        for name, (size, (whole, blocks)) in json_object(content).items()
    }


def read_beside(place: Place, record: Record, suffix: str, digest: str) -> bytes:
    """Contents of a file beside a version, compared with its digest in the record."""
    key = record.beside(suffix)
    location = place.where(key)
    try:
        text = place.read_small(key)
    except OSError as error:
        finding = error.strerror or "an unreadable file"
        raise input_error(location, AS_COMMITTED, finding, CURE) from None
    is_committed = hashlib.sha256(text).hexdigest() == digest
    require(is_committed, location, AS_COMMITTED, CHANGED, CURE)
    return text


class ListedStore(Store):
    """A zarr store that finds names by listing all of its files."""

    supports_writes = True
    supports_deletes = True
    supports_listing = True

    async def get_partial_values(
        self,
        prototype: BufferPrototype,
        key_ranges: Iterable[tuple[str, ByteRequest | None]],
    ) -> list[Buffer | None]:
        """Contents of several files."""
        return list(
            await asyncio.gather(
                *(self.get(key, prototype, part) for key, part in key_ranges)
            )
        )

    async def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Files whose path begins with `prefix`."""
        async for key in self.list():
            if key.startswith(prefix):
                yield key

    async def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Names directly below `prefix`."""
        start = f"{prefix.rstrip('/')}/" if prefix else ""
        keys = [key async for key in self.list_prefix(start)]
        for name in {key.removeprefix(start).partition("/")[0] for key in keys}:
            yield name


class VerifiedStore(ListedStore):
    """A version as a read-only zarr store; a missing or changed file raises an
    `InputError`, and is never a fill value.

    The manifest alone determines which files exist. Every read is extended to blocks of
    1 MiB, whose digests are compared in memory before a part of them is returned.

    Parameters
    ----------
    place, record
        Location of the database, and record of the version.

    Raises
    ------
    InputError
        If a file is missing or has a different size, before anything is read.
    """

    supports_writes = False
    supports_deletes = False

    def __init__(self, place: Place, record: Record) -> None:
        self.__setstate__((place, record))
        self._require_files()

    @cached_property
    def files(self) -> Manifest:
        """Every file as it was committed."""
        return read_manifest(self.place, self.record)

    @cached_property
    def _chunks(self) -> Counter[str]:
        """Number of chunk files of every array."""
        return Counter(map(array_of, self.files))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, VerifiedStore) and (self.place.name, self.record) == (
            other.place.name,
            other.record,
        )

    __hash__ = object.__hash__

    def __getstate__(self) -> tuple[Place, Record]:
        """Location and record only; another process reads the manifest itself, if it
        reads any values.
        """
        return self.place, self.record

    def __setstate__(self, state: tuple[Place, Record]) -> None:
        super().__init__(read_only=True)
        self.place, self.record = state

    async def get(
        self,
        key: str,
        prototype: BufferPrototype,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        """Contents of a file, or None if the version does not have it."""
        if key not in self.files:
            return None
        return prototype.buffer.from_bytes(
            await asyncio.to_thread(self._bytes, key, byte_range)
        )

    async def exists(self, key: str) -> bool:
        """Whether the version has this file."""
        return key in self.files

    async def set(self, key: str, value: Buffer) -> None:  # noqa: ARG002
        """Raise a `ValueError`, because versions never change."""
        raise ValueError(f"{self.record.path} is committed; a version never changes")

    async def delete(self, key: str) -> None:  # noqa: ARG002
        """Raise a `ValueError`, because versions never change."""
        raise ValueError(f"{self.record.path} is committed; a version never changes")

    async def list(self) -> AsyncIterator[str]:
        """All files."""
        for key in self.files:
            yield key

    def _bytes(self, key: str, byte_range: ByteRequest | None) -> bytes:
        begin, end = (0, None) if byte_range is None else limits(byte_range)
        content = self.read(key, begin, end)
        if key.endswith("zarr.json"):
            self._require_plausible(key, content)
        return content

    def read(self, key: str, begin: int = 0, end: int | None = None) -> bytes:
        """Contents of a file from byte `begin`, counted from its end if negative, up to `end`."""
        size, digests = self.files[key]
        begin = max(begin + size, 0) if begin < 0 else begin
        end = size if end is None else min(end, size)
        if begin >= end:
            return b""
        first = begin // BLOCK_BYTES
        last = -(-end // BLOCK_BYTES)
        start = first * BLOCK_BYTES
        part = (start, min(last * BLOCK_BYTES, size)) if end - begin < size else ()
        try:
            content = self.place.read(f"{self.record.path}/{key}", *part)
        except OSError as error:
            raise self._fault(key, error.strerror or "an unreadable file") from None
        committed = digests.blocks or (digests.whole,)
        if block_digests(content) != [*committed[first:last]]:
            raise self._fault(key, CHANGED)
        return content[begin - start : end - start]

    def _require_plausible(self, key: str, content: bytes) -> None:
        """Raise an `InputError` for metadata that do not match the chunk files."""
        node = key.removesuffix("zarr.json").rstrip("/")
        if finding := metadata_fault(content, node, self._chunks):
            location = self.place.where(f"{self.record.path}/{key}")
            raise input_error(
                location,
                "the metadata of an array must match its files",
                finding,
                "compute the version again",
            )

    def _require_files(self) -> None:
        """Raise an `InputError` with all missing and truncated files, before values are read."""
        sizes = self.place.sizes(self.record.path)
        faults: list[Fault] = []
        for key, file in self.files.items():
            if finding := size_difference(sizes.get(key), file):
                faults += self._fault(key, finding).faults
        require_none(faults)

    def _fault(self, key: str, finding: str) -> InputError:
        return input_error(
            self.place.where(f"{self.record.path}/{key}"),
            AS_COMMITTED,
            finding,
            CURE,
        )


def size_difference(size: int | None, file: Committed) -> str:
    """How a file of this size, see `Place.sizes`, differs from what was committed; empty
    if it does not.
    """
    if size is None:
        return "no file"
    if size < 0:
        return "something that is not a regular file"
    return "" if size == file.size else f"{size} bytes instead of {file.size}"


def limits(byte_range: Any) -> tuple[int, int | None]:
    """Begin and end of a byte range, as arguments of `Place.read`."""
    if isinstance(byte_range, RangeByteRequest):
        return byte_range.start, byte_range.end
    if isinstance(byte_range, OffsetByteRequest):
        return byte_range.offset, None
    assert isinstance(byte_range, SuffixByteRequest)
    return -byte_range.suffix, None


def metadata_fault(content: bytes, node: str, chunks: Mapping[str, int]) -> str:
    """Description of what is wrong with a committed zarr.json; empty if it is valid.

    Parameters
    ----------
    content
        Content of the file, which may hold the metadata of the nodes below it, too.
    node
        Path of its group or array.
    chunks
        Path of an array -> number of its chunk files; skindb writes every chunk,
        including those that contain only zeros.
    """
    try:
        meta = json_object(content)
        below = meta.get("consolidated_metadata", {"metadata": {}})["metadata"]
        nodes = {
            node: meta,
            **{f"{node}/{name}": value for name, value in below.items()},
        }
        faults = (
            _node_fault(one, chunks[path.strip("/")]) for path, one in nodes.items()
        )
        return next(filter(None, faults), "")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        return f"invalid metadata ({type(error).__name__}: {error})"


def _node_fault(meta: dict[str, Any], chunks: int) -> str:
    """What is wrong with the metadata of a group, or of an array with so many chunk files."""
    if meta.get("node_type") != "array":
        return ""
    dtype = meta["data_type"]
    if not isinstance(dtype, str) or not re.fullmatch(DTYPE, dtype):
        return f"elements of the type {str(dtype)[:80]}"
    item_bytes = STRING_BYTES if dtype == "string" else np.dtype(dtype).itemsize
    shape = _lengths(meta["shape"])
    chunk = _lengths(meta["chunk_grid"]["configuration"]["chunk_shape"])
    if len(shape) != len(chunk) or len(shape) > MAX_DIMS or 0 in chunk:
        return f"a shape {list(shape)} with chunks {list(chunk)}"
    if (size := math.prod(chunk) * item_bytes) > MAX_CHUNK_BYTES:
        return f"chunks of {size:.3g} bytes, more than the maximum of {MAX_CHUNK_BYTES:.3g}"
    promised = math.prod(
        -(-length // part) for length, part in zip(shape, chunk, strict=True)
    )
    if promised != chunks:
        return f"a shape {list(shape)} with {promised} chunks, but {chunks} chunk files"
    return ""


def _lengths(value: object) -> tuple[int, ...]:
    if not isinstance(value, list) or not all(
        isinstance(length, int) and length >= 0 for length in value
    ):
        raise ValueError("a shape must be a list of non-negative integers")
    return tuple(value)


def array_of(key: str) -> str:
    """Path of the array to which a chunk file belongs; empty for other files."""
    match = re.fullmatch(r"(.+)/c(/[0-9]+)*", key)
    return match[1] if match else ""
