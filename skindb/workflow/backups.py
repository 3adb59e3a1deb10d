"""Backups of a database, and databases that are restored from them."""

from __future__ import annotations

from pathlib import Path

from skindb import store
from skindb.store import BackupReport, Database, Restored, State
from skindb.workflow.audit import logged_action


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
