"""Commands for pictures that people already have: import, quick."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any

import click

import skindb
from skindb.cli.options import PATH, Finite, common
from skindb.cli.shared import emit
from skindb.cli.terminal import bar, echo
from skindb.errors import input_error

SOURCE = click.argument("source", type=PATH)
OUT = click.argument("out", type=PATH)
MAX_WIDTH_MM = 100_000.0  # of a picture on the subject: a wall
PICTURES = (
    click.option(
        "--lights",
        type=PATH,
        help=(
            "Table of the lights (.csv or RTI .lp): picture, x, y, z of the direction to "
            "the light; x to the right, y up, z to the camera. Columns x_mm, y_mm, z_mm "
            "are positions.  [default: lights.csv or the .lp file in SOURCE]"
        ),
    ),
    click.option(
        "--mirror-ball",
        type=PATH,
        help="Folder of pictures of a mirror ball under the same lights, and of its mask.",
    ),
    click.option(
        "--mask",
        type=PATH,
        help="Picture that is bright on the subject.  [default: *mask* in SOURCE]",
    ),
    click.option(
        "--response",
        type=click.Choice(["auto", "srgb", "linear"]),
        default="auto",
        help="Values of the pictures; auto: 8 bits are sRGB, others are linear.",
    ),
    click.option(
        "--width",
        "width_mm",
        type=Finite(0, MAX_WIDTH_MM, min_open=True),
        help="Width of a picture on the subject in mm.  [default: 250 on the longer side]",
    ),
)


def _pictures(command: Any) -> Any:
    for option in reversed(PICTURES):
        command = option(command)
    return command


@click.command("import")
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
@_pictures
@click.option(
    "--cameras",
    type=PATH,
    help=(
        "Cameras of olat: a JSON file, or a folder with a text model of COLMAP.  "
        "[default: cameras.json or SOURCE]"
    ),
)
@click.option(
    "--scan", type=PATH, help="Triangle mesh of olat in mm.  [default: that in SOURCE]"
)
@common
def import_command(
    source: Path,
    out: Path,
    layout: str,
    subject: str,
    consent: str,
    reference: str,
    condition: str,
    cameras: Path | None,
    scan: Path | None,
    **pictures: Any,
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
    }
    others = {"--cameras": cameras, "--scan": scan}
    if layout == "olat":
        others = {
            f"--{name.replace('_mm', '').replace('_', '-')}": pictures.pop(name)
            for name in ("mirror_ball", "mask", "width_mm")
        }
        pictures |= {"cameras": cameras, "mesh": scan}
    for option, value in others.items():
        if value is not None:
            raise input_error(
                option, f"does not apply to --as {layout}", str(value), "remove it"
            )
    call = getattr(skindb.ingest, f"import_{layout}")
    result = call(source, out, person, progress=bar(), **pictures)
    for note in result.notes:
        echo(f"note: {note}", err=True)
    count = f"{result.lights} lights, {result.cameras} cameras"
    emit(
        {"capture": str(result.folder), "notes": list(result.notes)},
        [f"{result.folder}: {count}"],
    )


@click.command()
@SOURCE
@OUT
@_pictures
@common
def quick(source: Path, out: Path, **pictures: Any) -> None:
    """Estimate normals, albedo and gloss from the pictures in the folder SOURCE.

    The folder OUT gets maps, and a page to turn and light the subject in a browser.
    Nothing else is kept.
    """
    # the folder with copies of the pictures is removed at the end
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    result = skindb.workflow.quick(source, out, progress=bar(), **pictures)
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
        f"median error of the normals, as stated: {error:.1f} degrees",
        *result["files"],
    ]
    emit(result, lines)
