"""Stages: versions that are being written, which are invisible until their record is in the log."""

import hashlib
import json
import math
import threading
import uuid
import warnings
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, Self

import numpy as np
import zarr
from xarray import DataArray, Dataset, Variable
from zarr.codecs import BloscCodec

from skindb import __version__
from skindb.errors import (
    Fault,
    InputError,
    UnavailableError,
    add_filename,
    require,
    require_none,
)
from skindb.files import Attributes, Json, plain
from skindb.schema import SCHEMA_VERSION, VARIABLES, check, dataset
from skindb.schema.label import BLOCK_SURFELS
from skindb.store.inputs import (
    names_of,
    require_consents,
    require_inputs,
    require_own_subject,
)
from skindb.store.lease import Lease
from skindb.store.log import Log, remove_version
from skindb.store.markers import WithdrawalGuard, read_markers, require_secret
from skindb.store.place import (
    GROUP,
    KINDS_OF_ONE_SUBJECT,
    TAKE,
    Place,
    in_parallel,
    require_text,
)
from skindb.store.record import (
    Record,
    intact_or_none,
    json_object,
    own_takes,
    subjects_of,
)
from skindb.store.verified import Committed, Manifest, read_beside
from skindb.types import AnyArray

MIN_CHUNK_SURFELS = 256  # in a chunk, the smallest unit of reading
MIN_CHUNK_BYTES = 1 << 19  # a smaller chunk gets more surfels
# level 2 with the default block size of Blosc takes 1.7 times as long to write, 1.4
# times to read, and 6 % more space
CODEC = BloscCodec(cname="zstd", clevel=1, shuffle="shuffle", blocksize=1 << 20)
# of an object before compression, except that it has at least a block of surfels: the
# samples of 16 cameras x 150 lights have 59 MB a block, and 16 MB compressed
MAX_OBJECT_BYTES = 1 << 24
MAX_UNSHARDED_BYTES = 1 << 26  # larger arrays are written shard by shard
TABLES = "tables"
NAMES = "names"  # file beside a version with the takes that it refers to
MAX_LABELS = 1000  # labels of longer dims are not listed in a record
_WITHOUT_WARNINGS = threading.Lock()  # threads share the filters of warnings


