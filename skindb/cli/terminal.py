"""Printing: the only module of the command line that writes to the terminal, with
control characters escaped.
"""

from __future__ import annotations

import click

from skindb.errors import escaped


def echo(*lines: str, err: bool = False) -> None:
    """Print lines on standard output or standard error; a line break inside of a line
    is escaped, too.
    """
    for line in lines:
        click.echo(escaped(line), err=err)


def redraw(text: str, *, last: bool) -> None:
    """Print over the present line of standard error; `last` begins a new one afterwards."""
    click.echo(f"\r{escaped(text)}", nl=last, err=True)


def confirm(question: str) -> bool:
    """Ask a question on standard error that is answered by yes or no."""
    return click.confirm(escaped(question), err=True)


def wait_for_enter(text: str) -> None:
    """Print a text and wait for Enter."""
    click.prompt(escaped(text), default="", show_default=False)
