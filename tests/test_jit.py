"""Compiled code on disk is updated if the source of any kernel that it contains changes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import FunctionType

import pytest

import skindb.jit
from skindb.kernel_cache import digest

CALL = """
from package.jit import reported_compilation
from package._outer_kernels import outer
calls = []
with reported_compilation(lambda: calls.append(1)):
    print(outer(1.0), len(calls))
"""
INNER = """{comment}from package.jit import kernel

STEP = {step}

@kernel
def other(x):
    return x - {other}

@kernel
def inner(x):
    return x + STEP
"""
OUTER = """from package.jit import kernel
from package._inner_kernels import inner

@kernel
def outer(x):
    return 10 * inner(x)
"""


def _package(folder: Path, **modules: str) -> Path:
    """A package with modules and our decorators."""
    package = folder / "package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "jit.py").write_bytes(Path(skindb.jit.__file__).read_bytes())
    for name, text in modules.items():
        (package / f"{name}.py").write_text(text)
    return package


def _printed(code: str, folder: Path, **environment: str) -> str:
    # without bytecode, which Python compares with sources by whole seconds only
    done = subprocess.run(
        [sys.executable, "-B", "-c", code],
        cwd=folder,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.mark.slow
def test_kernel__is_compiled_again_only_when_what_it_calls_changes(tmp_path):
    package = _package(tmp_path, _outer_kernels=OUTER)
    for values, expected in (
        ({"step": 1}, "20.0 2"),
        ({"step": 1}, "20.0 0"),
        ({"step": 1, "other": 4, "comment": "# moves the lines\n\n"}, "20.0 0"),
        ({"step": 4, "other": 4}, "50.0 2"),
    ):
        text = INNER.format(**{"other": 2, "comment": ""} | values)
        (package / "_inner_kernels.py").write_text(text)
        assert _printed(CALL, tmp_path) == expected
    # what was compiled from older code is removed; a called kernel has no machine code
    stored = {path.name.split("-")[0] for path in package.glob("__pycache__/*.nbc")}
    assert stored == {
        "linked.package._inner_kernels.inner",
        "package._outer_kernels.outer",
    }


def test_kernel__without_its_stored_code_is_compiled_again(tmp_path):
    package = _package(
        tmp_path, _outer_kernels=INNER.format(step=1, other=2, comment="")
    )
    call = CALL.replace("outer(", "inner(").replace("import outer", "import inner")
    assert _printed(call, tmp_path) == "2.0 1"
    (stored,) = package.glob("__pycache__/*.nbc")
    stored.write_bytes(stored.read_bytes()[:100])
    assert _printed(call, tmp_path) == "2.0 1"
    assert _printed(call, tmp_path) == "2.0 0"


LONG = (
    "from package.jit import kernel\nimport math\n\n@kernel\ndef inner(x):\n    return "
    + " + ".join(f"math.sin({i} * x)" for i in range(200))
)
SHARED = """
from package._outer_kernels import outer
outer(1.0)
[compiled] = outer.entry.overloads.values()
functions = compiled.library._final_module.functions
print({function.linkage.name for function in functions if "inner" in function.name})
"""


def test_kernel__calls_its_own_copies_of_kernels(tmp_path):
    # too long to be inlined; LLVM would call the copy of the entry that was loaded first
    outer = OUTER.replace("10 * inner(x)", "inner(x) + inner(2 * x)")
    _package(tmp_path, _outer_kernels=outer, _inner_kernels=LONG)
    assert _printed(SHARED, tmp_path) == "{'internal'}"


DIGESTS = """
import importlib
from numba.core.registry import CPUDispatcher
from skindb.kernel_cache import digest
for name in {}:
    for key, one in vars(importlib.import_module(name)).items():
        if isinstance(one, CPUDispatcher):
            print(name, key, digest(one))
"""


def test_digest__of_every_kernel_is_the_same_in_each_process():
    """Otherwise every process would compile it, and remove what the others stored."""
    root = Path(skindb.__file__).parent
    paths = [path.relative_to(root.parent) for path in root.rglob("_*_kernels.py")]
    names = [str(path.with_suffix("")).replace("/", ".") for path in paths]
    code = DIGESTS.format(names)
    printed = [
        _printed(first + code, root.parent, PYTHONHASHSEED=seed)
        # which sets print options of NumPy
        for seed, first in (("1", ""), ("2", "import colour\n"))
    ]
    assert len(printed[0].splitlines()) > 200
    assert printed[0] == printed[1]


@pytest.mark.parametrize("value", [object(), skindb.jit])
def test_digest__refuses_what_it_cannot_compare(value):
    code = compile("value", "kernel", "eval")
    with pytest.raises(TypeError, match="a kernel cannot use"):
        digest(FunctionType(code, {"value": value, "__name__": "package"}))


PAIR = """from typing import NamedTuple

class Pair(NamedTuple):
    {}: float
    {}: float
"""
TENFOLD = """from package.jit import kernel

@kernel
def outer(pair):
    return 10 * pair.a + pair.b
"""


@pytest.mark.slow
def test_kernel__is_compiled_again_when_the_class_of_an_argument_changes(tmp_path):
    """Compiled code has the positions of the fields, and the name of the module."""
    package = _package(tmp_path, _outer_kernels=TENFOLD)
    for module, fields, expected in (
        ("first", "ab", "12.0"),
        ("first", "ba", "21.0"),
        ("second", "ba", "21.0"),
    ):
        (package / "first.py").unlink(missing_ok=True)
        (package / f"{module}.py").write_text(PAIR.format(*fields))
        code = f"from package._outer_kernels import outer; from package.{module} import Pair\n"
        assert _printed(code + "print(outer(Pair(1.0, 2.0)))", tmp_path) == expected


IMPORTED = (
    "fit",
    "ingest",
    "render.rendering",
    "export.gltf",
    "virtual.capture",
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
parts = [part for one in kernels for part in (one, one.entry)]
print(len(calls), sum(len(part.signatures) for part in parts), len(kernels) > 50)
"""
    root = Path(skindb.__file__).parent.parent
    assert _printed(code, root).split() == ["0", "0", "True"]


FIT = """
import hashlib
import numpy as np
from skindb.reflectance._mixture_kernels import Problem, fit_memory, fit_one
rng, count, each = np.random.default_rng(0), 50, 60
rows = rng.gamma(0.5, 1.0, (count * each, 16)).astype(np.float32)
target, lift = rng.gamma(1.0, 1.0, (count * each, 3)), np.abs(rng.normal(size=(16, 59)))
found, work = np.zeros((count, 59)), fit_memory(each, 16, 59)
ones = np.ones(each, np.float32)
for x, m, r in zip(found, np.split(rows, count), np.split(target, count)):
    r = np.ascontiguousarray(r.T, np.float32)
    fit_one(Problem(m, r, ones, each, lift, True, 0.05, 1e-10), x, work)
print(hashlib.sha256(found.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_fast_kernel__the_same_bits_just_compiled_and_read_from_the_disk(tmp_path):
    """The first worker after an installation compiles, and its results must equal those
    of the others.
    """
    root = Path(skindb.__file__).parent.parent
    printed = [_printed(FIT, root, NUMBA_CACHE_DIR=str(tmp_path)) for _ in "12"]
    assert len(printed[0]) == 64
    assert printed[0] == printed[1]
    assert list(tmp_path.rglob("*.nbc"))
