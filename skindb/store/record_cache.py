"""What the catalogue needs of the records of a database, kept in one file, so that a query need not read them all.

`catalogue.json` is a cache like the heads: it may be missing or behind. A record never changes, so a part of one that
was read once stays true as long as the log lists that generation; what the log does not list is dropped.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from skindb.errors import InputError
from skindb.store.log import GENERATION
from skindb.store.paths import KIND, TAKE
from skindb.store.place import Place, UnavailableError
from skindb.store.record import Record, json_object, seal_of

if TYPE_CHECKING:
    from skindb.store.database import Database

CATALOGUE = "catalogue.json"
READERS = 16  # threads that read records: a bucket takes some 20 ms for each, whatever its size
# parts of a provenance that the catalogue shows or asks for
PARTS = (
    "schema_version", "subject", "condition", "session", "traits", "parameters", "dictionary", "dictionary_digest",
    "status", "inputs", "consent_scope", "withdrawn",
)  # fmt: skip
KEPT = ("kind", "take", "generation", "path", "created", "bytes", "seal")  # fields of a record
Key = tuple[str, str, int]


class RecordCache:
    """The records of a database as `Known` asks for them; only those that were never read before are read.

    Parameters
    ----------
    db, place
        Database, and the place where it is.
    """

    def __init__(self, db: Database, place: Place) -> None:
        self.db, self.place = db, place
        self._listed = _listed(place)
        stored = _stored(place)
        self._cached = {key: record for key, record in stored.items() if key[2] in self._listed.get(key[:2], [])}
        # a generation that was seen once and is not listed any more: the log says whether it was removed or lost
        self._doubtful = {key[:2] for key in stored if key[2] > max(self._listed.get(key[:2], [0]))}
        self._changed = len(self._cached) != len(stored)
        self._heads = {
            (kind, name.removesuffix(".json"))
            for kind, _, name in (one.partition("/") for one in place.sizes("heads"))
            if name.endswith(".json")
        }

    def takes(self, kind: str) -> list[str]:
        """Takes with a version of this kind, also those whose records were lost."""
        known = {take for of, take in self._listed if of == kind}
        lost = {take for of, take in {*self._heads, *self._doubtful} if of == kind} - known
        return sorted(known | {take for take in lost if re.fullmatch(TAKE, take) and self.db.has(kind, take)})

    def has(self, kind: str, take: str) -> bool:
        """Whether there is a version of this kind of a take."""
        return take in self.takes(kind)

    def record(self, kind: str, take: str, generation: int | None = None) -> Record:
        """The record of a version, default the current one, with the parts of its provenance that catalogues need."""
        listed = self._listed.get((kind, take), [])
        if not listed or (generation is None and (kind, take) in self._doubtful):
            return self.db.record(kind, take, generation)
        key = (kind, take, listed[-1] if generation is None else generation)
        if key not in self._cached:
            self._cached[key] = _trimmed(self.db.record(kind, take, generation))
            self._changed = True
        return self._cached[key]

    def read_ahead(self, kinds: Iterable[str]) -> None:
        """Read the newest records of these kinds that were never read, several at a time; faults show later."""

        def read(key: tuple[str, str]) -> None:
            with suppress(InputError):
                self.record(*key)

        wanted = set(kinds)
        newest = {(*key, those[-1]): key for key, those in self._listed.items() if key[0] in wanted}
        missing = [key for whole, key in newest.items() if whole not in self._cached]
        with ThreadPoolExecutor(READERS) as pool:
            list(pool.map(read, missing))

    def save(self) -> None:
        """Keep what was read for the next query, if it can be written; records that were removed meanwhile are not."""
        if not self._changed:
            return
        listed = _listed(self.place)
        rows = [_row(record) for key, record in sorted(self._cached.items()) if key[2] in listed.get(key[:2], [])]
        body = {"format": 1, "records": rows}
        with suppress(OSError, InputError):  # a full disk, a read-only folder: the next query reads the log again
            self.place.replace(CATALOGUE, json.dumps(body | {"seal": seal_of(body)}).encode())


def _listed(place: Place) -> dict[tuple[str, str], list[int]]:
    """Generations in the log, ascending, by kind and take."""
    found: dict[tuple[str, str], list[int]] = {}
    for name in sorted(place.sizes("log")):
        kind, _, rest = name.partition("/")
        take, _, file = rest.partition("/")
        if re.fullmatch(KIND, kind) and re.fullmatch(TAKE, take) and (match := GENERATION.fullmatch(file)):
            found.setdefault((kind, take), []).append(int(match[1]))
    return found


def _stored(place: Place) -> dict[Key, Record]:
    """Records in the cache; none if it is missing, damaged or of another version."""
    try:
        body = json_object(place.read_small(CATALOGUE))
        if body.pop("seal", None) != seal_of(body) or body.get("format") != 1:
            return {}
        records = [Record(**row) for row in body["records"]]
    except UnavailableError:
        raise
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return {}
    return {(record.kind, record.take, record.generation): record for record in records}


def _trimmed(record: Record) -> Record:
    about: dict[str, Any] = record.about  # with the names of the present schema
    provenance = {name: about[name] for name in PARTS if name in about}
    return Record(**{name: getattr(record, name) for name in KEPT}, provenance=provenance)


def _row(record: Record) -> dict[str, Any]:
    return {name: getattr(record, name) for name in (*KEPT, "provenance")}
