"""Commands about all takes: analyze, register, edit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import skindb
from skindb.cli.options import DB, PATH, TAKE, common
from skindb.cli.shared import aligned, bar, emit, existing, summary_of, writable


@click.command()
@DB
@click.argument("what", type=click.Choice(["brdf", "albedo", "translucency", "traits"]))
@click.option("--take", "takes", multiple=True, help="Only these takes (may be given several times).")
@click.option("--group-by", help="Attribute or trait to group translucency or albedo by: condition, gender, ...")
@click.option("--k", type=click.IntRange(1), default=6, help="Components of the common basis.")
@click.option("--in-metric", is_flag=True, help="Find the common basis by distances between BRDFs, not coefficients.")
@click.option("--seed", type=click.IntRange(0), default=0, help="Of the surfels drawn.")
@click.option("--basis", "merl", type=PATH, help="MERL files or tables the takes were fitted with.")
@click.option("--plot", type=PATH, help="Also write a plot (.png, .pdf, .svg).")
@common
def analyze(db: str, what: str, plot: Path | None, **options: Any) -> None:
    """Population studies of the fitted takes: brdf, albedo, translucency or traits."""
    from skindb.analysis.study import analyze as study
    from skindb.analysis.study import plot_study, tabulate_study

    if plot:
        writable(plot, ".png", ".pdf", ".svg")
    record, tree = study(skindb.open(db), what, progress=bar(), **options)
    if plot:
        plot_study(tree, plot)
    header, rows = tabulate_study(tree)
    result = {**summary_of(record), "header": header, "rows": rows}
    left = [f"left out: {line}" for line in record.provenance["left_out"]]
    emit(result, [*aligned([header, *rows]), *left, *record.provenance.get("registration", [])])


@click.command()
@DB
@click.option("--take", "takes", multiple=True, help="Only these takes (may be given several times).")
@click.option("--reference", metavar="TAKE", help="Whose (u, v) is the common one; default the mean of all takes.")
@common
def register(db: str, takes: tuple[str, ...], reference: str | None) -> None:
    """Warp the fitted takes into one (u, v) by their landmarks, and say how well these agree."""
    from skindb.analysis.registration import doubtful_landmarks, tabulate_registration
    from skindb.analysis.study import register_takes

    records, registered = register_takes(existing(db), takes=takes, reference=reference)
    header, rows = tabulate_registration(registered)
    done = {take: summary_of(record) for take, record in records.items()}
    doubts = doubtful_landmarks(registered)
    emit({"takes": done, "header": header, "rows": rows, "doubts": doubts}, [*aligned([header, *rows]), *doubts])


@click.command()
@DB
@TAKE
@click.option("--trait", "amounts", multiple=True, required=True, metavar="NAME=AMOUNT", help="For example lotion=0.5.")
@click.option("--basis", "merl", type=PATH, help="MERL files or tables the take was fitted with.")
@common
def edit(db: str, take: str, amounts: tuple[str, ...], merl: Path | None) -> None:
    """Move a model along traits; `render` and `export` show it with --edited."""
    from skindb.analysis.study import edit_take

    record, tree = edit_take(skindb.open(db), take, dict(_amount(text) for text in amounts), merl=merl)
    distance = float(tree.attrs["edit_distance"])
    far = " (farther than takes differ from each other: do not trust it)" if distance > 1 else ""
    report: dict[str, Any] = dict(tree.attrs["edit_report"])
    lines = [f"{take}: edit {record.generation}, {distance:.2f} of the distance between takes{far}"]
    lines += [
        f"  {part}: cut to what is physical on {own['clipped']:.0%} of the area"
        for part, own in report.items()
        if own["clipped"]
    ]
    emit({**summary_of(record), "edit_distance": distance, "edit_report": report}, lines)


def _amount(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        return name, float(number)
    except ValueError:
        raise click.UsageError(f"--trait needs NAME=AMOUNT, such as lotion=0.5; found {text!r}") from None
