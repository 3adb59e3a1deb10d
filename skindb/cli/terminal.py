"""The terminal: the only module of the command line that writes to it, with control characters
escaped, and progress on standard error: bars for people, lines of JSON for programs.
"""

from __future__ import annotations

import json
import sys
import time

import click

from skindb.cli.options import progress_style
from skindb.errors import escaped

Pace = tuple[float | None, float | None]  # steps per minute, and seconds left
MIN_INTERVAL_S = {"bar": 0.2, "json": 1.0}  # between two reports of the same stage


def echo(*lines: str, err: bool = False) -> None:
    """Print lines on standard output or standard error; a line break inside of a line
    is escaped, too.
    """
    for line in lines:
        click.echo(escaped(line), err=err)


def redraw(text: str, *, ends_line: bool) -> None:
    """Print over the present line of standard error; `ends_line` begins a new one afterwards."""
    click.echo(f"\r{escaped(text)}", nl=ends_line, err=True)


def confirm(question: str) -> bool:
    """Ask a question on standard error that is answered by yes or no."""
    return click.confirm(escaped(question), err=True)


def wait_for_enter(text: str) -> None:
    """Print a text and wait for Enter."""
    click.prompt(escaped(text), default="", show_default=False)


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
        self.steps_before = 0  # done when the stage began
        self.last_report = 0.0
        self.reported = (-1, 0)
        self.begin = time.monotonic()
        self.stage_begin = self.begin
        self.take = ""
        self.takes_done = 0
        self.takes_total = 0

    def __reduce__(self) -> tuple[type[Progress], tuple[str]]:
        return Progress, ("none",)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""
        now = time.monotonic()
        is_new = stage != self.stage
        if is_new:
            self.stage = stage
            self.stage_begin = now
            self.steps_before = done
            self.reported = (-1, 0)
            if self.plain:
                echo(stage, err=True)
        interval = MIN_INTERVAL_S.get(self.style, 0.0)
        is_early = now - self.last_report < interval and done < total
        if self.style == "json":
            if (is_new or not is_early) and (done, total) != self.reported:
                self.last_report = now
                self.reported = (done, total)
                self._line(stage, done, total)
        elif self.bars and not is_early:
            self.last_report = now
            self._bar(stage, done, total)

    def begin_takes(self, count: int, *, take: str = "") -> None:
        """Start to count finished takes; `take` is the one that is processed now, if
        it is known.
        """
        self.begin = time.monotonic()
        self.takes_done = 0
        self.takes_total = count
        self.take = take

    def end_take(self, take: str, *, failed: bool, following: str = "") -> None:
        """Report that a take is finished; `following` is the take that is processed
        next, if it is known.
        """
        self.take = take
        self.takes_done = self.takes_done + 1
        if self.style == "json":
            self._line("failed" if failed else "finished", 1, 1)
        elif self.bars and self.takes_total > 1:
            rate, seconds_left = self._pace_of_takes()
            pace = f"{rate:.3g} takes per minute, {seconds_left:.0f} s left"
            echo(f"take {self.takes_done} of {self.takes_total}: {pace}", err=True)
        self.take = following
        self.stage = ""

    def dashboard(self, link: str) -> None:
        """Report the address of the dashboard of a Dask cluster."""
        if self.style == "json":
            echo(json.dumps({"dashboard": link}), err=True)
        elif self.style == "bar":
            echo(f"dashboard: {link}", err=True)

    def _bar(self, stage: str, done: int, total: int) -> None:
        _, seconds_left = self._pace_of_stage(done, total)
        bar = "#" * round(24 * done / max(total, 1))
        prefix = (
            f"take {self.takes_done + 1} of {self.takes_total}: "
            if self.takes_total > 1
            else ""
        )
        redraw(
            f"{prefix + stage:<44.44} [{bar:<24}] {done}/{total} {seconds_left or 0:4.0f} s left",
            ends_line=done >= total,
        )

    def _line(self, stage: str, done: int, total: int) -> None:
        """Print a line of JSON; rate and remaining time refer to the takes if there are
        several, else to the stage.
        """
        rate, seconds_left = self._pace_of_stage(done, total)
        if self.takes_total > 1:
            rate, seconds_left = self._pace_of_takes()
        report = {
            "take": self.take or None,
            "stage": stage,
            "done": done,
            "total": total,
            "takes_done": self.takes_done,
            "takes_total": self.takes_total,
            "seconds": round(time.monotonic() - self.begin, 2),
            "rate_per_minute": rate and round(rate, 3),
            "seconds_left": None if seconds_left is None else round(seconds_left, 1),
        }
        echo(json.dumps(report), err=True)

    def _pace_of_takes(self) -> Pace:
        seconds = time.monotonic() - self.begin
        return _pace(self.takes_done, self.takes_total, seconds)

    def _pace_of_stage(self, done: int, total: int) -> Pace:
        seconds = time.monotonic() - self.stage_begin
        return _pace(done - self.steps_before, total - self.steps_before, seconds)


def _pace(done: int, total: int, seconds: float) -> Pace:
    """Steps per minute, and seconds until all are done; None before the first step."""
    if not done:
        return None, None
    return 60 * done / max(seconds, 1e-9), (total - done) * seconds / done


def bar(*, plain: bool = False) -> Progress:
    """Progress in the style of the running command; `plain` for long commands whose
    output goes to a file.
    """
    return Progress(progress_style(), plain=plain)
