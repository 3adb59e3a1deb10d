"""Consent, releases, cleaning and backups: actions that compute nothing, and are logged; and
the results that are out of date.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from skindb import store
from skindb.errors import InputError
from skindb.store import (
    CALIBRATION,
    RELEASE,
    STUDY,
    BackupReport,
    Database,
    Garbage,
    Record,
    Request,
    Restored,
    State,
    UnavailableError,
    stale_versions,
)
from skindb.workflow.audit import logged_action

MAX_NAMED = 8  # takes in one line
# of results that become stale, in order of dependence
KINDS = ("model", "registration", STUDY, "edit", RELEASE)
REQUESTED = "a subject was withdrawn"


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


def restore(
    source: str,
    url: str,
    *,
    number: int | None = None,
    markers: Path | None = None,
    without_markers: bool = False,
) -> Restored:
    """Restore a database from a backup; see `skindb.store.restore`.

    It is logged at its end, because the audit log itself is restored.
    """
    restored = store.restore(
        source, url, number=number, markers=markers, without_markers=without_markers
    )
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
        words = [self.kind, *([str(self.generation)] if self.generation else [])]
        return " ".join([*words, *(["of", self.take] if self.take else [])])


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
    newest = dict[str, int]()
    for name in db.takes(CALIBRATION):
        try:
            newest[name] = db.record(CALIBRATION, name).generation
        except UnavailableError:
            raise
        except InputError:
            continue
    superseded = dict[str, list[str]]()
    for take in db.takes("capture") if max(newest.values(), default=1) > 1 else ():
        try:
            calibration = (
                db.record("capture", take).provenance.get("calibrated_by") or {}
            )
        except UnavailableError:
            raise
        except InputError:
            continue
        if calibration.get("generation", 0) < newest.get(
            str(calibration.get("take")), 0
        ):
            superseded.setdefault(str(calibration["take"]), []).append(take)
    return {name: sorted(takes) for name, takes in sorted(superseded.items())}


def superseded_lines(superseded: Mapping[str, Sequence[str]]) -> list[str]:
    """What `superseded_calibrations` found in words, one line for each calibration:
    what happened and what to do.
    """
    lines = []
    for name, takes in superseded.items():
        count = "1 take was" if len(takes) == 1 else f"{len(takes)} takes were"
        named = (
            f"{', '.join(takes[:MAX_NAMED])}{', ...' if len(takes) > MAX_NAMED else ''}"
        )
        lines.append(
            f"{count} ingested with an earlier version of calibration {name}: "
            f"{named}; run skindb ingest again"
        )
    return lines
