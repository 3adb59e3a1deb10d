"""Kernels, and what their callers link: Numba compiles both in one way, which triples its time.

Code that is called from Python needs conversions of its arguments, which for records of
arrays are longer than most kernels, and machine code. What other kernels call needs
neither, because LLVM compiles it again as a part of each caller.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite.binding import Linkage
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher

from skindb.kernel_cache import KernelFiles


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """A compiled function: other kernels link it, and Python calls its `entry`."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        linked = options | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        super().__init__(function, targetoptions=linked, pipeline_class=LinkedCompiler)
        self.entry = Entry(
            function,
            targetoptions=options | {"no_cfunc_wrapper": True},
            pipeline_class=EntryCompiler,
        )
        for dispatcher in (self, self.entry):
            dispatcher.enable_caching()
            dispatcher.files = KernelFiles(dispatcher)
            dispatcher._cache._cache_file = dispatcher.files

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Call the kernel from Python."""
        return self.entry(*args, **options)

    def add_overload(self, cres: Any) -> None:
        """Make a signature available to other kernels."""
        if cres.entry_point is None:  # by which Numba finds the code of a function
            cres = cres._replace(entry_point=cres.library)
            self.targetctx.insert_user_function(
                cres.entry_point, cres.fndesc, [cres.library]
            )
        self.overloads[tuple(cres.signature.args)] = cres


class Entry(CPUDispatcher):  # type: ignore[misc]
    """A kernel as Python calls it."""

    def add_overload(self, cres: Any) -> None:
        """Make a signature callable, and constants of the kernels that it contains available."""
        for environment in cres._find_referenced_environments():
            cres.library.codegen.set_env(environment.env_name, environment)
        super().add_overload(cres)


class EntryCompiler(Compiler):  # type: ignore[misc]
    """Compiles to machine code that contains all kernels which it calls."""

    def __init__(
        self, typing: Any, target: Any, _library: Any, args: Any, *more: Any
    ) -> None:
        library = EntryLibrary(target.codegen(), "entry")
        library.enable_object_caching()
        super().__init__(typing, target, library, args, *more)


class EntryLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Machine code of one entry.

    The kernels in it are its own. Otherwise LLVM would call the copy of another entry that
    was loaded before, which may be inlined and rounded in another way.
    """

    def _optimize_final_module(self) -> None:
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.linkonce_odr:
                function.linkage = Linkage.internal
        super()._optimize_final_module()


class LinkedCompiler(Compiler):  # type: ignore[misc]
    """Compiles to code of LLVM instead of machine code."""

    def __init__(
        self, typing: Any, target: Any, _library: Any, args: Any, *more: Any
    ) -> None:
        library = LinkedLibrary(target.codegen(), "linked")
        super().__init__(typing, target, library, args, *more)
        self.state.flags.no_compile = True


class LinkedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code of LLVM that becomes a part of others, and is optimised there."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    # stored without machine code
    serialize_using_object_code = JITCodeLibrary.serialize_using_bitcode
