"""The commit log: one sealed JSON record per generation, created only if it is absent.

`docs/store_format.md` describes its files. What is large, the digests of the files of a version, is a manifest beside
the version; its record holds the digest of the manifest, the seal of the record before it, and its own seal. A record
that is removed leaves a tombstone with its seal under an opaque name. A head remembers the newest record; it is a cache
that may be missing or behind, but where it is whole and ahead of the log, a record was lost.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from skindb.errors import Fault, InputError
from skindb.store.paths import KIND, TAKE, TRANSIENT, require_text
from skindb.store.place import Place, UnavailableError
from skindb.store.record import (
    FORMAT,
    LaterError,
    Record,
    json_object,
    record_from_json,
    record_to_json,
    seal_of,
)

GENERATION = re.compile(r"([0-9]{8})\.json")
RESTORE = "restore it from a backup"
UPDATE = "update skindb"


class Conflict(InputError):  # noqa: N818  what happened, not an error of the program
    """Another writer committed this generation first; nothing of theirs was touched."""


class Log:
    """Records of one kind and take below `log/`."""

    def __init__(self, place: Place, kind: str, take: str) -> None:
        self.place, self.kind, self.take = place, require_text(kind, KIND, "kind"), require_text(take, TAKE, "take")
        self.key, self.head_key = f"log/{kind}/{take}", f"heads/{kind}/{take}.json"
        self.what = f"{kind} of {take}"

    def generations(self) -> list[int]:
        """All committed generations, ascending; left-over temporary files do not count."""
        names = self.place.children(self.key, links=True)  # a link in place of a record hides no record
        return [int(m[1]) for name in names if (m := GENERATION.fullmatch(name))]

    def read_listed(self, known: list[int], is_head: Callable[[bytes], bool]) -> Record:
        """The current record, where the generations were listed already; `InputError` if the head names another.

        A list from before another run committed looks like a lost record: without it the log is asked. `is_head` says
        whether the head is known to have some content without being read; it is read otherwise.
        """
        record = self._read(known[-1])
        if is_head(self._head_content(record.generation, record.seal)):
            return record
        head = self.head()
        if fault := self._lost(head, known) or self._other(head, record):
            raise InputError(fault)
        return record

    def read(self, generation: int | None = None) -> Record:
        """A record, default the current one; `InputError` names what there is."""
        head = self.head() if generation is None else {}  # before the log, which only grows
        known = self.generations()
        if generation is None and (lost := self._lost(head, known)):
            raise InputError(lost)
        if not known or (generation is not None and generation not in known):
            rule = "the database must hold it" if generation is None else f"generation {generation} must exist"
            found = f"generations {known}" if known else "nothing"
            raise InputError(Fault(f"{self.place.name}: {self.what}", rule, found, "see skindb info"))
        record = self._read(known[-1] if generation is None else generation)
        if other := self._other(head, record):
            raise InputError(other)
        return record

    def is_empty(self) -> bool:
        """Whether no record was ever committed, or all were removed on purpose."""
        return not self.generations() and not self._lost(self.head(), self.generations())

    def create(self, record: Record) -> Record:
        """Make `record` the current one and return it sealed; `Conflict` if its generation exists already."""
        content, seal = record_to_json(record)
        if not self.place.create(self._key(record.generation), content):
            found = f"generation {record.generation} was committed by another writer"
            raise Conflict(Fault(self.what, "one writer at a time", found, "run the command again"))
        if self.kind not in TRANSIENT:
            self._write_head(record.generation, seal)
        return Record(**{**asdict(record), "seal": seal})

    def remove(self, generation: int) -> None:
        """Remove a record and its version permanently; only a tombstone with its seal remains.

        The record is removed last: if the process is killed before, the same call finds it and removes the rest.
        """
        record = self._read(generation)
        stone = {"format": FORMAT, "seal": record.seal, "previous": record.previous}
        stone["removed"] = datetime.now(UTC).isoformat(timespec="seconds")
        self.place.create(tombstone_of(record.seal), json.dumps(stone).encode())
        for key in (record.path, record.beside("tables"), record.beside("manifest"), self._key(generation)):
            self.place.remove(key)

    def forget(self) -> None:
        """Remove all there is of a transient kind, also what a killed writer left; nothing remains, no tombstone."""
        if self.kind not in TRANSIENT:
            raise ValueError(f"{self.what} is history; it is removed with a note of its removal")
        for key in (self.key, f"data/{self.kind}/{self.take}"):  # the record first: none is without its version
            self.place.remove(key)

    def faults(self) -> tuple[list[Record], list[Fault]]:
        """The records that can be read, and what is wrong with the others, with their chain and with the head."""
        records: list[Record] = []
        faults: list[Fault] = []
        head = self.head()
        known, last, seal = self.generations(), 0, ""
        for generation in known:
            try:
                record = self._read(generation)
            except InputError as error:
                faults += error.faults
                last, seal = generation, "?"
                continue
            faults += self._link_faults(record, last, seal)
            faults += [fault] if (fault := self._other(head, record)) else []
            records.append(record)
            last, seal = generation, record.seal
        return records, faults + ([lost] if (lost := self._lost(head, known)) else [])

    def head(self) -> dict[str, Any]:
        """Generation and seal of the newest record, as cached; empty without a usable cache."""
        try:
            head = json_object(self.place.read_small(self.head_key))
        except UnavailableError:
            raise
        except (OSError, ValueError, RecursionError):
            return {}
        digest = head.pop("digest", None)  # the first heads had none
        if not isinstance(head.get("generation"), int) or not isinstance(head.get("seal"), str):
            return {}
        return head if digest in (None, self._head_digest(head)) else {}

    def is_removed(self, seal: str) -> bool:
        """Whether a record with this seal was removed on purpose."""
        return self._stone(seal) is not None

    def _read(self, generation: int) -> Record:
        key, cure = self._key(generation), RESTORE
        try:
            return record_from_json(self.place.read_small(key), key)
        except UnavailableError:
            raise
        except LaterError as error:
            found, cure = f"{error}, written by a later skindb", UPDATE
        except InputError as error:  # a symbolic link
            found = error.faults[0].found
        except (ValueError, RecursionError) as error:
            found = str(error)
        except OSError as error:
            found = error.strerror or "an unreadable file"
        raise InputError(Fault(self.place.where(key), "a record of the log must be as committed", found, cure))

    def _link_faults(self, record: Record, last: int, seal: str) -> list[Fault]:
        """Whether the record before this one is the one it was committed after, or was removed on purpose."""
        before, missing = record.previous, record.generation - last - 1
        stone = self._stone(before)
        if not missing and stone is not None:
            return []
        while missing and stone is not None:
            before, missing = stone["previous"], missing - 1
            stone = self._stone(before)
        if missing:
            lost = f"generation {last + 1}" if missing == 1 else f"generations {last + 1} to {last + missing}"
            return [Fault(self.what, f"{lost} must exist", "nothing, and no note of its removal", RESTORE)]
        if record.files is None and seal not in ("?", before):
            rule = f"generation {record.generation} must follow the record before it"
            return [Fault(self.what, rule, "a record of another history", RESTORE)]
        return []

    def _lost(self, head: dict[str, Any], known: list[int]) -> Fault | None:
        """The head is a cache that may lag behind; if it is ahead, records were lost."""
        if not head or (known and head["generation"] <= known[-1]) or self.is_removed(head["seal"]):
            return None
        found = f"generations {known}" if known else "nothing"
        return Fault(self.what, f"generation {head['generation']} must exist", found, self._cure())

    def _other(self, head: dict[str, Any], record: Record) -> Fault | None:
        """A record that took the place of the one that the head remembers."""
        if not head or head["generation"] != record.generation or head["seal"] == record.seal:
            return None
        if self.is_removed(head["seal"]):
            return None
        rule = f"generation {record.generation} must be the record that was committed"
        return Fault(self.what, rule, "another one", self._cure())

    def _cure(self) -> str:
        return f"{RESTORE}; if the log is right as it is, remove {self.head_key}"

    def _write_head(self, generation: int, seal: str) -> None:
        try:
            self.place.replace(self.head_key, self._head_content(generation, seal))
        except (OSError, InputError):
            return  # the record is committed; a full disk does not undo that

    def _head_content(self, generation: int, seal: str) -> bytes:
        head = {"generation": generation, "seal": seal}
        return json.dumps(head | {"digest": self._head_digest(head)}).encode()

    def _head_digest(self, head: dict[str, Any]) -> str:
        """Of the head of this kind and take: one that is damaged, or that of another take, is not used."""
        return seal_of({name: head[name] for name in ("generation", "seal")} | {"kind": self.kind, "take": self.take})

    def _stone(self, seal: str) -> dict[str, str] | None:
        """The tombstone of a record."""
        if not seal:
            return None
        try:
            stone = json_object(self.place.read_small(tombstone_of(seal)))
        except UnavailableError:
            raise
        except (OSError, ValueError, RecursionError):
            return None
        return stone if stone.get("seal") == seal and isinstance(stone.get("previous"), str) else None

    def _key(self, generation: int) -> str:
        return f"{self.key}/{generation:08d}.json"


def tombstone_of(seal: str) -> str:
    """Name of a tombstone, which reveals nothing, even to a reader who knows the name of the record."""
    return f"tombstones/{hashlib.sha256(seal.encode(errors='replace')).hexdigest()}.json"
