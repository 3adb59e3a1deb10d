"""Arguments and options that several commands have."""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import MISSING, Field, fields
from functools import wraps
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import click
from click.core import ParameterSource

from skindb import workflow
from skindb.files import Json
from skindb.limits import MAX_WAIT_S, MAX_WORKERS
from skindb.parameters import DICTIONARY_HELP, Option, broken_rule, option_of, words_of

DB = click.argument("db", metavar="DB")
PATH = click.Path(path_type=Path)
TAKE = click.argument("take")
TAKES = click.option(
    "--take",
    "takes",
    multiple=True,
    help="Take to use (may be given several times).  [default: all]",
)
WHERE = click.option(
    "--where",
    help="Condition that takes must fulfil, for example: condition == 'lotion' and age > 40.",
)
RELEASE = click.option(
    "--release",
    metavar="NAME",
    help="Release whose versions are used.  [default: the newest versions]",
)
DICTIONARY = click.option("--dictionary", type=PATH, help=DICTIONARY_HELP)
PORT = click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    help="Port of the local server; 0 chooses a free one.",
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


class WordOrNumber(click.ParamType):  # type: ignore[type-arg]
    """One of a few words, or a number within limits."""

    name = "text"

    def __init__(self, hint: Any, limits: Option) -> None:
        self.hint = hint
        self.limits = limits

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:
        """Convert to a number, unless it is a word."""
        converted = value
        if value not in words_of(self.hint):
            with suppress(ValueError):
                converted = float(value)
        if rule := broken_rule(self.limits, self.hint, converted):
            self.fail(f"{rule}; found {value!r}", param, ctx)
        return converted


class Switch(click.Choice[Any]):
    """on, off, or one of a few words."""

    def __init__(self, words: tuple[str, ...]) -> None:
        super().__init__([*words, "on", "off"])

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:
        """Convert to a bool, unless it is a word."""
        word = super().convert(value, param, ctx)
        return {"on": True, "off": False}.get(word, word)


Command = Callable[..., Any]


def options_of(
    record: type[Any], *, only_set: bool = False
) -> Callable[[Command], Command]:
    """Add the options of the fields of a parameter record to a command.

    The command is called with `parameters`, a record; or, if `only_set`, with `changes`,
    a dictionary of those that the user set.
    """
    hints = get_type_hints(record)
    specs = fields(record)

    def decorate(command: Command) -> Command:
        @wraps(command)
        def with_record(**values: Any) -> Any:
            chosen = {spec.name: values.pop(spec.name) for spec in specs}
            if only_set:
                changes = {k: value for k, value in chosen.items() if value is not None}
                return command(changes=changes, **values)
            return command(parameters=record(**chosen), **values)

        decorated: Command = with_record
        for spec in reversed(specs):
            limits = option_of(record, spec.name)
            add = _click_option(spec, hints[spec.name], limits, unset=only_set)
            decorated = add(decorated)
        return decorated

    return decorate


def _click_option(
    spec: Field[Any], hint: Any, limits: Option, *, unset: bool
) -> Callable[[Command], Command]:
    """The option of a field; with `unset` its default is None, and the help names the
    default of the field.
    """
    text = limits.help
    default = spec.default
    if unset and default is not False:
        default_text = f"{default:g}" if isinstance(default, float) else default
        text += f"  [default: {default_text}]"
    settings: Json = {"default": None if unset else default, "help": text}
    if default is MISSING:
        settings = {"required": True, "help": text}
    if limits.metavar:
        settings["metavar"] = limits.metavar
    if not limits.show_default:
        settings["show_default"] = False
    name = limits.name or spec.name.replace("_", "-")
    return click.option(
        f"--{name}", spec.name, **settings, **_kind(hint, limits, default)
    )


def _kind(hint: Any, limits: Option, default: Any) -> Json:
    """Settings of an option that follow from the type of its field."""
    if words_of(hint) and limits.minimum is not None:
        return {"type": WordOrNumber(hint, limits)}
    if words_of(hint) and bool in get_args(hint):
        return {"type": Switch(words_of(hint))}
    kind = get_args(hint)[0] if get_origin(hint) in (Union, UnionType) else hint
    if kind is bool and default is True:  # the option switches it off
        return {"is_flag": True, "flag_value": False, "show_default": False}
    if kind is bool:
        return {"is_flag": True}
    if get_origin(kind) is tuple:
        return {"multiple": True}
    return {"type": _type(kind, limits)}


def _type(kind: Any, limits: Option) -> Any:
    """The type of an option of one value."""
    if get_origin(kind) is Literal:
        return click.Choice(get_args(kind))
    if kind is Path:
        return PATH
    if kind is float:
        return Finite(limits.minimum, limits.maximum, min_open=limits.above_minimum)
    if kind is int:
        low, high = (
            None if x is None else int(x) for x in (limits.minimum, limits.maximum)
        )
        return click.IntRange(low, high)
    return kind


WAIT = click.option(
    "--wait",
    type=Finite(0, MAX_WAIT_S),
    default=0,
    show_default=False,
    help="Time in seconds to wait for another run of the same take.  [default: refuse at once]",
)


def _remember(ctx: click.Context, option: click.Parameter, value: Any) -> None:
    ctx.meta[str(option.name)] = value
    ctx.meta.setdefault("since", time.monotonic())


def _refuse_both(ctx: click.Context, option: click.Parameter, value: Any) -> None:
    source = ctx.get_parameter_source("workers")
    if value is not None and source is ParameterSource.COMMANDLINE:
        raise click.UsageError(
            "--workers starts local processes and --scheduler uses a cluster; give only one of them"
        )
    _remember(ctx, option, value)


WORKERS = click.option(
    "--workers",
    type=click.IntRange(1, MAX_WORKERS),
    default=1,
    is_eager=True,  # before --scheduler is read
    expose_value=False,
    callback=_remember,
    help="Number of takes processed at a time, each in its own process.",
)
SCHEDULER = click.option(
    "--scheduler",
    metavar="ADDRESS",
    expose_value=False,
    callback=_refuse_both,
    help=(
        "Dask scheduler whose workers process the takes: tcp://HOST:PORT, or the .json "
        "file that it wrote."
    ),
)
PROGRESS = click.option(
    "--progress",
    type=click.Choice(["bar", "json", "none"]),
    expose_value=False,
    callback=_remember,
    help="Progress on standard error: bars, a JSON object per line, or none.  [default: bar]",
)


def _act_as(ctx: click.Context, _: click.Parameter, actor: str | None) -> None:
    if actor is not None:
        ctx.with_resource(workflow.acting_as(actor))


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


def common(function: Command) -> Command:
    """Add the options that every command has; their values are kept in the context, see `asked`."""
    for names, text in (
        (("--json",), "Print the result as JSON."),
        (("--no-progress",), "Show no progress, as --progress none."),
        (("-v", "--verbose"), "Print more details and the run time."),
    ):
        function = click.option(
            *names, is_flag=True, expose_value=False, callback=_remember, help=text
        )(function)
    return ACTOR(PROGRESS(function))


def command(function: Command) -> click.Command:
    """A command with its own options and, after them, those that every command has."""
    made = click.command()(function)
    made.params += click.command()(common(lambda: None)).params
    return made


def asked(name: str) -> Any:
    """Value of an option that is kept in the context; None if the command does not have it."""
    return click.get_current_context().meta.get(name)
