"""A few killed and stopped runs and power losses in every run of the tests;
docs/reliability.md has many more, and those of workers of a cluster.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

RUNS = (
    "kill_fit --cases 1 --seed 3",
    "kill_withdraw --cases 1 --seed 502",
    "kill_backup --every 200",
    "stop_lease --cases 1",
    "race_lease --commits 8 --kills 2",
    "power_loss --every 500",
)


@pytest.mark.destructive
@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS)
def test_store__keeps_its_promises_to_killed_runs(run):
    name, *options = run.split()
    command = [sys.executable, Path(__file__).with_name(f"{name}.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
