"""Arrays of a version that are decoded straight into the result.

zarr copies every chunk several times on its way into an array. The arrays that skindb
writes have one plain chain of codecs (bytes and Blosc, in shards along the first
dimension), so that each chunk is decompressed where its values belong. All other arrays,
and all other programs, read them by zarr.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numcodecs import blosc
from xarray import Dataset, DataTree, open_dataset, open_datatree
from xarray.backends import BackendArray
from xarray.core import indexing
from zarr.codecs import BloscCodec, BytesCodec

from skindb.errors import choices, input_error
from skindb.schema.label import BLOCK_SURFELS
from skindb.store.place import BLOCK_BYTES, Place
from skindb.store.record import Record
from skindb.store.verified import VerifiedStore
from skindb.types import AnyArray

INDEX_BYTES = 16  # of a chunk in the index of a shard: offset and length
# of an object that is read whole: its index and chunks are in the same verified blocks
SMALL_BYTES = 2 * BLOCK_BYTES
CHECKSUM_BYTES = 4  # after the index; the digests of the file cover it too


@dataclass(frozen=True)
class ShardedArray(BackendArray):
    """An array (n, ...) of a version as xarray's source of lazy values."""

    store: VerifiedStore
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk: int  # elements along the first dim in a chunk
    shard: int  # and in an object

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.BASIC, self._selected
        )

    def _selected(self, key: tuple[Any, ...]) -> AnyArray:
        """Values at one slice or index along each dim."""
        first, *others = key
        if not isinstance(first, slice):
            return np.asarray(self.rows(first, first + 1)[(0, *others)])
        begin, end, step = first.indices(self.shape[0])
        values = self.rows(begin, max(begin, end))
        return values[(slice(None, None, step), *others)]

    def rows(self, begin: int, end: int) -> AnyArray:
        """Values from `begin` to `end` along the first dim, from whole chunks."""
        low = begin // self.chunk * self.chunk
        high = min(-(-end // self.chunk) * self.chunk, self.shape[0])
        out = np.empty((max(high - low, 0), *self.shape[1:]), self.dtype)
        start = low
        while start < high:
            stop = min(high, (start // self.shard + 1) * self.shard)
            self._decode(start, stop, out[start - low : stop - low])
            start = stop
        return out[begin - low : end - low]

    def _decode(self, begin: int, end: int, out: AnyArray) -> None:
        """Write the chunks from `begin` to `end`, which are in one object, to `out`."""
        number = begin // self.shard
        key = f"{self.name}/c/{number}{'/0' * (len(self.shape) - 1)}"
        first = begin % self.shard // self.chunk
        last = first + len(range(begin, end, self.chunk))
        index_bytes = INDEX_BYTES * (self.shard // self.chunk) + CHECKSUM_BYTES
        start = 0
        whole = first == 0 and end == min(begin + self.shard, self.shape[0])
        whole = whole or self.store.files[key].size <= SMALL_BYTES
        content = memoryview(self.store.read(key, 0 if whole else -index_bytes))
        index = content[-index_bytes:-CHECKSUM_BYTES]
        table = np.frombuffer(index, "<u8").reshape(-1, 2)[first:last].astype(np.int64)
        if not whole:
            start = int(table[:, 0].min())
            content = memoryview(self.store.read(key, start, int(table.sum(1).max())))
        size = self.chunk * self.dtype.itemsize * int(np.prod(self.shape[1:]))
        target = out.reshape(-1).view(np.uint8)
        for place, (offset, length) in enumerate(table.tolist()):
            source = content[offset - start : offset - start + length]
            values = target[place * size : (place + 1) * size]
            if len(values) == size:
                blosc.decompress(source, values)
            else:  # the last chunk of the array
                chunk = np.frombuffer(blosc.decompress(source), np.uint8)
                values[:] = chunk[: len(values)]


def open_version(
    place: Place, record: Record, groups: Sequence[str] | None = None
) -> DataTree:
    """A version, or some groups of it, as a lazy DataTree, in blocks of 4,096 surfels
    where it has samples, and of whole objects elsewhere.
    """
    if groups is not None:
        lazy = {name: open_group(place, record, name) for name in groups}
        attrs: Mapping[Any, Any] = record.provenance
    else:
        store = VerifiedStore(place, record)
        # chunks={} would use the inner chunks, which gives sixteen times as many tasks
        tree = open_datatree(store, engine="zarr", consolidated=True, chunks=None)  # type: ignore[arg-type]
        lazy = {
            path: _lazy(store, path.strip("/"), node.to_dataset(inherit=False))
            for path, node in tree.subtree_with_keys
        }
        attrs = tree.attrs
    version = DataTree.from_dict(lazy)
    version.attrs = {**attrs, "generation": record.generation}
    return version


def open_group(place: Place, record: Record, group: str) -> Dataset:
    """One group of a version, without opening the others."""
    store: Any = VerifiedStore(place, record)
    options: dict[str, Any] = {"engine": "zarr", "consolidated": True, "chunks": None}
    try:
        return _lazy(store, group, open_dataset(store, group=group, **options))
    except KeyError as error:
        raise input_error(
            f"{record.kind} of {record.take}",
            f"its version {record.generation} must have the group {group}",
            "none",
            choices(group, record.contents),
        ) from error


def _lazy(store: VerifiedStore, group: str, ds: Dataset) -> Dataset:
    """A group that xarray has opened, in blocks of surfels; arrays with the codecs of
    skindb are decoded straight into the result.
    """
    if "surfel" not in ds.dims:
        return ds
    arrays = {}
    for name, variable in ds.data_vars.items():
        how = variable.encoding
        if _is_direct(how):
            extent = (how["chunks"][0], how["shards"][0])
            path = f"{group}/{name}"
            shape = variable.shape
            arrays[name] = ShardedArray(store, path, shape, variable.dtype, *extent)
    rows = min((array.shard for array in arrays.values()), default=BLOCK_SURFELS)
    if any(array.ndim > 3 for array in arrays.values()):
        rows = BLOCK_SURFELS  # samples, from which long computations are made
    direct = {
        name: (ds[name].dims, indexing.LazilyIndexedArray(array), ds[name].attrs)
        for name, array in arrays.items()
    }
    return ds.assign(direct).chunk(surfel=rows)


def _is_direct(how: Mapping[Any, Any]) -> bool:
    """Whether an array has the codecs of skindb, and is divided along the first dim only."""
    chunks: Any = how.get("chunks")
    shards: Any = how.get("shards")
    return (
        bool(chunks and shards)
        and chunks[1:] == shards[1:]
        and not how["filters"]
        and [type(codec) for codec in how["compressors"]] == [BloscCodec]
        and how["serializer"] in (BytesCodec(endian="little"), BytesCodec(endian=None))
        and np.dtype(how["dtype"]).isnative
    )
