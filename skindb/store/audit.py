"""The audit log: an entry for each action that changes or discloses data of subjects.

`audit/<block>/<number>.json` is an entry, a sealed JSON record. It names the seal of
the entry before it, and its own seal is keyed with the random bytes in `secret`, so
that it belongs to this database and number. Subjects are named by their keyed hashes.
An entry is created only if its number is free: of two writers with the same number one
starts again with the next number. Blocks have a limited size, so that the last number
is found by listing one of them.
"""

import json
import re
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, get_origin, get_type_hints

from skindb import __version__
from skindb.clock import utc_time
from skindb.errors import Fault, InputError, UnavailableError, attempt, input_error
from skindb.store.markers import is_sealed, keyed_hash, keyed_seal, require_secret
from skindb.store.place import AUDIT, Place, in_parallel, subject_of
from skindb.store.record import damage_as_fault, json_object, require_format

FORMAT = 1
BLOCK = 1_000  # numbers in a folder
BLOCK_NAME = r"[0-9]{6}"
ENTRY_NAME = r"[0-9]{9}\.json"
# of a writer; each failed attempt means that another writer has created an entry
MAX_ATTEMPTS = 1_000
RULE = "an entry of the audit log must be as it was created"
RESTORE = "restore it from a backup"


@dataclass(frozen=True)
class AuditEntry:
    """An action that was begun."""

    number: int  # from 1
    id: str  # random, so that no two entries are the same
    when: str  # ISO 8601 in UTC
    actor: str
    action: str
    subjects: list[str]  # keyed hashes of pseudonyms, sorted
    counts: dict[str, int]
    parameters: dict[str, Any]  # without personal data
    software_version: str
    # seal of the entry before this one; empty if there was none, or if it could not be
    # read
    previous: str
    seal: str = field(compare=False)


def append_entry(
    place: Place,
    action: str,
    *,
    actor: str,
    takes: Iterable[str] = (),
    subjects: Iterable[str] = (),
    counts: Mapping[str, int] | None = None,
    parameters: Mapping[str, Any] | None = None,
) -> None:
    """Create the next entry durably.

    Parameters
    ----------
    place
        Location of the database.
    action
        Name of the action.
    actor
        Who acts.
    takes, subjects
        Whose data the action changes or discloses; only the hashes of the subjects and
        the number of takes are stored.
    counts, parameters
        Further numbers, and options, without personal data.

    Raises
    ------
    OSError, InputError
        If the place cannot be written, or if the secret of the database is missing or damaged.
    """
    secret = require_secret(place)
    distinct = {*takes}
    names = {*subjects, *map(subject_of, distinct)}
    numbers = {"takes": len(distinct)} if distinct else {}
    fields = {
        "format": FORMAT,
        "id": uuid.uuid4().hex,
        "when": utc_time(),
        "actor": actor,
        "action": action,
        "subjects": sorted(keyed_hash(secret, name) for name in names),
        "counts": numbers | dict(counts or {}),
        "parameters": dict(parameters or {}),
        "software_version": __version__,
    }
    for _ in range(MAX_ATTEMPTS):
        newest = _last_number(place)
        before = _outcome(place, secret, newest) if newest else None
        # `read_audit` reports one that cannot be read
        seal = before.seal if isinstance(before, AuditEntry) else ""
        body = fields | {"number": newest + 1, "previous": seal}
        key = entry_key(newest + 1)
        content = json.dumps(body | {"seal": keyed_seal(secret, key, body)}).encode()
        if place.create(key, content):
            return
    raise input_error(
        place.where(AUDIT),
        "must have a free number",
        "none",
        "run skindb verify, which names unknown files there",
    )


def read_audit(
    place: Place, *, subject: str | None = None
) -> tuple[list[AuditEntry], list[Fault]]:
    """The readable entries, oldest first, and the faults of the whole log.

    Parameters
    ----------
    place
        Location of the database.
    subject
        Pseudonym, for the entries that concern this subject only.
    """
    file_type = place.file_type(AUDIT)
    if not file_type:
        return [], []
    if file_type != "folder":
        return [], [
            Fault(place.where(AUDIT), "must be a folder", f"a {file_type}", RESTORE)
        ]
    numbers: list[int] = []
    faults: list[Fault] = []
    for block in _blocks(place):
        numbers += attempt(faults, partial(_numbers, place, block)) or ()
    secret = attempt(faults, partial(require_secret, place))
    if secret is None:
        return [], faults
    entries = {}
    outcomes = in_parallel(partial(_outcome, place, secret), numbers)
    for number, outcome in zip(numbers, outcomes, strict=True):
        if isinstance(outcome, Fault):
            faults.append(outcome)
        else:
            entries[number] = outcome
    faults += _chain_faults(place, numbers, entries)
    selected = list(entries.values())
    if subject is not None:
        name = keyed_hash(secret, subject)
        selected = [entry for entry in selected if name in entry.subjects]
    return selected, faults


def entry_key(number: int) -> str:
    """Key of an entry."""
    return f"{AUDIT}/{number // BLOCK:06d}/{number:09d}.json"


def _last_number(place: Place) -> int:
    """Number of the last entry, from a list of the blocks and one of the last block; 0
    if there is none.
    """
    for block in reversed(_blocks(place)):
        if numbers := _numbers(place, block):
            return numbers[-1]
    return 0


def _blocks(place: Place) -> list[str]:
    """Names of the folders of entries; those that are links are refused when they are read."""
    names = place.children(AUDIT, links=True)
    return [name for name in names if re.fullmatch(BLOCK_NAME, name)]


def _numbers(place: Place, block: str) -> list[int]:
    """Numbers of the entries of a block in order; `verify` reports other names."""
    folder = f"{AUDIT}/{block}"
    names = place.children(folder, links=True)
    numbers = [int(name[:9]) for name in names if re.fullmatch(ENTRY_NAME, name)]
    return [number for number in numbers if entry_key(number).startswith(folder)]


def _outcome(place: Place, secret: bytes, number: int) -> AuditEntry | Fault:
    """An entry, or what is wrong with it."""
    key = entry_key(number)
    try:
        with damage_as_fault(place.where(key), RULE, RESTORE):
            body = json_object(place.read_small(key))
            if body.get("number") != number:
                raise ValueError(f"the entry of number {str(body.get('number'))[:20]}")
            if not is_sealed(secret, key, body):
                raise ValueError("content that does not match its seal")
            require_format("log entry", body.pop("format", None), FORMAT)
            types = get_type_hints(AuditEntry)
            if body.keys() != types.keys() or not all(
                isinstance(body[name], get_origin(kind) or kind)
                for name, kind in types.items()
            ):
                raise ValueError("fields that do not match its format")
            return AuditEntry(**body)
    except UnavailableError:
        raise
    except InputError as error:
        return error.faults[0]


def _chain_faults(
    place: Place, numbers: list[int], entries: Mapping[int, AuditEntry]
) -> Iterator[Fault]:
    """Faults of entries that are missing or do not follow the entry before them."""
    expected = 1
    for number in numbers:
        if number > expected:
            rule = f"entry {expected} must exist"
            if number > expected + 1:
                rule = f"entries {expected} to {number - 1} must exist"
            yield Fault(place.where(AUDIT), rule, "no such file", RESTORE)
        expected = number + 1
        entry = entries.get(number)
        before = entries.get(number - 1)
        if entry and before and entry.previous not in ("", before.seal):
            yield Fault(
                place.where(entry_key(number)),
                f"entry {number} must follow the entry before it",
                "an entry that names a different predecessor",
                RESTORE,
            )
