"""Consent, releases, cleaning, backups and withdrawals: actions that compute nothing, and are
logged; and the results that are out of date.

A withdrawal erases the data of a subject before anything is computed again, and this module
imports no code that computes.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import skindb
from skindb import __version__, store
from skindb.clock import utc_time
from skindb.errors import Fault, InputError, few_names, require_none
from skindb.files import Json, private_file
from skindb.store import (
    CALIBRATION,
    RELEASE,
    STUDY,
    BackupReport,
    Database,
    Garbage,
    Holdings,
    Record,
    Request,
    Restored,
    State,
    intact_or_none,
    seal_of,
    stale_versions,
)
from skindb.workflow.audit import logged_action

MAX_NAMED = 8  # takes in one line
# of results that become stale, in order of dependence
KINDS = ("model", "registration", STUDY, "edit", RELEASE)
REQUESTED = "a subject was withdrawn"
NOT_REACHED = (
    "capture folders",
    "exports, pages, pictures and notebooks that were made from the database",
    "backups that were not given to the command, which may still contain the subject",
    "snapshots of disks, and earlier versions of objects in a bucket that keeps them",
    "first passes of interrupted fits on other machines, until skindb clean runs there",
    "blocks of a disk that were freed but not overwritten yet",
)


def record_consent(db: Database, subject: str, scope: Iterable[str]) -> Record:
    """Record the consent of a subject; see `Database.record_consent`."""
    scopes = list(scope)
    counts = {"scopes": len(set(scopes))}
    with logged_action(db, "consent", subjects=[subject], counts=counts):
        return db.record_consent(subject, scopes)


def create_release(
    db: Database, name: str, takes: Sequence[str] | None = None
) -> Record:
    """Name the present versions of takes as a release; see `Database.create_release`."""
    chosen = db.takes("model") if takes is None else list(takes)
    with logged_action(db, "release", chosen):
        return db.create_release(name, chosen)


def clean(db: Database, *, generations: int | None = None) -> list[Garbage]:
    """Remove garbage, and old generations if their number is given; see `Database.clean`."""
    with logged_action(db, "clean", arguments={"generations": generations}):
        return db.clean(generations=generations)


def backup(db: Database, destination: str, *, verify: bool = False) -> BackupReport:
    """Write the present state of a database to a backup, which is created if there is none.

    Files that the backup has already are not copied again. Others may write to the
    database meanwhile. If the process is killed, the same call continues.

    Parameters
    ----------
    db
        Database.
    destination
        Folder or ``s3://bucket/prefix``, empty or a backup of the same database.
    verify
        Also read the whole backup again.

    Returns
    -------
    BackupReport
        Number of the state, of its versions and of files that were copied, and damaged files.

    Raises
    ------
    InputError
        If the database or the destination cannot be used, or if another run writes to the backup.
    """
    with logged_action(db, "backup", db.takes()):
        return db.backup(destination, verify=verify)


def backup_states(source: str) -> list[State]:
    """The states of a backup, oldest first, with their number, date and number of versions."""
    return store.backup_states(source)


def restore(source: str, url: str, **options: Any) -> Restored:
    """Restore a database from a backup; see `skindb.store.restore`, also for the options
    number, markers and without_markers.

    It is logged at its end, because the audit log itself is restored.
    """
    restored = store.restore(source, url, **options)
    db = Database(url)
    with logged_action(db, "restore", db.takes(), counts={"state": restored.number}):
        return restored


@dataclass(frozen=True)
class Refreshed:
    """A stale or removed version and what became of it."""

    kind: str
    take: str
    generation: int  # 0 if it was removed
    reasons: tuple[str, ...]
    record: Record | None = None  # what took its place
    fault: str = ""  # why nothing did

    @property
    def name(self) -> str:
        """Kind, generation and take, as shown in messages."""
        generation = f" {self.generation}" if self.generation else ""
        return f"{self.kind}{generation}" + (f" of {self.take}" if self.take else "")


def requested_result(request: Request) -> Refreshed:
    """A result that a withdrawal removed."""
    return Refreshed(request.kind, request.take, 0, (REQUESTED,))


def stale_results(db: Database) -> list[Refreshed]:
    """The results that withdrawals removed and the newest versions that are stale, in
    order of dependence, and why.
    """
    stale = [requested_result(request) for request in db.requests()]
    for record, reasons in stale_versions(db):
        texts = tuple(dict.fromkeys(map(str, reasons)))
        stale.append(Refreshed(record.kind, record.take, record.generation, texts))
    return sorted(stale, key=lambda result: KINDS.index(result.kind))


def superseded_calibrations(db: Database) -> dict[str, list[str]]:
    """Takes whose newest capture used an earlier version than the newest one of a calibration.

    Records of captures are read only if a calibration has more than one version.

    Parameters
    ----------
    db
        Database.

    Returns
    -------
    dict
        Name of a calibration -> takes, in order. A damaged record counts as none:
        `Database.verify` names it.
    """
    newest = {}
    for name in db.takes(CALIBRATION):
        record = intact_or_none(partial(db.record, CALIBRATION, name))
        if record is not None:
            newest[name] = record.generation
    superseded = dict[str, list[str]]()
    for take in db.takes("capture") if max(newest.values(), default=1) > 1 else ():
        record = intact_or_none(partial(db.record, "capture", take))
        calibration = record and record.provenance.get("calibrated_by")
        if calibration:
            name = calibration["take"]
            if calibration["generation"] < newest.get(name, 0):
                superseded.setdefault(name, []).append(take)
    return {name: sorted(takes) for name, takes in sorted(superseded.items())}


def superseded_lines(superseded: Mapping[str, Sequence[str]]) -> list[str]:
    """What `superseded_calibrations` found in words, one line for each calibration:
    what happened and what to do.
    """
    lines = []
    for name, takes in superseded.items():
        count = "1 take was" if len(takes) == 1 else f"{len(takes)} takes were"
        lines.append(
            f"{count} ingested with an earlier version of calibration {name}: "
            f"{few_names(takes, MAX_NAMED)}; run skindb ingest again"
        )
    return lines


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
    if entry is not None:
        removed |= Counter(entry.get("removed", {}))
    versions = tuple(
        f"{kind} of {take}: {number or 'no complete'} version{'' if number == 1 else 's'}"
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
    require_none(faults)
    return replace(
        plan,
        removed=dict(sorted((Counter(plan.removed) | erasure.removed).items())),
        repeated=tuple(repeated),
        revised=tuple(erasure.revised),
        lost=tuple(erasure.lost),
        backups=erased,
        date=utc_time(),
    )


def _erase_from_backups(
    db: Database, backups: Sequence[str], wait: float
) -> tuple[tuple[int, ...], list[Fault]]:
    """Remove withdrawn subjects from every backup, and collect the faults of those
    where that failed.
    """
    erased = []
    faults = []
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


def erasure_report(withdrawal: Withdrawal) -> Json:
    """A report of a withdrawal that can be handed out: it contains no pseudonym,
    attribute, name or path.
    """
    again, waiting = (
        Counter(
            result.kind
            for result in withdrawal.repeated
            if (result.record is None) == is_waiting
        )
        for is_waiting in (False, True)
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


def erasure_report_file(path: Path) -> Path:
    """File of a report under a path without or with the ending .json."""
    return path.with_name(f"{path.name.removesuffix('.json')}.json")


def write_erasure_report(withdrawal: Withdrawal, path: Path) -> Path:
    """Write a report as JSON, as `erasure_report_file` of this path."""
    file = erasure_report_file(path)
    content = json.dumps(erasure_report(withdrawal), indent=1)
    private_file(file).write_text(f"{content}\n", encoding="utf-8")
    return file


def _is_erased(db: Database, subject: str) -> bool:
    """Whether a subject was withdrawn, and nothing of any withdrawn subject is left."""
    return db.markers().is_withdrawn(subject) and not db.has_remains()
