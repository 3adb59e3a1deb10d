"""The command analyze, with one command for each study, and tidy."""

from __future__ import annotations

from collections.abc import Callable
from csv import reader
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import skindb
from skindb import workflow
from skindb.cli.options import (
    DB,
    PATH,
    RELEASE,
    SCHEDULER,
    TAKES,
    command,
    common,
    options_of,
)
from skindb.cli.shared import aligned, cluster, emit, shared_path, writable
from skindb.cli.terminal import HelpContext, bar
from skindb.errors import counted, input_error
from skindb.files import Json, csv_text, private_file
from skindb.study_parameters import DECLARED, Declaration

if TYPE_CHECKING:
    from xarray import DataTree

    from skindb.store import Database

NOTES = {  # of results, with their labels
    "skipped": "skipped",
    "outdated": "out of date",
    "registration": "registration",
    "spacing": "spacing",
    "as_normal": "as normal",
}
# of every study, after its own parameters
STORED = (
    click.option(
        "--as-normal",
        metavar="NAME,...",
        help="Conditions, separated by commas, that count as normal for subjects who "
        "have no take in the condition normal: makeup.",
    ),
    RELEASE,
    click.option(
        "--name",
        help="Name under which the study is stored.  [default: its parameters]",
    ),
    click.option("--plot", type=PATH, help="Plot to write (.png, .pdf, .svg)."),
    click.option(
        "--csv", type=PATH, help="Table to write as comma-separated values (.csv)."
    ),
)
# of translucency, which can also draw takes, and of components, which other programs use
FURTHER = {
    "translucency": (
        click.Option(
            ["--faces"],
            type=PATH,
            help="Picture of the least and the most translucent take (.png, .pdf, .svg).",
        ),
        click.Option(
            ["--site"], help="Site of the probe for --faces.  [default: cheek]"
        ),
    ),
    "components": (
        click.Option(
            ["--out"], type=PATH, help="Face model to write, as AlbedoMM (.h5, .npz)."
        ),
    ),
}


class Studies(click.Group):
    """The studies as commands, each with the options of its own parameters."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Names of the studies."""
        return list(DECLARED)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command:
        """The command of a study."""
        if cmd_name not in DECLARED:
            names = ", ".join(DECLARED)
            raise click.UsageError(
                f"Invalid value for 'STUDY': {cmd_name!r} is not one of {names}.", ctx
            )
        return _study_command(DECLARED[cmd_name])


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
        names = ",\n\t".join(DECLARED)
        raise click.UsageError(f"Missing argument 'STUDY'. Choose from:\n\t{names}")
    ctx.obj = db


def _study_command(study: Declaration) -> click.Command:
    """The command of one study, with the options of its parameters."""
    run: Callable[..., Any] = partial(_run_study, study)
    for add in reversed(
        (TAKES, options_of(study.parameters), *STORED, SCHEDULER, common)
    ):
        run = add(run)
    text = f"Study the {study.description}."
    studying = click.command(study.name, help=text, short_help=study.description)(run)
    studying.context_class = HelpContext
    studying.params += FURTHER.get(study.name, ())
    options = [option for option in studying.params if option.name != "formula"]
    if len(options) < len(studying.params):
        studying.params = [click.Argument(["formula"]), *options]
    return studying


