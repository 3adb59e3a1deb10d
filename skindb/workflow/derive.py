"""Versions that are derived from others: computed only if what is stored is not current.

A version is current if it was derived from the same inputs, with the same parameters,
by the same code. This is decided here for models, registrations, summaries, studies
and edits.

The digest of the code covers the functions that are named and everything in skindb that
they use: functions, classes and constants, followed through the imports of their modules.
The source is parsed and never imported. Docstrings, comments, annotations, help texts of
parameters and formatting do not count, nor does what stands in the same file and is not
used. A table (a JSON file) beside a module counts where it is named.
"""

from __future__ import annotations

import ast
import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from xarray import Dataset, DataTree

from skindb.cache import cached_arrays
from skindb.files import ROOT, package_digest, plain
from skindb.store import STUDY, SUMMARY, Database, Lease, Record

PACKAGE = "skindb"
# The store returns what was committed, and the version of the schema, which every
# version records, stands for the table of variables
NOT_FOLLOWED = ("skindb.store.", "skindb.schema.variables.")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
# fields of syntax trees that follow from others or do not change what is computed
DERIVED_FIELDS = ("ctx", "kind", "type_comment", "type_params")
ANNOTATIONS: dict[type[ast.AST], str] = {
    ast.FunctionDef: "returns",
    ast.AsyncFunctionDef: "returns",
    ast.arg: "annotation",
}

Symbol = tuple[str, str]  # module and name
Reference = tuple[str, tuple[str, ...]]  # module and dotted names
COMMANDS = {
    "model": "fit",
    "registration": "register",
    SUMMARY: "summarise",
    STUDY: "analyze",
    "edit": "edit",
}
TABLES = "tables"  # group that is kept beside a version, for cohorts


def code_digest(*functions: Callable[..., Any]) -> str:
    """Digest of the source of functions and of all code of skindb that they use.

    Parameters
    ----------
    *functions
        Functions or classes of skindb. A function that is defined inside another one
        counts as the outer one; of a `functools.partial` the function is taken.

    Raises
    ------
    ValueError
        If a function is not part of skindb.
    """
    return _digest_of(ROOT, tuple(_symbol(function) for function in functions))


def _symbol(function: Callable[..., Any]) -> Symbol:
    while isinstance(function, partial):
        function = function.func
    module = function.__module__
    name = function.__qualname__.partition(".")[0]
    if module.partition(".")[0] != PACKAGE:
        raise ValueError(f"{module}.{name} must be a function of {PACKAGE}")
    return module, name


@cache
def _digest_of(root: Path, starts: tuple[Symbol, ...]) -> str:
    """From the cache on disk while no file of the package changes, as parsing takes a second."""
    # modules may have been parsed before an edit, in a notebook
    if package_digest.__wrapped__(root) != package_digest(root):
        return _parsed_digest(root, starts)
    stored = cached_arrays(
        f"code-{starts[0][1]}",
        (starts, package_digest(root)),
        sources=(__name__,),
        make=lambda: {"digest": np.array([_parsed_digest(root, starts)])},
    )
    return str(stored["digest"][0])


def _parsed_digest(root: Path, starts: tuple[Symbol, ...]) -> str:
    digest = hashlib.sha256()
    for module, name in sorted(_reached(root, starts)):
        digest.update(f"{module}:{name}\n".encode())
        for statement in _source(root, module).statements(name):
            digest.update(repr(_written(statement)).encode())
            for table in _tables(root, module, statement):
                digest.update(table.read_bytes())
    return digest.hexdigest()


def _tables(root: Path, module: str, statement: ast.stmt) -> Iterator[Path]:
    """Tables beside a module that a statement names."""
    path = _path(root, module)
    for node in ast.walk(statement):
        if (
            isinstance(node, ast.Constant)
            and str(node.value).endswith(".json")
            and path
        ):
            table = path.with_name(str(node.value))
            if table.is_file():
                yield table


def _reached(root: Path, starts: Iterable[Symbol]) -> set[Symbol]:
    """The definitions that some definitions use, and these themselves."""
    symbols: set[Symbol] = set()
    references = set()
    pending: list[Reference] = [(module, (name,)) for module, name in starts]
    while pending:
        reference = pending.pop()
        if reference not in references:
            references.add(reference)
            pending += _followed(root, *reference, symbols)
    return symbols


