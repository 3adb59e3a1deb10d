"""A version that is being written: invisible until its record is in the log."""

from __future__ import annotations

import hashlib
import re
import shutil
import uuid
import warnings
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import xarray as xr
import zarr
from zarr.codecs import BloscCodec, TransposeCodec

from skindb import __version__
from skindb.errors import Fault, InputError
from skindb.schema import GROUPS, SCHEMA_VERSION, check
from skindb.store.log import Log, Record, sync

CHUNK, SHARD = 256, 4096  # surfels: the unit of reading and of writing
CODEC = BloscCodec(cname="zstd", clevel=3, shuffle="shuffle")


class Stage:
    """Use as a context manager; leaving it without `commit` removes what was written."""

    def __init__(self, root: Path, kind: str, take: str) -> None:
        self.root, self.log = root, Log(root, kind, take)
        now = datetime.now(UTC)
        self.created = now.isoformat(timespec="seconds")
        self.path = f"data/{kind}/{take}/{now:%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:8]}.zarr"
        self.base = max(self.log.generations(), default=0)
        self.committed = False

    @property
    def folder(self) -> Path:
        """Where the version is written."""
        return self.root / self.path

    def __enter__(self) -> Self:
        self.folder.mkdir(parents=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self.committed:
            shutil.rmtree(self.folder, ignore_errors=True)

    def write(self, groups: Mapping[str, xr.Dataset]) -> None:
        """Write groups that fit the schema; lazy ones are computed shard by shard."""
        for name, ds in groups.items():
            known = [v.name for v in GROUPS.get(name, ()) if v.name in ds]
            check(ds, known, where=name)
            ready = _whole_shards(ds)
            encoding = {str(v): _encoding(ready[v]) for v in ready.variables}
            with warnings.catch_warnings():
                # variable-length text has no zarr v3 specification yet; xarray and zarr read it, see docs
                warnings.filterwarnings("ignore", message=".*does not have a Zarr V3 specification.*")
                ready.to_zarr(self.folder, group=name, mode="a", encoding=encoding, zarr_format=3, consolidated=False)

    def put(self, group: str, name: str, start: int, values: np.ndarray[Any, Any]) -> None:
        """Write whole shards of a variable that `write` has laid out, from surfel `start`."""
        array = zarr.open_array(self.folder, path=f"{group}/{name}", mode="r+")
        if start % SHARD or (len(values) % SHARD and start + len(values) != array.shape[0]):
            raise ValueError(f"regions must be whole shards of {SHARD} surfels; found {start} + {len(values)}")
        array[start : start + len(values)] = values

    def commit(self, provenance: Mapping[str, Any]) -> Record:
        """Make the version durable and current; `Conflict` if another writer was faster."""
        attrs = {"schema_version": SCHEMA_VERSION, "software_version": __version__, **provenance}
        zarr.open_group(self.folder, mode="a").attrs.update(attrs)
        files = {}
        for file in files_of(self.folder):
            sync(file)
            files[file.relative_to(self.folder).as_posix()] = digest(file)
        for folder in (*self.folder.rglob("*/"), self.folder, *list(self.folder.parents)[: len(Path(self.path).parts)]):
            sync(folder)
        size = sum(file.stat().st_size for file in files_of(self.folder))
        record = Record(
            self.log.kind, self.log.take, self.base + 1, self.path, self.created, size, files, dict(attrs)
        )  # fmt: skip
        self.log.create(record)
        self.committed = True
        return record


def files_of(folder: Path) -> Iterator[Path]:
    """Every file below a folder, in a fixed order."""
    return iter(sorted(p for p in folder.rglob("*") if p.is_file()))


def digest(file: Path) -> str:
    """sha256 of a file."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _whole_shards(ds: xr.Dataset) -> xr.Dataset:
    """Dask blocks become shards: two tasks in one shard would lose data."""
    ds = ds.copy()
    for name, variable in ds.variables.items():
        variable.encoding.clear()
        if variable.chunks is not None:
            sizes = {dim: SHARD if dim == "surfel" else -1 for dim in variable.dims}
            ds[name] = ds[name].chunk(sizes)
    return ds


def _encoding(array: xr.DataArray) -> dict[str, Any]:
    if array.dtype.kind not in "fiub" or array.ndim == 0 or array.size == 0:
        return {}
    # missing values are NaN or a status: no fill value that a reader would mask
    plain: dict[str, Any] = {"compressors": [CODEC], "_FillValue": None}
    if array.dims[0] != "surfel":
        return plain
    rest = array.shape[1:]
    # a shard larger than the array would be allocated whole: small takes get one of their own size
    chunk = min(CHUNK, array.shape[0])
    shard = min(SHARD, -(-array.shape[0] // chunk) * chunk)
    plain |= {"chunks": (chunk, *rest), "shards": (shard, *rest)}
    if array.ndim == 4:  # samples: neighbouring surfels side by side compress best
        plain["filters"] = [TransposeCodec(order=(1, 2, 3, 0))]
    return plain


def require_text(value: str, pattern: str, what: str) -> str:
    """`value` if all of it fits the pattern, else an `InputError`: names become paths."""
    if not re.fullmatch(pattern, value):
        raise InputError(Fault(what, f"must fit {pattern}", repr(value), "choose another name"))
    return value
