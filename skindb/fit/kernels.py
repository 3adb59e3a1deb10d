"""Compilation of the largest kernels of fits, in several processes after an installation."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed

import numpy as np

from skindb.elementwise import thread_count
from skindb.fit.model import COMPILING
from skindb.fit.normals import surfel_normals
from skindb.jit import is_stored
from skindb.reflectance._block_kernels import fit_block
from skindb.reflectance._ggx_kernels import fit_ggx
from skindb.reflectance._joint_kernels import fit_jointly
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.ggx import GGX
from skindb.reflectance.joint import refine_block
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Block, Comparison
from skindb.reflectance.separation import separate_diffuse
from skindb.types import Progress, silent

# in the order in which they are shared among processes, for similar times of two
STEPS = ("mixture", "joint", "normals", "diffuse", "ggx")


def compile_kernels(progress: Progress = silent) -> None:
    """Compile the kernels that fits spend the most time to compile, where they are not
    stored yet; the others are compiled at their first use.
    """
    kernels = (fit_jointly, fit_block, fit_ggx)
    if all(is_stored(kernel) for kernel in kernels):
        return
    # each starts in two seconds, and compiles once what several of its steps use
    count = min(thread_count(), len(STEPS))
    progress(COMPILING, 0, count)
    with ThreadPoolExecutor(count) as pool:
        calls = [pool.submit(_compile_apart, STEPS[i::count]) for i in range(count)]
        try:
            for done, call in enumerate(as_completed(calls), 1):
                call.result()
                progress(COMPILING, done, count)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _compile_apart(steps: tuple[str, ...]) -> None:
    # what the compiler makes are millions of objects that stay
    call = (
        f"import gc; gc.disable(); from {__name__} import compile_step; "
        f"[compile_step(step) for step in {steps!r}]"
    )
    # what fails here fails in the fit too, which reports it
    subprocess.run([sys.executable, "-c", call], check=False, capture_output=True)


def compile_step(step: str) -> None:
    """Compile the kernels of one of the STEPS, by a fit of no surfels."""
    none = np.zeros((0, 3))
    one = np.zeros((1, 3))
    sample = np.zeros((0, 1, 1, 3), np.float16)
    block = Block(sample, none, one, one, none, none)
    comparison = Comparison()
    match step:
        case "joint":
            refine_block(block, comparison, scan_normal=none, scan_error=1.0)
        case "diffuse":
            separate_diffuse(block, np.zeros((0, 2)), eta=1.3)
        case "mixture":
            Mixture(embedded_dictionary().table).fit(block, comparison)
        case "ggx":
            GGX().fit(block, comparison)
        case "normals":
            surfel_normals(*block[:4], none, eta=1.3, scan_error=3.0)
