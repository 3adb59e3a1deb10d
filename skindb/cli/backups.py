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
            [f"state {state.number}", state.created, f"{state.versions} versions"]
            for state in states
        ]
        listed = [
            {
                "number": state.number,
                "created": state.created,
                "versions": state.versions,
            }
            for state in states
        ]
        emit(listed, aligned(rows) if rows else ["no states"])
        return
    if db is None:
        raise click.UsageError("Missing argument 'DB'.")
    if markers is not None and without_markers:
        raise click.UsageError("--markers and --without-markers exclude each other")
    restored = skindb.workflow.restore(
        source, db, number=number, markers=markers, without_markers=without_markers
    )
    emit(
        _as_json(restored), _restored_lines(restored, without_markers), restored.faults
    )


def _restored_lines(restored: Restored, without_markers: bool) -> list[str]:
    lines = [
        (
            f"state {restored.number} of {restored.created}: {restored.versions} versions, "
            f"{restored.bytes / 1e6:.1f} MB"
        )
    ]
    if without_markers:
        lines.append(
            "subjects who were withdrawn after this state are in the database "
            "again: withdraw them again"
        )
    if restored.skipped:
        lines.append(
            f"not restored, because of withdrawals: {restored.skipped} versions"
        )
    if restored.requests:
        lines.append(
            f"results to be computed again by skindb refresh: {restored.requests}"
        )
    if restored.consents:
        lines.append(f"later records of consent, repeated: {restored.consents}")
    if restored.unknown_consents:
        lines.append(
            "later records of consent of subjects who are not in this state: "
            f"{restored.unknown_consents}; "
            "record them again when their captures are ingested"
        )
    return lines


def _as_json(report: BackupReport | Restored) -> dict[str, Any]:
    return {name: value for name, value in asdict(report).items() if name != "faults"}