class Stage:
    """A version to be written, as a context manager; without `commit`, what was written
    is removed at its end.

    Parameters
    ----------
    place, kind, take
        Location of the database, kind and take of the version.
    lease
        Lease under which it is written, if there is one.
    names
        Other takes that the version will refer to. They are written beside the version
        before its data, so that a withdrawal removes the data of a killed run if, and
        only if, they may contain data of the subject.

    Raises
    ------
    WithdrawnError
        If the subject of the take, or one of those that it names, is withdrawn.
    """

    def __init__(
        self,
        place: Place,
        kind: str,
        take: str,
        lease: Lease | None = None,
        names: Iterable[str] = (),
    ) -> None:
        self.place = place
        self.log = Log(place, kind, take)
        self.lease = lease
        named = {require_text(name, TAKE, "take") for name in names}
        require_own_subject(kind, take, named)
        self.names = sorted(named - own_takes(kind, take))
        subjects = frozenset(subjects_of(kind, take, self.names))
        self._guard = WithdrawalGuard(place, subjects)
        self._guard()
        now = datetime.now(UTC)
        self.created = now.isoformat(timespec="seconds")
        self.path = (
            f"data/{kind}/{take}/{now:%Y%m%dT%H%M%S}-{uuid.uuid4().hex[:8]}.zarr"
        )
        # finds a damaged record before the work
        self.base = 0
        self.previous = ""
        if self.log.is_empty():
            require_secret(place)
        else:
            current = self.log.read()
            self.base = current.generation
            self.previous = current.seal
        self.committed = False
        self._is_declared = kind in KINDS_OF_ONE_SUBJECT
        self.contents: Json = {}
        self.groups: set[str] = set()
        self.tables: Dataset | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if isinstance(error, UnavailableError):
            return  # it is unknown whether the record was written
        # the log decides, because an interrupt may come between the creation of the
        # record and the end of `commit`
        if not self.committed and not self._in_log():
            # what cannot be removed is garbage, and `error` says more
            with suppress(OSError):
                self._discard()
        if isinstance(error, OSError):
            # raises if a withdrawal has removed what could not be written
            self._guard()

    def write(
        self, groups: Mapping[str, Dataset], *, tables: Dataset | None = None
    ) -> None:
        """Write groups whose variables are all declared in the schema; lazy variables
        are computed shard by shard.

        Parameters
        ----------
        groups
            Name of a group -> Dataset.
        tables
            A small Dataset that cohorts read without opening the version, stored as JSON beside it.

        Raises
        ------
        InputError
            With all faults of all groups, before anything is written.
        """
        self._require_open()
        datasets = dict(groups) | ({} if tables is None else {TABLES: tables})
        faults = [fault for name, ds in datasets.items() for fault in _faults(name, ds)]
        require_none(faults)
        labels = {
            str(take)
            for ds in datasets.values()
            if "take" in ds.coords
            for take in np.atleast_1d(ds["take"].values)
        }
        self._require_named(labels)
        self._declare()
        self.tables = self.tables if tables is None else tables
        self.contents |= {name: describe(ds) for name, ds in datasets.items()}
        self.groups |= groups.keys()
        for name, ds in groups.items():
            ready = _whole_shards(ds).assign_attrs(plain(ds.attrs))
            encoding = {str(v): _encoding(ready[v]) for v in ready.variables}
            # the search for empty chunks would take as long as their compression
            with zarr.config.set({"array.write_empty_chunks": True}):
                store = self.place.writable(self.path)
                with add_filename(self.place.where(self.path)):
                    ready.to_zarr(
                        store,
                        group=name,
                        mode="a",
                        encoding=encoding,
                        zarr_format=3,
                        consolidated=False,
                    )

    def commit(self, provenance: Attributes) -> Record:
        """Make the version durable and current.

        Raises
        ------
        Conflict
            If another writer was faster.
        LeaseLost
            If the stage has a lease, and another run took it over.
        InputError
            If an input in the provenance was removed meanwhile, if a subject was
            withdrawn, if the consent of a subject no longer covers the result, or if
            the result refers to takes that were not named when it was begun.
        """
        self._require_open()
        self._guard()
        names = self._require_names(provenance)
        self._declare()
        attrs = {
            "schema_version": SCHEMA_VERSION,
            "software_version": __version__,
            **plain(dict(provenance)),
        }
        with add_filename(self.place.where(self.path)):
            self._write_metadata(attrs)
            self.place.make_durable(self.path)  # the data first, then the record
        files = self._written_files()
        record = Record(
            kind=self.log.kind,
            take=self.log.take,
            generation=self.base + 1,
            path=self.path,
            created=self.created,
            bytes=sum(file.size for file in files.values()),
            provenance=attrs,
            names=tuple(names),
            contents=self.contents,
            previous=self.previous,
        )
        manifest = self._create_beside(record, "manifest", files)
        tables = ""
        if self.tables is not None:
            tables = self._create_beside(record, TABLES, tables_to_json(self.tables))
        require_consents(self.place, self.log.kind, self.log.take, attrs)
        if self.lease is not None:
            # as late as possible, because a process can be suspended at any time
            self.lease.require()
        record = self.log.create(
            replace(record, manifest=manifest, tables=tables), self._guard
        )
        self.committed = True
        return record

    def _write_metadata(self, attrs: Json) -> None:
        """Write the metadata of the root and of each group with those of all nodes below
        it, so that a reader opens it by one file.
        """
        store = self.place.writable(self.path)
        root = zarr.open_group(store, mode="a", zarr_format=3)
        root.attrs.put(attrs)
        # that format 3 does not specify them yet
        with _WITHOUT_WARNINGS, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for group in (*sorted(self.groups), ""):
                with suppress(FileNotFoundError):  # `_written_files` reports it
                    zarr.consolidate_metadata(store, path=group, zarr_format=3)

    def _written_files(self) -> Manifest:
        """Size and digests of every file, with those of all groups that were written."""
        sizes = self.place.sizes(self.path)
        groups = sorted(self.groups)
        gone = [name for name in groups if f"{name}/zarr.json" not in sizes]
        require(
            not gone,
            self.log.what,
            "all groups of a version must exist when it is committed",
            f"that another process removed {', '.join(gone)}",
            "run the command again",
        )
        files = {name: size for name, size in sorted(sizes.items()) if size >= 0}
        digests = in_parallel(
            lambda name: self.place.digests(f"{self.path}/{name}"), files
        )
        return dict(zip(files, map(Committed, files.values(), digests), strict=True))

    def _require_names(self, provenance: Attributes) -> list[str]:
        """The other takes that the version refers to, which must have been named when
        it was begun.
        """
        inputs = require_inputs(self.place, provenance)
        names = names_of(self.log.kind, self.log.take, provenance, inputs)
        self._require_named(names)
        return sorted(names.union(self.names))

    def _require_named(self, takes: Iterable[str]) -> None:
        """Raise an `InputError` for takes that were not named when the version was begun."""
        kind = self.log.kind
        take = self.log.take
        unnamed = sorted({*takes} - {*self.names} - own_takes(kind, take))
        require(
            not unnamed or kind in KINDS_OF_ONE_SUBJECT,
            self.log.what,
            "a version must name the takes that it refers to before it is written",
            f"no {', '.join(unnamed[:8])}",
            f"call db.stage({kind!r}, {take!r}, names=[...])",
        )

    def _declare(self) -> None:
        """Write which takes the version refers to, before anything else."""
        if not self._is_declared:
            key = f"{self.path.removesuffix('.zarr')}.{NAMES}.json"
            content = json.dumps({"names": self.names}).encode()
            self.place.create(key, content, guard=self._guard)
            self._is_declared = True

    def _discard(self) -> None:
        """Remove what was written; of a withdrawn subject also the folder, whose name
        is the pseudonym.
        """
        remove_version(self.place, self.path)
        kind = self.log.kind
        take = self.log.take
        markers = read_markers(self.place)
        if any(map(markers.is_withdrawn, subjects_of(kind, take, ()))):
            self.place.remove(f"data/{kind}/{take}")

    def _create_beside(self, record: Record, suffix: str, value: Any) -> str:
        """Write a JSON file durably beside the version; returns its digest."""
        content = json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
        self.place.create(record.beside(suffix), content)
        return hashlib.sha256(content).hexdigest()

    def _require_open(self) -> None:
        if self.committed:
            raise ValueError(
                f"{self.path} is committed and never changes; stage a new version"
            )

    def _in_log(self) -> bool:
        mine = self.base + 1
        if mine not in self.log.generations():
            return False
        try:
            return self.log.read(mine).path == self.path
        except InputError:
            # the unreadable record may be that of this stage, so the data are kept
            return True


