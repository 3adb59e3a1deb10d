"""Commands about all takes: analyze, register, edit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import pandas as pd
from click.core import ParameterSource

import skindb
from skindb.cli.engine import SCHEDULER, client_of, shared_path
from skindb.cli.options import DB, DICTIONARY, PATH, TAKE, WORKERS, common
from skindb.cli.shared import aligned, bar, emit, existing, writable
from skindb.errors import Fault, InputError

if TYPE_CHECKING:
    import xarray as xr

RELEASE = click.option("--release", metavar="NAME", help="Use the versions of this release.  [default: the newest]")
# study -> the options that it takes
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

# columns that would make lines too long for a terminal; --json and --csv have them
LEFT_TO_FILES = (
    "sigma_tr_total_error",
    "sigma_tr_repeat_deviation",
    "effect_percent_low",
    "effect_percent_high",
    "effect_p_false_discovery",
    "effect_detectable",
)


@click.command()
@DB
@click.argument("what", type=click.Choice(list(OPTIONS)))
@click.option("--take", "takes", multiple=True, help="Use only these takes (may be given several times).")
@click.option("--group-by", help="Attribute or trait to group by: gender, age, ...")
@click.option("--adjust", metavar="NAME,...", default="", help="Attributes to hold fixed.")
@click.option(
    "--permutations",
    type=click.IntRange(100),
    help="Most permutations for p values.  [default: 10000, for maps 1000]",
)
@click.option(
    "--k",
    type=click.IntRange(1),
    help="Number of components.  [default: 6 of the common basis, 5 of albedo maps]",
)
@click.option("--in-metric", is_flag=True, help="Find the common basis by distances between BRDFs, not coefficients.")
@click.option(
    "--seed", type=click.IntRange(0), default=0, help="Random seed of factorisation, bootstrap and permutations."
)
@DICTIONARY
@RELEASE
@click.option("--name", help="Name to store the study under.  [default: its parameters]")
@click.option("--plot", type=PATH, help="Also write a plot (.png, .pdf, .svg).")
@click.option("--faces", type=PATH, help="translucency: also render the least and the most translucent take.")
@click.option("--site", help="translucency: site of the probe for --faces.  [default: cheek]")
@click.option("--csv", type=PATH, help="Also write the table as a file of comma-separated values (.csv).")
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

    `brdf` tells how many basis BRDFs it needs, `albedo` its colours, `translucency` how far light travels in it, and
    `traits` what goes with an attribute. `groups` compares groups of subjects in everything that was measured, with
    intervals and p values; `maps` does so at every texel of the common (u, v), and `surface` compares surface BRDFs:
    distances, a map of the takes, spheres and lobes. `components` draws the main axes of albedo as faces,
    `correlations` tells how albedo, surface and translucency go together, `chromophores` finds melanin and haemoglobin
    in maps of albedo, and the mean face, and `coverage` counts whom the takes represent and whom not.

    A study with other parameters, of other takes or of a release is stored beside the one with the default parameters,
    and does not replace it.
    """
    if plot:
        writable(plot, ".png", ".pdf", ".svg")
    if csv:
        writable(csv, ".csv")
    if faces:
        writable(faces, ".png", ".pdf", ".svg")
    if (faces or site) and what != "translucency":
        raise InputError(Fault("--faces" if faces else "--site", "belongs to translucency", f"the study {what}", ""))
    context = click.get_current_context()
    for option in sorted({name for known in OPTIONS.values() for name in known}):
        if option not in OPTIONS[what] and context.get_parameter_source(option) is ParameterSource.COMMANDLINE:
            *most, last = (name for name, known in OPTIONS.items() if option in known)
            belongs = f"belongs to {', '.join(most)} and {last}" if most else f"belongs to {last}"
            raise InputError(Fault(f"--{option.replace('_', '-')}", belongs, f"the study {what}", "leave it out"))
    options["adjust"] = [name.strip() for name in options["adjust"].split(",") if name.strip()]
    if what in ("groups", "maps", "surface") and not options["group_by"]:
        raise InputError(Fault(f"analyze {what}", "compares by an attribute", "none", "name it with --group-by"))
    database, progress = existing(db), bar()
    progress(f"analyze {what}", 0, 1)
    given = {option: options[option] for option in OPTIONS[what] if options[option] is not None}
    if "dictionary" in given:
        given["dictionary"] = shared_path(given["dictionary"], scheduler)
    with client_of(scheduler, progress) as client, skindb.workflow.computing_on(client, database.folder):
        study = skindb.workflow.STUDIES[what](database, takes=takes, release=release, name=name, **given)
    progress(f"analyze {what}", 1, 1)
    if plot:
        skindb.analysis.plot_study(study, plot)
    if faces:
        skindb.workflow.translucency_grid(database, faces, site=site or "cheek", progress=progress)
    header, rows = skindb.analysis.tabulate_study(study)
    if csv:
        pd.DataFrame(rows, columns=header).to_csv(csv, index=False)
    record = database.record("population", study.attrs["study"], study.attrs["generation"])
    notes = skindb.analysis.describe_study(study)
    skipped = [f"skipped: {line}" for line in study.attrs["skipped"]]
    skipped += [f"out of date: {line}" for line in study.attrs.get("outdated", [])]
    result = {"study": record.take, "generation": record.generation, "path": record.path}
    units = {name: skindb.schema.VARIABLES[name].units for name in header if name in skindb.schema.VARIABLES}
    result |= {"header": header, "units": units, "rows": rows, "notes": notes}
    result |= {"skipped": study.attrs["skipped"]}
    shown = [i for i, name in enumerate(header) if name not in LEFT_TO_FILES]
    table = aligned([[line[i] for i in shown] for line in [header, *rows]])
    emit(result, [*table, *notes, *skipped, *study.attrs.get("registration", [])])


