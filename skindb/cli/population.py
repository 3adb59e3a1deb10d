"""Commands for populations: analyze, register, edit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

import skindb
from skindb.cli.engine import SCHEDULER, client_of, shared_path
from skindb.cli.options import DB, DICTIONARY, PATH, TAKE, WORKERS, Seed, common
from skindb.cli.shared import aligned, bar, emit, existing, trait_amounts, writable
from skindb.errors import Fault, InputError
from skindb.files import csv_text, private_file
from skindb.limits import MAX_PERMUTATIONS

if TYPE_CHECKING:
    import xarray as xr

RELEASE = click.option(
    "--release",
    metavar="NAME",
    help="Release whose versions are used.  [default: the newest versions]",
)
# study: its options
OPTIONS = {
    "brdf": ("seed", "dictionary"),
    "albedo": ("group_by",),
    "translucency": ("group_by",),
    "traits": ("k", "in_metric", "adjust", "seed", "dictionary"),
    "groups": ("group_by", "adjust", "permutations", "seed"),
    "components": ("k",),
    "correlations": ("permutations", "seed"),
    "maps": ("group_by", "adjust", "permutations", "seed"),
    "chromophores": ("group_by", "seed"),
    "coverage": (),
    "surface": ("group_by", "k", "permutations", "seed", "dictionary"),
}

# columns that would make lines too long for a terminal; they are in the output of --json and --csv
COLUMNS_OF_FILES_ONLY = (
    "sigma_tr_total_error",
    "sigma_tr_repeat_deviation",
    "effect_percent_low",
    "effect_percent_high",
    "effect_p_false_discovery",
    "effect_detectable",
)


@click.command()
@DB
@click.argument("what", metavar="STUDY", type=click.Choice(list(OPTIONS)))
@click.option(
    "--take",
    "takes",
    multiple=True,
    help="Take to use (may be given several times).  [default: all]",
)
@click.option(
    "--group-by", help="Attribute or trait by which takes are grouped: gender, age, ..."
)
@click.option(
    "--adjust",
    metavar="NAME,...",
    default="",
    show_default=False,
    help="Attributes that the comparison adjusts for, separated by commas.",
)
@click.option(
    "--permutations",
    type=click.IntRange(100, MAX_PERMUTATIONS),
    help="Largest number of permutations for p values.  [default: 10000, for maps 1000]",
)
@click.option(
    "--k",
    type=click.IntRange(1),
    help="Number of components.  [default: 6 for the common basis, 5 for maps of albedo]",
)
@click.option(
    "--in-metric",
    is_flag=True,
    help="Find the common basis in the metric of BRDFs instead of that of coefficients.",
)
@click.option(
    "--seed",
    type=Seed(),
    default=0,
    help="Random seed for factorisation, bootstrap and permutations.",
)
@DICTIONARY
@RELEASE
@click.option(
    "--name", help="Name under which the study is stored.  [default: its parameters]"
)
@click.option("--plot", type=PATH, help="Plot to write (.png, .pdf, .svg).")
@click.option(
    "--faces",
    type=PATH,
    help="Picture of the least and the most translucent take, for translucency (.png, .pdf, .svg).",
)
@click.option("--site", help="Site of the probe for --faces.  [default: cheek]")
@click.option(
    "--csv", type=PATH, help="Table to write as comma-separated values (.csv)."
)
@SCHEDULER
@common
def analyze(
    db: str,
    what: str,
    takes: tuple[str, ...],
    release: str | None,
    name: str | None,
    plot: Path | None,
    csv: Path | None,
    faces: Path | None,
    site: str | None,
    scheduler: str | None,
    **options: Any,
) -> None:
    """Study the population of the fitted takes.

    \b
    brdf           number of basis BRDFs that the population needs
    albedo         distribution of the diffuse albedo
    translucency   translucency by site of the face
    traits         vectors of BRDF, albedo and translucency for each attribute
    groups         differences between groups of subjects, with intervals and p values
    components     principal components of albedo, drawn as faces
    correlations   correlations between albedo, surface BRDF and translucency
    maps           differences between groups at every texel of the common (u, v)
    chromophores   melanin and haemoglobin in maps of albedo, and the mean face
    coverage       number of subjects by skin type, gender and age
    surface        differences between the surface BRDFs of groups

    A study with other parameters, of other takes or of a release is stored under its
    own name, and does not replace the study with default parameters.
    """  # noqa: D301  click needs the character
    if plot:
        writable(plot, ".png", ".pdf", ".svg")
    if csv:
        writable(csv, ".csv")
    if faces:
        writable(faces, ".png", ".pdf", ".svg")
    if (faces or site) and what != "translucency":
        raise InputError(
            Fault(
                "--faces" if faces else "--site",
                "belongs to the study translucency",
                f"the study {what}",
                "omit it",
            )
        )
    context = click.get_current_context()
    for option in sorted({name for known in OPTIONS.values() for name in known}):
        if (
            option not in OPTIONS[what]
            and context.get_parameter_source(option) is ParameterSource.COMMANDLINE
        ):
            *most, last = (name for name, known in OPTIONS.items() if option in known)
            belongs = (
                f"belongs to the studies {', '.join(most)} and {last}"
                if most
                else f"belongs to the study {last}"
            )
            raise InputError(
                Fault(
                    f"--{option.replace('_', '-')}",
                    belongs,
                    f"the study {what}",
                    "omit it",
                )
            )
    options["adjust"] = [
        name.strip() for name in options["adjust"].split(",") if name.strip()
    ]
    if what in ("groups", "maps", "surface") and not options["group_by"]:
        raise InputError(
            Fault(
                f"analyze {what}",
                "needs an attribute to compare by",
                "none",
                "name it with --group-by",
            )
        )
    database = existing(db)
    progress = bar()
    progress(f"analyze {what}", 0, 1)
    given = {
        option: options[option]
        for option in OPTIONS[what]
        if options[option] is not None
    }
    if "dictionary" in given:
        given["dictionary"] = shared_path(given["dictionary"], scheduler)
    used = takes or database.takes("model", release=release)
    with skindb.workflow.logged_action(
        database, "study", used, what=what, arguments={"faces": faces is not None}
    ):
        with (
            client_of(scheduler, progress) as client,
            skindb.workflow.computing_on(client, database.folder),
        ):
            study = skindb.workflow.STUDIES[what](
                database, takes=takes, release=release, name=name, **given
            )
        progress(f"analyze {what}", 1, 1)
        if faces:
            skindb.workflow.translucency_grid(
                database, faces, site=site or "cheek", progress=progress
            )
    if plot:
        skindb.analysis.plot_study(study, plot)
    header, rows = skindb.analysis.tabulate_study(study)
    if csv:
        private_file(csv).write_text(csv_text(header, rows), encoding="utf-8")
    record = database.record(
        "population", study.attrs["study"], study.attrs["generation"]
    )
    notes = skindb.analysis.describe_study(study)
    lines = [
        f"skipped: {line}" for line in skindb.schema.note_lines(study.attrs["skipped"])
    ]
    lines += [
        f"out of date: {line}"
        for line in skindb.schema.note_lines(study.attrs["outdated"])
    ]
    lines += [
        f"registration: {line}"
        for line in skindb.schema.note_lines(study.attrs.get("registration", []))
    ]
    result = {
        "study": record.take,
        "generation": record.generation,
        "path": record.path,
    }
    units = {
        name: skindb.schema.VARIABLES[name].units
        for name in header
        if name in skindb.schema.VARIABLES
    }
    result |= {"header": header, "units": units, "rows": rows, "notes": notes}
    result |= {"skipped": study.attrs["skipped"]}
    shown = [i for i, name in enumerate(header) if name not in COLUMNS_OF_FILES_ONLY]
    table = aligned([[line[i] for i in shown] for line in [header, *rows]])
    table += _unit_lines(units, [header[i] for i in shown])
    emit(result, [*table, *notes, *lines])


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


MAX_EDIT_DISTANCE = 1.0  # to the nearest take, in median distances between takes
EXTRAPOLATED = "the edit is outside the data, and its result is not reliable"


def _far(tree: Any) -> list[str]:
    """A warning if an edit is far from the data."""
    distance = float(tree.attrs["edit_distance"])
    far = (
        f"the distance to the nearest take is {distance:.2f} times the median distance "
        "between takes"
    )
    return [f"{far}; {EXTRAPOLATED}"] if distance > MAX_EDIT_DISTANCE else []


@click.command()
@DB
@TAKE
@click.option(
    "--trait",
    "amounts",
    multiple=True,
    required=True,
    metavar="NAME=AMOUNT",
    help="Trait and its amount, for example lotion=0.5 (may be given several times).",
)
@click.option("--study", help="Study of traits.  [default: traits, or the only one]")
@click.option(
    "--grid",
    type=PATH,
    help=(
        "Picture of each trait at half and full strength, drawn instead of storing an "
        "edit (.png, .pdf, .svg)."
    ),
)
@DICTIONARY
@common
def edit(
    db: str,
    take: str,
    amounts: tuple[str, ...],
    study: str | None,
    grid: Path | None,
    dictionary: Path | None,
) -> None:
    """Move a model along traits and store the result.

    `render` and `export` use it with --edited.
    """
    parsed = trait_amounts(amounts)
    database = existing(db)
    if grid:
        writable(grid, ".png", ".pdf", ".svg")
        rows = {
            text: {name: amount}
            for text, (name, amount) in zip(amounts, parsed.items(), strict=True)
        }
        drawn = skindb.workflow.edit_grid(
            database,
            take,
            rows,
            grid,
            study=study,
            dictionary=dictionary,
            progress=bar(),
        )
        reports = {
            label: {"edit_report": tree.attrs["edit_report"]}
            for label, tree in drawn.items()
        }
        notes = [
            f"{label}: {line}"
            for label, tree in drawn.items()
            for line in [*_edit_notes(tree), *_far(tree)]
        ]
        emit({"path": str(grid), "edits": reports}, [str(grid), *notes])
        return
    tree = skindb.workflow.edit(
        database, take, parsed, study=study, dictionary=dictionary
    )
    record = database.record("edit", take, tree.attrs["generation"])
    distance = float(tree.attrs["edit_distance"])
    far = f"; {EXTRAPOLATED}" if distance > MAX_EDIT_DISTANCE else ""
    report: dict[str, Any] = dict(tree.attrs["edit_report"])
    takes = tree.attrs["study_takes"]
    near = "the distance to the nearest take is"
    lines = [
        (
            f"{take}: edit {record.generation}; {near} {distance:.2f} times the median "
            f"distance between takes{far}"
        )
    ]
    lines.append(
        f"  traits from the study of {len(takes)} takes: "
        f"{', '.join(takes[:8])}{', ...' if len(takes) > 8 else ''}"
    )
    lines += [f"  {line}" for line in _edit_notes(tree)]
    about = {
        "generation": record.generation,
        "path": record.path,
        "edit_distance": distance,
        "edit_report": report,
    }
    emit(about, lines)


def _edit_notes(tree: xr.DataTree) -> list[str]:
    """Notes of an edit on its traits and its changes, one line each."""
    return [
        *tree.attrs["trait_notes"],
        *skindb.analysis.describe_edit(tree.attrs["edit_report"]),
    ]
