"""What every version says of how it was made."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import xarray as xr

import skindb._version
from skindb.store import Database


def provenance(
    command: str,
    inputs: Iterable[Mapping[str, Any]],
    *,
    parameters: Mapping[str, Any],
    seeds: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """Attributes of a version: the command, its parameters, its random seeds and the versions it was made from.

    The store adds the versions of schema and software.
    """
    return {
        "command": command,
        "parameters": dict(parameters),
        "seeds": dict(seeds or {}),
        "inputs": [dict(one) for one in inputs],
    }


def as_input(db: Database, kind: str, take: str, version: xr.DataTree) -> dict[str, Any]:
    """How provenance names a version that was read."""
    return db.record(kind, take, version.attrs["generation"]).as_input()


@cache
def method_digest(modules: tuple[str, ...]) -> str:
    """Digest of the source of modules and subpackages of skindb: tells whether results were made by this very code."""
    root, digest = Path(skindb._version.__file__).parent, hashlib.sha256()
    for name in modules:
        files = sorted((root / name).rglob("*.py")) if (root / name).is_dir() else [root / f"{name}.py"]
        for file in files:
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def groups_of(tree: xr.DataTree) -> dict[str, xr.Dataset]:
    """The groups of a DataTree as Datasets."""
    return {str(name): node.to_dataset() for name, node in tree.children.items()}
