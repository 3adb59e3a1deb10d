"""Commands for the maintenance of databases: info, audit, verify, clean, backup, restore."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import skindb
from skindb import workflow
from skindb.cli.options import DB, PATH, RELEASE, WHERE, asked, command
from skindb.cli.shared import (
    aligned,
    calibrated_by_lines,
    calibration_lines,
    choice_lines,
    emit,
    indented,
)
from skindb.errors import InputError, counted, input_error
from skindb.files import Attributes, Json

if TYPE_CHECKING:
    from skindb.store import BackupReport, Database, Restored


@command
@DB
@WHERE
@RELEASE
def info(db: str, where: str | None, release: str | None) -> None:
    """List takes and their versions with paths and sizes.

    With -v, samples and prediction errors are listed too.

    The condition of --where compares columns of db.table(): attributes of the captures
    (age, gender, ...), condition, fit_k and other parameters, status_fitted, outdated,
    capture_created, model_created, consent. Comparisons are combined by and, or, not;
    there are also in ['a', 'b'] and is missing. Text and dates stand in quotes.
    """
    database = skindb.open(db, create=False)
    of_release = None
    if release is not None:
        kinds = ("capture", "model")
        named = (database.takes(kind, release=release) for kind in kinds)
        of_release = sorted(set().union(*named))
    result = database.info(takes=of_release, where=where, release=release)
    details = asked("verbose")
    # figures of merit and translucency are values of subjects
    action = workflow.logged_action(database, "show", result["takes"])
    with action if details else nullcontext():
        lines = _info_lines(database, result, details=details)
    if where is None and release is None:
        superseded = workflow.superseded_calibrations(database)
        result |= {"superseded_calibrations": superseded} if superseded else {}
        lines += workflow.superseded_lines(superseded)
    nothing = (
        "No take is chosen by --where." if where else "The database holds no takes."
    )
    emit(result, lines or [nothing])


def _info_lines(database: Database, result: Json, *, details: bool) -> list[str]:
    """A row for each take, with the versions of its kinds, and one for each study and
    the like; with details, lines for each version.
    """
    others = [
        part
        for name in ("studies", "releases", "calibrations", "consents")
        for part in result.get(name, {}).items()
    ]
    if details:
        return _version_lines(database, [*result["takes"].items(), *others])
    takes = result["takes"]
    kinds = sorted({kind for versions in takes.values() for kind in versions})
    rows = [["take", "created", "MB", *kinds]]
    for take, versions in takes.items():
        cells = {kind: _cells(version) for kind, version in versions.items()}
        created = max(cell[2] for cell in cells.values())
        size = sum(float(cell[1]) for cell in cells.values())
        states = (cells[kind][0] if kind in cells else "-" for kind in kinds)
        rows.append([take, created, f"{size:.1f}", *states])
    lines = aligned(rows) if takes else []
    rows = [
        [name, kind, *_cells(version)]
        for name, kinds in others
        for kind, version in kinds.items()
    ]
    if rows:
        lines += aligned([["name", "kind", "version", "MB", "created", ""], *rows])
    of_takes = [one for versions in takes.values() for one in versions.values()]
    of_others = [one for _, versions in others for one in versions.values()]
    if any(version.get("stale") for version in of_takes + of_others):
        lines.append("* out of date: skindb refresh computes it again")
    used = Counter(
        line
        for versions in takes.values()
        for line in calibrated_by_lines(versions.get("capture", {}))
    )
    lines += [f"{line}: {counted(count, 'take')}" for line, count in used.items()]
    return lines + [version["fault"] for version in of_takes if "fault" in version]


def _cells(version: Json) -> list[str]:
    """Number with a star if out of date, size, date and note of a version."""
    if "fault" in version:
        return ["damaged", "0", "-", version["fault"]]
    star = "*" if version.get("stale") else ""
    return [
        f"{version['generation']}{star}",
        f"{version['bytes'] / 1e6:.1f}",
        version["created"][:10],
        ", ".join(version.get("scope", ())) or "none" if "scope" in version else "",
    ]


def _version_lines(database: Database, parts: Iterable[tuple[str, Json]]) -> list[str]:
    """A line for each version, with its path in the database, and its details."""
    lines = []
    for name, kinds in parts:
        for kind, version in kinds.items():
            text = version.get("fault")
            if text is None:
                within = version["path"].split("/")[-4:]  # data/KIND/NAME/FILE
                text = "  ".join([*_cells(version), "/".join(within)])
            if version.get("stale"):
                text += f"  out of date: {version['stale'][0]}"
            lines.append(f"{name}  {kind}  {text}")
            lines += indented(calibrated_by_lines(version))
            if kind in DETAILS and "fault" not in version:
                try:
                    lines += indented(DETAILS[kind](database, name))
                except InputError as error:  # the version is damaged
                    lines += indented(map(str, error.faults))
    return lines


def _sample_lines(samples: Any, take: str) -> list[str]:
    """Table of samples by region; nothing for captures without a dome or without this table."""
    if samples is None:
        return []
    try:
        return [
            *skindb.ingest.sample_lines(samples),
            *aligned(skindb.ingest.sample_table(samples)),
        ]
    except (KeyError, TypeError, ValueError, AttributeError):
        # a record that another program wrote
        raise input_error(
            f"capture of {take}",
            "its record must hold the number of samples of surfels",
            "a different summary",
            "restore it from a backup",
        ) from None


def _prediction_lines(database: Database, take: str) -> list[str]:
    record = database.record("model", take)
    fit = skindb.fit
    table = database.tables(record)
    if not table:  # committed by a program of its own, without tables
        table = fit.prediction_table(database.read("model", take)["fitted"].dataset)
    lines = [
        *aligned(fit.tabulate_prediction(fit.describe_prediction(table))),
        *aligned(fit.tabulate_diffuse(table)),
    ]
    header, sites = fit.tabulate_translucency(record.provenance)
    return [*lines, *aligned([header, *sites])] if sites else lines


def _capture_lines(database: Database, take: str) -> list[str]:
    summary = database.record("capture", take).provenance.get("summary", {})
    return [
        *_sample_lines(summary.get("samples"), take),
        *calibration_lines(database, take),
        *choice_lines(summary.get("corrections", {})),
    ]


# kind: function of the lines that info -v adds
DETAILS = {"capture": _capture_lines, "model": _prediction_lines}


@command
@DB
def verify(db: str) -> None:
    """Read every file of every version and report all damage.

    Results that are out of date are no damage, see skindb refresh --dry-run, and neither is
    garbage, see skindb clean.
    """
    faults = skindb.open(db, create=False).verify()
    emit({}, [] if faults else ["Every version is intact."], faults)


@command
@DB
@click.option(
    "--subject",
    help="Pseudonym of a subject, to list only the actions that concern it.",
)
def audit(db: str, subject: str | None) -> None:
    """List who changed or disclosed data, and check the audit log.

    Entries that are missing, changed or in another order are faults.
    """
    entries, faults = skindb.open(db, create=False).audit(subject=subject)
    header = ["number", "when", "actor", "action", "subjects", "counts", "parameters"]
    rows = [
        [
            entry.number,
            entry.when,
            entry.actor,
            entry.action,
            len(entry.subjects),
            _pairs(entry.counts),
            _pairs(entry.parameters),
        ]
        for entry in entries
    ]
    lines = aligned([header, *rows]) if rows else ["The audit log has no such entry."]
    emit([asdict(entry) for entry in entries], lines, faults)


def _pairs(values: Attributes) -> str:
    """Names and values on one line; the name alone of a flag that is set."""
    return ", ".join(
        name if value is True else f"{name} {value}" for name, value in values.items()
    )


@command
@DB
@click.option(
    "--generations",
    type=click.IntRange(1),
    help="Number of the newest generations of each kind and take to keep. Older ones "
    "are removed too, unless a version "
    "that is kept was made from them.",
)
@click.option("--yes", is_flag=True, help="Remove the garbage instead of listing it.")
def clean(db: str, generations: int | None, yes: bool) -> None:
    """List or remove garbage, to which no record refers.

    Garbage is left, for example, by runs that were killed.

    Files of a take that is being processed are kept, and so are files of the last hour
    unless the process that wrote them has ended. Files from which an interrupted run
    can resume are kept for a day.
    """
    database = skindb.open(db, create=False)
    if yes:
        garbage = workflow.clean(database, generations=generations)
    else:
        garbage = database.garbage(generations=generations)
    going = [item for item in garbage if not item.kept]
    remaining = [item for item in garbage if item.kept]
    total = sum(item.bytes for item in going)
    lines = [
        f"{item.key}  {item.bytes / 1e6:.1f} MB  {item.what}"
        + (f"  (kept: {item.kept})" if item.kept else "")
        for item in [*going, *remaining]
    ]
    total_line = (
        f"{len(going)} {'removed' if yes else 'to remove'}, {total / 1e6:.1f} MB"
    )
    if going and not yes:
        total_line += "; --yes removes them"
    items = [asdict(item) for item in garbage]
    emit({"removed": yes, "bytes": total, "items": items}, [*lines, total_line])


@command
@DB
@click.argument("destination", metavar="BACKUP")
@click.option(
    "--verify",
    is_flag=True,
    help="Read the whole backup again, and name every damaged file.",
)
def backup(db: str, destination: str, verify: bool) -> None:
    """Write the present state of a database to BACKUP, a folder or a bucket.

    Only files that BACKUP does not have are copied. Commands may write to the database
    meanwhile. An interrupted backup is continued by the same command. Subjects who were
    withdrawn are removed from all earlier states.
    """
    report = workflow.backup(skindb.open(db, create=False), destination, verify=verify)
    lines = [
        f"state {report.number}: {counted(report.versions, 'version')}",
        f"files: {report.copied} copied ({report.bytes / 1e6:.1f} MB), {report.present} present, "
        f"{report.removed} removed",
    ]
    emit(_as_json(report), lines, report.faults)


@command
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
    file. After an interrupted restore the same command begins again, and until then every
    other command refuses DB.
    """
    if only_list:
        names = ("number", "created", "versions")
        listed = [
            {name: getattr(state, name) for name in names}
            for state in workflow.backup_states(source)
        ]
        rows = [
            [f"state {n}", when, f"{counted(count, 'version')}"]
            for n, when, count in map(dict.values, listed)
        ]
        emit(listed, aligned(rows) if rows else ["no states"])
        return
    if db is None:
        raise click.UsageError("Missing argument 'DB'.")
    if markers is not None and without_markers:
        raise click.UsageError("--markers and --without-markers exclude each other")
    restored = workflow.restore(
        source, db, number=number, markers=markers, without_markers=without_markers
    )
    emit(
        _as_json(restored), _restored_lines(restored, without_markers), restored.faults
    )


def _restored_lines(restored: Restored, without_markers: bool) -> list[str]:
    lines = {
        f"state {restored.number} of {restored.created}: "
        f"{counted(restored.versions, 'version')}, "
        f"{restored.bytes / 1e6:.1f} MB": True,
        "subjects who were withdrawn after this state are in the database again: "
        "withdraw them again": without_markers,
        f"not restored, because of withdrawals: {restored.skipped} versions": restored.skipped,
        f"results to be computed again by skindb refresh: {restored.requests}": restored.requests,
        f"later records of consent, repeated: {restored.consents}": restored.consents,
        "later records of consent of subjects who are not in this state: "
        f"{restored.unknown_consents}; record them again when their captures are "
        "ingested": restored.unknown_consents,
    }
    return [line for line, is_shown in lines.items() if is_shown]


def _as_json(report: BackupReport | Restored) -> Json:
    return {name: value for name, value in asdict(report).items() if name != "faults"}
