"""Compiled code on disk is updated if the source of any kernel that it contains changes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import skindb.jit

CALL = "from package._outer_kernels import outer; print(outer(1.0))"
INNER = "from package.jit import kernel\n\n@kernel\ndef inner(x):\n    return x + {}\n"
OUTER = "from package.jit import kernel\nfrom package._inner_kernels import inner\n\n"
OUTER += "@kernel\ndef outer(x):\n    return 10 * inner(x)\n"


@pytest.mark.slow
def test_kernel__is_compiled_again_when_a_kernel_of_another_file_changes(tmp_path):
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "jit.py").write_bytes(Path(skindb.jit.__file__).read_bytes())
    (package / "_outer_kernels.py").write_text(OUTER)

    def printed() -> str:
        done = subprocess.run(
            [sys.executable, "-c", CALL],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.strip()

    for step, expected in (("1", "20.0"), ("1", "20.0"), ("4", "50.0")):
        (package / "_inner_kernels.py").write_text(INNER.format(step))
        assert printed() == expected
    assert list(package.glob("__pycache__/*.nbc"))  # the cache is used


PAIR = "from typing import NamedTuple\n\nclass Pair(NamedTuple):\n    a: float\n    b: float\n"
SUM = "from package.jit import kernel\n\n@kernel\ndef outer(pair):\n    return pair.a + pair.b\n"
CALL_PAIR = "from package._outer_kernels import outer; from package.{} import Pair; "
CALL_PAIR += "print(outer(Pair(1.0, 2.0)))"


@pytest.mark.slow
def test_kernel__is_compiled_again_when_the_module_of_an_argument_is_renamed(tmp_path):
    """The cache names the classes of arguments by their modules."""
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "jit.py").write_bytes(Path(skindb.jit.__file__).read_bytes())
    (package / "_outer_kernels.py").write_text(SUM)
    (package / "_pair_kernels.py").write_text(PAIR)
    for name in ("_pair_kernels", "_couple_kernels"):
        if not (package / f"{name}.py").exists():
            (package / "_pair_kernels.py").rename(package / f"{name}.py")
        done = subprocess.run(
            [sys.executable, "-c", CALL_PAIR.format(name)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.stdout == "3.0\n", done.stderr


IMPORTED = (
    "fit",
    "ingest",
    "render.rendering",
    "export.gltf",
    "virtual.capture",
    "bench.run",
)


def test_import__compiles_nothing():
    """Kernels are compiled or read from the disk at their first call, not when modules
    import them.
    """
    names = ", ".join(f"skindb.{name}" for name in IMPORTED)
    code = f"""
from skindb.jit import reported_compilation
from numba.core.registry import CPUDispatcher
calls = []
with reported_compilation(lambda: calls.append(1)):
    import sys, {names}
names = [name for name in sys.modules if name.startswith("skindb.") and name.endswith("_kernels")]
kernels = [one for module in map(sys.modules.get, names)
           for one in vars(module).values() if isinstance(one, CPUDispatcher)]
print(len(calls), sum(len(one.signatures) for one in kernels), len(kernels) > 50)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["0", "0", "True"]


FIT = """
import hashlib
import numpy as np
from skindb.reflectance.mixture import fit_reflectance
rng, count, each = np.random.default_rng(0), 50, 60
rows = rng.gamma(0.5, 1.0, (count * each, 16)).astype(np.float32)
target, lift = rng.gamma(1.0, 1.0, (count * each, 3)), np.abs(rng.normal(size=(16, 59)))
offsets = np.arange(0, count * each + 1, each)
found = fit_reflectance(rows, offsets, target, None, lift, mode="perceptual", noise_floor=0.05)
print(hashlib.sha256(found.parameters.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_fast_kernel__the_same_bits_just_compiled_and_read_from_the_disk(
    tmp_path, monkeypatch
):
    """The first worker after an installation compiles, and its results must equal those
    of the others.
    """
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    printed = [
        subprocess.run(
            [sys.executable, "-c", FIT], capture_output=True, text=True, check=True
        ).stdout
        for _ in "12"
    ]
    assert len(printed[0].strip()) == 64
    assert printed[0] == printed[1]
    assert list(tmp_path.rglob("*.nbc"))
