"""Takes and records of a database, or of one of its releases, each looked up only once; and
a cache of records, so that a query need not read all of them.

A cached record is used as long as a listing shows the same file of the record and, for
the newest record, the same head. All other listed records are read and checked again.
"""

from __future__ import annotations

import re
from bisect import insort
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import partial
from itertools import chain
from typing import Any

from skindb.errors import Fault, InputError, choices, input_error, require
from skindb.schema.consent import CONSENT, consent_scope
from skindb.store.entries import (
    Entry,
    block_content,
    block_of,
    collection_paused,
    read_blocks,
    trimmed_record,
)
from skindb.store.log import GENERATION, Log
from skindb.store.markers import Markers, WithdrawnError, read_markers
from skindb.store.place import (
    KIND,
    KINDS_WITHOUT_SUBJECT,
    RELEASE,
    TAKE,
    Located,
    Place,
    in_parallel,
    require_text,
    subject_of,
)
from skindb.store.record import Key, Record, intact_or_none

# kinds of the versions that a release names for each take
PINNED = ("capture", "model", "registration")
# (kind, take) -> reference to the version in the provenance
Pins = Mapping[tuple[str, str], Mapping[str, Any]]


class Snapshot:
    """Versions of a database, with the withdrawals at one moment.

    Parameters
    ----------
    place
        Location of the database.
    """

    def __init__(self, place: Place) -> None:
        self.place = place
        self.markers = read_markers(place)

    def kinds(self, take: str | None = None) -> list[str]:
        """Kinds of the versions of one take or of all takes."""
        names = {*self.place.children("log"), *self._head_names("")}
        kinds = [name for name in sorted(names) if re.fullmatch(KIND, name)]
        takes = {kind: self.takes(kind) for kind in kinds}
        return [
            kind for kind in kinds if (take in takes[kind] if take else takes[kind])
        ]

    def takes(self, kind: str) -> list[str]:
        """Takes with a version of this kind, including those whose records were lost."""
        require_text(kind, KIND, "kind")
        listed = {take for _, take, _ in list_records(self.place, kind)}
        cached = {name.removesuffix(".json") for name in self._head_names(kind)}
        lost = {
            take
            for take in cached - listed
            if re.fullmatch(TAKE, take) and not Log(self.place, kind, take).is_empty()
        }
        takes = sorted(listed | lost)
        return [take for take in takes if not self.markers.hides(kind, take)]

    def has(self, kind: str, take: str) -> bool:
        """Whether a take has a version of this kind."""
        is_empty = Log(self.place, kind, take).is_empty()
        return not is_empty and not self.markers.hides(kind, take)

    def record(self, kind: str, take: str, generation: int | None = None) -> Record:
        """The record of a version; see `Database.record`."""
        try:
            record = Log(self.place, kind, take).read(generation)
        except InputError:
            if not self.has(kind, take):
                raise self._missing_error(kind, take) from None
            raise
        if self.markers.admits(record):
            return record
        if self.markers.hides(kind, take):
            raise self._missing_error(kind, take)
        raise WithdrawnError(
            Fault(
                record.title,
                "a version must not refer to a withdrawn subject",
                "a withdrawal that is not complete",
                "run skindb refresh",
            )
        )

    def history(self, kind: str, take: str) -> list[Record]:
        """All records, oldest first; see `Database.history`."""
        current = self.record(kind, take)
        log = Log(self.place, kind, take)
        before = [number for number in log.generations() if number < current.generation]
        if len(before) < current.generation - 1 and (faults := log.faults()[1]):
            raise InputError(faults)
        earlier = [log.read(generation) for generation in before]
        return [*filter(self.markers.admits, earlier), current]

    def subjects(self) -> list[str]:
        """Subjects with a version of any kind."""
        kinds = [kind for kind in self.kinds() if kind not in KINDS_WITHOUT_SUBJECT]
        return sorted({subject_of(take) for kind in kinds for take in self.takes(kind)})

    def _head_names(self, kind: str) -> list[str]:
        """Names of the heads of a kind, or of the kinds with heads; empty if this cache
        is damaged.
        """
        key = f"heads/{kind}".rstrip("/")
        return intact_or_none(partial(self.place.children, key)) or []

    def _missing_error(self, kind: str, take: str) -> InputError:
        takes = self.takes(kind)
        finding = take
        cure = choices(take, takes)
        if not takes:
            finding = f"no {kind}; kinds: {', '.join(self.kinds()) or 'none'}"
            cure = "see skindb info"
        where = f"{self.place.name}: {kind} of {take}"
        return input_error(where, "the database must hold it", finding, cure)


