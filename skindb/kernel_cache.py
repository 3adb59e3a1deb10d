"""Compiled kernels on disk, each under a digest of all that its machine code was made from."""

from __future__ import annotations

import hashlib
import pickle
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from enum import EnumMeta
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite.ir
import numba as nb
import numpy as np
from numba.core.caching import IndexDataCacheFile
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic
from numba.core.typing.templates import builtin_registry

LITERALS = (int, float, complex, str, bytes, type(None), type(...), np.generic)
LLVM = (llvmlite.ir.Type, llvmlite.ir.Constant)
# of a file that is damaged, or that names a module or class which is gone
UNREADABLE = (OSError, ImportError, AttributeError, EOFError, pickle.UnpicklingError)


class KernelFiles(IndexDataCacheFile):  # type: ignore[misc]
    """The files of one kernel, one for each digest and signature.

    Numba compares the file of a function only, although the compiled code contains the
    functions of other files that it calls, and its index of signatures loses entries if
    two processes write it at once. Files of older digests are removed.
    """

    def __init__(self, compiled: Any) -> None:
        self._cache_path = compiled._cache.cache_path
        self.compiled = compiled
        function = compiled.py_func
        kind = "linked." if compiled.targetoptions.get("no_cpython_wrapper") else ""
        self.name = f"{kind}{function.__module__}.{function.__qualname__}"

    def load(self, key: tuple[Any, ...]) -> Any:
        """The compiled signature, None if there is none."""
        with suppress(*UNREADABLE):
            return self._load_data(self._file(key))
        return None

    def is_empty(self) -> bool:
        """Whether no signature of the present code is stored."""
        prefix = f"{self.name}-{digest(self.compiled)[:16]}"
        return not any(Path(self._cache_path).glob(f"{prefix}.*.nbc"))

    def save(self, key: tuple[Any, ...], data: Any) -> None:
        """Store a compiled signature."""
        current = self._file(key)
        self._save_data(current, data)
        prefix = current[: -len(".0123456789abcdef.nbc")]
        for path in Path(self._cache_path).glob(f"{self.name}-*.nbc"):
            if not path.name.startswith(prefix):
                path.unlink(missing_ok=True)

    def _file(self, key: tuple[Any, ...]) -> str:
        signature = repr((key, [*_records(key[0])]))
        digests = [digest(self.compiled), _digest([signature])]
        return f"{self.name}-{'.'.join(text[:16] for text in digests)}.nbc"


def digest(compiled: Any) -> str:
    """Digest of Python, Numba and our compiler, of a kernel, of all functions that it
    calls and of all constants that these use; independent of comments and lines, and of
    print options, which colour-science sets.
    """
    waiting = [compiled]
    parts: dict[Any, str] = {}
    while waiting:
        value = waiting.pop()
        if value not in parts:
            with np.printoptions(legacy=False):
                parts[value], used = _function_parts(value)
            waiting += used
    compiler = Path(__file__).with_name("kernel_compiler.py").read_text()
    versions = f"{sys.implementation.cache_tag} {nb.__version__} {compiler}"
    return _digest([versions, parts[compiled], *sorted(parts.values())])


@cache
def _function_parts(value: Any) -> tuple[str, tuple[Any, ...]]:
    """Text of a function without those that it uses, and these."""
    if isinstance(value, Dispatcher):
        options = [
            (name, sorted(option) if isinstance(option, set) else option)
            for name, option in sorted(value.targetoptions.items())
        ]
        return f"{_name(value)} {options}", (value.py_func,)
    if isinstance(value, _Intrinsic):
        return _name(value), (value._defn,)
    used = [*_overloads(value)]
    code = value.__code__
    cells = [cell.cell_contents for cell in value.__closure__ or ()]
    read = {
        name: value.__globals__[name]
        for name in sorted(_names(code))
        if name in value.__globals__
    }
    parts = [
        _name(value),
        _code_text(code, value.__doc__),
        _text((value.__defaults__, value.__kwdefaults__, cells, read), used),
    ]
    return "\n".join(parts), tuple(used)


def _overloads(function: FunctionType) -> Iterator[Any]:
    """What Numba compiles where kernels call a function of Python."""
    for target, kind in builtin_registry.globals:
        if target is function:
            yield from (template._overload_func for template in kind.templates)


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _code_text(code: CodeType, doc: str | None) -> str:
    """Instructions and constants of a function, without its documentation."""
    constants = [
        _code_text(constant, None) if isinstance(constant, CodeType) else repr(constant)
        for constant in code.co_consts
        if doc is None or constant != doc
    ]
    names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    flags = (code.co_argcount, code.co_kwonlyargcount, code.co_flags)
    table = code.co_exceptiontable
    return repr((code.co_code.hex(), constants, names, flags, table))


def _text(value: Any, used: list[Any]) -> str:
    """A constant as text; functions are appended to `used`.

    Raises
    ------
    TypeError
        If all that kernels may use of the value is not known here.
    """
    if isinstance(value, (Dispatcher, _Intrinsic, FunctionType)):
        used.append(value)
        return _name(value)
    if isinstance(value, EnumMeta):
        return f"{value.__name__} {[(m.name, m.value) for m in value]}"  # type: ignore[var-annotated]
    if isinstance(value, LITERALS):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, LLVM):
        return str(value)
    if isinstance(value, np.ndarray):
        content = hashlib.sha256(value.tobytes()).hexdigest()
        return f"array {value.dtype.str} {value.shape} {content}"
    if isinstance(value, dict):
        return f"{[(key, _text(item, used)) for key, item in value.items()]}"
    if isinstance(value, tuple | list):
        return f"{_class_text(type(value))} {[_text(item, used) for item in value]}"
    if isinstance(value, ModuleType) and not _is_ours(value.__name__):
        return f"module {value.__name__}"
    if isinstance(value, type) and (
        hasattr(value, "_fields") or not _is_ours(value.__module__)
    ):
        return _class_text(value)
    raise TypeError(f"a kernel cannot use {value!r}: import its functions or constants")


def _name(function: Any) -> str:
    return f"{type(function).__name__} {function.__module__}.{function.__qualname__}"


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] == __name__.partition(".")[0]


def _class_text(kind: Any) -> str:
    return f"{kind.__module__}.{kind.__qualname__} {getattr(kind, '_fields', '')}"


def _records(kinds: Iterable[Any]) -> Iterator[str]:
    """The named tuples among types of arguments, whose repr lacks the fields."""
    for kind in kinds:
        if isinstance(kind, nb.types.BaseNamedTuple):
            yield _class_text(kind.instance_class)
        if isinstance(kind, nb.types.BaseTuple):
            yield from _records(kind)


def _digest(texts: Iterable[str]) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()
