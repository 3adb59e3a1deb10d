"""A subject removed from a database, with everything that was made from it.

The data are erased before anything is computed again, and this module imports no code
that computes.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import skindb
from skindb import __version__
from skindb.errors import Fault, InputError
from skindb.files import write_private
from skindb.store import Database, Holdings, seal_of
from skindb.workflow.audit import logged_action

if TYPE_CHECKING:
    from skindb.workflow.administration import Refreshed

NOT_REACHED = (
    "capture folders",
    "exports, pages, pictures and notebooks that were made from the database",
    "backups that were not given to the command, which may still contain the subject",
    "snapshots of disks, and earlier versions of objects in a bucket that keeps them",
    "scratch folders of interrupted ingests on other machines, until skindb clean runs there",
    "blocks of a disk that were freed but not overwritten yet",
)


@dataclass(frozen=True)
class Withdrawal:
    """What a withdrawal removes, or has removed."""

    subject: str
    versions: tuple[str, ...]  # of the subject
    # versions of others and of populations that refer to the subject
    users: tuple[str, ...]
    removed: dict[str, int]  # kind -> number of versions
    # removed results that were computed again, or that wait for it
    repeated: tuple[Refreshed, ...] = ()
    revised: tuple[str, ...] = ()  # releases with a new revision
    lost: tuple[str, ...] = ()  # removed results for which no other take was used
    backups: tuple[int, ...] = ()  # number of files that were removed from each backup
    date: str = ""


def plan_withdrawal(
    db: Database, subject: str, *, backups: Sequence[str] = ()
) -> Withdrawal:
    """What `withdraw` would remove from the database.

    Raises
    ------
    InputError
        If nothing of the subject is stored, or if there is no backup of this database
        at one of `backups`.
    """
    for url in backups:
        db.require_backup(url)
    is_erased = bool(backups) and _is_erased(db, subject)
    holdings = Holdings() if is_erased else db.holdings(subject)
    entry = db.withdrawal(subject)
    removed = holdings.counts
    # which was interrupted, and may have removed some of them
    if entry is not None and entry.is_withdrawal:
        removed |= Counter(entry.body.get("removed", {}))
    versions = tuple(
        f"{kind} of {take}: {_count(number)}"
        for (kind, take), number in holdings.takes.items()
    )
    users = tuple(
        f"{record.kind} {record.generation} of {record.take}"
        for record in holdings.versions
    )
    return Withdrawal(subject, versions, users, dict(sorted(removed.items())))


def withdraw(
    db: Database,
    subject: str,
    *,
    dictionary: Path | None = None,
    wait: float = 0.0,
    backups: Sequence[str] = (),
) -> Withdrawal:
    """Remove a subject: every version of every take, and every result that refers to one of them.

    First everything is erased, also in the backups, and releases get a new revision.
    Then studies, registrations and edits of others are computed again without the
    subject. One that cannot be computed now waits for `refresh`. If the process is
    killed at any point, the same call removes the rest.

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
    backups
        Folders or buckets of backups of the database, from whose states the subject is
        erased too. They can also be given later, when the database holds nothing of the
        subject any more.

    Returns
    -------
    Withdrawal
        What was removed and computed again.

    Raises
    ------
    InputError
        If nothing of the subject is stored, or if another run works on one of its takes.
    """
    plan = plan_withdrawal(db, subject, backups=backups)
    counts = plan.removed | ({"backups": len(backups)} if backups else {})
    with logged_action(db, "withdrawal", subjects=[subject], counts=counts):
        erasure = (
            db.complete_erasures()
            if _is_erased(db, subject)
            else db.erase(subject, wait=wait)
        )
        erased, faults = _erase_from_backups(db, backups, wait)
        repeated = skindb.workflow.repeat_requests(db, dictionary=dictionary)
    if faults:
        raise InputError(faults)
    return Withdrawal(
        subject,
        plan.versions,
        plan.users,
        dict(sorted((Counter(plan.removed) | erasure.removed).items())),
        tuple(repeated),
        tuple(erasure.revised),
        tuple(erasure.lost),
        erased,
        datetime.now(UTC).isoformat(timespec="seconds"),
    )


def _erase_from_backups(
    db: Database, backups: Sequence[str], wait: float
) -> tuple[tuple[int, ...], list[Fault]]:
    """Remove withdrawn subjects from every backup, and collect the faults of those
    where that failed.
    """
    erased: list[int] = []
    faults: list[Fault] = []
    for url in backups:
        try:
            erased.append(db.erase_from_backup(url, wait=wait))
        except InputError as error:  # the others are erased nevertheless
            title = f"backup {url}, from which the subject is not removed yet"
            faults += [
                replace(fault, where=f"{title}: {fault.where}")
                for fault in error.faults
            ]
    return tuple(erased), faults


def erasure_report(withdrawal: Withdrawal) -> dict[str, Any]:
    """A report of a withdrawal that can be handed out: it contains no pseudonym,
    attribute, name or path.
    """
    again = Counter(
        result.kind for result in withdrawal.repeated if result.record is not None
    )
    waiting = Counter(
        result.kind for result in withdrawal.repeated if result.record is None
    )
    body = {
        "completed": withdrawal.date,
        "software_version": __version__,
        "removed_versions": withdrawal.removed,
        "computed_again": dict(sorted(again.items())),
        "waiting_for_refresh": dict(sorted(waiting.items())),
        "revised_releases": len(withdrawal.revised),
        "results_without_other_takes": len(withdrawal.lost),
        "erased_backups": len(withdrawal.backups),
        "not_reached": list(NOT_REACHED),
    }
    return body | {"seal": seal_of(body)}


def write_erasure_report(withdrawal: Withdrawal, path: Path) -> list[Path]:
    """Write a report as JSON and as text, under a path without or with one of the
    endings .json and .txt.
    """
    report = erasure_report(withdrawal)
    stem = path.with_suffix("") if path.suffix in (".json", ".txt") else path
    contents = {
        ".json": json.dumps(report, indent=1),
        ".txt": "\n".join(_report_lines(report)),
    }
    paths = []
    for ending, content in contents.items():
        file = stem.with_name(f"{stem.name}{ending}")
        write_private(file, f"{content}\n".encode())
        paths.append(file)
    return paths


def _is_erased(db: Database, subject: str) -> bool:
    """Whether a subject was withdrawn, and nothing of any withdrawn subject is left."""
    return db.markers().is_withdrawn(subject) and not db.has_remains()


def _report_lines(report: dict[str, Any]) -> list[str]:
    counts = {
        "Removed versions": report["removed_versions"],
        "Computed again without the subject": report["computed_again"],
        "Waiting to be computed again (skindb refresh)": report["waiting_for_refresh"],
    }
    lines = [
        "Erasure of one subject from a skindb database",
        "",
        f"Completed: {report['completed']}",
        f"Software: skindb {report['software_version']}",
    ]
    for title, numbers in counts.items():
        parts = [f"{number} of kind {kind}" for kind, number in numbers.items()]
        lines.append(f"{title}: {', '.join(parts) or 'none'}")
    lines += [
        f"Releases with a new revision: {report['revised_releases']}",
        f"Results for which no other take was used: {report['results_without_other_takes']}",
        f"Backups from which the subject was erased: {report['erased_backups']}",
        "",
        "The erasure does not reach:",
        *(f"- {place}" for place in report["not_reached"]),
        "",
        f"Seal (SHA-256 of the report): {report['seal']}",
    ]
    return lines


def _count(number: int) -> str:
    if not number:
        return "no complete version"
    return f"{number} version{'' if number == 1 else 's'}"
