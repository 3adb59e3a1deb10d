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
from skindb.reflectance.ggx import GGX
from skindb.reflectance.joint import refine_block
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Block, Comparison, FitRequest
from skindb.reflectance.separation import separate_diffuse
from skindb.types import Progress, silent

STEPS = ("mixture", "joint", "diffuse", "normals", "ggx")  # the longest first


def compile_kernels(progress: Progress = silent) -> None:
    """Compile the kernels that fits spend the most time to compile, where they are not
    stored yet; the others are compiled at their first use.
    """
    kernels = (fit_jointly, fit_block, fit_ggx)
    if all(is_stored(kernel) for kernel in kernels):
        return
    progress(COMPILING, 0, len(STEPS))
    with ThreadPoolExecutor(thread_count()) as pool:
        calls = [pool.submit(_compile_apart, step) for step in STEPS]
        try:
            for done, call in enumerate(as_completed(calls), 1):
                call.result()
                progress(COMPILING, done, len(STEPS))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _compile_apart(step: str) -> None:
    # what the compiler makes are millions of objects that stay
    call = f"import gc; gc.disable(); from {__name__} import compile_step; compile_step({step!r})"
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
        case "mixture" | "ggx":
            kind = Mixture if step == "mixture" else GGX
            model = kind.unfitted(FitRequest(1.3, 0.0, 16, 4))
            model.fit(block, comparison)
        case "normals":
            surfel_normals(*block[:4], none, eta=1.3, scan_error=3.0)
