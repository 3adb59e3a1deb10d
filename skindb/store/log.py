"""The commit log: one sealed JSON record per generation, which is created only if it
does not exist yet.

`docs/store_format.md` describes its files. The digests of the files of a version are in
a manifest beside the version; its record contains the digest of the manifest, the seal
of the previous record, and its own seal. A removed record leaves a tombstone with its
seal under an opaque name. A head names the newest record. It is a cache that may be
missing or outdated, but if it is intact and ahead of the log, a record was lost.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial

from skindb.clock import utc_time
from skindb.errors import Fault, InputError, attempt, input_error, require_none
from skindb.files import Json
from skindb.store.markers import WithdrawnError
from skindb.store.place import (
    KIND,
    TAKE,
    VERSION,
    Guard,
    Place,
    require_text,
    unguarded,
)
from skindb.store.record import (
    FORMAT,
    Record,
    damage_as_fault,
    intact_or_none,
    json_object,
    record_from_json,
    record_to_json,
    seal_of,
)

GENERATION = re.compile(r"([0-9]{8})\.json")
HEADS = "heads"
RESTORE = "restore it from a backup"


class Conflict(InputError):  # noqa: N818  an event, not an error of the program
    """Another writer committed this generation first; its version was not changed."""


class Log:
    """Log of the versions of one kind of a take, below `log/`."""

    def __init__(self, place: Place, kind: str, take: str) -> None:
        self.place = place
        self.kind = require_text(kind, KIND, "kind")
        self.take = require_text(take, TAKE, "take")
        self.key = f"log/{kind}/{take}"
        self.head_key = f"{HEADS}/{kind}/{take}.json"
        self.what = f"{kind} of {take}"

    def generations(self) -> list[int]:
        """All committed generations, ascending, without left-over temporary files."""
        # a link in place of a record is not hidden
        names = self.place.children(self.key, links=True)
        return [int(m[1]) for name in names if (m := GENERATION.fullmatch(name))]

    def read(self, generation: int | None = None) -> Record:
        """A record, by default the current one; the `InputError` for a missing one
        lists the existing generations.
        """
        # read before the log, which only grows
        head = self.head() if generation is None else {}
        listed = self.generations()
        require_none(self._head_faults(head, listed))
        if not listed or (generation is not None and generation not in listed):
            rule = (
                "the database must hold it"
                if generation is None
                else f"generation {generation} must exist"
            )
            finding = f"generations {listed}" if listed else "nothing"
            raise input_error(
                f"{self.place.name}: {self.what}", rule, finding, "see skindb info"
            )
        record = self._read(listed[-1] if generation is None else generation)
        require_none(self._head_faults(head, listed, [record]))
        return record

    def is_empty(self) -> bool:
        """Whether no record was ever committed, or all records were removed deliberately."""
        return not self.generations() and not self._head_faults(
            self.head(), self.generations()
        )

    def create(self, record: Record, guard: Guard = unguarded) -> Record:
        """Commit `record` as the current one and return it sealed.

        Parameters
        ----------
        record
            Record without a seal.
        guard
            The last check before the record exists; see `WithdrawalGuard`.

        Raises
        ------
        Conflict
            If its generation exists already.
        """
        content, seal = record_to_json(record)
        number = record.generation
        try:
            created = self.place.create(self.record_key(number), content, guard=guard)
        except WithdrawnError:
            if number in self.generations() and self._read(number).seal == seal:
                # in a bucket, where another writer may have seen it
                self.remove(number)
            raise
        if not created:
            rule = "a generation must be committed only once"
            finding = f"generation {number} was committed by another writer"
            raise Conflict(Fault(self.what, rule, finding, "run the command again"))
        # the record is committed, even if the cache cannot be written
        with suppress(OSError, InputError):
            head = self.head_content(number, seal)
            self.place.replace(self.head_key, head, guard=guard)
        return replace(record, seal=seal)

    def remove(self, generation: int) -> None:
        """Remove a record and its version permanently, and leave a tombstone with its seal.

        The record is removed last, so that the same call can complete a removal that
        was interrupted.
        """
        record = self._read(generation)
        self.place.create(tombstone_of(record.seal), tombstone_content(record))
        remove_version(self.place, record.path)
        self.place.remove(self.record_key(generation))

    def faults(self) -> tuple[list[Record], list[Fault]]:
        """The readable records, and the faults of the other records, of the chain of
        seals and of the head.
        """
        records = []
        faults: list[Fault] = []
        head = self.head()
        listed = self.generations()
        preceding = 0
        seal = ""
        for generation in listed:
            record = attempt(faults, partial(self._read, generation))
            if record is None:
                seal = "?"
            else:
                faults += self._link_faults(record, preceding, seal)
                records.append(record)
                seal = record.seal
            preceding = generation
        return records, faults + self._head_faults(head, listed, records)

    def readable(self) -> list[Record]:
        """All readable records, oldest first; damaged ones are skipped."""
        read = (intact_or_none(partial(self._read, n)) for n in self.generations())
        return [record for record in read if record is not None]

    def head(self) -> Json:
        """Generation and seal of the newest record from the cache; empty if the cache
        is missing or damaged.
        """
        read = partial(self.place.read_small, self.head_key)
        head = intact_or_none(lambda: json_object(read())) or {}
        digest = head.pop("digest", None)
        is_whole = (
            isinstance(head.get("generation"), int)
            and isinstance(head.get("seal"), str)
            and digest == self._head_digest(head)
        )
        return head if is_whole else {}

    def is_removed(self, seal: str) -> bool:
        """Whether a record with this seal was removed deliberately."""
        return self._tombstone(seal) is not None

    def _read(self, generation: int) -> Record:
        return read_record(self.place, self.record_key(generation))[0]

    def _link_faults(self, record: Record, preceding: int, seal: str) -> list[Fault]:
        """Faults of the link to the previous record, which must exist unless it was
        removed deliberately.
        """
        before = record.previous
        missing = record.generation - preceding - 1
        tombstone = self._tombstone(before)
        if not missing and tombstone is not None:
            return []
        while missing and tombstone is not None:
            before = tombstone["previous"]
            missing -= 1
            tombstone = self._tombstone(before)
        if missing:
            last = preceding + missing
            rule = f"generation {last} must exist"
            if missing > 1:
                rule = f"generations {preceding + 1} to {last} must exist"
            finding = "no record and no tombstone"
        elif seal not in ("?", before):
            rule = f"generation {record.generation} must follow the record before it"
            finding = "a record that names a different predecessor"
        else:
            return []
        return [Fault(self.what, rule, finding, RESTORE)]

    def _head_faults(
        self, head: Json, listed: list[int], records: Iterable[Record] = ()
    ) -> list[Fault]:
        """Faults if the head, a cache that may be outdated, is ahead of the log, because
        records were lost, or names another record of the same generation.
        """
        if not head:
            return []
        number = head["generation"]
        seals = {record.generation: record.seal for record in records}
        if number > max(listed, default=0):
            rule = f"generation {number} must exist"
            finding = f"generations {listed}" if listed else "nothing"
        elif seals.get(number, head["seal"]) != head["seal"]:
            rule = f"generation {number} must be the record that was committed"
            finding = "a different record"
        else:
            return []
        if self.is_removed(head["seal"]):
            return []
        cure = f"{RESTORE}; if the log is correct, remove {self.head_key}"
        return [Fault(self.what, rule, finding, cure)]

    def head_content(self, generation: int, seal: str) -> bytes:
        """Content of the head that names a record."""
        head = {"generation": generation, "seal": seal}
        return json.dumps(head | {"digest": self._head_digest(head)}).encode()

    def _head_digest(self, head: Json) -> str:
        """Digest of a head of this kind and take, by which a damaged head or that of
        another take is detected.
        """
        return seal_of(
            {name: head[name] for name in ("generation", "seal")}
            | {"kind": self.kind, "take": self.take}
        )

    def _tombstone(self, seal: str) -> dict[str, str] | None:
        """The tombstone of the record with this seal; None if there is none."""
        if not seal:
            return None
        read = partial(self.place.read_small, tombstone_of(seal))
        tombstone = intact_or_none(lambda: json_object(read())) or {}
        previous = tombstone.get("previous")
        is_whole = tombstone.get("seal") == seal and isinstance(previous, str)
        return tombstone if is_whole else None

    def record_key(self, generation: int) -> str:
        """Key of a record."""
        return f"{self.key}/{generation:08d}.json"


def read_record(place: Place, key: str) -> tuple[Record, str]:
    """The record in a file of the log, and the digest of the file."""
    rule = "a record of the log must be as committed"
    with damage_as_fault(place.where(key), rule, RESTORE):
        content = place.read_small(key)
        return record_from_json(content, key), hashlib.sha256(content).hexdigest()


def remove_version(place: Place, path: str) -> None:
    """Remove the data of a version, which no record names any more when this call ends."""
    require_text(path, VERSION, "path of a version")
    for ending in (".zarr", ".tables.json", ".manifest.json", ".names.json"):
        place.remove(path.removesuffix(".zarr") + ending)


def tombstone_of(seal: str) -> str:
    """Key of a tombstone, which reveals nothing about the record, even to a reader who
    knows its name.
    """
    return (
        f"tombstones/{hashlib.sha256(seal.encode(errors='replace')).hexdigest()}.json"
    )


def tombstone_content(record: Record) -> bytes:
    """Content of the tombstone of a record that is removed now."""
    tombstone = {"format": FORMAT, "seal": record.seal, "previous": record.previous}
    tombstone["removed"] = utc_time()
    return json.dumps(tombstone).encode()


def committed_logs(place: Place) -> Iterator[Log]:
    """The logs of all kinds and takes, including those for which only a head exists."""
    for kind, take in sorted({*takes_below(place, "log"), *takes_below(place, HEADS)}):
        yield Log(place, kind, take)


def takes_below(place: Place, key: str) -> Iterator[tuple[str, str]]:
    """Kinds and takes on the first two levels below a key, without other names and links."""
    kinds = place.children(key) if place.file_type(key) == "folder" else []
    for kind in filter(re.compile(KIND).fullmatch, kinds):
        for name in place.children(f"{key}/{kind}"):
            take = name.removesuffix(".json") if key == HEADS else name
            if re.fullmatch(TAKE, take):
                yield kind, take
