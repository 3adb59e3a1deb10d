"""Tables of many takes in one file, so that a study does not read thousands of them.

A block of tables is a cache, `gathered/<digest>.npz`, which is named after the seals of
the versions that it was made from: a block of other versions is never found. It is
written only while no subject was withdrawn since its tables were read, and a withdrawal
removes the blocks that hold the subject, and those that cannot be read.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np
from xarray import Dataset

from skindb.errors import InputError, input_error, require
from skindb.schema.cohort import TAKE, Held, Values, combine, values_of
from skindb.schema.variables import VARIABLES
from skindb.store.bucket import place_at
from skindb.store.entries import packed, read_cache, unpacked
from skindb.store.log import RESTORE
from skindb.store.markers import read_markers
from skindb.store.place import Place, subject_of
from skindb.store.record import AS_RECORDED, Record, intact_or_none
from skindb.store.snapshot import Snapshot, require_same_markers
from skindb.store.stage import describe, read_tables

GATHERED = "gathered"
BLOCK_NAME = r"[0-9a-f]{64}\.npz"
BLOCK_KEY = rf"{GATHERED}/{BLOCK_NAME}"
GATHERED_TAKES = 256  # in a block, on average
SEAL = "seal"  # of the version of each take in a block
# cached by a process; the tables of a take have some 20 kB, blocks 3 kB for each take
MAX_OPEN_TABLES = 2048
MAX_OPEN_BLOCKS = 64


@dataclass(frozen=True)
class Address:
    """Address of a version, with which another process finds it and detects changes."""

    url: str  # of the database
    kind: str
    take: str
    generation: int
    seal: str

    @classmethod
    def of(cls, url: str, record: Record) -> Address:
        """The address of the version of a record in the database at `Place.address`."""
        return cls(url, record.kind, record.take, record.generation, record.seal)

    @property
    def place(self) -> Place:
        """Location of the database."""
        return _place(self.url)

    def record(self) -> Record:
        """The record at this address; `InputError` if its seal differs."""
        snapshot = Snapshot(self.place)
        record = snapshot.record(self.kind, self.take, self.generation)
        require(
            record.seal == self.seal,
            f"{self.kind} of {self.take}",
            "a version must not change while a cohort refers to it",
            "a different version of that generation",
            "open the cohort again",
        )
        return record


@dataclass(frozen=True)
class Block:
    """The tables of some versions."""

    key: str  # of the file
    addresses: tuple[Address, ...] = field(compare=False, repr=False)


@dataclass(frozen=True)
class StoredTables:
    """The tables beside a version as a source of variables."""

    address: Address
    block: Block | None = None  # that holds them too
    index: int = 0  # in the block

    def read(self, name: str) -> Values:
        """Values of a variable of the tables."""
        if self.block is None:
            return values_of(_tables(self.address), name)
        array, labels = values_of(_opened(self.block), name)
        return Values(array[self.index], labels)


def table_sources(addresses: Iterable[Address]) -> list[StoredTables]:
    """Sources of the tables of takes, which share blocks.

    A block starts where the digest of a take says so, not after a number of takes, so
    that a take that is added or missing changes only its own block.
    """
    parts: list[list[Address]] = []
    for one in addresses:
        number = int.from_bytes(hashlib.sha256(one.take.encode()).digest(), "big")
        if not parts or number % GATHERED_TAKES == 0:
            parts.append([])
        parts[-1].append(one)
    sources = []
    for part in parts:
        seals = "\n".join(one.seal for one in part)
        digest = hashlib.sha256(seals.encode()).hexdigest()
        block = Block(f"{GATHERED}/{digest}.npz", tuple(part))
        sources += [StoredTables(one, block, i) for i, one in enumerate(part)]
    return sources


def blocks_of(place: Place, is_named: Callable[[str], bool]) -> list[str]:
    """Blocks that may hold the tables of a subject for whom `is_named` is true."""

    def read(key: str) -> list[str] | None:
        stored = intact_or_none(partial(_stored, place, key))
        return None if stored is None else stored[TAKE].values.tolist()

    return [
        key
        for key, takes in read_cache(place, GATHERED, read).items()
        if takes is None or any(is_named(subject_of(take)) for take in takes)
    ]


@lru_cache(MAX_OPEN_BLOCKS)
def _opened(block: Block) -> Dataset:
    place = block.addresses[0].place
    stored = intact_or_none(partial(_stored, place, block.key))
    if stored is not None:
        return stored
    markers = read_markers(place)
    # not from memory, which may hold tables of a subject who is withdrawn
    parts = [
        Held.part(one.take, {SEAL: one.seal}, _read(one)) for one in block.addresses
    ]
    gathered = combine(parts).compute(scheduler="synchronous")
    # for example a read-only folder: the next study reads the versions again
    with suppress(OSError, InputError):
        guard = partial(require_same_markers, place, markers, block.key)
        place.replace(block.key, _packed(block.key, gathered), guard=guard)
    return gathered


def _packed(key: str, block: Dataset) -> bytes:
    """Content of the file of a block."""
    arrays = {str(name): v.values for name, v in block.variables.items()}
    for name, values in arrays.items():
        if values.dtype.kind not in "fiub":
            arrays[name] = np.array(values.tolist(), "U")
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **arrays)
    return packed(key, content.getvalue())


def _stored(place: Place, key: str) -> Dataset:
    """The block in a file; `ValueError` if the file is damaged."""
    content = unpacked(key, place.read(key))
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        values = {name: arrays[name] for name in arrays.files}
    coords = {name: values.pop(name) for name in [*values] if name not in VARIABLES}
    coords[SEAL] = (TAKE, coords[SEAL])
    dims = {name: (TAKE, *VARIABLES[name].dims) for name in values}
    return Dataset({name: (dims[name], values[name]) for name in values}, coords)


def _read(address: Address) -> Dataset:
    record = address.record()
    return require_recorded(record, "tables", read_tables(address.place, record))


_tables = lru_cache(MAX_OPEN_TABLES)(_read)


@lru_cache
def _place(url: str) -> Place:
    return place_at(url)


def require_recorded(record: Record, name: str, ds: Dataset) -> Dataset:
    """Return the group, which must match the description in its record that defines the
    layout of the cohort.
    """
    if name in record.contents and describe(ds) != record.contents[name]:
        title = record.title
        raise input_error(title, AS_RECORDED, f"a different group {name}", RESTORE)
    return ds
