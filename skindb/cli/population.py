"""Commands for populations: analyze, register, edit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import skindb
from skindb.cli.engine import SCHEDULER, client_of, shared_path
from skindb.cli.options import DB, PATH, TAKE, WORKERS, common, options_of
from skindb.cli.shared import aligned, bar, emit, existing, trait_amounts, writable
from skindb.files import csv_text, private_file
from skindb.parameters import EditParameters

if TYPE_CHECKING:
    import xarray as xr

    from skindb.analysis.study import Study
    from skindb.store import Database, Record
    from skindb.types import Progress

MAX_EDIT_DISTANCE = 1.0  # to the nearest take, in median distances between takes
EXTRAPOLATED = "the edit is outside the data, and its result is not reliable"
TAKES = click.option(
    "--take",
    "takes",
    multiple=True,
    help="Take to use (may be given several times).  [default: all]",
)
# of every study, after its own parameters
STORED = (
    click.option(
        "--release",
        metavar="NAME",
        help="Release whose versions are used.  [default: the newest versions]",
    ),
    click.option(
        "--name",
        help="Name under which the study is stored.  [default: its parameters]",
    ),
    click.option("--plot", type=PATH, help="Plot to write (.png, .pdf, .svg)."),
    click.option(
        "--csv", type=PATH, help="Table to write as comma-separated values (.csv)."
    ),
)
# of translucency, which can also draw takes
FACES = (
    click.Option(
        ["--faces"],
        type=PATH,
        help="Picture of the least and the most translucent take (.png, .pdf, .svg).",
    ),
    click.Option(["--site"], help="Site of the probe for --faces.  [default: cheek]"),
)


class Studies(click.Group):
    """The studies as commands, each with the options of its own parameters."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Names of the studies."""
        return list(skindb.analysis.STUDIES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """The command of a study."""
        study = skindb.analysis.STUDIES.get(cmd_name)
        return None if study is None else _study_command(study)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of the study that the first argument names."""
        if args[0] not in skindb.analysis.STUDIES:
            names = ", ".join(self.list_commands(ctx))
            raise click.UsageError(
                f"Invalid value for 'STUDY': {args[0]!r} is not one of {names}.", ctx
            )
        return super().resolve_command(ctx, args)

    def format_commands(
        self,
        ctx: click.Context,  # noqa: ARG002
        formatter: click.HelpFormatter,
    ) -> None:
        """List the studies."""
        studies = skindb.analysis.STUDIES.values()
        with formatter.section("Studies"):
            formatter.write_dl([(study.name, study.description) for study in studies])


@click.group(
    cls=Studies, subcommand_metavar="STUDY [OPTIONS]", invoke_without_command=True
)
@DB
@click.pass_context
def analyze(ctx: click.Context, db: str) -> None:
    """Study the population of the fitted takes.

    A study with other parameters, of other takes or of a release is stored under its
    own name, and does not replace the study with default parameters. The options of a
    study are listed by: skindb analyze DB STUDY --help
    """
    if ctx.invoked_subcommand is None:
        names = ",\n\t".join(skindb.analysis.STUDIES)
        raise click.UsageError(f"Missing argument 'STUDY'. Choose from:\n\t{names}")
    ctx.obj = db


def _study_command(study: Study) -> click.Command:
    """The command of one study, with the options of its parameters."""
    run = partial(_run_study, study)
    for add in reversed(
        (TAKES, options_of(study.parameters), *STORED, SCHEDULER, common)
    ):
        run = add(run)
    command = click.command(study.name, help=f"Study the {study.description}.")(run)
    if study.name == "translucency":
        command.params += FACES
    return command


def _run_study(
    study: Study,
    *,
    takes: tuple[str, ...],
    parameters: Any,
    release: str | None,
    name: str | None,
    scheduler: str | None,
    csv: Path | None,
    **drawn: Any,
) -> None:
    """Compute or read a study, and print, write and draw it."""
    pictures = StudyPictures(**drawn)
    pictures.require_writable()
    if csv:
        writable(csv, ".csv")
    chosen = dict(vars(parameters))
    if "adjust" in chosen:
        names = ",".join(chosen["adjust"]).split(",")
        chosen["adjust"] = tuple(name.strip() for name in names if name.strip())
    if "dictionary" in chosen:
        chosen["dictionary"] = shared_path(chosen["dictionary"], scheduler)
    database = existing(click.get_current_context().obj)
    progress = bar()
    progress(f"analyze {study.name}", 0, 1)
    used = takes or database.takes("model", release=release)
    arguments = {"faces": pictures.faces is not None}
    with skindb.workflow.logged_action(
        database, "study", used, what=study.name, arguments=arguments
    ):
        with (
            client_of(scheduler, progress) as client,
            skindb.workflow.computing_on(client, database.folder),
        ):
            results = skindb.workflow.study(
                database, study.name, takes=takes, release=release, name=name, **chosen
            )
        progress(f"analyze {study.name}", 1, 1)
        pictures.draw(database, results, progress)
    _report(database, study, results, csv)


@dataclass(frozen=True)
class StudyPictures:
    """Pictures that a command draws of a study, if they are named."""

    plot: Path | None
    faces: Path | None = None  # of the most and the least translucent take
    site: str | None = None  # of the faces

    def require_writable(self) -> None:
        """Check the names of the pictures before anything is computed."""
        for picture in (self.plot, self.faces):
            if picture:
                writable(picture, ".png", ".pdf", ".svg")

    def draw(
        self, database: Database, results: xr.DataTree, progress: Progress
    ) -> None:
        """Draw the pictures."""
        if self.faces:
            site = self.site or "cheek"
            skindb.workflow.translucency_grid(
                database, self.faces, site=site, progress=progress
            )
        if self.plot:
            skindb.analysis.plot_study(results, self.plot)


def _report(
    database: Database, study: Study, results: xr.DataTree, csv: Path | None
) -> None:
    """Print the table and the notes of a study, and write its table."""
    header, rows = skindb.analysis.tabulate_study(results)
    if csv:
        private_file(csv).write_text(csv_text(header, rows), encoding="utf-8")
    attrs = results.attrs
    record = database.record("population", attrs["study"], attrs["generation"])
    notes = skindb.analysis.describe_study(results)
    lines = [
        f"{label}: {line}"
        for label, name in (
            ("skipped", "skipped"),
            ("out of date", "outdated"),
            ("registration", "registration"),
        )
        for line in skindb.schema.note_lines(attrs.get(name, []))
    ]
    units = {
        name: skindb.schema.VARIABLES[name].units
        for name in header
        if name in skindb.schema.VARIABLES
    }
    report = {
        "study": record.take,
        "generation": record.generation,
        "path": record.path,
        "header": header,
        "units": units,
        "rows": rows,
        "notes": notes,
        "skipped": attrs["skipped"],
    }
    columns = [i for i, name in enumerate(header) if name not in study.columns_of_files]
    table = aligned([[line[i] for i in columns] for line in [header, *rows]])
    table += _unit_lines(units, [header[i] for i in columns])
    emit(report, [*table, *notes, *lines])


def _unit_lines(units: dict[str, str], shown: list[str]) -> list[str]:
    """One line for each unit of the columns other than 1."""
    of = dict[str, list[str]]()
    for name in shown:
        if units.get(name, "1") not in ("", "1"):
            of.setdefault(units[name], []).append(name)
    return [f"unit {unit}: {', '.join(names)}" for unit, names in of.items()]


@click.command()
@DB
@click.option(
    "--take",
    "takes",
    multiple=True,
    help="Take to register (may be given several times).  [default: all]",
)
@click.option(
    "--reference",
    metavar="TAKE",
    help="Take whose (u, v) is the common one.  [default: the mean of all takes]",
)
@WORKERS
@SCHEDULER
@common
def register(
    db: str,
    takes: tuple[str, ...],
    reference: str | None,
    workers: int,
    scheduler: str | None,
) -> None:
    """Warp the fitted takes into a common (u, v) by landmarks.

    The report says how well the landmarks agree.
    """
    database = existing(db)
    workflow = skindb.workflow
    progress = bar()
    with client_of(scheduler, progress) as client:
        records = workflow.register_takes(
            database,
            takes=takes or None,
            reference=reference,
            workers=workers,
            client=client,
            progress=progress,
        )
    left = [take for take in (takes or database.takes("model")) if take not in records]
    why = {True: "no landmarks", False: "its consent does not cover statistics"}
    skipped = {take: why["statistics" in database.consent(take)] for take in left}
    registered = workflow.registered_datasets(database, records)
    header, rows = skindb.analysis.tabulate_registration(registered)
    done = {
        take: {"generation": record.generation, "path": record.path}
        for take, record in records.items()
    }
    doubts = skindb.analysis.doubtful_landmarks(registered)
    report = {
        "takes": done,
        "header": header,
        "rows": rows,
        "doubts": doubts,
        "skipped": skipped,
    }
    lines = [f"skipped: {take}: {reason}" for take, reason in skipped.items()]
    emit(report, [*aligned([header, *rows]), *skindb.schema.note_lines(doubts), *lines])


@click.command()
@DB
@TAKE
@click.option(
    "--grid",
    type=PATH,
    help=(
        "Picture of each trait at half and full strength, drawn instead of storing an "
        "edit (.png, .pdf, .svg)."
    ),
)
@options_of(EditParameters)
@common
def edit(db: str, take: str, grid: Path | None, parameters: EditParameters) -> None:
    """Move a model along traits and store the result.

    `render` and `export` use it with --edited.
    """
    amounts = trait_amounts(parameters.traits)
    database = existing(db)
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
        drawn = skindb.workflow.edit_grid(
            database, take, rows, grid, progress=bar(), **options
        )
        _report_grid(grid, drawn)
    else:
        tree = skindb.workflow.edit(database, take, amounts, **options)
        _report_edit(database.record("edit", take, tree.attrs["generation"]), tree)


def _report_grid(grid: Path, drawn: dict[str, xr.DataTree]) -> None:
    """Print the reports of the edits of a picture."""
    reports = {
        label: {"edit_report": tree.attrs["edit_report"]}
        for label, tree in drawn.items()
    }
    notes = [
        f"{label}: {line}"
        for label, tree in drawn.items()
        for line in [*_edit_notes(tree), *_extrapolation(tree)]
    ]
    emit({"path": str(grid), "edits": reports}, [str(grid), *notes])


def _extrapolation(tree: xr.DataTree) -> list[str]:
    """A warning if an edit is far from the data."""
    distance = float(tree.attrs["edit_distance"])
    if distance <= MAX_EDIT_DISTANCE:
        return []
    return [
        f"the distance to the nearest take is {distance:.2f} times the median distance "
        f"between takes; {EXTRAPOLATED}"
    ]


def _report_edit(record: Record, tree: xr.DataTree) -> None:
    """Print the report of an edit that was stored."""
    distance = float(tree.attrs["edit_distance"])
    warning = f"; {EXTRAPOLATED}" if distance > MAX_EDIT_DISTANCE else ""
    takes = tree.attrs["study_takes"]
    lines = [
        f"{record.take}: edit {record.generation}; the distance to the nearest take is "
        f"{distance:.2f} times the median distance between takes{warning}",
        f"  traits from the study of {len(takes)} takes: "
        f"{', '.join(takes[:8])}{', ...' if len(takes) > 8 else ''}",
    ]
    about = {
        "generation": record.generation,
        "path": record.path,
        "edit_distance": distance,
        "edit_report": dict(tree.attrs["edit_report"]),
    }
    emit(about, [*lines, *(f"  {line}" for line in _edit_notes(tree))])


def _edit_notes(tree: xr.DataTree) -> list[str]:
    """Notes of an edit on its traits and its changes, one line each."""
    return [
        *tree.attrs["trait_notes"],
        *skindb.analysis.describe_edit(tree.attrs["edit_report"]),
    ]
