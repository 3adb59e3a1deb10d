"""An S3 bucket as the location of a database: one object for each file.

An object is written in one request, so that it is either complete or absent. The many
small zarr.json files of a version, each of which zarr changes several times, are written
when it is committed.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import os
import stat
import tempfile
import time
import uuid
from collections.abc import AsyncIterator, Callable, Hashable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype

from skindb.errors import InputError, UnavailableError, input_error, require
from skindb.files import Json, cache_folder, make_private
from skindb.limits import MAX_STORE_JSON_BYTES
from skindb.store.folder import Folder
from skindb.store.place import (
    Digests,
    Guard,
    Place,
    digests_of,
    in_parallel,
    require_parts,
    unguarded,
)
from skindb.store.s3 import (
    RETRY_TIMEOUT,
    BrokenAnswerError,
    DeniedError,
    bucket_and_prefix,
    connect,
    endpoint,
    readable_errors,
)
from skindb.store.verified import ListedStore, limits

T = TypeVar("T")
# before a request is repeated whose answer was lost and that obstore does not repeat
PAUSES_S = (0.2, 1.0, 5.0)
METADATA = "zarr.json"
FETCH_BYTES = 1 << 23  # read at a time while a digest is computed


class Bucket:
    """A bucket or a prefix of it; see `place`. Credentials are neither stored in
    the object nor pickled.

    Parameters
    ----------
    url
        ``s3://bucket/prefix`` of an existing bucket.
    """

    def __init__(self, url: str) -> None:
        bucket, prefix = bucket_and_prefix(url)
        self.name = f"s3://{bucket}/{prefix}".rstrip("/")
        self._store = connect(bucket, prefix)
        self.is_unlocked = False
        # whether the server is known to refuse to overwrite
        self._is_conditional = False
        self._pending: dict[str, bytes] = {}  # metadata that are not written yet
        # key -> digests and entity tag of an object that this process wrote
        self._written: dict[str, tuple[Digests, str]] = {}

    def __repr__(self) -> str:
        return f"Bucket({self.name!r})"

    def __reduce__(self) -> tuple[type[Bucket], tuple[str]]:
        return Bucket, (self.name,)

    def writable(self, key: str) -> Store:
        """A zarr store at a key, written by this process only; `digests` does not read
        again what was written to it.
        """
        return BucketStore(self, self._path(key))

    def scratch(self) -> Path:
        """A folder of this user in the cache, or in the folder for temporary files if
        there is no cache.
        """
        base = cache_folder() or Path(tempfile.gettempdir()) / f"skindb-{os.getuid()}"
        folder = base / "buckets" / self._address_digest()[:24]
        make_private(folder)
        status = folder.lstat()
        if (
            not stat.S_ISDIR(status.st_mode)
            or status.st_uid != os.getuid()
            or status.st_mode & 0o077
        ):
            raise input_error(
                str(folder),
                "must be a folder of this user with permissions 0700",
                f"a different owner, or permissions {status.st_mode & 0o777:04o}",
                "remove it, or set SKINDB_CACHE",
            )
        return folder

    def marker_file(self) -> Path:
        """A file in the data folder of this user (XDG_DATA_HOME), named after the bucket."""
        folder = Path(
            os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
        )
        name = self.name.removeprefix("s3://").replace("/", "-")
        return folder / "skindb" / f"{name}-{self._address_digest()[:8]}.markers"

    def _address_digest(self) -> str:
        """Digest by which buckets of the same name at different servers differ."""
        return hashlib.sha256(f"{endpoint()} {self.name}".encode()).hexdigest()

    def address(self) -> str:
        """URL by which another process finds the place."""
        return self.name

    def url(self, key: str) -> str:
        """Address of a key as shown to users."""
        return self.where(self._path(key))

    def where(self, key: str) -> str:
        """Name of a key in messages; the key may contain any characters."""
        return f"{self.name}/{key}"

    def names(self) -> list[str] | None:
        """Names at the top level; None if there are no objects below the prefix."""
        return self._names_below("") or None

    # a bucket has no links
    def children(self, key: str, *, links: bool = False) -> list[str]:  # noqa: ARG002
        """Names directly below a key, sorted; empty if there are none."""
        return self._names_below(self._path(key))

    def file_type(self, key: str) -> str:
        """Type of a key: "file" for an object, "folder" if there are objects below it;
        empty if it does not exist.
        """
        try:
            self._ask(key, lambda: self._store.head(self._path(key)))
        except FileNotFoundError:
            return (
                "folder"
                if self._ask(key, lambda: next(iter(self._store.list(key)), []))
                else ""
            )
        return "file"

    def sizes(self, key: str) -> dict[str, int]:
        """Size in bytes of every object below a key, by its path relative to the key."""
        return {path: meta["size"] for path, meta in self._objects(key).items()}

    def read(self, key: str, begin: int = 0, end: int | None = None) -> bytes:
        """Contents of an object from byte `begin`, counted from its end if negative, up
        to `end`.
        """
        path = self._path(key)
        if path in self._pending and not begin and end is None:
            return self._pending[path]
        if end is not None and end <= begin:
            return b""
        options: Any = {}
        if end is not None:
            options = {"range": (begin, end)}
        elif begin:
            options = {"range": {"offset": begin} if begin > 0 else {"suffix": -begin}}
        return self._ask(
            key, lambda: bytes(self._store.get(path, options=options).bytes())
        )

    def read_small(self, key: str) -> bytes:
        """Contents of a JSON object, whose size is limited."""
        path = self._path(key)

        def fetch() -> bytes:
            finding = self._store.get(path)
            if finding.meta["size"] > MAX_STORE_JSON_BYTES:
                raise OSError(
                    errno.EFBIG,
                    f"{finding.meta['size'] / 1e6:,.1f} MB",
                    self.where(key),
                )
            return bytes(finding.bytes())

        return self._ask(key, fetch)

    def digests(self, key: str) -> Digests:
        """Digests of an object, or of the content that this process has just
        written; see `make_durable`.
        """
        path = self._path(key)
        if (written := self._written.pop(path, None)) is not None:
            return written[0]

        def fetch() -> Digests:
            return digests_of(self._store.get(path).stream(min_chunk_size=FETCH_BYTES))

        return self._ask(key, fetch)

    def identities(self, key: str) -> dict[str, tuple[Hashable, ...]]:
        """The identity of every object below a key, by its path relative to the key."""
        return {
            path: (meta["size"], meta["e_tag"], meta["last_modified"])
            for path, meta in self._objects(key).items()
        }

    def modified(self, key: str) -> float:
        """Time in seconds, by the clock of the bucket, when an object or the newest
        object below a key was written.
        """
        path = self._path(key)
        try:
            metas = [self._ask(key, lambda: self._store.head(path))]
        except FileNotFoundError:
            metas = [*self._objects(key).values()]
            if not metas:
                raise
        return float(max(meta["last_modified"] for meta in metas).timestamp())

    def now(self) -> float:
        """Time of the clock of the bucket in whole seconds, from an object that is
        written and removed again.
        """
        key = f"leases/now/{uuid.uuid4().hex}"
        self._put(key, b"")
        try:
            return self.modified(key)
        finally:
            self.remove(key)

    def make_durable(self, key: str) -> None:
        """Write pending metadata, and check that every object is stored as it was acknowledged."""
        names = [f"{key}/{name}" for name in self.pending(key)]
        in_parallel(lambda name: self.write(name, self._pending.pop(name)), names)
        stored = self._objects(key)
        for path, (_, tag) in list(self._written.items()):
            if path.startswith(f"{key}/"):
                meta = stored.get(path.removeprefix(f"{key}/"))
                if meta is None or meta["e_tag"] != tag:
                    finding = (
                        "a different object than was written"
                        if meta
                        else "no object where one was written"
                    )
                    raise OSError(errno.EIO, finding, self.where(path))

    def create(self, key: str, data: bytes, *, guard: Guard = unguarded) -> bool:
        """Write an object that must not exist yet; returns False and writes nothing if it exists.

        A guard is called before and after; if it raises the second time, the caller
        must remove the object.
        """
        guard()
        created = self._create(key, data)
        if created:
            guard()
        return created

    def _create(self, key: str, data: bytes) -> bool:
        """Write an object that must not exist yet.

        If an answer was lost, the object was created if it has exactly this content. No
        other writer may therefore write the same content under this key, as is the case
        for a record.
        """
        path = self._path(key)
        lost = None
        for pause_s in PAUSES_S:
            try:
                if self._put_new(path, data):
                    self._require_conditional(path, data)
                    return True
                # another writer was faster, or the request was repeated after its
                # answer was lost
                lost = None
            except DeniedError:
                raise
            except UnavailableError as error:
                lost = error
            try:
                return self.read(key) == data
            except FileNotFoundError:
                # the request did not arrive, or the object was removed again
                time.sleep(pause_s)
        raise lost or OSError(
            errno.EAGAIN,
            "an object that is repeatedly created and removed",
            self.where(key),
        )

    def replace(self, key: str, data: bytes, *, guard: Guard = unguarded) -> None:
        """Write or replace a small object; it is removed if the guard raises after it
        was written.
        """
        guard()
        self._put(self._path(key), data)
        try:
            guard()
        except UnavailableError:
            raise
        except InputError:
            self.remove(key)
            raise

    def sweep(self) -> None:
        """Nothing: writers call their guards again after an object was written."""

    def remove(self, key: str) -> None:
        """Delete an object or all objects below a key, if there are any."""
        path = self._path(key)
        # listed again after a lost answer, so that no deletion of a missing object is requested
        self._ask(
            key,
            lambda: self._store.delete(
                [path, *(f"{path}/{name}" for name in self._objects(key))]
            ),
        )
        for cache in (self._pending, self._written):
            for name in [
                name
                for name in list(cache)
                if name == path or name.startswith(f"{path}/")
            ]:
                cache.pop(name)

    def has_written(self, key: str) -> bool:
        """Whether this process wrote an object at this key that is not committed yet."""
        return key in self._pending or key in self._written

    def pending(self, key: str) -> list[str]:
        """Paths, relative to a key, of the objects that `write_later` keeps below it."""
        return [
            path.removeprefix(f"{key}/")
            for path in list(self._pending)
            if path.startswith(f"{key}/")
        ]

    def write_later(self, key: str, data: bytes) -> None:
        """Keep an object in memory until `make_durable` writes it."""
        self._pending[self._path(key)] = data

    def write(self, key: str, data: bytes) -> None:
        """Write an object, and keep its digests for `digests`."""
        path = self._path(key)
        tag = self._put(path, data)
        self._written[path] = digests_of([data]), tag

    def _put_new(self, path: str, data: bytes) -> bool:
        """Write an object by a conditional put; False if one exists."""
        from obstore.exceptions import AlreadyExistsError

        try:
            with readable_errors(self.where(path)):
                self._store.put(path, data, mode="create")
        except AlreadyExistsError:
            return False
        return True

    def _require_conditional(self, path: str, data: bytes) -> None:
        """Raise an `InputError` if the server ignores the condition, so that a
        concurrent commit could be lost.

        Checked once, by writing again an object that was just created; the first object
        of a commit is a manifest, not a record.
        """
        with suppress(UnavailableError):  # checked with the next object
            require(
                self._is_conditional or not self._put_new(path, data),
                self.name,
                "the server must support conditional put (If-None-Match)",
                "a server that overwrites objects",
                "use another server, or a newer version of it",
            )
            self._is_conditional = True

    def _put(self, path: str, data: bytes) -> str:
        """Write an object of any size in one request; returns its entity tag."""
        return self._ask(
            path,
            lambda: self._store.put(path, data, use_multipart=False)["e_tag"] or "",
        )

    def _objects(self, key: str) -> Json:
        """Metadata of every object below a key, by its path relative to the key."""
        path = self._path(key)
        listing = self._ask(
            key, lambda: [meta for page in self._store.list(path) for meta in page]
        )
        return {
            meta["path"].removeprefix(f"{path}/"): meta
            for meta in listing
            if meta["path"] != path
        }

    def _names_below(self, path: str) -> list[str]:
        listing = self._ask(path, lambda: self._store.list_with_delimiter(path or None))
        paths = {
            *listing["common_prefixes"],
            *(meta["path"] for meta in listing["objects"]),
        } - {path, ""}
        return sorted(entry.rsplit("/", 1)[-1] for entry in paths)

    def _ask(self, key: str, request: Callable[[], T]) -> T:
        """Answer to a request, which is repeated if its answer was incomplete and
        obstore did not repeat it.
        """
        end = time.monotonic() + RETRY_TIMEOUT.total_seconds()
        for pause_s in PAUSES_S:
            try:
                with readable_errors(self.where(key)):
                    return request()
            except BrokenAnswerError:
                if time.monotonic() > end:
                    raise
            time.sleep(pause_s)
        with readable_errors(self.where(key)):
            return request()

    def _path(self, key: str) -> str:
        """The key; `InputError` if it leads outside the prefix."""
        require_parts(self.name, key)
        return key


class BucketStore(ListedStore):
    """A version that is being written, as a zarr store; which objects exist is known
    without requests.

    Parameters
    ----------
    bucket, key
        Location of the version.
    """

    def __init__(self, bucket: Bucket, key: str) -> None:
        super().__init__(read_only=False)
        self.bucket = bucket
        self.key = key

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BucketStore) and (self.bucket.name, self.key) == (
            other.bucket.name,
            other.key,
        )

    __hash__ = object.__hash__

    async def get(
        self,
        key: str,
        prototype: BufferPrototype,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        """Contents of an object, or None if it does not exist."""
        if not await self.exists(key):
            return None
        part = (0, None) if byte_range is None else limits(byte_range)
        try:
            return prototype.buffer.from_bytes(
                await asyncio.to_thread(self.bucket.read, self._of(key), *part)
            )
        except FileNotFoundError:
            return None

    async def exists(self, key: str) -> bool:
        """Whether an object exists."""
        return self.bucket.has_written(self._of(key))

    async def set(self, key: str, value: Buffer) -> None:
        """Write an object, or keep it until the commit if it is metadata."""
        if key.endswith(METADATA):
            self.bucket.write_later(self._of(key), value.to_bytes())
            return
        await asyncio.to_thread(self.bucket.write, self._of(key), value.to_bytes())

    async def delete(self, key: str) -> None:
        """Delete an object."""
        await asyncio.to_thread(self.bucket.remove, self._of(key))

    async def list(self) -> AsyncIterator[str]:
        """All objects."""
        for name in await asyncio.to_thread(self.bucket.sizes, self.key):
            yield name
        for name in self.bucket.pending(self.key):
            yield name

    def _of(self, key: str) -> str:
        return f"{self.key}/{key}" if key else self.key


def place_at(url: str) -> Place:
    """The folder or bucket of a URL; `InputError` for other URLs and for files."""
    if url.startswith("s3://"):
        return Bucket(url)
    if "://" in url:
        scheme = url.partition("://")[0]
        raise input_error(
            f"{scheme}://...",
            "a database must be a local folder or an S3 bucket",
            "a different URL",
            "give a folder, or s3://BUCKET/PREFIX",
        )
    require(
        not Path(url).exists() or Path(url).is_dir(),  # another process may create it
        url,
        "a database must be a folder",
        "a file",
        "choose another folder",
    )
    return Folder(Path(url))
