"""Arguments and options that several commands have."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

import skindb
from skindb.limits import MAX_SEED, MAX_WAIT_S, MAX_WORKERS

DB = click.argument("db", metavar="DB")
PATH = click.Path(path_type=Path)
TAKE = click.argument("take")
DICTIONARY = click.option(
    "--dictionary",
    type=PATH,
    help=(
        "Dictionary to use instead of the embedded one: a folder of MERL files, or an "
        ".npz file of tables."
    ),
)
WORKERS = click.option(
    "--workers",
    type=click.IntRange(1, MAX_WORKERS),
    default=1,
    is_eager=True,  # parsed before --scheduler
    help="Number of takes processed at a time, each in its own process.",
)
GENERATION = click.option(
    "--generation",
    type=click.IntRange(1),
    help="Number of an earlier version.  [default: the newest]",
)


class Finite(click.FloatRange):
    """A range that excludes NaN and infinity."""

    name = "number"

    def _describe_range(self) -> str:
        """Text of the range in the help; empty without bounds."""
        return (
            "" if self.min is None and self.max is None else super()._describe_range()
        )

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:
        """Convert to a finite number."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


class Seed(click.IntRange):
    """A random seed, whose largest value is not worth a line of the help."""

    def __init__(self) -> None:
        super().__init__(0, MAX_SEED)

    def _describe_range(self) -> str:
        return "x>=0"


WAIT = click.option(
    "--wait",
    type=Finite(0, MAX_WAIT_S),
    default=0,
    show_default=False,
    help="Time in seconds to wait for another run of the same take.  [default: refuse at once]",
)


def _remember(ctx: click.Context, option: click.Parameter, value: bool) -> None:
    ctx.meta[str(option.name)] = value
    ctx.meta.setdefault("since", time.monotonic())


def _remember_text(
    ctx: click.Context, option: click.Parameter, value: str | None
) -> None:
    ctx.meta[str(option.name)] = value


PROGRESS = click.option(
    "--progress",
    type=click.Choice(["bar", "json", "none"]),
    expose_value=False,
    callback=_remember_text,
    help="Progress on standard error: bars, a JSON object per line, or none.  [default: bar]",
)


def _act_as(ctx: click.Context, _: click.Parameter, actor: str | None) -> None:
    if actor is not None:
        ctx.with_resource(skindb.workflow.acting_as(actor))


ACTOR = click.option(
    "--actor",
    metavar="NAME",
    expose_value=False,
    callback=_act_as,
    help=(
        "Name under which the action is logged.  [default: SKINDB_ACTOR, or the user "
        "of the operating system]"
    ),
)


def common(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that every command has; their values are kept in the context, see `asked`."""
    for names, text in (
        (("--json",), "Print the result as JSON."),
        (("--no-progress",), "Show no progress, as --progress none."),
        (("-v", "--verbose"), "Print more details and the run time."),
    ):
        command = click.option(
            *names, is_flag=True, expose_value=False, callback=_remember, help=text
        )(command)
    return ACTOR(PROGRESS(command))


def asked(name: str) -> bool:
    """Whether the running command was given this one of the common options."""
    return bool(click.get_current_context().meta[name])


def progress_style() -> str:
    """How the running command shows its progress: bar, json or none."""
    style = click.get_current_context().meta["progress"]
    if asked("no_progress") and style not in (None, "none"):
        raise click.UsageError(
            f"--no-progress and --progress {style} contradict each other; give only one of them"
        )
    return "none" if asked("no_progress") else style or "bar"
