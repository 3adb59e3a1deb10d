"""Command that shows faces in a browser: view."""

from __future__ import annotations

from pathlib import Path

import click

import skindb
from skindb.cli.options import DB, PATH, PORT, common, options_of
from skindb.cli.shared import (
    bar,
    chosen_takes,
    emit,
    existing,
    require_one_take,
    serve,
    trait_amounts,
)
from skindb.errors import Fault, InputError
from skindb.parameters import ViewParameters


@click.command()
@DB
@click.argument("takes", metavar="[TAKE...]", nargs=-1)
@click.option(
    "--out",
    type=PATH,
    help="Self-contained page of one take (.html), or folder for the page of several.",
)
@options_of(ViewParameters)
@PORT
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
    port: int,
    explain: bool,
    parameters: ViewParameters,
) -> None:
    """Show models in a browser, to turn, light and edit them.

    By default all models are shown. With --out, the page is written. Otherwise the
    printed address opens it, once, in one browser of this machine, until Ctrl-C ends
    the server.
    """
    amounts = trait_amounts(parameters.traits, default=1.0)
    if 0.0 in amounts.values():
        rule = "the amount at the end of a slider must not be 0"
        raise InputError(Fault("--trait", rule, "0", "give, for example, age=20"))
    database = existing(db)
    chosen = chosen_takes(database, takes, "model")
    if explain:
        with skindb.workflow.logged_action(database, "view", chosen, explain=True):
            skipped = {
                take: skindb.workflow.explain_view(database, take, traits=amounts)
                for take in chosen
            }
        lines = [f"{take}: {line}" for take, lines in skipped.items() for line in lines]
        emit(skipped, lines)
        return
    options = {**vars(parameters), "traits": amounts, "progress": bar()}
    if out is None:
        server = skindb.workflow.view_server(database, chosen, port=port, **options)
        serve(server, takes=chosen)
        return
    if out.suffix == ".html":
        require_one_take(out, chosen)
    report = skindb.workflow.view_takes(database, chosen, out, **options)
    page = (
        report["path"]
        if out.suffix
        else f"{out / 'index.html'}: serve the folder to open it"
    )
    emit(report, [page])
