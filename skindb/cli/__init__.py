"""The command line: each command parses its options, makes one public call and prints
the result.
"""

import io
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn, TextIO

import click

import skindb
from skindb.cli.captures import demo, ingest, simulate
from skindb.cli.fitting import dictionary_command, fit
from skindb.cli.imports import import_command, quick
from skindb.cli.laboratory import (
    calibrate,
    calibrate_cameras,
    capture,
    check_device,
    landmarks,
    register_scan,
)
from skindb.cli.pictures import compare, export, render, show, view
from skindb.cli.population import edit, register, reproduce
from skindb.cli.shared import echo_json, fault_lines
from skindb.cli.studies import analyze, tidy
from skindb.cli.subjects import consent, refresh, release, withdraw
from skindb.cli.terminal import HelpContext, echo
from skindb.cli.upkeep import audit, backup, clean, info, restore, verify
from skindb.errors import Fault, InputError, SkindbWarning, escaped, system_fault
from skindb.files import private_umask

INTERRUPTED = 130


SECTIONS = {
    "Try": (demo, simulate, quick),
    "Laboratory": (
        calibrate_cameras,
        calibrate,
        capture,
        check_device,
        landmarks,
        register_scan,
    ),
    "Measure": (import_command, ingest, fit, compare, dictionary_command),
    "Population": (register, analyze, tidy, edit, reproduce),
    "Pictures": (show, render, view, export),
    "Subjects": (consent, release, refresh, withdraw),
    "Database": (info, audit, verify, clean, backup, restore),
}


class Commands(click.Group):
    """The commands, which the help lists in sections."""

    context_class = HelpContext

    def format_commands(
        self,
        ctx: click.Context,  # noqa: ARG002
        formatter: click.HelpFormatter,
    ) -> None:
        """Write a section for each purpose."""
        for section, commands in SECTIONS.items():
            with formatter.section(section):
                formatter.write_dl(
                    [(one.name or "", one.get_short_help_str(100)) for one in commands]
                )


@click.group(
    cls=Commands,
    context_settings={"help_option_names": ["-h", "--help"], "show_default": True},
)
@click.version_option(skindb.__version__, prog_name="skindb")
def cli() -> None:
    """Measure human skin: ingest captures, fit reflectance models, study populations,
    edit, render and export.
    """


for _commands in SECTIONS.values():
    for _command in _commands:
        _command.context_class = HelpContext
        cli.add_command(_command)


def _give_up(code: int, faults: Sequence[Fault], results: Any = None) -> NoReturn:
    """Exit with this code; with --json print the faults, and what was done in spite of them.

    The option is looked up in `sys.argv`, because a faulty call may not have been parsed.
    """
    if "--json" in sys.argv:
        errors = [
            {"what": f.where, "rule": f.rule, "found": f.found, "cure": f.cure}
            for f in faults
        ]
        echo_json({"error": errors} | ({"done": results} if results else {}))
    sys.exit(code)


def _one_line(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    # the signature is that of the standard library
    line: str | None = None,  # noqa: ARG001
) -> str:
    """Format a warning: only its text if it is meant for users, otherwise with its
    place in the code.
    """
    place = (
        ""
        if issubclass(category, SkindbWarning)
        else f"{filename}:{lineno}: {category.__name__}: "
    )
    return f"skindb: warning: {escaped(f'{place}{message}')}\n"


def _silence_libraries() -> None:
    """Keep lines that C libraries print about damaged files from the terminal, and from
    the output of --json.

    They write to the descriptors 1 and 2, which become the null device; `sys.stdout`
    and `sys.stderr` get others.
    """
    if (
        sys.stdout is not sys.__stdout__
        or sys.stderr is not sys.__stderr__
        or sys.stdout is None
        or sys.stderr is None
    ):
        return  # closed, or replaced by a program that calls this one
    sys.stdout = _moved(sys.stdout)
    sys.stderr = _moved(sys.stderr)


def _moved(stream: TextIO) -> TextIO:
    """The stream on a new descriptor; its old one becomes the null device."""
    stream.flush()
    number = os.dup(stream.fileno())
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)
    return os.fdopen(
        number, "w", buffering=1, encoding=stream.encoding, errors=stream.errors
    )


def main() -> None:
    """Run the command line.

    Each fault of the input is printed as one line, and the exit code is 1; wrong usage
    gives exit code 2.
    """
    verbose = bool({"-v", "--verbose"} & set(sys.argv))
    _silence_libraries()
    # otherwise Dask imports distributed, to look for a client
    os.environ.setdefault("DASK_SCHEDULER", "threads")
    warnings.formatwarning = _one_line
    if not verbose and not sys.warnoptions:
        # those of libraries, which name lines of their code
        warnings.simplefilter("ignore")
    warnings.filterwarnings("always", category=SkindbWarning)
    try:
        with private_umask():  # also for what libraries and worker processes write
            cli.main(standalone_mode=False)
    except InputError as error:
        echo(
            *(
                f"skindb: {line}"
                for line in fault_lines(error.faults, unlimited=verbose)
            ),
            err=True,
        )
        _give_up(1, error.faults, getattr(error, "done", None))
    except click.ClickException as error:
        stream = io.StringIO()
        error.show(stream)
        if isinstance(error, click.NoSuchOption) and error.option_name[1:2] != "-":
            stream.write("A name that begins with - follows after --.\n")
        echo(*stream.getvalue().expandtabs(2).splitlines(), err=True)
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "skindb"
        _give_up(
            error.exit_code,
            [
                Fault(
                    command,
                    "must be called as its --help says",
                    error.format_message(),
                    f"see {command} --help",
                )
            ],
        )
    except (click.Abort, KeyboardInterrupt):
        message = "interrupted"
        command = cli.commands.get("".join(sys.argv[1:2]))
        if command and any(param.name == "db" for param in command.params):
            message += "; no incomplete version was committed"
        echo(f"skindb: {message}", err=True)
        _give_up(
            INTERRUPTED, [Fault("skindb", "must run until it is finished", message)]
        )
    except OSError as error:
        fault = system_fault(error, "file system")
        echo(f"skindb: {fault}", err=True)
        _give_up(1, [fault])