@click.command()
@DB
@click.option("--take", "takes", multiple=True, help="Register only these takes (may be given several times).")
@click.option("--reference", metavar="TAKE", help="Whose (u, v) is the common one; default the mean of all takes.")
@WORKERS
@SCHEDULER
@common
def register(db: str, takes: tuple[str, ...], reference: str | None, workers: int, scheduler: str | None) -> None:
    """Warp the fitted takes into one (u, v) by their landmarks, and report how well these agree."""
    database, workflow, progress = existing(db), skindb.workflow, bar()
    with client_of(scheduler, progress) as client:
        records = workflow.register_takes(
            database, takes=takes or None, reference=reference, workers=workers, client=client, progress=progress
        )
    left = [take for take in (takes or database.takes("model")) if take not in records]
    why = {True: "no landmarks", False: "its consent does not cover statistics"}
    skipped = {take: why["statistics" in database.consent(take)] for take in left}
    registered = workflow.registered_datasets(database, records)
    header, rows = skindb.analysis.tabulate_registration(registered)
    done = {take: {"generation": record.generation, "path": record.path} for take, record in records.items()}
    doubts = skindb.analysis.doubtful_landmarks(registered)
    report = {"takes": done, "header": header, "rows": rows, "doubts": doubts, "skipped": skipped}
    lines = [f"skipped: {take}: {reason}" for take, reason in skipped.items()]
    emit(report, [*aligned([header, *rows]), *doubts, *lines])


MAX_EDIT_DISTANCE = 1.0  # of the median distance between takes


def _far(tree: Any) -> list[str]:
    """A warning for an edit that leaves the data."""
    distance = float(tree.attrs["edit_distance"])
    far = f"the nearest take is as far as {distance:.2f} times the median distance between takes"
    return [f"{far}; this leaves the data: do not trust it"] if distance > MAX_EDIT_DISTANCE else []


@click.command()
@DB
@TAKE
@click.option("--trait", "amounts", multiple=True, required=True, metavar="NAME=AMOUNT", help="For example lotion=0.5.")
@click.option("--study", help="Study of traits to use.  [default: traits, or the only one]")
@click.option(
    "--grid",
    type=PATH,
    help="Instead draw each trait, a row each, at half and full strength with one exposure (.png, .pdf, .svg).",
)
@DICTIONARY
@common
def edit(
    db: str, take: str, amounts: tuple[str, ...], study: str | None, grid: Path | None, dictionary: Path | None
) -> None:
    """Move a model along traits; `render` and `export` show it with --edited."""
    given = [_amount(text) for text in amounts]
    parsed = dict(given)
    if len(parsed) < len(given):
        twice = next(name for name, _ in given if [other for other, _ in given].count(name) > 1)
        raise InputError(Fault("--trait", "names each trait once", f"{twice} more than once", "give one amount"))
    database = existing(db)
    if grid:
        writable(grid, ".png", ".pdf", ".svg")
        rows = {text: {name: amount} for text, (name, amount) in zip(amounts, parsed.items(), strict=True)}
        drawn = skindb.workflow.edit_grid(
            database, take, rows, grid, study=study, dictionary=dictionary, progress=bar()
        )
        told = {label: {"edit_report": tree.attrs["edit_report"]} for label, tree in drawn.items()}
        notes = [f"{label}: {line}" for label, tree in drawn.items() for line in [*_said(tree), *_far(tree)]]
        emit({"path": str(grid), "edits": told}, [str(grid), *notes])
        return
    tree = skindb.workflow.edit(database, take, parsed, study=study, dictionary=dictionary)
    record = database.record("edit", take, tree.attrs["generation"])
    distance = float(tree.attrs["edit_distance"])
    far = "; this leaves the data: do not trust it" if distance > MAX_EDIT_DISTANCE else ""
    report: dict[str, Any] = dict(tree.attrs["edit_report"])
    takes = tree.attrs["study_takes"]
    near = "the nearest take is as far as"
    lines = [f"{take}: edit {record.generation}; {near} {distance:.2f} times the median distance between takes{far}"]
    lines.append(
        f"  traits from the study of {len(takes)} takes: {', '.join(takes[:8])}{', ...' if len(takes) > 8 else ''}"
    )
    lines += [f"  {line}" for line in _said(tree)]
    about = {"generation": record.generation, "path": record.path, "edit_distance": distance, "edit_report": report}
    emit(about, lines)


def _said(tree: xr.DataTree) -> list[str]:
    """What an edit says of itself, a line each."""
    return [*tree.attrs["trait_notes"], *skindb.analysis.describe_edit(tree.attrs["edit_report"])]


def _amount(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        return name, float(number)
    except ValueError:
        raise click.UsageError(f"--trait needs NAME=AMOUNT, such as lotion=0.5; found {text!r}") from None
