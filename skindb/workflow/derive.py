"""Versions that are derived from others: computed only if what is stored is not current.

A version is current if it was derived from the same inputs, with the same parameters,
by the same code. This is decided here for first passes, models, registrations,
summaries, studies and edits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import xarray as xr

from skindb.files import plain
from skindb.store import STUDY, SUMMARY, Database, Lease, Record
from skindb.workflow.code_digest import code_digest

FIRST_PASS = "first"  # of a fit: transient, it is removed when the model is committed
COMMANDS = {
    FIRST_PASS: "fit",
    "model": "fit",
    "registration": "register",
    SUMMARY: "summarise",
    STUDY: "analyze",
    "edit": "edit",
}
TABLES = "tables"  # group that is kept beside a version, for cohorts


@dataclass(frozen=True)
class Derivation:
    """What decides the content of a version that is derived from others.

    Parameters
    ----------
    db, kind, key
        Database, kind of the version, and its take or the name of the study.
    provenance
        Attributes of the version that decide its content.
    names
        Takes that the version refers to.
    """

    db: Database
    kind: str
    key: str
    provenance: Mapping[str, Any] = field(repr=False)
    names: frozenset[str] = frozenset()

    @classmethod
    def of(
        cls,
        db: Database,
        kind: str,
        key: str,
        *,
        inputs: Iterable[Record],
        code: Iterable[Callable[..., Any]],
        names: Iterable[str] = (),
        **decisive: Any,
    ) -> Derivation:
        """Describe how a version is derived.

        Parameters
        ----------
        db, kind, key, names
            See above.
        inputs
            Records of the versions from which it is computed.
        code
            Functions that compute it, see `code_digest`.
        **decisive
            Everything else that decides its content: parameters, seeds, digests.
        """
        provenance = {
            "command": COMMANDS[kind],
            "inputs": [record.as_input() for record in inputs],
            "code_digest": code_digest(*code),
            **decisive,
        }
        return cls(db, kind, key, plain(provenance), frozenset(names))

    def describes(self, record: Record) -> bool:
        """Whether a version was derived in this way."""
        stored = record.provenance
        return all(stored.get(name) == value for name, value in self.provenance.items())

    def current(self) -> Record | None:
        """The record of the newest version if it was derived in this way."""
        if not self.db.has(self.kind, self.key):
            return None
        record = self.db.record(self.kind, self.key)
        return record if self.describes(record) else None

    def commit(self, version: xr.DataTree, lease: Lease | None = None) -> Record:
        """Commit a version that was computed, with its attributes.

        A group "tables" is kept beside the version, where cohorts read it.
        """
        groups = groups_of(version)
        tables = groups.pop(TABLES, None)
        attrs = {str(name): value for name, value in version.attrs.items()}
        with self.db.stage(self.kind, self.key, lease, names=self.names) as stage:
            stage.write(groups, tables=tables)
            attrs["study" if self.kind == STUDY else "take"] = self.key
            defaults: dict[str, Any] = {"parameters": {}, "seeds": {}}
            return stage.commit({**defaults, **attrs, **self.provenance})


def derive(derivation: Derivation, compute: Callable[[], xr.DataTree]) -> Record:
    """The stored version if it is current, or a new one, which is computed and committed.

    Parameters
    ----------
    derivation
        What decides the content of the version.
    compute
        Returns its groups and further attributes; see `Derivation.commit`.
    """
    return derivation.current() or derivation.commit(compute())


def groups_of(tree: xr.DataTree) -> dict[str, xr.Dataset]:
    """The groups of a DataTree as Datasets."""
    return {str(name): node.to_dataset() for name, node in tree.children.items()}
