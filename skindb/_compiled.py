"""How kernels are compiled."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numba as nb
from numba.core import event

# sums may be reordered and products fused; NaN and inf keep their meaning (`fastmath=True` drops tests for them)
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
# kept on disk; without the interpreter's lock; a division by zero is inf: tests for it would keep loops out of the
# vector registers
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
INTRINSICS = os.environ.get("SKINDB_INTRINSICS", "1") != "0"  # 0: only what Numba itself compiles, see `_vectors`


def kernel(function: Any) -> Any:
    """Compile a kernel whose sums keep their order."""
    return _stamped(nb.njit(**OPTIONS)(function))


def fast_kernel(function: Any) -> Any:
    """Compile a kernel whose loops may run in vector registers, see FAST.

    It becomes part of each kernel that calls it. Otherwise a process that has just compiled both would call the copy
    that was compiled alone, and one that read them from the disk the copy beside the caller: two orders of a sum.
    """
    return _stamped(nb.njit(fastmath=FAST, forceinline=True, **OPTIONS)(function))


def inline_kernel(function: Any) -> Any:
    """Like `kernel`, put into each of its callers."""
    return _stamped(nb.njit(inline="always", **OPTIONS)(function))


def inline_fast_kernel(function: Any) -> Any:
    """Like `fast_kernel`, put into each of its callers."""
    return _stamped(nb.njit(fastmath=FAST, inline="always", **OPTIONS)(function))


def _stamped(compiled: Any) -> Any:
    """Compiled code that is kept on disk is used again only if no kernel has changed.

    Numba compares the date of the file of a function alone; a function of another file that it calls is part of the
    compiled code, too, and would stay as it was.
    """
    compiled._cache._cache_file._source_stamp = _sources()
    return compiled


@cache
def _sources() -> str:
    """Digest of the text of all modules with compiled code."""
    root = Path(__file__).parent
    digest = hashlib.sha256(str(INTRINSICS).encode())
    for path in sorted([*root.glob("_*.py"), *root.glob("*/_*kernels.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@contextmanager
def reported_compilation(call: Callable[[], None]) -> Iterator[None]:
    """Call `call` before each kernel that is compiled, not read from the disk: once after an installation."""

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:  # noqa: ARG002
            call()

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield
