"""Commands for consent and for results that depend on it: consent, release, refresh, withdraw."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

import skindb
from skindb import workflow
from skindb.cli.options import (
    DB,
    DICTIONARY,
    PATH,
    SCHEDULER,
    TAKES,
    WAIT,
    WHERE,
    WORKERS,
    asked,
    command,
)
from skindb.cli.shared import cluster, emit, require_folder, shared_path
from skindb.cli.terminal import bar, confirm, echo
from skindb.errors import counted, few_names, input_error, require
from skindb.files import Json

if TYPE_CHECKING:
    from skindb.store import Database
    from skindb.workflow import Refreshed, Withdrawal


@command
@DB
@click.argument("subject")
@click.option(
    "--scope",
    metavar="SCOPE,...",
    help=(
        "Scopes that the subject consents to: fit, statistics, export, publish, or "
        "none.  [default: only show them]"
    ),
)
def consent(db: str, subject: str, scope: str | None) -> None:
    """Show or record the consent of a subject.

    The newest record takes effect immediately, for every version of the subject. fit
    allows ingest and fit; statistics allows analyze, register and edit; export allows
    render, compare, show, view and export; publish labels exports.
    """
    database = skindb.open(db, create=False)
    if scope is not None:
        names = [name for part in scope.split(",") if (name := part.strip())]
        if not names or ("none" in names and len(names) > 1):
            text = repr(scope)
            raise input_error(
                "--scope",
                "must name scopes, or be the single word none",
                text,
                "for example fit,statistics",
            )
        names = [] if names == ["none"] else names
        workflow.record_consent(database, subject, names)
    history = database.consent_history(subject)
    emit(
        history,
        [
            f"{entry['created']}  {', '.join(entry['scope']) or 'none'}  ({entry['source']})"
            for entry in history
        ],
    )


@command
@DB
@click.argument("name", required=False)
@TAKES
@WHERE
def release(
    db: str, name: str | None, takes: tuple[str, ...], where: str | None
) -> None:
    """Name the present versions of takes as a release.

    By default all fitted takes are in the release. Without NAME, the releases are
    listed. Studies and cohorts of a release give the same values, whatever is fitted
    later.
    """
    database = skindb.open(db, create=False)
    if name is not None:
        chosen = list(takes) or database.takes("model")
        if where is not None:
            fulfilling = set(database.takes("model", where=where))
            chosen = [take for take in chosen if take in fulfilling]
        workflow.create_release(database, name, chosen)
    listed = {
        listed_name: _released(database, listed_name)
        for listed_name in ([name] if name else database.takes("release"))
    }
    lines = [
        f"{listed_name}  {report['created']}  {counted(len(report['takes']), 'take')}"
        for listed_name, report in listed.items()
    ]
    emit(listed, lines or ["no releases"])


def _released(database: Database, name: str) -> Json:
    record = database.record("release", name)
    takes: dict[str, dict[str, int]] = {}
    for source in record.made_from:
        takes.setdefault(source["take"], {})[source["kind"]] = source["generation"]
    return {"created": record.created, "revision": record.generation, "takes": takes}


@command
@DB
@DICTIONARY
@WAIT
@WORKERS
@SCHEDULER
@click.option(
    "--dry-run",
    is_flag=True,
    help="Only list the results that are out of date, and the reasons.",
)
def refresh(
    db: str,
    dictionary: Path | None,
    wait: float,
    dry_run: bool,
) -> None:
    """Compute results that are out of date again.

    The order is models, registrations, studies and edits. A result is out of date when
    one of its inputs was superseded or withdrawn, or when a subject no longer consents
    to statistics. Each result is computed again with its own parameters.
    """
    database = skindb.open(db, create=False)
    progress = bar()
    if dry_run:
        results = workflow.stale_results(database)
    else:
        dictionary = shared_path(dictionary)
        with cluster() as client:
            results = workflow.refresh(
                database,
                dictionary=dictionary,
                workers=asked("workers"),
                client=client,
                wait=wait,
                progress=progress,
            )
    lines = [_line(result) for result in results] or ["every result is up to date"]
    # refresh has no folders to ingest from
    emit(
        [stale_as_json(result) for result in results],
        lines + workflow.superseded_lines(workflow.superseded_calibrations(database)),
    )


def stale_as_json(result: Refreshed) -> Json:
    """JSON record of a stale version and its replacement."""
    return {
        "kind": result.kind,
        "take": result.take,
        "generation": result.generation,
        "reasons": list(result.reasons),
        "made": result.record.generation if result.record else None,
        "fault": result.fault,
    }


def _line(result: Refreshed) -> str:
    name = result.name
    reasons = few_names(result.reasons, separator="; ")
    if result.record is not None:
        return f"{name} -> {result.record.generation} ({reasons})"
    return f"{name}: {reasons}" + (
        f"; it cannot be computed again: {result.fault}" if result.fault else ""
    )


@command
@DB
@click.argument("subject")
@DICTIONARY
@WAIT
@click.option(
    "--dry-run",
    is_flag=True,
    help="Only list what would be removed and computed again.",
)
@click.option("--yes", is_flag=True, help="Remove without asking.")
@click.option(
    "--backup",
    "backups",
    multiple=True,
    metavar="BACKUP",
    help="Backup from which the subject is removed too (may be given several times, also later).",
)
@click.option(
    "--report",
    type=PATH,
    help=(
        "Name of a report without personal data, which can be handed out; written as "
        "NAME.json."
    ),
)
def withdraw(
    db: str,
    subject: str,
    dictionary: Path | None,
    wait: float,
    dry_run: bool,
    yes: bool,
    backups: tuple[str, ...],
    report: Path | None,
) -> None:
    """Remove SUBJECT permanently, with all results made from it.

    Every version of every take is removed, and so is every result that refers to one of
    them. Then studies, registrations, releases and edits of others are computed again
    without the subject; refresh repeats those that fail. A keyed mark of the pseudonym
    remains, so that neither interrupted runs nor the capture folder bring the subject
    back. Pictures and exports that were written earlier, and backups that are not
    given, are not reached.
    """
    database = skindb.open(db, create=False)
    plan = workflow.plan_withdrawal(database, subject, backups=backups)
    if report is not None:
        require_folder(report)
        file = workflow.erasure_report_file(report)
        require(
            not file.exists(),
            str(file),
            "a report is not replaced, as it may be that of another subject",
            "a file",
            "choose another name",
        )
    if dry_run:
        emit(_withdrawal_as_json(plan), _plan_lines(plan))
        return
    if not yes:
        echo(*_plan_lines(plan), err=True)
        if not _is_confirmed(f"Remove {subject} permanently?"):
            emit(_withdrawal_as_json(plan), ["Nothing was removed."])
            return
    withdrawal = workflow.withdraw(
        database, subject, dictionary=dictionary, wait=wait, backups=backups
    )
    lines = [_line(result) for result in withdrawal.repeated]
    lines += [
        f"revised without {subject}: release {name}" for name in withdrawal.revised
    ]
    lines += [f"removed: {reason}" for reason in withdrawal.lost]
    counts = ", ".join(
        f"{count} of kind {kind}" for kind, count in withdrawal.removed.items()
    )
    lines.append(f"removed versions: {counts or 'none'}")
    lines += [
        f"removed from {url}: {counted(count, 'file')}"
        for url, count in zip(backups, withdrawal.backups, strict=True)
    ]
    if report is not None:
        lines.append(str(workflow.write_erasure_report(withdrawal, report)))
    emit(_withdrawal_as_json(withdrawal), lines)


def _is_confirmed(question: str) -> bool:
    try:
        return confirm(question)
    except click.Abort:
        if sys.stdin.isatty():
            raise
        raise input_error(
            "withdraw", "must be confirmed", "no terminal to ask on", "give --yes"
        ) from None


def _plan_lines(plan: Withdrawal) -> list[str]:
    users: dict[str, list[str]] = {}
    for kind, generation, _, take in (name.split(" ", 3) for name in plan.users):
        users.setdefault(f"{kind} of {take}", []).append(generation)
    again = [
        f"{name} (generations {', '.join(those)})" for name, those in users.items()
    ]
    return [
        *(f"remove {line}" for line in plan.versions),
        *(
            f"remove: {name}; calibrate again from other takes"
            if name.startswith("calibration ")
            else f"remove, and compute the newest again without {plan.subject}: {name}"
            for name in again
        ),
    ]


def _withdrawal_as_json(withdrawal: Withdrawal) -> Json:
    return {
        "versions": list(withdrawal.versions),
        "users": list(withdrawal.users),
        "removed": withdrawal.removed,
        "repeated": [stale_as_json(result) for result in withdrawal.repeated],
        "revised": list(withdrawal.revised),
        "lost": list(withdrawal.lost),
        "removed_from_backups": list(withdrawal.backups),
    }
