"""The commit log: one JSON record per generation, created only if it is absent."""

from __future__ import annotations

import json
import os
import re
import uuid
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError

GENERATION = re.compile(r"(\d{8})\.json")


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


def sync(path: Path) -> None:
    """Make a file or the entries of a folder durable."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class Log:
    """Records of one kind and take below `<root>/log`."""

    def __init__(self, root: Path, kind: str, take: str) -> None:
        self.root, self.kind, self.take = root, kind, take
        self.folder = root / "log" / kind / take

    def generations(self) -> list[int]:
        """All committed generations, ascending; left-over temporary files do not count."""
        if not self.folder.is_dir():
            return []
        return sorted(int(m[1]) for file in self.folder.iterdir() if (m := GENERATION.fullmatch(file.name)))

    def read(self, generation: int | None = None) -> Record:
        """A record, default the current one; `InputError` names what there is."""
        known = self.generations()
        if not known or (generation is not None and generation not in known):
            where = f"{self.root}: {self.kind} of {self.take}"
            rule = "the database must hold it" if generation is None else f"generation {generation} must exist"
            raise InputError(Fault(where, rule, f"generations {known}" if known else "nothing", "see skindb info"))
        file = self.folder / f"{known[-1] if generation is None else generation:08d}.json"
        try:
            return Record(**json.loads(file.read_text(encoding="utf-8")))
        except (json.JSONDecodeError, TypeError, UnicodeDecodeError) as error:
            raise InputError(Fault(str(file), "a log record must be readable", str(error), "restore it")) from None

    def create(self, record: Record) -> None:
        """Make `record` the current one; `Conflict` if its generation exists. Durable when this returns."""
        self.folder.mkdir(parents=True, exist_ok=True)
        temporary = self.folder / f".{uuid.uuid4().hex}.tmp"
        final = self.folder / f"{record.generation:08d}.json"
        try:
            with temporary.open("w", encoding="utf-8") as file:
                json.dump(record.as_dict(), file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            os.link(temporary, final)  # fails if the name exists: the one atomic step of a commit
        except FileExistsError:
            what = f"{self.kind} of {self.take}"
            found = f"generation {record.generation} committed by another writer"
            raise Conflict(Fault(what, "one writer at a time", found, "run the command again")) from None
        finally:
            temporary.unlink(missing_ok=True)
        for folder in (self.folder, *self.folder.parents[:3]):
            sync(folder)
