"""Command with which a person sets the landmarks of a scan: landmarks."""

from __future__ import annotations

from pathlib import Path

import click

import skindb
from skindb.cli.options import PATH, PORT, common
from skindb.cli.shared import serve, writable


@click.command()
@click.argument("scan", type=PATH)
@click.option(
    "--out",
    type=PATH,
    default=Path("landmarks.json"),
    help="File for the landmarks (.json).",
)
@PORT
@common
def landmarks(scan: Path, out: Path, port: int) -> None:
    """Set the 20 landmarks and a crop box on a scan in a browser.

    The scan is a .ply or .obj file. The printed address opens the page, once, in one
    browser of this machine; Ctrl-C ends it. If the file exists, its landmarks are
    loaded. The crop box is written beside it, to a file that ends in .crop.json, by
    which skindb ingest crops the scan.
    """
    writable(out, ".json")
    serve(skindb.workflow.landmark_page(scan, out, port=port), out=str(out))
