"""Command that shows faces in a browser: view."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import skindb
from skindb.cli.options import DB, DICTIONARY, PATH, common
from skindb.cli.shared import bar, emit, existing, serve, trait_amounts
from skindb.errors import Fault, InputError


@click.command()
@DB
@click.argument("takes", metavar="[TAKE...]", nargs=-1)
@click.option(
    "--out",
    type=PATH,
    help="Self-contained page of one take (.html), or folder for the page of several.",
)
@click.option(
    "--trait",
    "traits",
    multiple=True,
    metavar="NAME[=AMOUNT]",
    help="Trait that gets a slider, and the amount at its end, for example age=20; 1 if "
    "no amount is given (may be "
    "given several times).",
)
@click.option(
    "--study", help="Study of traits.  [default: traits, or the only one there is]"
)
@click.option(
    "--environment",
    type=PATH,
    help="Latitude-longitude image of light from all directions (.exr).  [default: overcast sky]",
)
@DICTIONARY
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    help="Port of the local server; 0 chooses a free one.",
)
@click.option(
    "--explain",
    is_flag=True,
    help="Only report what the pages skip and approximate, with error bounds.",
)
@common
def view(
    db: str,
    takes: tuple[str, ...],
    out: Path | None,
    traits: tuple[str, ...],
    study: str | None,
    environment: Path | None,
    dictionary: Path | None,
    port: int,
    explain: bool,
) -> None:
    """Show models in a browser, to turn, light and edit them.

    By default all models are shown. With --out, the page is written. Otherwise the
    printed address opens it, once, in one browser of this machine, until Ctrl-C ends
    the server.
    """
    amounts = trait_amounts(traits, default=1.0)
    if 0.0 in amounts.values():
        raise InputError(
            Fault(
                "--trait",
                "the amount at the end of a slider must not be 0",
                "0",
                "give, for example, age=20",
            )
        )
    database = existing(db)
    chosen = list(takes) or database.takes("model")
    if not chosen:
        raise InputError(
            Fault(
                db, "there must be a take with a model", "none", "run skindb fit first"
            )
        )
    if explain:
        with skindb.workflow.logged_action(database, "view", chosen, explain=True):
            skipped = {
                take: skindb.workflow.explain_view(database, take, traits=amounts)
                for take in chosen
            }
        emit(
            skipped,
            [f"{take}: {line}" for take, lines in skipped.items() for line in lines],
        )
        return
    if out is not None and out.suffix == ".html" and len(chosen) > 1:
        count = f"{len(chosen)} takes"
        cure = "name a folder, or one take"
        raise InputError(Fault(str(out), "a file must hold one take", count, cure))
    options: dict[str, Any] = {
        "traits": amounts,
        "study": study,
        "dictionary": dictionary,
        "progress": bar(),
    }
    options["environment"] = environment
    if out is not None:
        report = skindb.workflow.view_takes(database, chosen, out, **options)
        emit(
            report,
            [
                report["path"]
                if out.suffix
                else f"{out / 'index.html'}: serve the folder to open it"
            ],
        )
        return
    serve(
        skindb.workflow.view_server(database, chosen, port=port, **options),
        takes=chosen,
    )