class Lookup:
    """Cached lookups of takes and records, for example while a cohort or a table is created.

    Parameters
    ----------
    db
        Database.
    release
        Name of a release, whose versions are used instead of the newest ones.
    cache
        Source of takes and records, by default the database itself.
    """

    def __init__(
        self,
        db: Located,
        release: str | None = None,
        cache: RecordCache | None = None,
    ) -> None:
        self.place = db.place
        self._cache = cache
        self._snapshot = Snapshot(db.place) if cache is None else cache.snapshot
        self._source: Records = cache or self._snapshot
        self._pins = None if release is None else pins_of(self._snapshot, release)
        self._takes: dict[str, frozenset[str]] = {}
        self._records: dict[tuple[str, str], Record] = {}

    def takes(self, kind: str) -> frozenset[str]:
        """Takes with a version of this kind."""
        if kind not in self._takes:
            names = (
                [take for pinned, take in self._pins or () if pinned == kind]
                if self._is_pinned(kind)
                else self._source.takes(kind)
            )
            self._takes[kind] = frozenset(names)
        return self._takes[kind]

    def read_ahead(self, kinds: Iterable[str]) -> None:
        """Read the records of these kinds in parallel, if they are cached."""
        if self._cache is not None:
            pins = self._pins or {}
            generations = {key: int(pin["generation"]) for key, pin in pins.items()}
            newest = [kind for kind in kinds if not self._is_pinned(kind)]
            self._cache.read_ahead(newest, generations)

    def save(self) -> None:
        """Save the records that were read to the cache, if there is one."""
        if self._cache is not None:
            self._cache.save()

    def has(self, kind: str, take: str) -> bool:
        """Whether a take has a version of this kind."""
        return take in self.takes(kind)

    def record(self, kind: str, take: str) -> Record:
        """The newest record of a take, or that of the release."""
        key = (kind, take)
        if key not in self._records:
            self._records[key] = (
                pinned_record(self._source, self._pins, kind, take)
                if self._pins and self._is_pinned(kind)
                else self._source.record(kind, take)
            )
        return self._records[key]

    def history(self, kind: str, take: str) -> list[Record]:
        """All records of a take, oldest first; none if it has no such version."""
        return self._snapshot.history(kind, take) if self.has(kind, take) else []

    def generation(self, kind: str, take: str, generation: int) -> Record:
        """The record of any generation."""
        return self._source.record(kind, take, generation)

    def about(self, take: str) -> dict[str, Any]:
        """Provenance of the capture of a take, or of its model if there is no capture."""
        kind = "capture" if self.has("capture", take) else "model"
        return self.record(kind, take).provenance

    def scope(self, take: str) -> tuple[str, ...]:
        """Scopes of the present consent of the subject of a take; see `Database.consent`."""
        return consent_of(self._source, take)

    def _is_pinned(self, kind: str) -> bool:
        return self._pins is not None and kind in PINNED


def list_records(place: Place, kind: str = "") -> dict[Key, str]:
    """Identity of the file of every record in the log, of one kind or of all kinds.

    Raises
    ------
    InputError
        If the log holds heads: its folder, or that of a kind, was exchanged with theirs.
    """
    identities = {}
    for name, identity in place.identities(f"log/{kind}".rstrip("/")).items():
        path = f"{kind}/{name}" if kind else name
        listed_kind, take, file, *_ = [*path.split("/"), "", ""]
        match = GENERATION.fullmatch(file)
        if match and re.fullmatch(KIND, listed_kind) and re.fullmatch(TAKE, take):
            identities[listed_kind, take, int(match[1])] = str(identity)
        elif re.fullmatch(KIND, listed_kind) and take.endswith(".json"):
            raise input_error(
                place.where(f"log/{path}"),
                "the log must hold records, each in the folder of its take",
                "a file that belongs into heads/",
                "move it back, or restore the folders log and heads from a backup",
            )
    return identities


def consent_of(records: Records, take: str) -> tuple[str, ...]:
    """See `Database.consent`."""
    if records.has(CONSENT, subject_of(take)):
        record = records.record(CONSENT, subject_of(take))
    else:
        kind = "capture" if records.has("capture", take) else "model"
        record = records.record(kind, take)
    return consent_scope(record.provenance)


def pins_of(records: Records, release: str) -> Pins:
    """The versions that a release names; `InputError` if the release does not exist."""
    if not records.has(RELEASE, release):
        raise input_error(
            release,
            "the release must exist",
            f"releases: {', '.join(records.takes(RELEASE)) or 'none'}",
            "see skindb release",
        )
    named = records.record(RELEASE, release).made_from
    return {(pin["kind"], pin["take"]): pin for pin in named}