def read_names(place: Place, path: str) -> list[str] | None:
    """Takes that a version refers to, from beside it; None if they are unknown."""

    def read() -> list[str]:
        key = f"{path.removesuffix('.zarr')}.{NAMES}.json"
        names = json_object(place.read_small(key))["names"]
        return [require_text(name, TAKE, "take") for name in names]

    return intact_or_none(read)


def describe(ds: Dataset) -> Json:
    """Description of a group in a record: sizes, variables and short labels, which
    define the layout of a cohort.
    """
    labels = {
        str(dim): plain(ds[dim].values)
        for dim in ds.dims
        if dim in ds.coords and ds.sizes[dim] <= MAX_LABELS
    }
    return {
        "sizes": {str(dim): size for dim, size in ds.sizes.items()},
        "variables": sorted(map(str, ds.data_vars)),
        "labels": labels,
    }


def tables_to_json(tables: Dataset) -> Json:
    """Values and labels of a small Dataset of schema variables."""
    labels, values = (
        {str(name): plain(array.values) for name, array in arrays.items()}
        for arrays in (tables.coords, tables.data_vars)
    )
    return {"labels": labels, "values": values}


def tables_from_json(content: Attributes) -> Dataset:
    """The Dataset that was converted by `tables_to_json`; null becomes NaN."""
    values = {
        name: np.array(value, VARIABLES[name].dtype)
        for name, value in content["values"].items()
    }
    return dataset(values, coords=content["labels"])


