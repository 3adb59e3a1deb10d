"""The command line: each command parses its options, makes one public call and prints the result."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

import click

import skindb
from skindb.cli.capture import calibrate, capture
from skindb.cli.captures import demo, ingest, simulate
from skindb.cli.fitting import dictionary_command, fit
from skindb.cli.landmarks import landmarks
from skindb.cli.pictures import compare, export, render, show
from skindb.cli.population import analyze, edit, register
from skindb.cli.shared import echo_json, fault_lines
from skindb.cli.subjects import consent, refresh, release, withdraw
from skindb.cli.upkeep import bench, clean, info, verify
from skindb.cli.view import view
from skindb.errors import Fault, InputError, system_fault

INTERRUPTED = 130


@click.group(context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.version_option(skindb.__version__, prog_name="skindb")
def cli() -> None:
    """Measure human skin: ingest captures, fit reflectance models, study populations, edit, render and export."""


for _command in (
    demo,
    simulate,
    calibrate,
    capture,
    landmarks,
    ingest,
    fit,
    dictionary_command,
    analyze,
    register,
    edit,
    render,
    compare,
    show,
    export,
    view,
    consent,
    release,
    refresh,
    withdraw,
    info,
    verify,
    clean,
    bench,
):
    cli.add_command(_command)


def _give_up(code: int, faults: Sequence[Fault], done: Any = None) -> NoReturn:
    """Exit with this code; with --json print the faults, and what was done in spite of them.

    The option is looked up in `sys.argv`, because a faulty call may not have been parsed.
    """
    if "--json" in sys.argv:
        errors = [{"what": f.where, "rule": f.rule, "found": f.found, "cure": f.cure} for f in faults]
        echo_json({"error": errors} | ({"done": done} if done else {}))
    sys.exit(code)


def _one_line(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,  # noqa: ARG001  the signature is that of the standard library
) -> str:
    """Format a warning: only its text if it is meant for users, otherwise with its place in the code."""
    place = "" if category.__name__ == "StaleWarning" else f"{filename}:{lineno}: {category.__name__}: "
    return f"skindb: warning: {place}{message}\n"


def main() -> None:
    """Run the command line.

    Each fault of the input is printed as one line, and the exit code is 1; wrong usage gives exit code 2.
    """
    warnings.formatwarning = _one_line
    warnings.filterwarnings(
        "always", message=".* is out of date: "
    )  # StaleWarning; importing it here would slow the start
    try:
        cli.main(standalone_mode=False)
    except InputError as error:
        for line in fault_lines(error.faults, every=bool({"-v", "--verbose"} & set(sys.argv))):
            click.echo(f"skindb: {line}", err=True)
        _give_up(1, error.faults, getattr(error, "done", None))
    except click.ClickException as error:
        error.show()
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "skindb"
        rule = "must be called as its --help says"
        _give_up(error.exit_code, [Fault(command, rule, error.format_message(), f"see {command} --help")])
    except (click.Abort, KeyboardInterrupt):
        said = "interrupted; no incomplete version was committed"
        click.echo(f"skindb: {said}", err=True)
        _give_up(INTERRUPTED, [Fault("skindb", "must run until it is finished", said)])
    except OSError as error:
        fault = system_fault(error, "file system")
        click.echo(f"skindb: {fault}", err=True)
        _give_up(1, [fault])
