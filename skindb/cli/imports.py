"""Commands for pictures that people already have: import, quick."""

import signal
import sys
from dataclasses import asdict
from functools import cache
from pathlib import Path

import click

import skindb
from skindb import workflow
from skindb.cli.options import PATH, command, options_of
from skindb.cli.shared import emit
from skindb.cli.terminal import bar, echo
from skindb.errors import counted
from skindb.limits import MAX_VISIT
from skindb.parameters import ImportParameters, QuickParameters

COMPILING = "note: kernels are compiled, which takes minutes after an installation"
SOURCE = click.argument("source", type=PATH)
OUT = click.argument("out", type=PATH)


@command
@SOURCE
@OUT
@click.option(
    "--as",
    "layout",
    type=click.Choice(["images", "olat"]),
    required=True,
    help="images: pictures of one camera; olat: a picture of each light and camera.",
)
@click.option("--subject", required=True, help="Pseudonym of the subject.")
@click.option(
    "--consent",
    required=True,
    help=(
        "Scopes that the subject consents to, separated by commas: fit, statistics, "
        "export, publish."
    ),
)
@click.option(
    "--reference", required=True, help="Reference to the signed consent form."
)
@click.option("--condition", default="normal", help="Condition of the skin.")
@click.option(
    "--visit",
    type=click.IntRange(1, MAX_VISIT),
    help="Visit of the subject.  [default: ingest numbers sessions by their times]",
)
@options_of(ImportParameters)
def import_command(
    source: Path,
    out: Path,
    layout: str,
    subject: str,
    consent: str,
    reference: str,
    condition: str,
    visit: int | None,
    parameters: ImportParameters,
) -> None:
    """Write the capture folder OUT from the pictures in the folder SOURCE.

    What is missing is estimated or named: without a scan, one camera shows the surface;
    without a white target, albedo is relative.
    """
    person = {
        "subject": subject,
        "condition": condition,
        "consent": {
            "scope": [word.strip() for word in consent.split(",")],
            "reference": reference,
        },
    } | ({} if visit is None else {"visit": visit})
    call = getattr(skindb.ingest, f"import_{layout}")
    result = call(source, out, person, progress=bar(), **asdict(parameters))
    for note in result.notes:
        echo(f"note: {note}", err=True)
    count = f"{counted(result.lights, 'light')}, {counted(result.cameras, 'camera')}"
    emit(
        {"capture": str(result.folder), "notes": list(result.notes)},
        [f"{result.folder}: {count}"],
    )


@command
@SOURCE
@OUT
@options_of(QuickParameters)
def quick(source: Path, out: Path, parameters: QuickParameters) -> None:
    """Estimate normals, albedo and gloss from the pictures in the folder SOURCE.

    The folder OUT gets maps, and a page to turn and light the subject in a browser.
    Nothing else is kept.
    """
    # the folder with copies of the pictures is removed at the end
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    progress = bar()
    is_shown = progress.bars or progress.style == "json"
    result = workflow.quick(
        source,
        out,
        progress=progress,
        compiling=None if is_shown else cache(lambda: echo(COMPILING, err=True)),
        **asdict(parameters),
    )
    for note in result["notes"]:
        echo(f"note: {note}", err=True)
    total = sum(result["points"].values())
    parts = ", ".join(
        f"{name.replace('_', ' ')} {count / total:.1%}"
        for name, count in result["points"].items()
    )
    error = result["normal_error"]
    lines = [
        f"{total:,} points: {parts}",
        f"stated error of the normals (with that of the model, median): {error:.1f} degrees",
        *result["files"],
    ]
    emit(result, lines)
