"""A few kills of a commit in every run of the tests; docs/reliability.md has the
numbers of all of them.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.destructive
@pytest.mark.slow
def test_commit__killed_at_any_call_keeps_its_promises():
    program = Path(__file__).with_name("kill_commit.py")
    command = [sys.executable, program, "--every", "16", "--fits", "0"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith("small model: ")
