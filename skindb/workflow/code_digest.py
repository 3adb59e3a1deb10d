"""Digest of the code that computes a result.

The digest covers the functions that are named and everything in skindb that they use:
functions, classes and constants, followed through the imports of their modules. The
source is parsed and never imported. Docstrings, comments, annotations and formatting do
not count, nor does what stands in the same file and is not used.
"""

from __future__ import annotations

import ast
import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PACKAGE = "skindb"
# The store returns what was committed, and the version of the schema, which every
# version records, stands for the table of variables
NOT_FOLLOWED = ("skindb.store", "skindb.schema.variables")
WHOLE = "*"  # in place of a name: everything in a module
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
# fields of syntax trees that follow from others or do not change what is computed
DERIVED_FIELDS = ("ctx", "kind", "type_comment", "type_params")

Symbol = tuple[str, str]  # module and name


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


@cache
def package_digest() -> str:
    """Digest of all source files of skindb, byte by byte: whether two processes run the
    same program.
    """
    digest = hashlib.sha256()
    for file in sorted(ROOT.rglob("*.py")):
        name = file.relative_to(ROOT).as_posix()
        digest.update(name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def code_symbols(*functions: Callable[..., Any]) -> list[Symbol]:
    """The modules and names that `code_digest` covers, in order."""
    starts = tuple(_symbol(function) for function in functions)
    return sorted(_reached(ROOT, starts))


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
    digest = hashlib.sha256()
    for module, name in sorted(_reached(root, starts)):
        source = _source(root, module)
        digest.update(f"{module}:{name}\n".encode())
        for statement in source.statements(name):
            digest.update(repr(_written(statement)).encode())
    return digest.hexdigest()


def _reached(root: Path, starts: Iterable[Symbol]) -> set[Symbol]:
    """The definitions that some definitions use, and these themselves."""
    symbols = set(starts)
    pending = list(symbols)
    while pending:
        module, name = pending.pop()
        uses = set(_uses(root, module, name)) - symbols
        symbols |= uses
        pending += uses
    return {
        (module, name)
        for module, name in symbols
        if _source(root, module).defines(name)
    }


@cache
def _uses(root: Path, module: str, name: str) -> tuple[Symbol, ...]:
    source = _source(root, module)
    if name != WHOLE and name not in source.definitions:
        targets = [
            _resolved(root, target, ()) for target in source.imports.get(name, ())
        ]
    else:
        targets = [
            target
            for statement in source.statements(name)
            for chain in _chains(statement)
            for target in _bound(root, module, chain)
        ]
        if name == WHOLE:
            imported = [target for found in source.imports.values() for target in found]
            targets += [_resolved(root, target, ()) for target in imported]
    return tuple(target for target in targets if not _is_left_out(target[0]))


def _is_left_out(module: str) -> bool:
    return any(f"{module}.".startswith(f"{package}.") for package in NOT_FOLLOWED)


def _bound(root: Path, module: str, chain: tuple[str, ...]) -> Iterator[Symbol]:
    """What a dotted name in a module refers to; nothing if it is local or not of skindb."""
    source = _source(root, module)
    if chain[0] in source.definitions:
        yield module, chain[0]
    for target in source.imports.get(chain[0], ()):
        yield _resolved(root, target, chain[1:])


def _resolved(root: Path, target: Symbol, attributes: tuple[str, ...]) -> Symbol:
    """Follow the attributes of a module that was imported to a definition."""
    module, name = target
    if name == WHOLE:
        if not attributes:
            return target
        return _resolved(root, (module, attributes[0]), attributes[1:])
    if _is_module(root, f"{module}.{name}"):
        source = _source(root, module)
        if name not in source.definitions and set(source.imports.get(name, ())) <= {
            target
        }:
            return _resolved(root, (f"{module}.{name}", WHOLE), attributes)
    return target


@dataclass
class _Source:
    """What the names in a module stand for."""

    definitions: dict[str, list[ast.stmt]] = field(
        default_factory=lambda: defaultdict(list)
    )
    imports: dict[str, list[Symbol]] = field(default_factory=lambda: defaultdict(list))
    # statements that bind no name: they may change what the others are
    effects: list[ast.stmt] = field(default_factory=list)

    def defines(self, name: str) -> bool:
        return name == WHOLE or name in self.definitions

    def statements(self, name: str) -> list[ast.stmt]:
        if name == WHOLE:
            unique = {
                id(statement): statement
                for statements in self.definitions.values()
                for statement in statements
            }
            return [*unique.values(), *self.effects]
        return [*self.definitions[name], *self.effects] if self.defines(name) else []


@cache
def _source(root: Path, module: str) -> _Source:
    path = _path(root, module)
    if path is None:
        return _Source()
    tree = ast.parse(path.read_bytes(), path.name)
    source = _Source()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            _add_imports(source, node)
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False):
            del node.body[0]
    for statement in tree.body:
        _add_definitions(source, statement)
    return source


def _add_imports(source: _Source, node: ast.Import | ast.ImportFrom) -> None:
    for alias in node.names:
        if isinstance(node, ast.ImportFrom):
            target = (str(node.module), alias.name)
            name = alias.asname or alias.name
        elif alias.asname:
            target = (alias.name, WHOLE)
            name = alias.asname
        else:
            name = alias.name.partition(".")[0]
            target = (name, WHOLE)
        if target[0].partition(".")[0] == PACKAGE:
            source.imports[name].append(target)


def _add_definitions(source: _Source, statement: ast.stmt) -> None:
    if isinstance(statement, ast.Import | ast.ImportFrom) or _is_for_types(statement):
        return
    names = {
        node.id
        for node in ast.walk(statement)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    }
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        # `@overload(function)` changes what `function` is
        names = {statement.name} | {
            argument.id
            for decorator in statement.decorator_list
            if isinstance(decorator, ast.Call)
            for argument in decorator.args
            if isinstance(argument, ast.Name)
        }
    for name in names:
        source.definitions[name].append(statement)
    if not names:
        source.effects.append(statement)


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
    skipped = {*DERIVED_FIELDS, *_annotations(node)}
    fields = tuple(
        (name, _written(value))
        for name, value in ast.iter_fields(node)
        if name not in skipped and value not in (None, [])
    )
    return type(node).__name__, fields


def _annotations(node: ast.AST) -> tuple[str, ...]:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        return ("returns",)
    return ("annotation",) if isinstance(node, ast.arg) else ()


def _is_module(root: Path, module: str) -> bool:
    return _path(root, module) is not None


@cache
def _path(root: Path, module: str) -> Path | None:
    base = root.joinpath(*module.split(".")[1:])
    candidates = [base / "__init__.py", base.with_suffix(".py")]
    return next((path for path in candidates if path.is_file()), None)
