"""Commands that use the population of a database: register, edit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import skindb
from skindb import workflow
from skindb.cli.options import (
    DB,
    PATH,
    SCHEDULER,
    TAKE,
    TAKES,
    WORKERS,
    asked,
    command,
    options_of,
)
from skindb.cli.shared import (
    aligned,
    cluster,
    emit,
    indented,
    trait_amounts,
    writable,
)
from skindb.cli.terminal import bar
from skindb.errors import counted, few_names
from skindb.parameters import DICTIONARY_HELP, EditParameters

if TYPE_CHECKING:
    from xarray import DataTree

    from skindb.store import Record

MAX_EDIT_DISTANCE = 1.0  # to the nearest take, in median distances between takes
EXTRAPOLATED = "the edit is outside the data, and its result is not reliable"


@command
@DB
@TAKES
@click.option(
    "--reference",
    metavar="TAKE",
    help="Take whose (u, v) is the common one.  [default: the mean of all takes]",
)
@WORKERS
@SCHEDULER
def register(
    db: str,
    takes: tuple[str, ...],
    reference: str | None,
) -> None:
    """Warp the fitted takes into a common (u, v) by landmarks.

    The report says how well the landmarks agree.
    """
    database = skindb.open(db, create=False)
    progress = bar()
    with cluster() as client:
        records = workflow.register_takes(
            database,
            takes=takes or None,
            reference=reference,
            workers=asked("workers"),
            client=client,
            progress=progress,
        )
    remaining = [
        take for take in (takes or database.takes("model")) if take not in records
    ]
    reasons = {True: "no landmarks", False: "its consent does not cover statistics"}
    skipped = {
        take: reasons["statistics" in database.consent(take)] for take in remaining
    }
    registered = workflow.registered_datasets(database, records)
    header, rows = skindb.analysis.tabulate_registration(registered)
    registered_takes = {
        take: {"generation": record.generation, "path": record.path}
        for take, record in records.items()
    }
    doubts = skindb.analysis.doubtful_landmarks(registered)
    report = {
        "takes": registered_takes,
        "header": header,
        "rows": rows,
        "doubts": doubts,
        "skipped": skipped,
    }
    lines = [f"skipped: {take}: {reason}" for take, reason in skipped.items()]
    emit(report, [*aligned([header, *rows]), *skindb.schema.note_lines(doubts), *lines])


@command
@DB
@TAKE
@click.option(
    "--grid",
    type=PATH,
    help=(
        "Picture of each trait at half and full strength, drawn instead of storing an "
        "edit (.png, .pdf, .svg), under the light nearest to the frontal camera."
    ),
)
@options_of(EditParameters)
def edit(db: str, take: str, grid: Path | None, parameters: EditParameters) -> None:
    """Move a model along traits and store the result.

    `render` and `export` use it with --edited.
    """
    amounts = trait_amounts(parameters.traits)
    database = skindb.open(db, create=False)
    options: dict[str, Any] = {
        "study": parameters.study,
        "dictionary": parameters.dictionary,
    }
    if grid:
        writable(grid, ".png", ".pdf", ".svg")
        rows = {
            text: {name: amount}
            for text, (name, amount) in zip(
                parameters.traits, amounts.items(), strict=True
            )
        }
        drawn = workflow.edit_grid(
            database, take, rows, grid, progress=bar(), **options
        )
        _report_grid(grid, drawn)
    else:
        tree = workflow.edit(database, take, amounts, **options)
        _report_edit(database.record("edit", take, tree.attrs["generation"]), tree)


def _report_grid(grid: Path, drawn: dict[str, DataTree]) -> None:
    """Print the reports of the edits of a picture."""
    reports = {
        label: {"edit_report": tree.attrs["edit_report"]}
        for label, tree in drawn.items()
    }
    notes = [
        f"{label}: {line}"
        for label, tree in drawn.items()
        for line in [*_edit_notes(tree), _distance(tree)]
    ]
    emit({"path": str(grid), "edits": reports}, [str(grid), *notes])


def _distance(tree: DataTree) -> str:
    """How far an edit is from the data, with a warning if that is far."""
    distance = float(tree.attrs["edit_distance"])
    warning = f"; {EXTRAPOLATED}" if distance > MAX_EDIT_DISTANCE else ""
    return (
        f"the distance to the nearest take is {distance:.2f} times the median distance "
        f"between takes{warning}"
    )


def _report_edit(record: Record, tree: DataTree) -> None:
    """Print the report of an edit that was stored."""
    takes = tree.attrs["study_takes"]
    title = f"{record.take}: edit {record.generation}; {_distance(tree)}"
    source = (
        f"traits from the study of {counted(len(takes), 'take')}: {few_names(takes)}"
    )
    summary = {
        "generation": record.generation,
        "path": record.path,
        "edit_distance": float(tree.attrs["edit_distance"]),
        "edit_report": dict(tree.attrs["edit_report"]),
    }
    emit(summary, [title, *indented([source, *_edit_notes(tree)])])


def _edit_notes(tree: DataTree) -> list[str]:
    """Notes of an edit on its traits and its changes, one line each."""
    return [
        *tree.attrs["trait_notes"],
        *skindb.analysis.describe_edit(tree.attrs["edit_report"]),
    ]


@command
@DB
@click.option("--out", type=PATH, default="figures", help="Folder to write.")
@click.option(
    "--take",
    help="Take of the figures of one face.  [default: one of the subject with the most conditions]",
)
@click.option("--dictionary", type=PATH, help=DICTIONARY_HELP)
def reproduce(db: str, out: Path, take: str | None, dictionary: Path | None) -> None:
    """Write the tables and figures of the paper: a page, figures.md, and its pictures.

    What the takes do not allow is named on the page with the reason.
    """
    made = workflow.reproduce(
        skindb.open(db, create=False),
        out,
        take=take,
        dictionary=dictionary,
        progress=bar(),
    )
    lines = [f"{title}: {reason or 'made'}" for title, reason in made.items()]
    emit(
        {"page": str(out / "figures.md"), "made": made},
        [*lines, str(out / "figures.md")],
    )
