"""A few damaged captures in every run of the tests; docs/reliability.md has the table of many."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CASES = 10
SEED = 2005


@pytest.mark.destructive
@pytest.mark.slow
def test_ingest__damaged_captures_end_in_lines_with_a_cure_or_in_numbers():
    program = Path(__file__).with_name("fuzz_capture.py")
    command = [sys.executable, program, "--cases", str(CASES), "--seed", str(SEED)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("refused ")
