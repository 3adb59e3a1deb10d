"""Decisions about the subjects and versions of a database that compute nothing, and are logged."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from skindb.store import Database, Garbage, Record
from skindb.workflow.audit import logged_action


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
