"""The commit log: one sealed JSON record per generation, created only if it is absent.

Format 2 of a record, which `docs/store_format.md` describes: what is large, the digests of the files of the version,
is a manifest beside the version; the record holds the manifest's digest, the seal of the record before it, and its own
seal. A record that is removed leaves a tombstone with its seal under an opaque name. Heads are caches: they tell that
the newest record is missing, and are never needed to read.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import Any

from skindb.errors import Fault, InputError
from skindb.schema.migrate import migrate_provenance_1
from skindb.store.folder import Folder
from skindb.store.paths import KIND, TAKE, VERSION, require_text

FORMAT = 2
GENERATION = re.compile(r"(\d{8})\.json")
SEALS = {1: "sha256", 2: "seal"}  # format -> key of the seal: a changed byte of the log is found like one of the data
FIELDS_1 = {"kind", "take", "generation", "path", "created", "bytes", "files", "provenance"}
FIELDS_2 = (FIELDS_1 - {"files"}) | {"format", "manifest", "tables", "contents", "previous"}
RESTORE = "restore it from a backup"


class Conflict(InputError):  # noqa: N818  what happened, not an error of the program
    """Another writer committed this generation first; nothing of theirs was touched."""


@dataclass(frozen=True)
class Record:
    """One commit."""

    kind: str
    take: str
    generation: int
    path: str  # of the version, relative to the database
    created: str  # ISO 8601
    bytes: int
    provenance: dict[str, Any] = field(repr=False)
    manifest: str = ""  # sha256 of the manifest
    tables: str = ""  # sha256 of the tables, if the version has any
    contents: dict[str, Any] = field(default_factory=dict, repr=False)  # group -> sizes, variables and short labels
    previous: str = ""  # seal of the record before this one
    seal: str = field(default="", compare=False)
    files: dict[str, str] | None = field(default=None, repr=False)  # of format 1: file -> sha256

    @property
    def about(self) -> dict[str, Any]:
        """The provenance under the names of the present schema version."""
        version = self.provenance.get("schema_version", 1)
        return migrate_provenance_1(self.provenance) if version == 1 else self.provenance

    def beside(self, what: str) -> str:
        """Key of the file `what` (manifest or tables) beside the version."""
        return f"{self.path.removesuffix('.zarr')}.{what}.json"

    def as_input(self) -> dict[str, Any]:
        """How the provenance of another version names this one."""
        return {"kind": self.kind, "take": self.take, "generation": self.generation, "seal": self.seal}


class Log:
    """Records of one kind and take below `log/`."""

    def __init__(self, place: Folder, kind: str, take: str) -> None:
        self.place, self.kind, self.take = place, require_text(kind, KIND, "kind"), require_text(take, TAKE, "take")
        self.key = f"log/{kind}/{take}"

    def generations(self) -> list[int]:
        """All committed generations, ascending; left-over temporary files do not count."""
        return [int(m[1]) for name in self.place.children(self.key) if (m := GENERATION.fullmatch(name))]

    def read(self, generation: int | None = None) -> Record:
        """A record, default the current one; `InputError` names what there is."""
        known = self.generations()
        if not known or (generation is not None and generation not in known):
            where = f"{self.place.root}: {self.kind} of {self.take}"
            rule = "the database must hold it" if generation is None else f"generation {generation} must exist"
            raise InputError(Fault(where, rule, f"generations {known}" if known else "nothing", "see skindb info"))
        key = self._key(known[-1] if generation is None else generation)
        try:
            return self._opened(self.place.read(key), key)
        except (ValueError, TypeError, RecursionError, OSError) as error:
            found = error.faults[0].found if isinstance(error, InputError) else str(error)
            fault = Fault(self.place.url(key), "a record of the log must be as committed", found, RESTORE)
            raise InputError(fault) from None

    def create(self, record: Record) -> Record:
        """Make `record` the current one and return it sealed; `Conflict` if its generation exists already."""
        body = {name: value for name, value in asdict(record).items() if name in FIELDS_2} | {"format": FORMAT}
        seal = _seal(body)
        if not self.place.create(self._key(record.generation), json.dumps(body | {"seal": seal}, indent=1).encode()):
            what = f"{self.kind} of {self.take}"
            found = f"generation {record.generation} was committed by another writer"
            raise Conflict(Fault(what, "one writer at a time", found, "run the command again"))
        self._write_head(record.generation, seal)
        return Record(**{**asdict(record), "seal": seal})

    def remove(self, generation: int) -> None:
        """Remove a record for good; a tombstone with its seal, and nothing else of it, remains."""
        record = self.read(generation)
        stone = {"format": FORMAT, "seal": record.seal, "previous": record.previous}
        stone["removed"] = datetime.now(UTC).isoformat(timespec="seconds")
        self.place.create(_tombstone(record.seal), json.dumps(stone).encode())
        self.place.remove(self._key(generation))

    def faults(self) -> list[Fault]:
        """What is wrong with the chain of records: gaps, changed records, a missing newest one."""
        faults: list[Fault] = []
        known, seal = self.generations(), ""
        for generation in range(1, known[-1] + 1 if known else 1):
            if generation not in known:
                seal = "?"  # told by the next record's `previous`
                continue
            try:
                record = self.read(generation)
            except InputError as error:
                faults += error.faults
                seal = "?"
                continue
            faults += self._link_faults(record, seal)
            seal = record.seal
        return faults + self._head_faults(known)

    def _link_faults(self, record: Record, before: str) -> list[Fault]:
        """Whether the record before this one is the one it was committed after, or was removed on purpose."""
        where = f"{self.kind} of {self.take}"
        if before == "?":
            if record.previous and self._removed(record.previous):
                return []
            rule, found = f"generation {record.generation - 1} must exist", "nothing, and no note of its removal"
            return [Fault(where, rule, found, RESTORE)]
        if record.files is None and record.previous != before and not self._removed(record.previous):
            rule = f"generation {record.generation} must follow the record before it"
            return [Fault(where, rule, "a record of another history", RESTORE)]
        return []

    def _head_faults(self, known: list[int]) -> list[Fault]:
        """The head is a cache that may lag behind; if it is ahead, records were lost."""
        head = self.head()
        if not head or (known and head["generation"] <= known[-1]) or self._removed(str(head["seal"])):
            return []
        where, rule = f"{self.kind} of {self.take}", f"generation {head['generation']} must exist"
        return [Fault(where, rule, f"generations {known}" if known else "nothing", RESTORE)]

    def head(self) -> dict[str, Any]:
        """Generation and seal of the newest record, as cached; empty without a usable cache."""
        try:
            head = json.loads(self.place.read(f"heads/{self.kind}/{self.take}.json"))
            return head if isinstance(head.get("generation"), int) else {}
        except (OSError, ValueError, AttributeError):
            return {}

    def _write_head(self, generation: int, seal: str) -> None:
        content = json.dumps({"generation": generation, "seal": seal}).encode()
        try:
            self.place.replace(f"heads/{self.kind}/{self.take}.json", content)
        except OSError:
            return  # the record is committed; a full disk does not undo that

    def _removed(self, seal: str) -> bool:
        try:
            return bool(json.loads(self.place.read(_tombstone(seal))).get("seal") == seal)
        except (OSError, ValueError, AttributeError):
            return False

    def _key(self, generation: int) -> str:
        return f"{self.key}/{generation:08d}.json"

    def _opened(self, text: bytes, key: str) -> Record:
        """The record in a file; `ValueError`, `TypeError` or `InputError` where the file is not one."""
        body = json.loads(text)
        if not isinstance(body, dict):
            raise TypeError("no JSON object")
        format_ = body.get("format", 1)
        if format_ not in SEALS:
            raise ValueError(f"format {format_!r}, written by a later skindb")
        seal = body.pop(SEALS[format_], None)
        sealed = _seal(body)
        if seal != sealed and not (format_ == 1 and seal is None):  # the first records had none
            raise ValueError("other contents than its seal")
        if set(body) != (FIELDS_1 if format_ == 1 else FIELDS_2):
            raise ValueError(f"other fields: {', '.join(sorted(map(str, body)))[:200]}")
        if f"log/{body['kind']}/{body['take']}/{body['generation']:08d}.json" != key:
            raise ValueError(f"the record of {body['kind']} {body['generation']} of {body['take']}")
        require_text(body["path"], VERSION, "path")
        if not body["path"].startswith(f"data/{self.kind}/{self.take}/"):
            raise ValueError(f"the path of another take, {body['path']}")
        body.pop("format", None)
        return Record(**body, seal=sealed)


def _tombstone(seal: str) -> str:
    """Its name tells nothing, not even to one who knows the record's name."""
    return f"tombstones/{hashlib.sha256(seal.encode()).hexdigest()}.json"


def _seal(body: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