def read_tables(place: Place, record: Record) -> Dataset:
    """The tables beside a version; empty if it has none."""
    if not record.tables:
        return Dataset()
    content = read_beside(place, record, TABLES, record.tables)
    return tables_from_json(json_object(content))


def _faults(name: str, ds: Dataset) -> list[Fault]:
    """Faults for which a group cannot be stored."""
    require_text(name, GROUP, "group")
    names = [str(v) for v in ds.data_vars]
    unknown = [v for v in names if v not in VARIABLES]
    rule = "a stored variable must be declared in the schema"
    cure = "declare or drop it"
    faults = [Fault(f"{name}[{v}]", rule, "an unknown name", cure) for v in unknown]
    try:
        check(ds, [v for v in names if v not in unknown], where=name)
    except InputError as error:
        faults += error.faults
    return faults


def _whole_shards(ds: Dataset) -> Dataset:
    """Copy with one dask block per shard, as two tasks in a shard would lose data, and
    with variable-length text.
    """
    ds = ds.copy()
    for name, variable in ds.variables.items():
        variable.encoding.clear()
        rows = _object_rows(variable)
        if variable.chunks is not None:
            first = dict.fromkeys(variable.dims[:1], rows)
            ds[name] = ds[name].chunk(dict.fromkeys(variable.dims, -1) | first)
        elif variable.dims[:1] == ("surfel",) and variable.nbytes > MAX_UNSHARDED_BYTES:
            ds[name] = variable.copy(data=_shards(variable.values, rows))
        elif variable.dtype.kind in "UO":
            # zarr v3 specifies StringDType, but not fixed-width text
            ds[name] = ds[name].astype(np.dtypes.StringDType())
    return ds


def _shards(values: AnyArray, rows: int) -> Any:
    """An array as lazy shards; `dask.array.from_array` would copy a memory-mapped file
    into memory.
    """
    # a third of the start-up of `skindb info`, which forms no arrays
    import dask.array as da

    starts = range(0, len(values), rows)
    sizes = tuple(len(values[start : start + rows]) for start in starts)

    def shard(block_info: Any = None) -> AnyArray:
        (begin, end), *_ = block_info[None]["array-location"]
        return values[begin:end]

    chunks = (sizes, *((n,) for n in values.shape[1:]))
    name = f"shards-{uuid.uuid4().hex}"  # without a name dask would hash the values
    return da.map_blocks(  # type: ignore[no-untyped-call]
        shard, chunks=chunks, dtype=values.dtype, meta=values[:0], name=name
    )


def _row_bytes(array: DataArray | Variable) -> int:
    return int(array.dtype.itemsize * math.prod(array.shape[1:]))


def _object_rows(array: DataArray | Variable) -> int:
    """Elements along the first dim in one object; whole blocks of surfels."""
    rows = MAX_OBJECT_BYTES // max(_row_bytes(array), 1)
    if array.dims[:1] == ("surfel",):
        return max(rows // BLOCK_SURFELS, 1) * BLOCK_SURFELS
    return max(rows, 1)


def _encoding(array: DataArray) -> Json:
    if array.dtype.kind not in "fiub" or array.ndim == 0 or array.size == 0:
        return {}
    length, *rest = array.shape
    rows = _object_rows(array)
    # no fill value, which a reader would mask; missing values are NaN or have a status
    plain = {"compressors": [CODEC], "_FillValue": None}
    if array.dims[0] != "surfel":
        return plain | {"chunks": (min(rows, length), *rest)}
    # reading a chunk takes at least a millisecond, whatever its size
    chunk = MIN_CHUNK_SURFELS
    while chunk < BLOCK_SURFELS and chunk * _row_bytes(array) < MIN_CHUNK_BYTES:
        chunk *= 2
    # a shard is allocated in full, so that of a small take is no larger than the array
    chunk = min(chunk, length)
    shard = min(rows, -(-length // chunk) * chunk)
    return plain | {"chunks": (chunk, *rest), "shards": (shard, *rest)}