def _run_study(
    study: Declaration,
    *,
    takes: tuple[str, ...],
    parameters: Any,
    as_normal: str | None,
    release: str | None,
    name: str | None,
    csv: Path | None,
    plot: Path | None,
    faces: Path | None = None,
    site: str | None = None,
    out: Path | None = None,
) -> None:
    """Compute or read a study, and print, write and draw it."""
    if out:
        writable(out, ".h5", ".npz")
    for picture in filter(None, (plot, faces)):
        writable(picture, ".png", ".pdf", ".svg")
    if csv:
        writable(csv, ".csv")
    chosen = dict(vars(parameters))
    for several in {"adjust", "quantities", "pairs"}.intersection(chosen):
        # names may contain commas, in quotes
        lines = reader(chosen[several], skipinitialspace=True)
        names = [name.strip() for line in lines for name in line]
        chosen[several] = tuple(filter(None, names))
    if "dictionary" in chosen:
        chosen["dictionary"] = shared_path(chosen["dictionary"])
    database = skindb.open(click.get_current_context().obj, create=False)
    progress = bar()
    progress(f"analyze {study.name}", 0, 1)
    studied = takes or database.takes("model", release=release)
    arguments = {"faces": faces is not None}
    with workflow.logged_action(
        database, "study", studied, what=study.name, arguments=arguments
    ):
        with (
            cluster() as client,
            workflow.computing_on(client, database.folder),
        ):
            results = workflow.study(
                database,
                study.name,
                takes=takes,
                as_normal=(as_normal or "").replace(",", " ").split(),
                release=release,
                name=name,
                **chosen,
            )
        progress(f"analyze {study.name}", 1, 1)
        if faces:
            workflow.translucency_grid(
                database, faces, site=site or "cheek", progress=progress
            )
        if plot:
            skindb.analysis.plot_study(results, plot)
        if out:
            model = results["face_model"].dataset.load()
            skindb.analysis.write_face_model(model, out)
    _report(database, study, results, csv)


def _report(
    database: Database, study: Declaration, results: DataTree, csv: Path | None
) -> None:
    """Print the table and the notes of a study, and write its table."""
    header, rows = skindb.analysis.tabulate_study(results)
    if csv:
        private_file(csv).write_text(csv_text(header, rows), encoding="utf-8")
    attrs = results.attrs
    record = database.record("population", attrs["study"], attrs["generation"])
    notes = skindb.analysis.describe_study(results)
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
        "visits": attrs.get("visits", ""),
    } | {name: attrs.get(name, []) for name in NOTES}
    hidden = skindb.analysis.STUDIES[study.name].columns_of_files
    columns = [i for i, name in enumerate(header) if name not in hidden]
    table = aligned([[line[i] for i in columns] for line in [header, *rows]])
    table += _unit_lines(units, [header[i] for i in columns])
    visits = [f"visits: {attrs['visits']}"] if attrs.get("visits") else []
    emit(report, [*visits, *table, *notes, *_note_lines(report)])


def _note_lines(notes: Json) -> list[str]:
    """The notes of `NOTES` with their labels, one line each."""
    return [
        f"{label}: {line}"
        for name, label in NOTES.items()
        for line in skindb.schema.note_lines(notes.get(name, []))
    ]


def _unit_lines(units: dict[str, str], columns: list[str]) -> list[str]:
    """One line for each unit of the columns other than 1."""
    names_by_unit = dict[str, list[str]]()
    for name in columns:
        if units.get(name, "1") not in ("", "1"):
            names_by_unit.setdefault(units[name], []).append(name)
    return [f"unit {unit}: {', '.join(names)}" for unit, names in names_by_unit.items()]


@command
@DB
@TAKES
@RELEASE
@click.option(
    "--out", type=PATH, required=True, help="Table to write (.csv or .parquet)."
)
def tidy(db: str, takes: tuple[str, ...], release: str | None, out: Path) -> None:
    """Write a table with one row for each take, region, channel and quantity.

    Its columns are the value, its standard error, unit and status, the subject,
    condition, visit and repeat, and the attributes of the captures.
    """
    writable(out, ".csv", ".parquet")
    database = skindb.open(db, create=False)
    table, skipped, spacing = workflow.tidy_table(
        database, takes=takes, release=release
    )
    if out.suffix == ".csv":
        text = csv_text([*table], table.values.tolist())
        private_file(out).write_text(text, encoding="utf-8")
    else:
        try:
            data = table.to_parquet()
        except ImportError:
            raise input_error(
                str(out), "needs pyarrow", "none", "pip install pyarrow, or write .csv"
            ) from None
        private_file(out).write_bytes(data)
    notes = {"skipped": skipped, "spacing": spacing}
    report = {"path": str(out), "rows": len(table)} | notes
    emit(report, [f"{out}: {counted(len(table), 'row')}", *_note_lines(notes)])
