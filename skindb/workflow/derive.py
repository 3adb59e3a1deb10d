"""Versions that are derived from others: computed only if what is stored is not current.

A version is current if it was derived from the same inputs, with the same parameters,
by the same code. This is decided here for models, registrations, summaries, studies
and edits.

The digest of the code covers the modules of the functions that are named, and all modules
of skindb that these import, directly or through others. The source is parsed and never
imported. Docstrings, comments, annotations, help texts of parameters and formatting do not
count. A table (a JSON file) beside a module counts where it is named.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from xarray import Dataset, DataTree

from skindb.cache import cached_arrays
from skindb.files import ROOT, Attributes, Json, package_digest, plain
from skindb.store import STUDY, SUMMARY, Database, Lease, Record

PACKAGE = "skindb"
# The store and the workflow read and commit what was computed, the list of the studies
# names also the others, and the version of the schema, which every version records,
# stands for the table of variables
NOT_FOLLOWED = (
    "skindb.store.",
    "skindb.workflow.",
    "skindb.analysis.studies.",
    "skindb.schema.variables.",
)
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
# fields of syntax trees that follow from others or do not change what is computed
DERIVED_FIELDS = ("ctx", "kind", "type_comment", "type_params")
ANNOTATIONS: dict[type[ast.AST], str] = {
    ast.FunctionDef: "returns",
    ast.AsyncFunctionDef: "returns",
    ast.arg: "annotation",
}
COMMANDS = {
    "model": "fit",
    "registration": "register",
    SUMMARY: "summarise",
    STUDY: "analyze",
    "edit": "edit",
}
TABLES = "tables"  # group that is kept beside a version, for cohorts


def code_digest(*functions: Callable[..., Any]) -> str:
    """Digest of the modules of functions, and of all modules of skindb that these import.

    Parameters
    ----------
    *functions
        Functions or classes of skindb; of a `functools.partial` the function is taken.

    Raises
    ------
    ValueError
        If a function is not part of skindb.
    """
    return _digest_of(ROOT, tuple(_module_of(function) for function in functions))


def _module_of(function: Callable[..., Any]) -> str:
    while isinstance(function, partial):
        function = function.func
    module = function.__module__
    if module.partition(".")[0] != PACKAGE:
        name = f"{module}.{function.__qualname__}"
        raise ValueError(f"{name} must be a function of {PACKAGE}")
    return module


@cache
def _digest_of(root: Path, starts: tuple[str, ...]) -> str:
    """From the cache on disk while no file of the package changes, as parsing takes a second."""
    # modules may have been parsed before an edit, in a notebook
    if package_digest.__wrapped__(root) != package_digest(root):
        return _parsed_digest(root, starts)
    stored = cached_arrays(
        f"code-{starts[0]}",
        (starts, package_digest(root)),
        sources=(__name__,),
        make=lambda: {"digest": np.array([_parsed_digest(root, starts)])},
    )
    return str(stored["digest"][0])


def _parsed_digest(root: Path, starts: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for module, tree in sorted(_reached(root, starts).items()):
        digest.update(f"{module}\n{_written(tree)!r}".encode())
        for table in _tables(root, module, tree):
            digest.update(table.read_bytes())
    return digest.hexdigest()


def _reached(root: Path, starts: Iterable[str]) -> dict[str, ast.Module]:
    """Syntax trees of modules and of those that they import."""
    trees = {}
    pending = list(starts)
    while pending:
        module = pending.pop()
        path = _path(root, module)
        if path is not None and module not in trees:
            trees[module] = _parsed(path)
            imported = _imported(root, module, trees[module])
            pending += [x for x in imported if not f"{x}.".startswith(NOT_FOLLOWED)]
    return trees


@cache
def _parsed(path: Path) -> ast.Module:
    """Syntax tree of a module and of its stub of lazy imports, without docstrings."""
    tree = ast.parse(path.read_bytes(), path.name)
    stub = path.with_suffix(".pyi")
    if stub.is_file():
        tree.body += ast.parse(stub.read_bytes()).body
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False):
            del node.body[0]
    return tree


def _imported(root: Path, package: str, tree: ast.Module) -> Iterator[str]:
    """Modules that a module or package imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            source = f"{package}.{node.module}" if node.level else str(node.module)
            for alias in node.names:
                name = f"{source}.{alias.name}"
                yield source if _path(root, name) is None else name


def _tables(root: Path, module: str, tree: ast.Module) -> Iterator[Path]:
    """Tables beside a module that it names."""
    path = _path(root, module)
    for node in ast.walk(tree):
        if (
            path
            and isinstance(node, ast.Constant)
            and str(node.value).endswith(".json")
        ):
            table = path.parent / str(node.value)
            if table.is_file():
                yield table


def _written(node: Any) -> Any:
    """A syntax tree as nested tuples that are the same in every version of Python."""
    if isinstance(node, list):
        return tuple(_written(part) for part in node)
    if not isinstance(node, ast.AST):
        return node
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "option":
        # a parameter of `skindb.parameters`, whose help does not count
        return _written([*node.args[:1], *node.keywords])
    skipped = {*DERIVED_FIELDS, ANNOTATIONS.get(type(node))}
    fields = tuple(
        (name, _written(value))
        for name, value in ast.iter_fields(node)
        if name not in skipped and value not in (None, [])
    )
    return type(node).__name__, fields


@cache
def _path(root: Path, module: str) -> Path | None:
    """File of a module of skindb; None for modules of other packages and other names."""
    package, *names = module.split(".")
    if package != PACKAGE:
        return None
    base = root.joinpath(*names)
    candidates = [base / "__init__.py", base.with_suffix(".py")]
    return next((path for path in candidates if path.is_file()), None)


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
    provenance: Attributes = field(repr=False)
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

    def commit(self, version: DataTree, lease: Lease | None = None) -> Record:
        """Commit a version that was computed, with its attributes.

        A group "tables" is kept beside the version, where cohorts read it.
        """
        groups = groups_of(version)
        tables = groups.pop(TABLES, None)
        attrs = {str(name): value for name, value in version.attrs.items()}
        with self.db.stage(self.kind, self.key, lease, names=self.names) as stage:
            stage.write(groups, tables=tables)
            attrs["study" if self.kind == STUDY else "take"] = self.key
            defaults: Json = {"parameters": {}, "seeds": {}}
            return stage.commit({**defaults, **attrs, **self.provenance})


def derive(derivation: Derivation, compute: Callable[[], DataTree]) -> Record:
    """The stored version if it is current, or a new one, which is computed and committed.

    Parameters
    ----------
    derivation
        What decides the content of the version.
    compute
        Returns its groups and further attributes; see `Derivation.commit`.
    """
    return derivation.current() or derivation.commit(compute())


def groups_of(tree: DataTree) -> dict[str, Dataset]:
    """The groups of a DataTree as Datasets."""
    return {str(name): node.to_dataset() for name, node in tree.children.items()}
