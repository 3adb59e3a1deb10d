"""Functions that several commands use: printing results, processing takes in this process, in
local processes or on a Dask cluster, checking databases and files.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import repeat, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click

import skindb
from skindb import workflow
from skindb.cli.options import asked
from skindb.cli.terminal import Progress, echo, terminal_width
from skindb.errors import (
    Fault,
    InputError,
    few_names,
    require,
    require_none,
)
from skindb.files import Attributes, Json, plain

if TYPE_CHECKING:
    from distributed import Client

    from skindb.store import Database, Record
    from skindb.view.page import PageServer
    from skindb.workflow import Outcome

MAX_NAMES = 10  # in a message
MAX_ALIKE = 10  # faults that break the same rule and are printed
P = TypeVar("P", Path, Path | None)
T = TypeVar("T")
R = TypeVar("R")


@contextmanager
def cluster() -> Iterator[Client | None]:
    """Client of the scheduler that was named; None if none was named."""
    scheduler = asked("scheduler")
    if scheduler is None:
        yield None
        return
    if not asked("verbose"):
        # messages of distributed; their consequence for the takes is reported in one line
        logging.disable(logging.ERROR)
    with workflow.connected(scheduler) as client:
        yield client


def shared_path(path: P) -> P:
    """A path that is valid for workers of a cluster, whose working folders differ from
    that of this process.
    """
    return path.absolute() if path and asked("scheduler") else path


class UnfinishedError(InputError):
    """Faults of some takes; the results of the others are in `done`."""

    def __init__(self, faults: Iterable[Fault], done: Any) -> None:
        super().__init__(faults)
        self.done = done


def emit(result: Any, lines: list[str], faults: Sequence[Fault] = ()) -> None:
    """Print a result, and raise faults if there are any; with --json, result and faults
    are printed as one object.
    """
    if faults and asked("json"):
        raise UnfinishedError(faults, result)
    if asked("json"):
        echo_json(result)
    elif lines:
        echo(*lines)
    if asked("verbose"):
        echo(f"{time.monotonic() - asked('since'):.1f} s", err=True)
    require_none(faults)


def serve(server: PageServer, **values: Any) -> None:
    """Print the address of a page, with --json beside the values `about` it, and serve
    it until Ctrl-C.
    """
    with server, suppress(KeyboardInterrupt):
        emit(
            {"address": server.address} | values,
            [f"{server.address}  (Ctrl-C ends it)"],
        )
        server.serve_forever()


def echo_json(value: Any) -> None:
    """Print standard JSON, in which NaN and infinity are null."""
    echo(*json.dumps(plain(value), indent=1, allow_nan=False).splitlines())


def aligned(rows: list[list[Any]], width: int | None = None) -> list[str]:
    """Format rows as aligned columns, with numbers to three significant digits.

    A table that is wider than the terminal, or than `width`, continues below, with its
    columns of text again.
    """
    text = [
        [f"{c:.3g}" if isinstance(c, float) else str(c) for c in row] for row in rows
    ]
    widths = [max(map(len, column)) for column in zip(*text, strict=True)]
    labels = list(takewhile(lambda i: isinstance(rows[-1][i], str), range(len(widths))))
    width = width or terminal_width()
    parts = [labels]
    for i in range(len(labels), len(widths)):
        if (
            sum(widths[j] + 2 for j in [*parts[-1], i]) > width + 2
            and parts[-1] != labels
        ):
            parts.append(labels)
        parts[-1] = [*parts[-1], i]
    return [
        "  ".join(row[i].ljust(widths[i]) for i in part).rstrip()
        for part in parts
        for row in text
    ]


def indented(lines: Iterable[str]) -> list[str]:
    """Lines below the one of a take or calibration."""
    return [f"  {line}" for line in lines]


def each_take(
    function: Callable[[T], R],
    takes: Sequence[T],
    *,
    shared: Path | None = None,
    progress: Progress,
    finish: Callable[[R], tuple[str, Any, list[str]]],
) -> tuple[Json, list[Fault]]:
    """Call a function for every take and print each result when it is available; a
    fault does not stop other takes.

    Parameters
    ----------
    function, takes, shared
        See `skindb.workflow.map_takes`.
    progress
        Progress to which `function` reports its stages.
    finish
        Called in this process with each result; returns its name, what --json prints of
        it, and lines to print.
    """
    results = {}
    faults = []
    workers = asked("workers") or 1
    # so that the running take is known
    in_turn = not asked("scheduler") and (workers == 1 or len(takes) == 1)
    following = iter([*map(str, takes[1:]), ""]) if in_turn else repeat("")
    progress.begin_takes(len(takes), take=str(takes[0]) if takes and in_turn else "")
    try:
        with cluster() as client:
            for outcome in workflow.map_takes(
                function, takes, workers=workers, client=client, shared=shared
            ):
                name, result = _finished(outcome, finish)
                failed = outcome.error is not None
                if failed:
                    faults += result
                else:
                    results[name] = result
                progress.end_take(name, failed=failed, following=next(following))
    except InputError as error:  # of the cluster: no other take can be processed
        faults += error.faults
    return results, faults


def _finished(
    outcome: Outcome[T, R], finish: Callable[[R], tuple[str, Any, list[str]]]
) -> tuple[str, Any]:
    """Name of a take, and what --json prints of it, or its faults; its lines are printed."""
    name = str(outcome.take)
    if outcome.attempts > 1:
        echo(
            f"{name}: a worker process was killed; the take was started again", err=True
        )
    if outcome.error is None:
        name, result, lines = finish(outcome.result())
        if not asked("json"):
            echo(*lines)
        return name, result
    if outcome.traceback and asked("verbose"):
        echo(*outcome.traceback.splitlines(), err=True)
    faults = dict.fromkeys(workflow.faults_of(outcome))
    return name, [
        fault if name in fault.where else replace(fault, where=f"{name}: {fault.where}")
        for fault in faults
    ]


def fault_lines(faults: Iterable[Fault], *, unlimited: bool) -> list[str]:
    """One line for each fault; if more than MAX_ALIKE break the same rule, the others are
    only counted unless `unlimited`.
    """
    lines = []
    count = Counter[str]()
    for fault in faults:
        count[fault.rule] += 1
        if unlimited or count[fault.rule] <= MAX_ALIKE:
            lines.append(str(fault))
    return lines + [
        f"and {n - MAX_ALIKE} more: {rule} (-v lists them)"
        for rule, n in count.items()
        if n > MAX_ALIKE and not unlimited
    ]


def chosen_takes(
    database: Database, takes: Sequence[str], kind: Literal["model", "edit"]
) -> list[str]:
    """The named takes, or all that have a model or an edit."""
    chosen = list(takes) or database.takes(kind)
    cure = f"run skindb {'edit' if kind == 'edit' else 'fit'} first"
    rule = f"there must be a take with a {kind}"
    require(chosen, database.url, rule, "none", cure)
    return chosen


def require_one_take(out: Path, takes: Sequence[str]) -> None:
    """Check that a file gets one take."""
    require(
        len(takes) <= 1,
        str(out),
        "a file must hold one take",
        f"{len(takes)} takes: {few_names(takes, MAX_NAMES)}",
        "name one take, or a folder for all",
    )


def writable(path: Path, *endings: str) -> None:
    """Check the name and folder of a file before the work of which it is the result."""
    rule = f"must end in {' or '.join(endings)}"
    ending = path.suffix or "no ending"
    require(path.suffix.lower() in endings, str(path), rule, ending, "rename it")
    require_folder(path)


def require_folder(path: Path) -> None:
    """Check that the folder of a file exists."""
    require(
        path.parent.is_dir(),
        str(path),
        "its folder must exist",
        "none",
        f"make {path.parent}",
    )


def summary_of(record: Record) -> Json:
    """The parts of the record of a version that commands print."""
    names = ("skipped", "cleaning", "cleaning_places", "summary", "registration")
    parts = {
        name: record.provenance[name] for name in names if name in record.provenance
    }
    return {"generation": record.generation, "path": record.path, **parts}


def calibrated_by_lines(provenance: Attributes) -> list[str]:
    """The calibration that a capture used, and why if the capture does not name it."""
    if not (used := provenance.get("calibrated_by")):
        return []
    line = f"calibration {used['take']}, version {used['generation']}"
    if not provenance.get("calibration"):
        line += ", made from takes with its lights"
    return [line]


def choice_lines(corrections: Mapping[str, str]) -> list[str]:
    """The corrections that were chosen by trials and why, in one line."""
    choices = [f"{n.replace('_', ' ')} {why}" for n, why in corrections.items()]
    return [f"chosen: {'; '.join(choices)}"] if choices else []


def calibration_lines(database: Database, take: str) -> list[str]:
    """Table of the checks of the calibration; nothing for captures that were ingested
    without these checks.
    """
    capture = database.read("capture", take)
    # without a dome, or ingested before calibrations were checked
    if "calibration" not in capture.children:
        return []
    calibration = capture["calibration"].dataset
    return [
        *skindb.ingest.calibration_lines(calibration),
        *aligned(skindb.ingest.calibration_table(calibration)),
    ]


def trait_amounts(
    texts: Sequence[str], *, default: float | None = None
) -> dict[str, float]:
    """Trait -> amount, from texts NAME=AMOUNT, or also NAME if there is a default amount.

    Raises
    ------
    InputError
        If a trait is named more than once.
    click.UsageError
        If a text has another form, or an amount is not a finite number.
    """
    amounts = {}
    for text in texts:
        name, equals, number = text.partition("=")
        try:
            amount = default if default is not None and not equals else float(number)
        except ValueError:
            amount = math.nan
        if not name or not math.isfinite(amount):
            form = "NAME=AMOUNT" if default is None else "NAME or NAME=AMOUNT"
            raise click.UsageError(
                f"--trait needs {form}, such as lotion=0.5; found {text!r}"
            )
        require(
            name not in amounts,
            "--trait",
            "must name each trait once",
            f"{name} more than once",
            "give one amount",
        )
        amounts[name] = amount
    return amounts
