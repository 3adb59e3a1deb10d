"""The marker file: a local file outside the database that notes withdrawals,
readmissions and consents.

A restore of an earlier backup repeats what the file notes. Each line is a JSON object
with a seal that is keyed by the secret of the database. Subjects are named by keyed
hashes only. Lines are only added; what is missing, for example after a full disk, is
added by the next command that writes to the file.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import stat
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError, SkindbWarning, system_fault
from skindb.files import PRIVATE_FILE, make_private, read_regular
from skindb.limits import MAX_STORE_JSON_BYTES
from skindb.schema.consent import SCOPES, consent_scope
from skindb.store.folder import flush_path
from skindb.store.markers import (
    ENTRY,
    WITHDRAWN,
    is_sealed,
    keyed_hash,
    keyed_seal,
    require_secret,
)
from skindb.store.place import Place, UnavailableError
from skindb.store.record import DIGEST, Record
from skindb.store.sealed import json_object

FORMAT = 1
LINE = "line"  # the key in the seals of lines
CURE = (
    "give the right file; or rename this one, and the next withdrawal, consent or "
    "backup writes a new one"
)


class MarkerFileWarning(SkindbWarning):
    """A withdrawal or consent could not be noted outside the database."""


@dataclass
class Notes:
    """What a marker file notes."""

    # key of an entry of `withdrawn/` -> content
    entries: dict[str, dict[str, Any]] = field(default_factory=dict)
    # hash of a subject -> its newest consent
    consents: dict[str, dict[str, Any]] = field(default_factory=dict)
    # keyed hashes of the seals of records of consent
    records: set[str] = field(default_factory=set)


def read_marker_file(path: Path, secret: bytes) -> Notes:
    """The notes of a marker file; `InputError` if it is damaged, or not that of the
    database with this secret.
    """
    content = read_regular(path, MAX_STORE_JSON_BYTES)
    return _notes_from(content, str(path), secret)


def _notes_from(content: bytes, location: str, secret: bytes) -> Notes:
    notes = Notes()
    for number, line in enumerate(content.removesuffix(b"\n").split(b"\n"), 1):
        try:
            body = json_object(line)
            if not is_sealed(secret, LINE, body):
                raise ValueError("a line that is damaged, or of another database")
            if number == 1 and body.get("format") != FORMAT:
                raise ValueError("a first line of another format")
            _add_line(notes, body)
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            fault = Fault(
                f"{location}, line {number}",
                "a marker file must be as it was written",
                str(error),
                CURE,
            )
            raise InputError(fault) from None
    return notes


def note_withdrawals(place: Place, *, is_repeated: bool = False) -> None:
    """Add the withdrawals and readmissions of a database to its marker file, which is
    created if it is missing.

    Parameters
    ----------
    place
        Location of the database.
    is_repeated
        Whether the caller calls this again later, so that a failure causes no warning.
    """

    def lines(notes: Notes, _: bytes) -> list[dict[str, Any]]:
        keys = [
            f"{WITHDRAWN}/{name}"
            for name in sorted(place.sizes(WITHDRAWN))
            if ENTRY.fullmatch(name)
        ]
        return [_entry_line(place, key) for key in keys if key not in notes.entries]

    _add_lines(place, lines, is_repeated=is_repeated)


def note_consents(place: Place, records: Iterable[Record]) -> None:
    """Add records of consent to the marker file of their database, which is created if
    it is missing.
    """

    def lines(notes: Notes, secret: bytes) -> list[dict[str, Any]]:
        return [
            line
            for record in records
            if (line := _consent_line(record, secret))["record"] not in notes.records
        ]

    _add_lines(place, lines, is_repeated=False)


def _add_line(notes: Notes, body: Mapping[str, Any]) -> None:
    if "entry" in body:
        name = str(body["entry"]).removeprefix(f"{WITHDRAWN}/")
        match = ENTRY.fullmatch(name)
        if match is None:
            raise ValueError("a withdrawal with an invalid name")
        notes.entries[f"{WITHDRAWN}/{name}"] = dict(body["content"])
        notes.consents.pop(match[1], None)  # what was agreed to before the withdrawal
    elif "consent" in body:
        if not re.fullmatch(DIGEST, body["subject"]) or not set(body["consent"]) <= {
            *SCOPES
        }:
            raise ValueError("a consent with invalid values")
        notes.consents[body["subject"]] = dict(body)
        notes.records.add(body["record"])


def _entry_line(place: Place, key: str) -> dict[str, Any]:
    return {"entry": key, "content": json_object(place.read_small(key))}


def _consent_line(record: Record, secret: bytes) -> dict[str, Any]:
    return {
        "consent": list(consent_scope(record.provenance)),
        "subject": keyed_hash(secret, record.take),
        "created": record.created,
        "record": keyed_hash(secret, record.seal),
    }


def _add_lines(
    place: Place,
    missing: Callable[[Notes, bytes], list[dict[str, Any]]],
    *,
    is_repeated: bool,
) -> None:
    """Add the lines that are missing; a file that cannot be written is a warning,
    because the database is not.
    """
    path = place.marker_file()
    try:
        secret = require_secret(place)
        with _locked(path) as number:
            content = os.pread(number, MAX_STORE_JSON_BYTES, 0)
            # without a line whose writer was killed
            complete = content[: content.rfind(b"\n") + 1]
            notes = _notes_from(complete, str(path), secret) if complete else Notes()
            bodies = ([] if complete else [{"format": FORMAT}]) + missing(notes, secret)
            lines = [
                json.dumps({**body, "seal": keyed_seal(secret, LINE, body)})
                for body in bodies
            ]
            _append(
                number, len(complete), "".join(f"{line}\n" for line in lines).encode()
            )
    except UnavailableError:
        raise
    except (OSError, InputError) as error:
        if is_repeated:
            return
        rule = (
            "withdrawals and consents must be noted outside the database, so that a "
            "restore repeats them"
        )
        fault = (
            system_fault(error, str(path))
            if isinstance(error, OSError)
            else error.faults[0]
        )
        warnings.warn(MarkerFileWarning(str(replace(fault, rule=rule))), stacklevel=2)


@contextmanager
def _locked(path: Path) -> Iterator[int]:
    """Descriptor of a marker file, which is created if it is missing, and which no
    other process writes.
    """
    make_private(path.parent)
    is_new = not path.exists()
    number = os.open(
        path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK, PRIVATE_FILE
    )
    try:
        if not stat.S_ISREG(os.fstat(number).st_mode):
            raise OSError(
                errno.EINVAL, "something that is not a regular file", str(path)
            )
        fcntl.flock(number, fcntl.LOCK_EX)
        try:
            yield number
            if is_new:
                flush_path(path.resolve().parent)
        finally:
            # closing alone keeps it while a copy of the descriptor is open
            fcntl.flock(number, fcntl.LOCK_UN)
    finally:
        os.close(number)


def _append(number: int, size: int, content: bytes) -> None:
    """Write durably at the end of a file of this size, everything or nothing."""
    os.ftruncate(number, size)
    if not content:
        return
    try:
        if os.pwrite(number, content, size) < len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fsync(number)
    except OSError:
        os.ftruncate(number, size)
        raise
