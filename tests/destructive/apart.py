"""Run cases of damage, each in its own process, within limits of time and memory."""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import distributed  # noqa: F401  else every process that computes would import it

# what was flushed only shows after a power loss, which power_loss.py records itself
os.fsync = os.fstat
TIME_LIMIT_S = 20.0
ADDRESS_LIMIT_BYTES = 3 << 30
RESIDENT_LIMIT_KB = 1_500_000
PATIENCE = 10  # times its limit of CPU time that a case may take on busy cores
FAILURES = ("message of a library", "traceback", "hang", "memory")
Outcome = tuple[str, str]  # outcome of a case, and a detail


@dataclass(frozen=True)
class Case:
    """One damaged folder, and the outcome."""

    number: int
    variant: str
    damage: str
    outcome: str
    detail: str


# makes a case in a folder from its number: its variant, what was damaged, and the attempt
Prepare = Callable[[int, Path], tuple[str, str, Callable[[], Outcome]]]


def in_a_process(call: Callable[[], object]) -> None:
    """Call a function in a separate process, because threads of compiled code must not
    be forked.
    """
    process = os.fork()
    if not process:
        try:
            call()
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    if os.waitpid(process, 0)[1]:
        raise RuntimeError("the undamaged data do not pass")


@dataclass(frozen=True)
class Limits:
    """How cases are run."""

    jobs: int = 2  # processes at a time
    seconds: float = TIME_LIMIT_S  # limit of the CPU time of one case
    minutes: float = math.inf  # no other case is started after this time
    # called with each case as soon as it has ended
    tell: Callable[[Case], object] = lambda _: None


def run(
    cases: Iterable[int], prepare: Prepare, folder: Path, limits: Limits
) -> list[Case]:
    """Make, attempt and judge every case."""
    since = time.monotonic()
    waiting = list(cases)
    running = {}
    done = []
    while waiting or running:
        if time.monotonic() - since > 60 * limits.minutes:
            waiting = []
        while waiting and len(running) < limits.jobs:
            number = waiting.pop(0)
            work = folder / f"case-{number}"
            work.mkdir()
            variant, damage, attempt = prepare(number, work)
            running[_start(work, attempt, limits.seconds)] = (
                number,
                variant,
                damage,
                work,
                time.monotonic(),
            )
        for process, (number, variant, damage, work, began) in list(running.items()):
            ended, status, usage = os.wait4(process, os.WNOHANG)
            late = not ended and time.monotonic() - began > PATIENCE * limits.seconds
            if late:
                os.kill(process, signal.SIGKILL)
                ended, status, usage = os.wait4(process, 0)
            if ended:
                del running[process]
                done.append(
                    Case(
                        number,
                        variant,
                        damage,
                        *_judged(work, status, usage.ru_maxrss, late=late),
                    )
                )
                limits.tell(done[-1])
                shutil.rmtree(work)
        time.sleep(0.01)
    return sorted(done, key=lambda case: case.number)


def _start(work: Path, attempt: Callable[[], Outcome], seconds: float) -> int:
    process = os.fork()
    if process:
        return process
    try:
        os.setsid()
        target = os.open(work / "output", os.O_WRONLY | os.O_CREAT)
        os.dup2(target, 1)
        os.dup2(target, 2)
        resource.setrlimit(
            resource.RLIMIT_AS, (ADDRESS_LIMIT_BYTES, ADDRESS_LIMIT_BYTES)
        )
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(
            resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 1)
        )
        try:
            outcome = attempt()
        except MemoryError:
            outcome = ("memory", traceback.format_exc())
        except Exception:
            outcome = ("traceback", traceback.format_exc())
        (work / "outcome").write_text(json.dumps(outcome))
    finally:
        os._exit(0)


def _judged(work: Path, status: int, peak_kb: int, *, late: bool) -> Outcome:
    """Outcome and detail of a process that ended."""
    if late or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        return "hang", "ended after its time"
    if not (work / "outcome").exists():
        return (
            "traceback",
            f"the process died with status {status}: {_output(work)[-300:]}",
        )
    outcome, detail = json.loads((work / "outcome").read_text())
    if outcome not in FAILURES and peak_kb > RESIDENT_LIMIT_KB:
        return "memory", f"{peak_kb / 1e6:.1f} GB; {detail}"
    if outcome not in FAILURES and (said := _output(work).strip()):
        return "message of a library", said[-500:]
    return outcome, detail


def _output(work: Path) -> str:
    """What was printed."""
    return (
        (work / "output").read_text(errors="replace")
        if (work / "output").exists()
        else ""
    )


def program(
    doc: str,
    run_all: Callable[..., list[Case]],
    outcomes: tuple[str, ...],
    bad: tuple[str, ...],
    options: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> None:
    """The command line of a program that damages data; ends with 1 if any outcome is a bad one.

    Parameters
    ----------
    doc
        Its first line describes the program.
    run_all
        Runs cases with a seed, in a folder for temporary files, within limits, with the
        values of `options`.
    outcomes
        The rows of the table, those of `FAILURES` included.
    bad
        Those of the outcomes that are failures beside `FAILURES`.
    options
        Arguments of `add_argument` for further options, by name.
    """
    parser = argparse.ArgumentParser(description=doc.partition("\n")[0])
    parser.add_argument(
        "--cases", type=int, default=1000, help="Number of damaged folders."
    )
    parser.add_argument(
        "--first", type=int, default=0, help="Number of the first case, to repeat one."
    )
    parser.add_argument("--seed", type=int, default=0, help="Seed of the damage.")
    parser.add_argument(
        "--jobs", type=int, default=2, help="Number of processes at a time."
    )
    parser.add_argument(
        "--minutes",
        type=float,
        default=math.inf,
        help="Begin no other case after so many minutes.",
    )
    parser.add_argument(
        "--list",
        nargs="*",
        default=[],
        help="Outcomes whose cases are listed beside the failures.",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=TIME_LIMIT_S,
        help="Limit of the CPU time of a case [s].",
    )
    for name, about in options.items():
        parser.add_argument(name, **about)
    asked = parser.parse_args()
    further = {name[2:]: getattr(asked, name[2:]) for name in options}

    def tell(case: Case) -> None:
        if case.outcome in (*FAILURES, *bad, *asked.list) or asked.cases == 1:
            text = (
                f"case {case.number} ({case.variant}): {case.damage}\n{case.outcome}: "
                f"{case.detail}\n"
            )
            print(text, file=sys.stderr, flush=True)

    limits = Limits(asked.jobs, asked.seconds, asked.minutes, tell)
    with tempfile.TemporaryDirectory() as folder:
        cases = run_all(
            range(asked.first, asked.first + asked.cases),
            asked.seed,
            Path(folder),
            limits,
            **further,
        )
    count = Counter(case.outcome for case in cases)
    for outcome in outcomes:
        print(f"{outcome:<32} {count[outcome]:>6}")
    sys.exit(any(count[outcome] for outcome in (*FAILURES, *bad)))
