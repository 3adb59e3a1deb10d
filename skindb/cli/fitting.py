"""Commands for fits: fit, dictionary."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import skindb
from skindb import workflow
from skindb.cli.options import (
    DB,
    DICTIONARY,
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
    aligned,
    choice_lines,
    each_take,
    emit,
    indented,
    shared_path,
    summary_of,
)
from skindb.cli.terminal import bar, echo
from skindb.errors import Fault, attempt, require_none
from skindb.files import Json
from skindb.parameters import FitParameters

if TYPE_CHECKING:
    from skindb.store import Database, Record

# median residual above which the model explains nothing: good captures have 2 to 6 %,
# exchanged exposures or poses 50 to 80 %
MAX_RESIDUAL = 0.2
# below it the errors of the fitted surfels do not describe the face
MIN_FITTED_FRACTION = 0.5


@command
@DB
@click.argument("takes", metavar="[TAKE...]", nargs=-1)
@options_of(FitParameters, only_set=True)
@DICTIONARY
@click.option(
    "--refit",
    is_flag=True,
    help=(
        "Fit again the takes whose model would change, each with the parameters of its "
        "model except those given here."
    ),
)
@click.option("--explain", is_flag=True, help="Only report what the fits would skip.")
@WAIT
@WORKERS
@SCHEDULER
def fit(
    db: str,
    takes: tuple[str, ...],
    dictionary: Path | None,
    refit: bool,
    explain: bool,
    wait: float,
    changes: Json,
) -> None:
    """Fit the named takes, or all without a current model.

    A model is current if it was made from the newest capture of its take. A take with a
    model keeps the parameters of this model, except those given here. A take that fails
    does not stop the others. The same command resumes an interrupted run.
    """
    database = skindb.open(db, create=False)
    progress = bar()
    dictionary = shared_path(dictionary)
    # its faults are reported once, before the fits start
    workflow.dictionary_at(dictionary)
    faults = list[Fault]()
    for take in sorted({*takes} - {*database.takes("capture")}):
        attempt(faults, partial(database.record, "capture", take))
    require_none(faults)
    chosen = takes or workflow.takes_to_fit(
        database, refit=refit, changes=changes, dictionary=dictionary
    )
    for take in [] if takes else workflow.takes_without_consent(database):
        echo(f"skipped: {take}: its consent does not cover fits", err=True)
    call = partial(
        workflow.fit_with,
        database,
        changes=changes,
        dictionary=dictionary,
        explain=explain,
        wait=wait,
        progress=progress,
    )
    finish = partial(_finished, database)
    if not chosen:
        line = (
            "every take has a model of its newest capture; --refit fits again those "
            "whose model would change"
        )
        if not database.takes("capture"):
            line = "no captures: ingest some first"
        elif refit:
            line = (
                "every take has a model with these parameters from this version of the "
                "code; name takes to fit them anyway"
            )
        echo(line, err=True)
        emit({}, [])
        return
    if not (asked("scheduler") or explain):
        skindb.fit.compile_kernels(progress)
    flags = {"refit": refit, "explain": explain}
    with workflow.logged_action(database, "fit", chosen, arguments=flags):
        results, faults = each_take(
            call, chosen, shared=database.folder, progress=progress, finish=finish
        )
    emit(results, [], faults)


def _finished(
    database: Database, result: Record | tuple[str, list[str]]
) -> tuple[str, Any, list[str]]:
    """Name, JSON record and printed lines of a fit or of the plan of a fit."""
    if isinstance(result, tuple):
        take, plan = result
        return take, plan, [f"{take}: {line}" for line in plan]
    tables = database.tables(result)
    prediction = skindb.fit.describe_prediction(tables)
    report = {**result.provenance, **summary_of(result), "prediction": prediction}
    lines = _fit_lines(report)
    if asked("verbose"):
        lines += aligned(skindb.fit.tabulate_diffuse(tables))
    status = ", ".join(
        f"{fraction:.1%} {name}" for name, fraction in report["status"].items()
    )
    title = (
        f"{result.take}: model {report['generation']}, {report['surfels']} surfels in "
        f"{sum(report['seconds'].values()):.1f} s: {status}"
    )
    return result.take, report, [title, *indented(lines)]


def _fit_lines(report: Json) -> list[str]:
    lines = []
    if report["status"].get("fitted", 0) < MIN_FITTED_FRACTION:
        lines.append(
            "few surfels are fitted, and the errors below refer only to them; "
            "draw fit_status with skindb show"
        )
    names = ("fit_residual", "held_out_error", "held_out_camera_error")
    errors = {name: report[name] for name in names if name in report}
    lines += [
        f"{n.replace('_', ' ')} of unobstructed surfels: median {v['median']:.1%}, "
        f"95 % {v['p95']:.1%}"
        for n, v in errors.items()
    ]
    if report.get("fit_residual", {}).get("median", 0) > MAX_RESIDUAL:
        lines.append(
            "the model does not explain the photographs: check the camera poses, "
            "exposure seconds, response and "
            "positions of the lights before anything else"
        )
    lines += [f"dictionary, {line}" for line in report.get("dictionary_notes", [])]
    lines += [_site_line(*site) for site in report.get("translucency", {}).items()]
    lines += [_suspect_line(entry) for entry in report["suspects"]]
    if (energy := report.get("surface_energy", {})).get("contradicted"):
        lines.append(
            f"the highlights reflect {energy['highlights']:.3f} of the light, but the "
            f"surface should reflect {energy['mean']:.3f} with a standard deviation of "
            f"{energy['error']:.3f} in this condition: even reflection stays in R_d; if "
            "you know more, state --surface-energy"
        )
    lines += choice_lines(report.get("corrections", {}))
    if gains := report.get("light_gains"):
        lines.append(
            f"gains of the lights: standard deviation {gains['spread']:.1%}; "
            f"the farthest from 1 is {gains['gain']:.2f}, of light {gains['light']}"
        )
    lines += [f"skipped: {line}" for line in report["skipped"]]
    if asked("verbose"):
        lines += aligned(skindb.fit.tabulate_prediction(report["prediction"]))
        lines += [
            f"{stage}: {seconds:.1f} s" for stage, seconds in report["seconds"].items()
        ]
    return lines


def _site_line(site: str, result: Json) -> str:
    """sigma_tr of one site with its total error, by channel, and the status of the fit."""
    values = zip("RGB", result["sigma_tr"], result["total_error"], strict=True)
    channels = ", ".join(
        f"{c} {v:.3g} +- {e:.1g}" if v is not None else f"{c} unknown"
        for c, v, e in values
    )
    statuses = ", ".join(dict.fromkeys(result["status"]))
    return f"sigma_tr of {site}: {channels} mm-1 ({statuses})"


def _suspect_line(suspect: Json) -> str:
    questions = {"light": "did the face move?", "camera": "was it moved?"}
    device = "light" if "light" in suspect else "camera"
    return (
        f"{device} {suspect[device]}: {suspect['outlier_fraction']:.0%} of its samples are "
        f"outliers, residuals {suspect['misfit']:.1f} times noise ({questions[device]})"
    )


@command
@click.argument("path", type=PATH, required=False)
@click.option(
    "--disc",
    type=Finite(0, 20),
    default=0.8,
    help="Angular radius of the lights in degrees.",
)
def dictionary_command(path: Path | None, disc: float) -> None:
    """Report on the BRDFs in PATH or of the embedded dictionary.

    The report has the energy, reciprocity, errors and missing values of each BRDF.
    """
    fit = skindb.fit
    dictionary = fit.read_dictionary(path) if path else fit.embedded_dictionary()
    report = fit.dictionary_report(dictionary, disc_angular_radius=math.radians(disc))
    columns = {str(name): v for name, v in report.items() if v.dims == ("dictionary",)}
    rows = [
        [name, *(float(v[i]) for v in columns.values())]
        for i, name in enumerate(dictionary.names)
    ]
    worst = [
        f"{name}: median {float(v.median()):.3g}, largest {float(v.max()):.3g}"
        for name, v in columns.items()
    ]
    header = ["dictionary", *columns]
    figures = report.attrs | {
        "disc_angular_radius": float(report["disc_angular_radius"]),
        "header": header,
        "rows": rows,
    }
    emit(figures, [*aligned([header, *rows]), *worst, *report.attrs["notes"]])
