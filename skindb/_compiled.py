"""Decorators that compile kernels with Numba, and their options."""

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

# sums may be reordered and products fused; NaN and inf keep their meaning
# (`fastmath=True` would drop tests for them)
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}
# cached on disk; without the GIL; a division by zero gives inf, because tests for it
# would prevent vectorised loops
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
# 0: only code that Numba compiles itself, see `_vectors`
INTRINSICS = os.environ.get("SKINDB_INTRINSICS", "1") != "0"


def kernel(function: Any) -> Any:
    """Compile a kernel whose sums keep their order."""
    return _stamped(nb.njit(**OPTIONS)(function))


def fast_kernel(function: Any) -> Any:
    """Compile a kernel whose loops may run in vector registers, see FAST.

    The kernel is always inlined into its callers. Otherwise a process that has just
    compiled both would call the separately compiled copy, and a process that reads them
    from the disk the copy next to the caller, which may sum in another order.
    """
    return _stamped(nb.njit(fastmath=FAST, forceinline=True, **OPTIONS)(function))


def inline_kernel(function: Any) -> Any:
    """Like `kernel`, but inlined by Numba into each of its callers."""
    return _stamped(nb.njit(inline="always", **OPTIONS)(function))


def inline_fast_kernel(function: Any) -> Any:
    """Like `fast_kernel`, but inlined by Numba into each of its callers."""
    return _stamped(nb.njit(fastmath=FAST, inline="always", **OPTIONS)(function))


def _stamped(compiled: Any) -> Any:
    """Make the cache on disk valid only as long as no kernel changes.

    Numba only compares the date of the file of a function. Compiled code also contains
    the functions of other files that it calls, which would not be updated.
    """
    compiled._cache._cache_file._source_stamp = _sources()
    return compiled


@cache
def _sources() -> str:
    """Digest of the source of all modules with compiled code."""
    root = Path(__file__).parent
    digest = hashlib.sha256(str(INTRINSICS).encode())
    for path in sorted([*root.glob("_*.py"), *root.glob("*/_*kernels.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@contextmanager
def reported_compilation(call: Callable[[], None]) -> Iterator[None]:
    """Call `call` before each kernel that is compiled instead of read from the disk, as
    after an installation.
    """

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:  # noqa: ARG002
            call()

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield
