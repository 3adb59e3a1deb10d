"""Cache of the parts of records that the catalogue needs, in one file, so that a query
need not read all records.

`catalogue.json` may be missing or outdated, like the heads. A cached record is used as
long as a listing shows the same file of the record and, for the newest record, the same
head. All other listed records are read and checked again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from skindb.errors import Fault, InputError
from skindb.schema.consent import CONSENT
from skindb.store.log import Log
from skindb.store.markers import WithdrawnError, read_markers
from skindb.store.paths import KIND, TAKE, TRANSIENT
from skindb.store.place import Place, UnavailableError
from skindb.store.record import Record
from skindb.store.sealed import intact_or_none, sealed, sealed_object
from skindb.store.snapshot import Snapshot, identity_text, list_records

CATALOGUE = "catalogue.json"
FORMAT = 3
# threads that read records; a bucket takes some 20 ms per record, whatever its size
READER_THREADS = 32
# parts of a provenance that the catalogue shows or uses
CACHED_PARTS = (
    "schema_version",
    "subject",
    "condition",
    "session",
    "traits",
    "parameters",
    "dictionary",
    "dictionary_digest",
    "status",
    "consent_scope",
)
# not registrations, which name every take: those of 1,000 takes have a million inputs
KINDS_WITH_INPUTS = ("model",)
# kinds whose cached records contain all that `Staleness` needs
CACHED_KINDS = ("capture", *KINDS_WITH_INPUTS, CONSENT)
# cached fields of a record
CACHED_FIELDS = (
    "kind",
    "take",
    "generation",
    "path",
    "created",
    "bytes",
    "admissions",
    "seal",
)
Key = tuple[str, str, int]


@dataclass(frozen=True)
class Entry:
    """A record that was read and checked, with the identities of its files."""

    record: Record
    file: str  # identity of the file of the record
    # identity of the head when the record was the newest; empty without a head, None if
    # not read
    head: str | None


class RecordCache:
    """The records of a database as `Lookup` needs them; only records that are not in the
    cache are read.

    Parameters
    ----------
    place
        Location of the database.
    """

    def __init__(self, place: Place) -> None:
        self.place = place
        with ThreadPoolExecutor(4) as pool:
            listed = pool.submit(list_records, place)
            heads = pool.submit(_list_heads, place)
            stored = pool.submit(_load_entries, place)
            markers = pool.submit(read_markers, place)
        self._files = listed.result()
        self._heads = heads.result()
        self._markers = markers.result()
        self.snapshot = Snapshot(place, self._markers)
        entries = stored.result() or {}
        self._entries = _unchanged_entries(entries, self._files)
        self._changed = len(self._entries) != len(entries)
        self._generations = _generations(self._files)

    def kinds(self) -> list[str]:
        """Kinds of the versions of all takes, without the transient kinds."""
        named = sorted(
            {kind for kind, _ in {*self._generations, *self._heads}} - {*TRANSIENT}
        )
        return [kind for kind in named if re.fullmatch(KIND, kind) and self.takes(kind)]

    def takes(self, kind: str) -> list[str]:
        """Takes with a version of this kind, including those whose records were lost."""
        return sorted(
            take
            for listed_kind, take in {*self._generations, *self._heads}
            if listed_kind == kind and self.has(kind, take)
        )

    def has(self, kind: str, take: str) -> bool:
        """Whether a take has a version of this kind."""
        if self._markers.hides(kind, take):
            return False
        if (kind, take) in self._generations:
            return True
        return (
            (kind, take) in self._heads
            and re.fullmatch(TAKE, take) is not None
            and self.snapshot.has(kind, take)
        )

    def record(self, kind: str, take: str, generation: int | None = None) -> Record:
        """The record of a version, by default the current one, with the parts of its
        provenance that catalogues need.

        Its inputs are included only for the kinds `KINDS_WITH_INPUTS`.
        """
        entry = self._entry(kind, take, generation)
        if entry is None or not self._markers.admits(entry.record):
            return self._read(kind, take, generation)
        return entry.record

    def read_ahead(
        self, kinds: Iterable[str], pins: Mapping[tuple[str, str], int]
    ) -> None:
        """Read in parallel the newest records of these kinds, and the given
        generations, that are not in the cache.

        Errors of single records are ignored here; they are raised when the record is requested.
        """
        chosen = {*kinds}
        newest = [(*key, None) for key in self._generations if key[0] in chosen]
        missing = [
            key
            for key in [
                *newest,
                *((*key, generation) for key, generation in pins.items()),
            ]
            if self._entry(*key) is None
        ]
        pool = ThreadPoolExecutor(READER_THREADS)
        try:
            list(
                pool.map(intact_or_none, [partial(self._read, *key) for key in missing])
            )
        finally:
            # if a bucket does not answer one request, it does not answer the others
            pool.shutdown(cancel_futures=True)

    def save(self) -> None:
        """Write the cache for the next query if possible, without records that were
        removed meanwhile.
        """
        if not self._changed:
            return
        entries = _unchanged_entries(self._entries, list_records(self.place))
        rows = [
            entry
            for _, entry in sorted(entries.items())
            if self._markers.admits(entry.record)
        ]
        names = {
            entry.record.names: number for number, entry in enumerate(rows)
        }  # takes registered together share them
        body: dict[str, Any] = {
            "format": FORMAT,
            "names": {str(number): those for those, number in names.items()},
        }
        body["records"] = [_row(entry, names) for entry in rows]
        # for example a read-only folder: the next query reads the log again
        with suppress(OSError, InputError):
            guard = self._require_same_markers
            self.place.replace(CATALOGUE, sealed(body), guard=guard)

    def _require_same_markers(self) -> None:
        """Raise a `WithdrawnError` if a subject was withdrawn since this query began."""
        if read_markers(self.place) != self._markers:
            rule = "no subject must be withdrawn while the cache is written"
            raise WithdrawnError(
                Fault(
                    self.place.where(CATALOGUE),
                    rule,
                    "a withdrawal",
                    "run the command again",
                )
            )

    def _entry(self, kind: str, take: str, generation: int | None) -> Entry | None:
        """Cached entry of a version; None if its files have changed."""
        listed = self._generations.get((kind, take), [])
        number = generation if generation is not None or not listed else listed[-1]
        entry = None if number is None else self._entries.get((kind, take, number))
        is_checked = generation is not None or (
            entry is not None
            and entry.head == identity_text(self._heads.get((kind, take), ()))
        )
        return entry if is_checked else None

    def _read(self, kind: str, take: str, generation: int | None) -> Record:
        """A record from the log, with the checks of `Log.read`."""
        log = Log(self.place, kind, take)
        listed = self._generations.get((kind, take), [])
        head = self._heads.get((kind, take), ())
        try:
            if generation is None and listed:
                record = log.read_listed(
                    listed, lambda content: self.place.proves(head, content)
                )
            else:
                record = log.read(generation)
        except UnavailableError:
            raise
        except InputError:
            # damaged, or committed or removed since the listing, which the log decides
            record = self.snapshot.record(kind, take, generation)
        if not self._markers.admits(record):
            # raises the reason
            return self.snapshot.record(kind, take, generation)
        record, key = _trimmed_record(record), (kind, take, record.generation)
        if key in self._files:
            self._entries[key] = Entry(
                record,
                self._files[key],
                identity_text(head) if generation is None else None,
            )
            self._changed = True
        return record


def cache_names(place: Place, is_named: Callable[[str], bool]) -> bool:
    """Whether the cache may contain a record of a subject for whom `is_named` is true."""
    if not place.file_type(CATALOGUE):
        return False
    entries = _load_entries(place)
    return entries is None or any(
        is_named(subject)
        for entry in entries.values()
        for subject in entry.record.subjects
    )


def _generations(files: Iterable[Key]) -> dict[tuple[str, str], list[int]]:
    """Generations in ascending order, by kind and take."""
    generations: dict[tuple[str, str], list[int]] = {}
    for kind, take, generation in sorted(files):
        generations.setdefault((kind, take), []).append(generation)
    return generations


def _list_heads(place: Place) -> dict[tuple[str, str], tuple[Hashable, ...]]:
    """Identity of every head, by kind and take; empty if the folder of heads is damaged."""
    # a link in place of the folder is damage
    identities = intact_or_none(partial(place.identities, "heads")) or {}
    parts = {
        name: name.removesuffix(".json").partition("/")
        for name in identities
        if name.endswith(".json")
    }
    return {(kind, take): identities[name] for name, (kind, _, take) in parts.items()}


def _unchanged_entries(
    entries: Mapping[Key, Entry], files: Mapping[Key, str]
) -> dict[Key, Entry]:
    return {
        key: entry for key, entry in entries.items() if files.get(key) == entry.file
    }


def _load_entries(place: Place) -> dict[Key, Entry] | None:
    """Entries of the cache; None if it is missing, damaged or of another format."""

    def read() -> dict[Key, Entry] | None:
        body = sealed_object(place.read_small(CATALOGUE))
        if body["format"] != FORMAT:
            return None
        names = {number: tuple(takes) for number, takes in body["names"].items()}
        entries = {}
        for row in body["records"]:
            record = Record(**row["record"], names=names[str(row["names"])])
            key = (record.kind, record.take, record.generation)
            entries[key] = Entry(record, str(row["file"]), row["head"])
        return entries

    return intact_or_none(read)


def _trimmed_record(record: Record) -> Record:
    parts = (
        (*CACHED_PARTS, "inputs") if record.kind in KINDS_WITH_INPUTS else CACHED_PARTS
    )
    provenance = {
        name: record.provenance[name] for name in parts if name in record.provenance
    }
    fields = {name: getattr(record, name) for name in CACHED_FIELDS}
    return Record(**fields, names=record.names, provenance=provenance)


def _row(entry: Entry, names: Mapping[tuple[str, ...], int]) -> dict[str, Any]:
    record = {
        name: getattr(entry.record, name) for name in (*CACHED_FIELDS, "provenance")
    }
    return {
        "record": record,
        "names": names[entry.record.names],
        "file": entry.file,
        "head": entry.head,
    }