def _followed(
    root: Path, module: str, names: tuple[str, ...], symbols: set[Symbol]
) -> list[Reference]:
    """What dotted names in a module lead to; a definition is added to `symbols`."""
    if f"{module}.".startswith(NOT_FOLLOWED):
        return []
    source = _source(root, module)
    if not names:  # the module itself
        return [(module, (name,)) for name in (*source.definitions, *source.imports)]
    name, *attributes = names
    followed: list[Reference] = []
    if name in source.definitions and (module, name) not in symbols:
        symbols.add((module, name))
        statements = source.statements(name)
        followed += [(module, chain) for node in statements for chain in _chains(node)]
    for target, path in source.imports.get(name, ()):
        followed.append((target, (*path, *attributes)))
    if name not in source.imports and _path(root, f"{module}.{name}") is not None:
        followed.append((f"{module}.{name}", tuple(attributes)))
    return followed


@dataclass
class _Source:
    """What the names in a module stand for."""

    definitions: dict[str, list[ast.stmt]]
    imports: dict[str, list[Reference]]
    # statements that bind no name: they may change what the others are
    effects: list[ast.stmt]

    def statements(self, name: str) -> list[ast.stmt]:
        """The statements that define a name."""
        return [*self.definitions[name], *self.effects]


@cache
def _source(root: Path, module: str) -> _Source:
    source = _Source(defaultdict(list), defaultdict(list), [])
    path = _path(root, module)
    if path is None:
        return source
    tree = ast.parse(path.read_bytes(), path.name)
    # names that a package imports at their first use are listed in its stub
    stub = path.with_suffix(".pyi")
    lazy = ast.parse(stub.read_bytes()) if stub.is_file() else ast.Module([], [])
    for node in (*ast.walk(tree), *ast.walk(lazy)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            for name, target in _imported(node, module):
                is_own = target == (module, (name,))
                if target[0].partition(".")[0] == PACKAGE and not is_own:
                    source.imports[name].append(target)
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False):
            del node.body[0]
    for statement in tree.body:
        names = _defined(statement)
        for name in names:
            source.definitions[name].append(statement)
        is_import = isinstance(statement, ast.Import | ast.ImportFrom)
        if not names and not is_import and not _is_for_types(statement):
            source.effects.append(statement)
    return source


def _imported(
    node: ast.Import | ast.ImportFrom, package: str
) -> Iterator[tuple[str, Reference]]:
    """Names that an import in a module or package binds, and what they stand for."""
    for alias in node.names:
        if isinstance(node, ast.ImportFrom):
            source = f"{package}.{node.module}" if node.level else str(node.module)
            yield alias.asname or alias.name, (source, (alias.name,))
        elif alias.asname:
            yield alias.asname, (alias.name, ())
        else:
            name = alias.name.partition(".")[0]
            yield name, (name, ())


def _defined(statement: ast.stmt) -> set[str]:
    """Names that a statement of a module binds or changes."""
    if not isinstance(statement, DOCUMENTED):
        nodes = [node for node in ast.walk(statement) if isinstance(node, ast.Name)]
        return {node.id for node in nodes if isinstance(node.ctx, ast.Store)}
    assert not isinstance(statement, ast.Module)
    # `@overload(function)` changes what `function` is
    calls = [call for call in statement.decorator_list if isinstance(call, ast.Call)]
    arguments = [argument for call in calls for argument in call.args]
    changed = {node.id for node in arguments if isinstance(node, ast.Name)}
    return {statement.name} | changed


def _is_for_types(statement: ast.stmt) -> bool:
    """Whether it is `if TYPE_CHECKING`. What is imported there are the names that
    annotations use, or that a package imports at their first use.
    """
    return isinstance(statement, ast.If) and "TYPE_CHECKING" in ast.dump(statement.test)


def _chains(node: ast.AST) -> Iterator[tuple[str, ...]]:
    """The dotted names in a statement, also in annotations: the class of a parameter
    is code that the function uses.
    """
    names = []
    part = node
    while isinstance(part, ast.Attribute):
        names.append(part.attr)
        part = part.value
    if isinstance(part, ast.Name):
        yield (part.id, *reversed(names))
        return
    for child in ast.iter_child_nodes(part):
        yield from _chains(child)


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
    base = root.joinpath(*module.split(".")[1:])
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
            defaults: dict[str, Any] = {"parameters": {}, "seeds": {}}
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
