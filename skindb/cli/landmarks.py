"""Command with which a person sets the landmarks of a scan: landmarks."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import click

import skindb
from skindb.cli.options import PATH, common
from skindb.cli.shared import emit, writable


@click.command()
@click.argument("scan", type=PATH)
@click.option("--out", type=PATH, default=Path("landmarks.json"), help="File for the landmarks (.json).")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=0, help="Port of the local server; 0 chooses a free one."
)
@common
def landmarks(scan: Path, out: Path, port: int) -> None:
    """Set the 20 landmarks and a crop box on a scan in a browser.

    The scan is a .ply or .obj file. The page is available on this machine only; Ctrl-C ends it. If the file exists, its
    landmarks are loaded. The crop box is written beside it, to a file that ends in .crop.json, by which skindb ingest
    crops the scan.
    """
    writable(out, ".json")
    with skindb.workflow.landmark_page(scan, out, port=port) as server:
        address = f"http://127.0.0.1:{server.server_address[1]}/"
        emit({"address": address, "out": str(out)}, [f"{address}  (Ctrl-C ends it)"])
        with suppress(KeyboardInterrupt):  # ends the server
            server.serve_forever()
