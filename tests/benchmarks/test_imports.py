"""What benchmarks and notebooks import from skindb exists; they run too rarely to show it."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAMS = sorted((ROOT / "benchmarks").rglob("*.py"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def code_of(file: Path) -> Iterator[str]:
    if file.suffix == ".py":
        yield file.read_text(encoding="utf-8")
        return
    for cell in json.loads(file.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            yield "".join(cell["source"])


def imported(file: Path) -> Iterator[tuple[str, str]]:
    for code in code_of(file):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom):
                module = node.module or ""
                if module.partition(".")[0] == "skindb":
                    yield from ((module, alias.name) for alias in node.names)


@pytest.mark.parametrize("file", [*PROGRAMS, *NOTEBOOKS], ids=lambda file: file.name)
def test_imports__exist(file):
    for module, name in imported(file):
        is_there = hasattr(import_module(module), name) or find_spec(f"{module}.{name}")
        assert is_there, f"{module} has no {name}"
