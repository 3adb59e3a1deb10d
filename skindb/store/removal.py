"""Versions with data of a subject, and their permanent removal."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from skindb.errors import InputError
from skindb.schema.consent import CONSENT
from skindb.store.inputs import KINDS_WITHOUT_SUBJECT
from skindb.store.kinds import RELEASE, STUDY
from skindb.store.log import Log
from skindb.store.paths import KIND, TAKE, TRANSIENT, subject_of
from skindb.store.place import Place, UnavailableError
from skindb.store.record import FORMAT, Record, seal_of

if TYPE_CHECKING:
    from skindb.store.database import Database

# parts of a provenance that name takes
PARTS_WITH_TAKES = ("skipped", "outdated", "registration", "study_takes", "parameters")
FOLDERS_WITH_TAKES = ("log", "data", "heads", "leases")  # folders with one entry per kind, and below it one per take
REMOVAL_ORDER = ("edit", STUDY, RELEASE, "summary", "registration", "model", "capture")  # results before their inputs


def takes_of(place: Place, subject: str) -> list[tuple[str, str]]:
    """Kind and take of all versions of a subject, including unfinished ones; the consent comes last."""
    found = set()
    for top in FOLDERS_WITH_TAKES:
        for kind in place.children(top):
            if re.fullmatch(KIND, kind) and kind not in KINDS_WITHOUT_SUBJECT:
                names = (name.removesuffix(".json") for name in place.children(f"{top}/{kind}"))
                found |= {(kind, name) for name in names if re.fullmatch(TAKE, name) and subject_of(name) == subject}
    return sorted(found, key=lambda one: (one[0] == CONSENT, _rank(one[0]), one))


def users_of(db: Database, subject: str) -> list[Record]:
    """Versions of other subjects and of populations that were made from data of a subject or name it.

    All generations are considered, and the versions that were made from those found. Results come before their inputs.
    """
    records = list(_every_record(db))
    affected = {_key(record) for record in records if _belongs_to(record, subject) or _mentions(record, subject)}
    while more := {_key(r) for r in records if any(_input_key(one) in affected for one in r.made_from)} - affected:
        affected |= more
    users = [record for record in records if _key(record) in affected and not _belongs_to(record, subject)]
    return sorted(users, key=lambda record: (_rank(record.kind), record.take, record.generation))


def erase_take(place: Place, kind: str, take: str) -> int:
    """Remove all files of a kind of a take: versions, records including damaged ones, and files of killed runs.

    Each readable record leaves a tombstone. The same call completes a removal that was interrupted.

    Returns
    -------
    int
        Number of records that were removed.
    """
    log = Log(place, kind, take)
    generations = log.generations()
    for generation in generations if kind not in TRANSIENT else []:
        try:
            log.remove(generation)
        except UnavailableError:
            raise
        except InputError:
            continue  # the files of a damaged record and its version are removed below
    for key in (f"data/{kind}/{take}", f"leases/{kind}/{take}", f"heads/{kind}/{take}.json", f"log/{kind}/{take}"):
        place.remove(key)
    return len(generations) if kind not in TRANSIENT else 0


def leave_tombstone(place: Place, removed: Counter[str]) -> dict[str, Any]:
    """Record that a subject was removed, with the number of versions of each kind, without the pseudonym."""
    stone: dict[str, Any] = {"format": FORMAT, "withdrawn": datetime.now(UTC).isoformat(timespec="seconds")}
    stone["removed"] = {kind: count for kind, count in sorted(removed.items()) if count}
    seal = seal_of(stone)
    place.create(f"tombstones/{seal}.json", json.dumps(stone | {"seal": seal}).encode())
    return stone | {"seal": seal}


def _every_record(db: Database) -> Iterator[Record]:
    for kind in db.kinds():
        for take in db.takes(kind):
            yield from db.readable_history(kind, take)


def _belongs_to(record: Record, subject: str) -> bool:
    return record.kind not in KINDS_WITHOUT_SUBJECT and subject_of(record.take) == subject


def _mentions(record: Record, subject: str) -> bool:
    """Whether a record names a version of the subject, or the subject itself."""
    if any(one["kind"] not in KINDS_WITHOUT_SUBJECT and subject_of(one["take"]) == subject for one in record.made_from):
        return True
    parts: list[Any] = [record.provenance.get(name) for name in PARTS_WITH_TAKES]
    parts += [group.get("labels", {}).get("take") for group in record.contents.values()]
    name = re.compile(rf"(?<![A-Za-z0-9_-]){re.escape(subject)}(?![A-Za-z0-9_-])")
    return any(name.search(text) for text in _texts(parts))


def _texts(value: Any) -> Iterable[str]:
    """All strings in nested lists and in values of nested dicts."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for one in value.values() if isinstance(value, dict) else value:
            yield from _texts(one)


def _key(record: Record) -> tuple[str, str, str]:
    return record.kind, record.take, record.seal


def _input_key(one: dict[str, Any]) -> tuple[str, str, str]:
    return one["kind"], one["take"], one.get("seal", "")


def _rank(kind: str) -> int:
    return REMOVAL_ORDER.index(kind) if kind in REMOVAL_ORDER else len(REMOVAL_ORDER)
