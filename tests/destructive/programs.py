"""Runs programs of this folder, each in a process that is forked from this one, so that
what all of them import is imported once.

Each line of standard input is a program with its options, and each line of standard output
its exit code and its messages as JSON.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
import tempfile
from pathlib import Path
from typing import IO

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "store"), str(HERE)]

import apart  # noqa: F401
import planted_cohort  # noqa: F401
import planted_population  # noqa: F401
import sklearn.decomposition  # noqa: F401  as a fit does
import sphere  # noqa: F401

import skindb.analysis
import skindb.cli
import skindb.fit  # noqa: F401
from skindb import workflow

# imported when they are first used
IMPORTED = (
    workflow.edit,
    workflow.fit_take,
    workflow.ingest_take,
    workflow.refresh,
    workflow.withdraw,
)


def run(words: list[str], output: IO[bytes]) -> None:
    """Run a program in this process, which ends."""
    code = 1
    try:
        os.dup2(output.fileno(), 1)
        os.dup2(output.fileno(), 2)
        sys.argv = words
        runpy.run_path(str(HERE / f"{words[0]}.py"), run_name="__main__")
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:  # noqa: BLE001  whatever a program raises
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stdout.flush()
        os._exit(code)


if __name__ == "__main__":
    for line in sys.stdin:
        with tempfile.TemporaryFile() as output:
            process = os.fork()
            if not process:
                run(line.split(), output)
            status = os.waitpid(process, 0)[1]
            output.seek(0)
            said = output.read().decode(errors="replace")
        print(json.dumps([os.waitstatus_to_exitcode(status), said]), flush=True)
