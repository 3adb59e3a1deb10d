"""Provenance: how every version records the way in which it was made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import xarray as xr

from skindb.store import Database
from skindb.workflow.source import method_digest

__all__ = ["as_input", "groups_of", "method_digest", "provenance"]


def provenance(
    command: str,
    inputs: Iterable[Mapping[str, Any]],
    *,
    parameters: Mapping[str, Any],
    seeds: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """Attributes of a version: the command, its parameters and random seeds, and the
    versions it was made from.

    The store adds the versions of schema and software.
    """
    return {
        "command": command,
        "parameters": dict(parameters),
        "seeds": dict(seeds or {}),
        "inputs": [dict(one) for one in inputs],
    }


def as_input(
    db: Database, kind: str, take: str, version: xr.DataTree
) -> dict[str, Any]:
    """How provenance names a version that was read."""
    return db.record(kind, take, version.attrs["generation"]).as_input()


def groups_of(tree: xr.DataTree) -> dict[str, xr.Dataset]:
    """The groups of a DataTree as Datasets."""
    return {str(name): node.to_dataset() for name, node in tree.children.items()}
