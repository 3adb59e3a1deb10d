"""Commands that simulate and ingest captures: demo, simulate, ingest."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import skindb
from skindb import workflow
from skindb.cli.options import (
    DB,
    PATH,
    SCHEDULER,
    WAIT,
    WORKERS,
    Finite,
    asked,
    command,
    options_of,
)
from skindb.cli.shared import (
    calibrated_by_lines,
    calibration_lines,
    choice_lines,
    each_take,
    emit,
    indented,
    shared_path,
    summary_of,
)
from skindb.cli.terminal import bar, echo
from skindb.errors import counted, require
from skindb.limits import MAX_COHORT, MAX_DEMO_TAKES, MAX_VIRTUAL_VISITS, MAX_VISIT
from skindb.parameters import (
    CONDITIONS,
    DemoParameters,
    IngestParameters,
    SimulationParameters,
)

if TYPE_CHECKING:
    from skindb.store import Database, Record


@command
@click.option("--out", type=PATH, default=Path("demo"), help="Folder to write.")
@options_of(DemoParameters)
def demo(out: Path, parameters: DemoParameters) -> None:
    """Run every step on simulated subjects, and write a report.

    The subjects are ingested, fitted, analysed, edited, rendered and exported;
    report.html and viewer.html show them.
    """
    result = skindb.demo.run_demo(out, progress=bar(plain=True), **vars(parameters))
    emit(result, [result["report"], result["viewer"]])


@command
@click.argument("out", type=PATH)
@click.option(
    "--takes",
    type=click.IntRange(1, MAX_DEMO_TAKES),
    default=MAX_DEMO_TAKES,
    help="Number of virtual takes.",
)
@click.option(
    "--cohort",
    type=click.IntRange(1, MAX_COHORT),
    help="Number of subjects of a virtual population like that of the paper.",
)
@click.option(
    "--condition",
    "conditions",
    type=click.Choice(CONDITIONS[1:]),
    multiple=True,
    help=(
        "Condition in which each subject of the cohort is captured too (may be given "
        "several times)."
    ),
)
@click.option(
    "--visits",
    type=click.IntRange(1, MAX_VIRTUAL_VISITS),
    default=1,
    help="Number of visits of each subject of the cohort.",
)
@click.option(
    "--paper",
    is_flag=True,
    help=(
        "Datasets A and B of the paper: one subject in seven conditions, and a cohort "
        "of 87 unless --cohort states another number."
    ),
)
@options_of(SimulationParameters)
@WORKERS
def simulate(
    out: Path,
    takes: int,
    cohort: int | None,
    conditions: tuple[str, ...],
    visits: int,
    paper: bool,
    parameters: SimulationParameters,
) -> None:
    """Write virtual captures with their true values beside them.

    Each take gets its own folder. With --cohort, the subjects have the groups and ages
    of table 1 of the paper. Existing takes are kept: the same command continues an
    interrupted run, and a larger number adds subjects.
    """
    progress = bar()
    for option, is_given in (("condition", conditions), ("visits", visits > 1)):
        require(
            not is_given or cohort or paper,
            f"--{option}",
            "belongs to a cohort",
            "no --cohort",
            "give the number of subjects",
        )
    call, numbers = workflow.begin_simulation(
        out,
        parameters,
        takes=takes,
        cohort=cohort,
        conditions=conditions,
        visits=visits,
        paper=paper,
        progress=progress,
    )
    results, faults = each_take(
        call,
        numbers,
        progress=progress,
        finish=lambda take: (f"{take[0]:04d}", str(take[1]), [str(take[1])]),
    )
    emit([results[name] for name in sorted(results)], [], faults)


@command
@DB
@click.argument("captures", metavar="CAPTURE...", nargs=-1, required=True, type=PATH)
@options_of(IngestParameters)
@click.option(
    "--visit",
    type=click.IntRange(1, MAX_VISIT),
    help=(
        "Visit of the captures.  [default: what capture.json states; otherwise that of "
        "the same session, or the next one]"
    ),
)
@click.option(
    "--crop-box",
    type=Finite(),
    nargs=6,
    help="Box of the scan to keep, from X Y Z to X Y Z in mm.",
)
@click.option(
    "--crop-reach",
    type=Finite(0, min_open=True),
    help="Distance from a landmark within which the scan is kept, in mm.",
)
@click.option(
    "--again",
    is_flag=True,
    help="Also ingest captures of which the newest version would not change.",
)
@click.option(
    "--explain",
    is_flag=True,
    help="Report what was cleaned (with -v also where) and what was skipped.",
)
@WAIT
@WORKERS
@SCHEDULER
def ingest(
    db: str,
    captures: tuple[Path, ...],
    visit: int | None,
    crop_box: Any,
    crop_reach: float | None,
    again: bool,
    explain: bool,
    wait: float,
    parameters: IngestParameters,
) -> None:
    """Ingest capture folders into the database DB.

    The database is created if it is absent. A folder with faults is not committed, and
    does not stop the others. An interrupted ingest leaves nothing visible, and the
    same command begins it again. Nothing is done if the newest version was made of the
    same files, with the same parameters, by the same code. A capture of a subject who
    was withdrawn is refused. The same session of a subject in a condition is a new
    version of its take, and another session is the next visit unless a visit is stated.
    """
    low, high = (crop_box[:3], crop_box[3:]) if crop_box else (None, None)
    crop = skindb.ingest.Crop(low, high, crop_reach) if crop_box or crop_reach else None
    progress = bar()
    database = skindb.open(db, create=True)
    folders = [shared_path(folder) for folder in captures]
    call = partial(
        workflow.ingest_if_changed,
        database,
        visit=visit,
        planned={} if visit else workflow.next_visits(database, folders),
        again=again,
        crop=crop,
        wait=wait,
        progress=progress,
        **asdict(parameters),
    )
    finish = partial(_ingested, database, explain=explain)
    results, faults = each_take(
        call, folders, shared=database.folder, progress=progress, finish=finish
    )
    if faults and len(captures) > 1:
        echo(f"{len(results)} of {len(captures)} captures were ingested", err=True)
    emit(results, [], faults)


def _ingested(
    database: Database, result: tuple[Record, bool], *, explain: bool
) -> tuple[str, Any, list[str]]:
    """Name, JSON record and printed lines of a capture that was ingested or is unchanged."""
    record, is_new = result
    if not is_new and not explain:
        line = f"{record.take}: unchanged since capture {record.generation}; --again ingests it"
        return record.take, summary_of(record), [line]
    if keys := record.provenance["unknown_keys"]:
        echo(
            f"{record.take}: warning: unknown keys of capture.json, kept but not "
            f"read: {', '.join(keys)}",
            err=True,
        )
    summary = summary_of(record)
    figures = summary.get("summary", {})
    lines = []
    if surfels := figures.get("surfels"):
        spacing = f"{surfels['spacing_mm']:.2g} mm apart"
        lines.append(f"{counted(surfels['count'], 'surfel')}, {spacing}")
    lines += calibrated_by_lines(record.provenance)
    if "samples" in figures:
        lines += skindb.ingest.sample_lines(figures["samples"])
    lines += choice_lines(figures.get("corrections", {}))
    if asked("verbose"):
        lines += calibration_lines(database, record.take)
    lines += [f"note: {line}" for line in figures.get("notes", [])]
    lines += [f"skipped: {line}" for line in summary.get("skipped", [])]
    if explain:
        lines += skindb.ingest.cleaning_lines(summary, places=asked("verbose"))
    title = f"{record.take}: capture {summary['generation']}, {summary['path']}"
    return record.take, summary, [title, *indented(lines)]
