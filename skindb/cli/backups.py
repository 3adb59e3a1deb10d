"""Commands for backups: backup, restore."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import skindb
from skindb.cli.options import DB, PATH, common
from skindb.cli.shared import aligned, emit, existing

if TYPE_CHECKING:
    from skindb.store import BackupReport, Restored


@click.command()
@DB
@click.argument("destination", metavar="BACKUP")
@click.option(
    "--verify",
    is_flag=True,
    help="Read the whole backup again, and name every damaged file.",
)
@common
def backup(db: str, destination: str, verify: bool) -> None:
    """Write the present state of a database to BACKUP, a folder or a bucket.

    Only files that BACKUP does not have are copied. Commands may write to the database
    meanwhile. An interrupted backup is continued by the same command. Subjects who were
    withdrawn are removed from all earlier states.
    """
    report = skindb.workflow.backup(existing(db), destination, verify=verify)
    lines = [
        f"state {report.number}: {report.versions} versions",
        f"files: {report.copied} copied ({report.bytes / 1e6:.1f} MB), {report.present} present, "
        f"{report.removed} removed",
    ]
    emit(_as_json(report), lines, report.faults)


@click.command()
@click.argument("source", metavar="BACKUP")
@click.argument("db", metavar="DB", required=False)
@click.option(
    "--list", "only_list", is_flag=True, help="Only list the states of the backup."
)
@click.option(
    "--at",
    "number",
    type=int,
    metavar="NUMBER",
    help="Number of the state.  [default: the newest]",
)
@click.option(
    "--markers",
    type=PATH,
    help=(
        "Marker file of the lost database, which notes later withdrawals and consents. "
        " [default: DB.markers]"
    ),
)
@click.option(
    "--without-markers",
    is_flag=True,
    help=(
        "Restore without a marker file, although subjects who were withdrawn after the "
        "backup then come back."
    ),
)
@common
def restore(
    source: str,
    db: str | None,
    only_list: bool,
    number: int | None,
    markers: Path | None,
    without_markers: bool,
) -> None:
    """Restore the database of BACKUP to DB, a folder or a bucket that is empty or missing.

    Withdrawals and consents that came after the backup are repeated from the marker
    file. An interrupted restore is continued by the same command, and until then every
    other command refuses DB.
    """
    if only_list:
        states = skindb.workflow.backup_states(source)
        rows = [
            [f"state {one.number}", one.created, f"{one.versions} versions"]
            for one in states
        ]
        listed = [
            {"number": one.number, "created": one.created, "versions": one.versions}
            for one in states
        ]
        emit(listed, aligned(rows) if rows else ["no states"])
        return
    if db is None:
        raise click.UsageError("Missing argument 'DB'.")
    if markers is not None and without_markers:
        raise click.UsageError("--markers and --without-markers exclude each other")
    done = skindb.workflow.restore(
        source, db, number=number, markers=markers, without_markers=without_markers
    )
    emit(_as_json(done), _restored_lines(done, without_markers), done.faults)


def _restored_lines(done: Restored, without_markers: bool) -> list[str]:
    lines = [
        (
            f"state {done.number} of {done.created}: {done.versions} versions, "
            f"{done.bytes / 1e6:.1f} MB"
        )
    ]
    if without_markers:
        lines.append(
            "subjects who were withdrawn after this state are in the database "
            "again: withdraw them again"
        )
    if done.skipped:
        lines.append(f"not restored, because of withdrawals: {done.skipped} versions")
    if done.requests:
        lines.append(f"results to be computed again by skindb refresh: {done.requests}")
    if done.consents:
        lines.append(f"later records of consent, repeated: {done.consents}")
    if done.unknown_consents:
        lines.append(
            "later records of consent of subjects who are not in this state: "
            f"{done.unknown_consents}; "
            "record them again when their captures are ingested"
        )
    return lines


def _as_json(report: BackupReport | Restored) -> dict[str, Any]:
    return {name: value for name, value in asdict(report).items() if name != "faults"}
