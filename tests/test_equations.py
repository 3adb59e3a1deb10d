"""The table of equations names functions and modules that exist."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import skindb

TABLE = Path(__file__).parents[1] / "docs/equations.md"
PARTS = sorted(
    path.name
    for path in Path(skindb.__file__).parent.iterdir()
    if (path / "__init__.py").is_file()
)
NAMES = sorted(
    set(
        re.findall(
            rf"`((?:{'|'.join(PARTS)})(?:\.\w+)+)`", TABLE.read_text(encoding="utf-8")
        )
    )
)


def _resolve(name):
    """The module or the member of a module with this name."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        module, _, member = name.rpartition(".")
        return getattr(_resolve(module), member)


def test_equations__the_table_is_found():
    assert len(NAMES) > 50


def test_equations__names_exist():
    for name in NAMES:
        assert _resolve(f"skindb.{name}") is not None, name
