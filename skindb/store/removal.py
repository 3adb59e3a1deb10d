"""Versions that hold data of a subject, and their permanent removal."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from skindb.errors import InputError
from skindb.schema.consent import CONSENT
from skindb.store.inputs import OF_NO_SUBJECT
from skindb.store.kinds import RELEASE, STUDY
from skindb.store.log import Log
from skindb.store.paths import KIND, TAKE, TRANSIENT, subject_of
from skindb.store.place import Place, UnavailableError
from skindb.store.record import FORMAT, Record, seal_of

if TYPE_CHECKING:
    from skindb.store.database import Database

MENTIONS = ("skipped", "outdated", "registration", "study_takes", "parameters")  # parts of a provenance that name takes
PLACES = ("log", "data", "heads", "leases")  # folders with one entry for each kind, and below it one for each take
ORDER = ("edit", STUDY, RELEASE, "summary", "registration", "model", "capture")  # results before what they are made of


def takes_of(place: Place, subject: str) -> list[tuple[str, str]]:
    """Kind and take of everything that is, or was begun to be, stored of a subject; consent comes last."""
    found = set()
    for top in PLACES:
        for kind in place.children(top):
            if re.fullmatch(KIND, kind) and kind not in OF_NO_SUBJECT:
                names = (name.removesuffix(".json") for name in place.children(f"{top}/{kind}"))
                found |= {(kind, name) for name in names if re.fullmatch(TAKE, name) and subject_of(name) == subject}
    return sorted(found, key=lambda one: (one[0] == CONSENT, _rank(one[0]), one))


def users_of(db: Database, subject: str) -> list[Record]:
    """Versions of other subjects and of populations that were made from data of a subject, or that name it.

    Every generation counts, and what was made from such a version in turn. Results come before what they are made of.
    """
    records = list(_every_record(db))
    affected = {_key(record) for record in records if _is_of(record, subject) or _mentions(record, subject)}
    while more := {_key(r) for r in records if any(_input_key(one) in affected for one in r.made_from)} - affected:
        affected |= more
    users = [record for record in records if _key(record) in affected and not _is_of(record, subject)]
    return sorted(users, key=lambda record: (_rank(record.kind), record.take, record.generation))


def erase_take(place: Place, kind: str, take: str) -> int:
    """Remove everything of a kind of a take: records, also damaged ones, versions and what killed runs left.

    Each record that can be read leaves a tombstone. Killed in the middle, the same call removes the rest.

    Returns
    -------
    int
        The number of records.
    """
    log = Log(place, kind, take)
    generations = log.generations()
    for generation in generations if kind not in TRANSIENT else []:
        try:
            log.remove(generation)
        except UnavailableError:
            raise
        except InputError:
            continue  # a damaged record: its file and its version are removed below
    for key in (f"data/{kind}/{take}", f"leases/{kind}/{take}", f"heads/{kind}/{take}.json", f"log/{kind}/{take}"):
        place.remove(key)
    return len(generations) if kind not in TRANSIENT else 0


def leave_tombstone(place: Place, removed: Counter[str]) -> dict[str, Any]:
    """Record that a subject was removed, with the number of versions of each kind but without the pseudonym."""
    stone: dict[str, Any] = {"format": FORMAT, "withdrawn": datetime.now(UTC).isoformat(timespec="seconds")}
    stone["removed"] = {kind: count for kind, count in sorted(removed.items()) if count}
    seal = seal_of(stone)
    place.create(f"tombstones/{seal}.json", json.dumps(stone | {"seal": seal}).encode())
    return stone | {"seal": seal}


def _every_record(db: Database) -> Iterator[Record]:
    for kind in db.kinds():
        for take in db.takes(kind):
            yield from db.readable_history(kind, take)


def _is_of(record: Record, subject: str) -> bool:
    return record.kind not in OF_NO_SUBJECT and subject_of(record.take) == subject


def _mentions(record: Record, subject: str) -> bool:
    """Whether a record names a version of the subject, or the subject itself."""
    if any(one["kind"] not in OF_NO_SUBJECT and subject_of(one["take"]) == subject for one in record.made_from):
        return True
    parts: list[Any] = [record.provenance.get(name) for name in MENTIONS]
    parts += [group.get("labels", {}).get("take") for group in record.contents.values()]
    name = re.compile(rf"(?<![A-Za-z0-9_-]){re.escape(subject)}(?![A-Za-z0-9_-])")
    return any(name.search(text) for text in _texts(parts))


def _texts(value: Any) -> Iterable[str]:
    """Every text in nested lists and values of dictionaries."""
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
    return ORDER.index(kind) if kind in ORDER else len(ORDER)
