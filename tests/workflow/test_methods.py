"""The digests by which a refit recognises changed code cover all code that makes a result."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import skindb
from skindb.workflow import fit, summaries

ROOT = Path(skindb.__file__).parent
# errors, names, declarations and checks, which do not change numbers of a result
WITHOUT_NUMBERS = ("cache", "errors", "files", "schema", "types")


def _source(module: str) -> Path | None:
    path = ROOT.joinpath(*module.split(".")[1:])
    files = [path / "__init__.py", path.with_suffix(".py")]
    return next((file for file in files if file.exists()), None)


def _imported(module: str) -> set[str]:
    """Modules of skindb that a module imports, and what those import."""
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in seen or name == "skindb":
            continue
        seen.add(name)
        for node in ast.walk(ast.parse(_source(name).read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                "skindb"
            ):
                below = [f"{node.module}.{one.name}" for one in node.names]
                waiting += [one if _source(one) else node.module for one in below]
    return seen


@pytest.mark.parametrize(
    ("module", "method"),
    [("skindb.fit.model", fit.METHOD), ("skindb.analysis.summary", summaries.METHOD)],
)
def test_method__covers_all_that_the_results_are_made_with(module, method):
    names = {
        name.removeprefix("skindb.").replace(".", "/") for name in _imported(module)
    }
    assert len(names) > 10
    missing = {
        name
        for name in names
        if not any(f"{name}/".startswith(f"{one}/") for one in method)
    }
    assert {
        name for name in missing if name.split("/")[0] not in WITHOUT_NUMBERS
    } == set()
