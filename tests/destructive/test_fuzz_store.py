"""A few damaged databases in every run of the tests; docs/reliability.md has the table of many."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CASES = 3
SEED = 2006


@pytest.mark.destructive
@pytest.mark.slow
def test_verify__damaged_databases_are_named_or_refused_or_unchanged():
    program = Path(__file__).with_name("fuzz_store.py")
    command = [sys.executable, program, "--cases", str(CASES), "--seed", str(SEED)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("named by verify ")
