"""What commands share: progress, printing, one fault not stopping the others, databases that exist."""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

import skindb
from skindb.cli.options import asked
from skindb.errors import Fault, InputError

if TYPE_CHECKING:
    from skindb.store import Database, Record

T = TypeVar("T")


class Progress:
    """Stage, count and time left on standard error; with `plain` a line a stage, where no bar can move."""

    def __init__(self, *, show: bool, plain: bool = False) -> None:
        self.show, self.plain, self.stage, self.since, self.last = show, plain, "", 0.0, 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""
        now = time.monotonic()
        if stage != self.stage:
            self.stage, self.since = stage, now
            if self.plain:
                click.echo(stage, err=True)
        if not self.show or (now - self.last < 0.2 and done < total):
            return
        self.last = now
        left = (now - self.since) / done * (total - done) if done else 0.0
        bar = "#" * round(24 * done / max(total, 1))
        end = "\n" if done >= total else ""
        click.echo(f"\r{stage:<44.44} [{bar:<24}] {done}/{total} {left:4.0f} s left{end}", nl=False, err=True)


def bar(*, plain: bool = False) -> Progress:
    """Bars for who looks; `plain` for long commands whose output goes to a file."""
    wanted, moving = not asked("no_progress"), sys.stderr.isatty()
    return Progress(show=wanted and moving, plain=plain and wanted and not moving)


class UnfinishedError(InputError):
    """Mistakes after which something was done all the same."""

    def __init__(self, faults: Iterable[Fault], done: Any) -> None:
        super().__init__(faults)
        self.done = done


def emit(result: Any, lines: list[str], faults: Sequence[Fault] = ()) -> None:
    """Print a result; with faults they are raised, and the result is in the one JSON object that names them."""
    if faults and asked("json"):
        raise UnfinishedError(faults, result)
    if asked("json"):
        echo_json(result)
    elif lines:
        click.echo("\n".join(lines))
    if asked("verbose"):
        click.echo(f"{time.monotonic() - click.get_current_context().meta['since']:.1f} s", err=True)
    if faults:
        raise InputError(faults)


def echo_json(value: Any) -> None:
    """Print JSON that every reader takes: what is no number is null."""
    from skindb.schema.plain import plain  # brings xarray along, which --help does not need

    click.echo(json.dumps(plain(value), indent=1, allow_nan=False))


def aligned(rows: list[list[Any]]) -> list[str]:
    """Rows as text in columns; numbers to three significant digits."""
    text = [[f"{c:.3g}" if isinstance(c, float) else str(c) for c in row] for row in rows]
    widths = [max(len(row[i]) for row in text) for i in range(len(text[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in text]


def each(items: Iterable[T], call: Callable[[T], tuple[str, Any]]) -> tuple[dict[str, Any], list[Fault]]:
    """Call for every item; one user's mistake does not stop the others."""
    done: dict[str, Any] = {}
    faults: list[Fault] = []
    for item in items:
        try:
            name, result = call(item)
            done[name] = result
        except InputError as error:
            faults += [_placed(fault, str(item)) for fault in dict.fromkeys(error.faults)]
        except OSError as error:  # a full or failing disc: what is committed is still told
            where = str(error.filename or item)
            faults.append(Fault(where, "it must be possible to read and write", str(error), "check the disc"))
    return done, faults


def _placed(fault: Fault, item: str) -> Fault:
    """The fault with the capture or take it is of, where it does not say so itself."""
    return fault if item in fault.where else replace(fault, where=f"{item}: {fault.where}")


def fault_lines(faults: Iterable[Fault], *, every: bool, most: int = 10) -> list[str]:
    """A line a fault; of many that break the same rule the first ones only, as 4,800 frames may, unless `every`."""
    lines, count = [], Counter[str]()
    for fault in faults:
        count[fault.rule] += 1
        if every or count[fault.rule] <= most:
            lines.append(str(fault))
    folded = {rule: n - most for rule, n in count.items() if n > most and not every}
    return lines + [f"and {n} more: {rule} (-v lists them)" for rule, n in folded.items()]


def existing(db: str) -> Database:
    """The database, which must be one."""
    database = skindb.open(db)
    if not database.root.is_dir():
        raise InputError(Fault(db, "the database must exist", "nothing", "ingest a capture into it first"))
    begun = {"data", "tmp"}  # a killed first ingest leaves these
    if {path.name for path in database.root.iterdir()} - begun and not (database.root / "log").is_dir():
        raise InputError(Fault(db, "a database has a log", "a folder without", "give the folder captures went into"))
    return database


def writable(path: Path, *endings: str) -> None:
    """A file that is to be written at the end of the work: wrong names are told before it."""
    if path.suffix.lower() not in endings:
        raise InputError(
            Fault(str(path), f"must end in {' or '.join(endings)}", path.suffix or "no ending", "rename it")
        )
    if not path.parent.is_dir():
        raise InputError(Fault(str(path), "its folder must exist", "none", f"make {path.parent}"))


def summary_of(record: Record) -> dict[str, Any]:
    """What a commit's record tells of it."""
    names = ("left_out", "cleaning", "cleaning_places", "summary", "registration")
    said = {name: record.provenance[name] for name in names if name in record.provenance}
    return {"generation": record.generation, "path": record.path, **said}
