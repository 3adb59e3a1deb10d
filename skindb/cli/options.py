"""What commands are called with: arguments and options that several have."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

DB = click.argument("db", metavar="DB")
PATH = click.Path(path_type=Path)
TAKE = click.argument("take")
DICTIONARY = click.option(
    "--dictionary", type=PATH, help="Folder of MERL files or .npz of tables to use instead of the embedded BRDFs."
)
WORKERS = click.option(
    "--workers",
    type=click.IntRange(1),
    default=1,
    is_eager=True,  # known when --scheduler is read
    help="Number of takes at a time, each in a process of its own.",
)
GENERATION = click.option("--generation", type=click.IntRange(1), help="An earlier version; default the newest.")


class Finite(click.FloatRange):
    """A range without NaN, which compares with nothing."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, if it is one."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


WAIT = click.option(
    "--wait",
    type=Finite(0),
    default=0,
    show_default=False,
    help="Seconds to wait for another run of the same take.  [default: refuse at once]",
)


def _remember(ctx: click.Context, option: click.Parameter, value: bool) -> None:
    ctx.meta[str(option.name)] = value
    ctx.meta.setdefault("since", time.monotonic())


def _remember_text(ctx: click.Context, option: click.Parameter, value: str | None) -> None:
    ctx.meta[str(option.name)] = value


PROGRESS = click.option(
    "--progress",
    type=click.Choice(["bar", "json", "none"]),
    expose_value=False,
    callback=_remember_text,
    help="Progress on standard error: bars, a JSON object per line, or none.  [default: bar]",
)


def common(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options every command has; they are kept in the context, see `asked`."""
    for names, text in (
        (("--json",), "Print the result as JSON."),
        (("--no-progress",), "The same as --progress none."),
        (("-v", "--verbose"), "Say more, and how long it took."),
    ):
        command = click.option(*names, is_flag=True, expose_value=False, callback=_remember, help=text)(command)
    return PROGRESS(command)


def asked(name: str) -> bool:
    """Whether the running command was given an option of those every command has."""
    return bool(click.get_current_context().meta[name])


def progress_style() -> str:
    """How the running command shows its progress: bar, json or none."""
    style = click.get_current_context().meta["progress"]
    if asked("no_progress") and style not in (None, "none"):
        raise click.UsageError(f"--no-progress and --progress {style} contradict each other: give one of them")
    return "none" if asked("no_progress") else style or "bar"