def pinned_record(records: Records, pins: Pins, kind: str, take: str) -> Record:
    """The record of the version that a release names for a take."""
    if (kind, take) not in pins:
        takes = sorted(name for pinned_kind, name in pins if pinned_kind == kind)
        raise input_error(
            take,
            f"the release must name a {kind} of this take",
            f"takes: {', '.join(takes) or 'none'}",
            "choose one of these",
        )
    pin = pins[kind, take]
    record = records.record(kind, take, pin["generation"])
    require(
        record.seal == pin["seal"],
        take,
        f"generation {pin['generation']} of its {kind} must be that of the release",
        "a different version",
        "restore it from a backup",
    )
    return record


class RecordCache:
    """The records of a database as `Lookup` needs them; only records that are not in the
    cache are read.

    Parameters
    ----------
    place
        Location of the database.
    """

    @collection_paused()
    def __init__(self, place: Place) -> None:
        self.place = place
        self._files = list_records(place)
        self._heads = _list_heads(place)
        blocks = read_blocks(place)
        self.snapshot = Snapshot(place)
        self._markers = self.snapshot.markers
        self._entries: dict[Key, Entry] = {}
        for entry in chain(*filter(None, blocks.values())):  # if its files are the same
            key = entry.record.key
            if self._files.get(key) == entry.file:
                head = self._heads.get(key[:2], "")
                if key not in self._entries or entry.head == head:
                    self._entries[key] = entry
        self._new: set[Key] = set()  # entries that no block holds
        # kind and take -> generations in ascending order
        self._generations: dict[tuple[str, str], list[int]] = {}
        for kind, take, generation in self._files:
            insort(self._generations.setdefault((kind, take), []), generation)
        self._named: dict[str, set[str]] = {}  # kind -> takes with a record or a head
        for kind, take in (*self._generations, *self._heads):
            self._named.setdefault(kind, set()).add(take)

    def kinds(self) -> list[str]:
        """Kinds of the versions of all takes."""
        return [
            kind
            for kind in sorted(self._named)
            if re.fullmatch(KIND, kind) and self.takes(kind)
        ]

    def takes(self, kind: str) -> list[str]:
        """Takes with a version of this kind, including those whose records were lost."""
        named = self._named.get(kind, ())
        return sorted(take for take in named if self.has(kind, take))

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
        keys: list[tuple[str, str, int | None]] = [
            (*key, None) for key in self._generations if key[0] in chosen
        ]
        keys += [(*key, generation) for key, generation in pins.items()]
        missing = [key for key in keys if self._entry(*key) is None]
        in_parallel(intact_or_none, [partial(self._read, *key) for key in missing])

    def save(self) -> None:
        """Write what was read to the cache for the next query if possible, without
        records that were removed meanwhile.
        """
        if not self._new:
            return
        listed = list_records(self.place)
        blocks: dict[str, list[Entry]] = {
            block_of(take): [] for _, take, _ in self._new
        }
        for key, entry in self._entries.items():
            is_present = listed.get(key) == entry.file
            if is_present and self._markers.admits(entry.record):
                blocks.get(block_of(key[1]), []).append(entry)
        # for example a read-only folder: the next query reads the log again
        with suppress(OSError, InputError):
            for block, rows in blocks.items():
                guard = partial(require_same_markers, self.place, self._markers, block)
                self.place.replace(block, block_content(block, rows), guard=guard)
            self._new = set()

    def _entry(self, kind: str, take: str, generation: int | None) -> Entry | None:
        """Cached entry of a version; None if its files have changed."""
        listed = self._generations.get((kind, take), [])
        number = generation if generation is not None or not listed else listed[-1]
        entry = None if number is None else self._entries.get((kind, take, number))
        is_checked = generation is not None or (
            entry is not None and entry.head == self._heads.get((kind, take), "")
        )
        return entry if is_checked else None

    def _read(self, kind: str, take: str, generation: int | None) -> Record:
        """A record from the log, with the checks of `Log.read`."""
        record = trimmed_record(self.snapshot.record(kind, take, generation))
        key = record.key
        if key in self._files:
            head = self._heads.get(key[:2], "") if generation is None else None
            self._entries[key] = Entry(record, self._files[key], head)
            self._new.add(key)
        return record


Records = Snapshot | RecordCache  # a source of takes and records


def require_same_markers(place: Place, markers: Markers, key: str) -> None:
    """Raise a `WithdrawnError` if a subject was withdrawn since these markers were read."""
    if read_markers(place) != markers:
        raise WithdrawnError(
            Fault(
                place.where(key),
                "no subject must be withdrawn while the cache is written",
                "a withdrawal",
                "run the command again",
            )
        )


def _list_heads(place: Place) -> dict[tuple[str, str], str]:
    """Identity of every head, by kind and take; empty if the folder of heads is damaged."""
    # a link in place of the folder is damage
    identities = intact_or_none(partial(place.identities, "heads")) or {}
    heads = {}
    for name, identity in identities.items():
        if name.endswith(".json"):
            kind, _, take = name.removesuffix(".json").partition("/")
            heads[kind, take] = str(identity)
    return heads
