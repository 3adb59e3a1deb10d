"""A few damaged captures and databases, killed and stopped runs and power losses in every
run of the tests; docs/reliability.md has many more, and those of workers of a cluster.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

RUNS = (
    "kill_fit --cases 1 --seed 3",
    "kill_withdraw --cases 1 --seed 502",
    "kill_backup --every 200",
    "kill_commit --every 16 --fits 0",
    "stop_lease --cases 1",
    "race_lease --commits 8 --kills 2",
    "power_loss --every 500",
    "fuzz_capture --cases 10 --seed 2005",
    "fuzz_store --cases 3 --seed 2006",
)


@pytest.fixture(scope="module")
def programs():
    """The process in which all programs are started."""
    command = [sys.executable, Path(__file__).with_name("programs.py")]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        yield process


@pytest.mark.destructive
@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS)
def test_store__keeps_its_promises(programs, run):
    programs.stdin.write(f"{run}\n")
    programs.stdin.flush()
    code, said = json.loads(programs.stdout.readline())
    assert code == 0, said
    assert said
