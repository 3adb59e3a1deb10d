"""The commit log: one sealed JSON record per generation, created only if it is absent."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from typing import Any

from skindb.errors import Fault, InputError
from skindb.store.folder import Folder

GENERATION = re.compile(r"(\d{8})\.json")
SEAL = "sha256"  # of the record: a flipped byte of the log is found like one of the data


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
    files: dict[str, str] = field(repr=False)  # file of the version -> sha256
    provenance: dict[str, Any] = field(repr=False)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


class Log:
    """Records of one kind and take below `log/`."""

    def __init__(self, place: Folder, kind: str, take: str) -> None:
        self.place, self.kind, self.take = place, kind, take
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
        key = f"{self.key}/{known[-1] if generation is None else generation:08d}.json"
        try:
            return _opened(self.place.read(key))
        except (ValueError, TypeError, OSError) as error:
            fault = Fault(self.place.url(key), "a log record must be as committed", str(error), "restore it")
            raise InputError(fault) from None

    def create(self, record: Record) -> None:
        """Make `record` the current one; `Conflict` if its generation exists. Durable when this returns."""
        if not self.place.create(f"{self.key}/{record.generation:08d}.json", _sealed(record)):
            what = f"{self.kind} of {self.take}"
            found = f"generation {record.generation} committed by another writer"
            raise Conflict(Fault(what, "one writer at a time", found, "run the command again"))


def _sealed(record: Record) -> bytes:
    body = record.as_dict()
    return json.dumps({**body, SEAL: _seal(body)}, indent=1).encode()


def _opened(text: bytes) -> Record:
    """The record of a file; `ValueError` or `TypeError` where the file is not one."""
    body = json.loads(text)
    if not isinstance(body, dict):
        raise TypeError("no JSON object")
    seal = body.pop(SEAL, None)
    if seal is not None and seal != _seal(body):  # the first records had none
        raise ValueError("other contents than its seal")
    return Record(**body)


def _seal(body: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
