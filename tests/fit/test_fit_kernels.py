"""Compilation of kernels before they are used."""

from __future__ import annotations

import subprocess
import sys

import pytest

from skindb.fit import kernels

SIGNATURES = """
import sys
import skindb
from skindb.fit._normal_kernels import normals_block
from skindb.fit.kernels import STEPS, compile_step
from skindb.reflectance._block_kernels import fit_block
from skindb.reflectance._ggx_kernels import fit_ggx
from skindb.reflectance._joint_kernels import fit_jointly
from skindb.reflectance._separation_kernels import separate_block
kernels = (fit_jointly, separate_block, fit_block, fit_ggx, normals_block)
for step in STEPS:
    compile_step(step)
before = [{*kernel.entry.signatures} for kernel in kernels]
assert all(before)
skindb.fit.fit_model(skindb.open(sys.argv[1]).read("capture", "S01"))
print(before == [{*kernel.entry.signatures} for kernel in kernels])
"""


@pytest.mark.slow
def test_compile_step__compiles_what_fits_use(fitted_database):
    done = subprocess.run(
        [sys.executable, "-c", SIGNATURES, fitted_database.url],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "True\n", done.stderr


def test_compile_kernels__ends_although_its_processes_are_killed(tmp_path, monkeypatch):
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\nkill -9 $$\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(kernels, "is_stored", lambda _: False)
    monkeypatch.setattr(kernels, "thread_count", lambda: 2)
    steps = []
    kernels.compile_kernels(lambda _, done, total: steps.append((done, total)))
    assert steps == [(0, 2), (1, 2), (2, 2)]
