"""Blocks of the cache of records, which hold the parts of records that queries need.

A block, `catalogue/<digit>.block`, has the records of the takes whose digests begin with
this digit. A query that had to read records writes their blocks again. No lock is needed,
as by SQLite on a folder that machines share: of two queries that write a block, one is
repeated later, and an entry counts only while the files that it was read from are the
same.
"""

import gc
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from skindb.schema.consent import CONSENT
from skindb.store.place import Place, in_parallel
from skindb.store.record import Record, intact_or_none

CATALOGUE = "catalogue"
CATALOGUE_BLOCK = r"[0-9a-f]\.block"
BLOCK_FORMAT = 8
DIGEST_BYTES = 32  # before the content of a file of a cache
# parts of a provenance that are equal in many records
SHARED_PARTS = (
    "schema_version",
    "parameters",
    "dictionary",
    "dictionary_digest",
    "relative_reflectance",
    "summary_parameters",
    "consent_scope",
    "calibration",
    "calibrated_by",
)
# parts that the catalogue shows or uses
CACHED_PARTS = (
    *SHARED_PARTS,
    "subject",
    "condition",
    "session",
    "traits",
    "even_reflection",
    "even_reflection_error",
    "status",
)
# not registrations, which name every take: those of 1,000 takes have a million inputs
KINDS_WITH_INPUTS = ("model",)
# kinds whose cached records contain all that `Staleness` needs
CACHED_KINDS = ("capture", *KINDS_WITH_INPUTS, CONSENT)
# groups that cohorts need the layout of
CACHED_GROUPS = {"capture": ("dome", "samples"), "model": ("tables", "sample")}
# cached fields of a record
CACHED_FIELDS = (
    "kind",
    "take",
    "generation",
    "path",
    "created",
    "bytes",
    "seal",
)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Entry:
    """A record that was read and checked, with the identities of its files."""

    record: Record
    file: str  # identity of the file of the record
    # identity of the head when the record was the newest; empty without a head, None if
    # not read
    head: str | None


@contextmanager
def collection_paused() -> Iterator[None]:
    """Context without garbage collections, a quarter of the time in which the objects of
    ten thousand takes are made, all of which remain.
    """
    is_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if is_enabled:
            gc.enable()


def trimmed_record(record: Record) -> Record:
    """The record with the parts that are cached."""
    inputs = ("inputs",) if record.kind in KINDS_WITH_INPUTS else ()
    groups = CACHED_GROUPS.get(record.kind, ())
    return Record(
        **{name: getattr(record, name) for name in CACHED_FIELDS},
        names=record.names,
        contents=_chosen(record.contents, groups),
        provenance=_chosen(record.provenance, (*CACHED_PARTS, *inputs)),
    )


def block_keys(place: Place, folder: str) -> list[str]:
    """Keys of the blocks of a cache; none if its folder is damaged."""
    names = intact_or_none(partial(place.children, folder)) or []
    return [f"{folder}/{name}" for name in names]


def read_cache(
    place: Place, folder: str, read: Callable[[str], T | None]
) -> dict[str, T | None]:
    """Key of every file of a cache -> what is read from it; None if it is damaged or
    foreign. Files that are removed meanwhile are not included.
    """
    keys = block_keys(place, folder)
    blocks = dict(zip(keys, in_parallel(read, keys), strict=True))
    if None in blocks.values():
        keys = block_keys(place, folder)
    return {key: b for key, b in blocks.items() if b is not None or key in keys}


def packed(key: str, content: bytes) -> bytes:
    """Content of a file of a cache, with a digest by which a damaged file, or that of
    another key, is detected.
    """
    return hashlib.sha256(key.encode() + b"\0" + content).digest() + content


def unpacked(key: str, content: bytes) -> bytes:
    """What was packed; `ValueError` if the file is damaged."""
    if packed(key, content[DIGEST_BYTES:]) != content:
        raise ValueError("content that does not match its digest")
    return content[DIGEST_BYTES:]


def read_blocks(place: Place) -> dict[str, list[Entry] | None]:
    """Key of every file in the folder of the catalogue -> its entries; None if it is
    damaged or foreign.
    """
    return read_cache(place, CATALOGUE, partial(_read_block, place))


def catalogue_blocks_of(place: Place, is_named: Callable[[str], bool]) -> list[str]:
    """Blocks, and foreign files beside them, that may name a subject for whom `is_named`
    is true.
    """
    return [
        key
        for key, entries in read_blocks(place).items()
        if entries is None
        or any(is_named(name) for entry in entries for name in entry.record.subjects)
    ]


def block_of(take: str) -> str:
    """Key of the block with the records of a take."""
    return f"{CATALOGUE}/{hashlib.sha256(take.encode()).hexdigest()[0]}.block"


def _chosen(values: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {name: values[name] for name in names if name in values}


def block_content(key: str, entries: Iterable[Entry]) -> bytes:
    """Content of the file of a block."""
    shared: dict[str, int] = {}

    def index(value: Any) -> int:
        return shared.setdefault(json.dumps(value), len(shared))

    rows = []
    for entry in sorted(entries, key=lambda entry: entry.record.key):
        record = entry.record
        provenance = record.provenance
        own = {n: value for n, value in provenance.items() if n not in SHARED_PARTS}
        parts = (_chosen(provenance, SHARED_PARTS), record.names, record.contents)
        fields = [getattr(record, name) for name in CACHED_FIELDS]
        rows.append([fields, own, *map(index, parts), entry.file, entry.head])
    values = [json.loads(text) for text in shared]
    body = {"format": BLOCK_FORMAT, "shared": values, "rows": rows}
    return packed(key, json.dumps(body, separators=(",", ":")).encode())


def _read_block(place: Place, key: str) -> list[Entry] | None:
    def read() -> list[Entry] | None:
        body = json.loads(unpacked(key, place.read_small(key)))
        if body["format"] != BLOCK_FORMAT:
            return None
        shared = body["shared"]
        entries = []
        for fields, own, common, names, contents, file, head in body["rows"]:
            record = Record(
                **dict(zip(CACHED_FIELDS, fields, strict=True)),
                provenance=shared[common] | own,
                names=tuple(shared[names]),
                contents=shared[contents],
            )
            entries.append(Entry(record, file, head))
        return entries

    return intact_or_none(read)
