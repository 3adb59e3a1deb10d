"""A subject removed from a database, with everything that was made from it."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from skindb.errors import Fault, InputError
from skindb.schema.consent import CONSENT
from skindb.store import RELEASE, STUDY, Database, Record, UnavailableError
from skindb.store.release import commit_release
from skindb.workflow.registration import register_takes
from skindb.workflow.upkeep import repeat_edit, repeat_study

SUBJECT = r"[A-Za-z0-9_-]{1,64}"
SCRATCH_DIGEST = r"-[0-9a-f]{16}"  # what the names of scratch folders of an ingest end with


@dataclass(frozen=True)
class Withdrawal:
    """What a withdrawal removes, or has removed."""

    subject: str
    versions: tuple[str, ...]  # of the subject
    users: tuple[str, ...]  # versions of others and of populations that were made from them, or that name the subject
    made_again: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()  # why some of these could not be computed again
    tombstone: dict[str, Any] = field(default_factory=dict)


def plan_withdrawal(db: Database, subject: str) -> Withdrawal:
    """What `withdraw` would remove.

    Raises
    ------
    InputError
        If nothing of the subject is stored.
    """
    holdings, users = ([], []) if not re.fullmatch(SUBJECT, subject) else (db.holdings(subject), db.users(subject))
    if not holdings and not users and not _scratch(db, subject):
        known = ", ".join(db.subjects()[:8]) or "none"
        raise InputError(Fault(subject, "the database must hold the subject", f"subjects: {known}", "see skindb info"))
    own = [f"{kind} of {take}: {_count(db, kind, take)}" for kind, take in holdings]
    return Withdrawal(subject, tuple(own), tuple(map(_name, users)))


def withdraw(db: Database, subject: str, *, dictionary: Path | None = None, wait: float = 0.0) -> Withdrawal:
    """Remove a subject: every version of every take, and every result that used one of them.

    Studies, registrations, releases and edits of others that used the subject are computed again without it, then their
    old generations are removed. Killed at any point, the same call removes the rest.

    Parameters
    ----------
    db
        Database.
    subject
        Pseudonym.
    dictionary
        Path of the dictionary of the fits; default the embedded one.
    wait
        Seconds to wait for a run that works on a take of the subject.

    Returns
    -------
    Withdrawal
        What was removed and computed again. Results that could not be computed again are removed too; `faults` has the
        reasons.

    Raises
    ------
    InputError
        If nothing of the subject is stored, or if another run works on one of its takes.
    """
    plan = plan_withdrawal(db, subject)
    with ExitStack() as leases:
        for take in sorted({take for kind, take in db.holdings(subject) if kind != CONSENT}):
            leases.enter_context(db.lease(take, "capture", "model", wait=wait, command="skindb withdraw"))
        return _withdraw(db, plan, dictionary)


def _withdraw(db: Database, plan: Withdrawal, dictionary: Path | None) -> Withdrawal:
    subject, removed = plan.subject, Counter[str]()
    try:
        db.record_consent(subject, [], withdrawn=True)  # from here on nothing reads the subject's data any more
    except UnavailableError:
        raise
    except InputError:
        pass  # its records are damaged, or a killed withdrawal left nothing but results of others
    made, faults = _make_again(db, subject, db.users(subject), dictionary)
    removed += _remove_users(db, subject)
    for folder in _scratch(db, subject):
        shutil.rmtree(folder)
    removed += db.erase(subject)
    removed += _remove_users(db, subject)  # committed by another process while the data still existed
    stone = db.leave_tombstone(removed)
    return Withdrawal(subject, plan.versions, plan.users, tuple(made), tuple(faults), stone)


def _remove_users(db: Database, subject: str) -> Counter[str]:
    users = db.users(subject)
    for record in users:
        db.remove(record)
    return Counter(record.kind for record in users)


def _make_again(
    db: Database, subject: str, users: Iterable[Record], dictionary: Path | None
) -> tuple[list[str], list[str]]:
    """Newest results that used the subject, made without it; what was made, and why others could not be."""
    gone = {record.seal for record in users}
    current = [record for record in users if db.readable_history(record.kind, record.take)[-1].seal == record.seal]
    calls: list[tuple[str, Callable[[], object]]] = []
    if any(record.kind == "registration" for record in current):
        calls.append(("registration", partial(_register, db, current)))
    makers: dict[str, Callable[[Record], object]] = {
        RELEASE: lambda record: _revise(db, record, subject, gone),
        STUDY: lambda record: repeat_study(db, record, dictionary=dictionary),
        "edit": lambda record: repeat_edit(db, record, dictionary=dictionary),
    }
    calls += [(_name(one), partial(make, one)) for kind, make in makers.items() for one in current if one.kind == kind]
    made, faults = [], []
    for name, call in calls:
        try:
            call()
            made.append(name)
        except UnavailableError:
            raise
        except InputError as error:
            faults.append(f"{name}: {error}")
    return made, faults


def _register(db: Database, current: Iterable[Record]) -> None:
    one = next(record for record in current if record.kind == "registration")
    reference = one.about.get("parameters", {}).get("reference") or None
    there = reference is not None and "statistics" in db.consent(reference)
    register_takes(db, reference=reference if there else None)


def _revise(db: Database, record: Record, subject: str, gone: set[str]) -> None:
    """The next revision of a release: without the subject, and with new registrations of the models it names."""
    kept = [one for one in record.made_from if one["seal"] not in gone and one["take"].partition(".")[0] != subject]
    models = {one["take"]: one["seal"] for one in kept if one["kind"] == "model"}
    for one in record.made_from:
        if one["kind"] == "registration" and one["seal"] in gone and one["take"] in models:
            newest = db.record("registration", one["take"])
            if models[one["take"]] in {made["seal"] for made in newest.made_from} and newest.seal not in gone:
                kept.append(newest.as_input())
    if not kept:
        raise InputError(Fault(record.take, "a release needs fitted takes", "none is left", ""))
    commit_release(db, record.take, kept)


def _scratch(db: Database, subject: str) -> list[Path]:
    """Scratch folders of ingests of the subject on this machine."""
    name = re.compile(rf"{re.escape(subject)}(\.[A-Za-z0-9_-]+)?{SCRATCH_DIGEST}(\.gone)?.*")
    place = db.scratch()
    return [folder for folder in place.iterdir() if name.fullmatch(folder.name)] if place.is_dir() else []


def _count(db: Database, kind: str, take: str) -> str:
    count = len(db.readable_history(kind, take))
    return f"{count} version{'' if count == 1 else 's'}" if count else "no whole version"


def _name(record: Record) -> str:
    return f"{record.kind} {record.generation} of {record.take}"
