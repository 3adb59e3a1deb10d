"""The page of equations names functions and modules that exist, and links to those of the API."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import skindb

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "equations.md").read_text(encoding="utf-8")
PARTS = "|".join(
    path.name
    for path in Path(skindb.__file__).parent.iterdir()
    if (path / "__init__.py").is_file()
)
NAMES = sorted(set(re.findall(rf"`((?:{PARTS})(?:\.\w+)+)`", PAGE)))
LINKED = sorted(set(re.findall(r"\{py:obj\}`([\w.]+)`", PAGE)))
API = (DOCS / "api/index.md").read_text(encoding="utf-8")


def _resolve(name):
    """The module or the member of a module with this name."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        module, _, member = name.rpartition(".")
        return getattr(_resolve(module), member)


def test_equations__the_names_are_found():
    assert len(NAMES) > 50
    assert len(LINKED) > 50


def test_equations__names_exist():
    for name in NAMES:
        assert _resolve(f"skindb.{name}") is not None, name


def test_equations__linked_functions_are_in_the_api():
    for name in LINKED:
        package, _, member = name.partition(".")
        public = member in getattr(_resolve(f"skindb.{package}"), "__all__", ())
        module = re.escape(name.rpartition(".")[0])
        listed = re.search(rf"^   skindb\.({re.escape(name)}|{module})$", API, re.M)
        assert public or listed, name
