"""The terminal: the only module of the command line that writes to it, with control characters
escaped, and progress on standard error: bars for people, lines of JSON for programs.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from shutil import get_terminal_size

import click

from skindb.cli.options import asked
from skindb.errors import escaped

MIN_INTERVAL_S = {"bar": 0.2, "json": 1.0}  # between two reports of the same stage


class HelpFormatter(click.HelpFormatter):
    """Help with bold headings, and names of commands and options in colour."""

    def write_heading(self, heading: str) -> None:
        """Write the title of a section."""
        super().write_heading(click.style(heading, bold=True))

    def write_dl(
        self, rows: Iterable[tuple[str, str]], col_max: int = 26, col_spacing: int = 2
    ) -> None:
        """Write names and what they mean as two columns."""
        coloured = [(click.style(name, fg="cyan"), text) for name, text in rows]
        super().write_dl(coloured, col_max, col_spacing)


def echo(*lines: str, err: bool = False) -> None:
    """Print lines on standard output or standard error; a line break inside of a line
    is escaped, too.
    """
    for line in lines:
        click.echo(escaped(line), err=err)


class HelpContext(click.Context):
    """The context of a command whose help is in colour."""

    formatter_class = HelpFormatter


def terminal_width() -> int:
    """Columns of the terminal; of a file or a pipe, as many as a line has."""
    return get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize


def redraw(text: str, *, ends_line: bool) -> None:
    """Print over the present line of standard error; `ends_line` begins a new one afterwards."""
    click.echo(f"\r{escaped(text)}", nl=ends_line, err=True)


def confirm(question: str) -> bool:
    """Ask a question on standard error that is answered by yes or no."""
    return click.confirm(escaped(question), err=True)


def wait_for_enter(text: str) -> None:
    """Print a text and wait for Enter."""
    click.prompt(escaped(text), default="", show_default=False)


@dataclass
class Count:
    """Steps that are done of a total, and the time since the first of them began."""

    total: int = 0
    done: int = 0
    skipped: int = 0  # done before
    begin: float = field(default_factory=time.monotonic)

    @property
    def rate_per_minute(self) -> float | None:
        """Steps per minute; None before the first."""
        steps = self.done - self.skipped
        return 60 * steps / max(time.monotonic() - self.begin, 1e-9) if steps else None

    @property
    def seconds_left(self) -> float | None:
        """Seconds until all are done; None before the first."""
        rate = self.rate_per_minute
        return 60 * (self.total - self.done) / rate if rate else None


class Progress:
    """Report the stages and takes of a command in the chosen style.

    The style "bar" shows rate and remaining time if standard error is a terminal;
    otherwise, with `plain`, it prints one line for each stage. The style "json" prints
    one object per line (docs/howto/cluster.md lists the keys), and "none" prints
    nothing. A copy that is sent to another process is silent.
    """

    def __init__(self, style: str, *, plain: bool = False) -> None:
        moving = sys.stderr.isatty()
        self.style = style
        self.bars = style == "bar" and moving
        self.plain = style == "bar" and plain and not moving
        self.stage = ""
        self.steps = Count()  # of the stage
        self.last_report = 0.0
        self.take = ""
        self.takes = Count()

    def __reduce__(self) -> tuple[type[Progress], tuple[str]]:
        return Progress, ("none",)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""
        before = (self.steps.done, self.steps.total)
        if stage != self.stage:
            self.stage = stage
            self.steps = Count(skipped=done)
            self.last_report = 0.0
            before = (-1, 0)
            if self.plain:
                echo(stage, err=True)
        self.steps.done = done
        self.steps.total = total
        now = time.monotonic()
        if (
            now - self.last_report < MIN_INTERVAL_S.get(self.style, 0.0)
            and done < total
        ):
            return
        if self.style == "json" and (done, total) != before:
            self._line(stage, self.steps)
        elif self.bars:
            self._bar()
        self.last_report = now

    def begin_takes(self, count: int, *, take: str = "") -> None:
        """Start to count finished takes; `take` is the one that is processed now, if
        it is known.
        """
        self.takes = Count(count)
        self.take = take

    def end_take(self, take: str, *, failed: bool, following: str = "") -> None:
        """Report that a take is finished; `following` is the take that is processed
        next, if it is known.
        """
        self.take = take
        self.takes.done += 1
        if self.style == "json":
            done = Count(1, 1, begin=self.steps.begin)
            self._line("failed" if failed else "finished", done)
        elif self.bars and self.takes.total > 1:
            rate = self.takes.rate_per_minute
            pace = f"{rate:.3g} takes per minute, {self.takes.seconds_left:.0f} s left"
            echo(f"take {self.takes.done} of {self.takes.total}: {pace}", err=True)
        self.take = following
        self.stage = ""

    def _bar(self) -> None:
        steps = self.steps
        stage = self.stage
        if self.takes.total > 1:
            stage = f"take {self.takes.done + 1} of {self.takes.total}: {stage}"
        left = steps.seconds_left or 0
        count = f"{steps.done}/{steps.total} {left:4.0f} s left"
        # the last column stays empty, as some terminals begin a new line after it
        free = min(get_terminal_size().columns, 90) - len(count) - 5
        cells = max(free // 3, 0)
        bar = "#" * round(cells * steps.done / max(steps.total, 1))
        name = max(free - cells, 0)
        text = f"{stage:<{name}.{name}} [{bar:<{cells}}] {count}"
        redraw(text, ends_line=steps.done >= steps.total)

    def _line(self, stage: str, steps: Count) -> None:
        """Print a line of JSON; rate and remaining time refer to the takes if there are
        several, else to the stage.
        """
        counted = self.takes if self.takes.total > 1 else steps
        rate = counted.rate_per_minute
        left = counted.seconds_left
        report = {
            "take": self.take or None,
            "stage": stage,
            "done": steps.done,
            "total": steps.total,
            "takes_done": self.takes.done,
            "takes_total": self.takes.total,
            "seconds": round(time.monotonic() - self.takes.begin, 2),
            "rate_per_minute": None if rate is None else round(rate, 3),
            "seconds_left": None if left is None else round(left, 1),
        }
        echo(json.dumps(report), err=True)


def bar(*, plain: bool = False) -> Progress:
    """Progress in the style of the running command; `plain` for long commands whose
    output goes to a file.
    """
    style = "none" if asked("no_progress") else asked("progress") or "bar"
    return Progress(style, plain=plain)
