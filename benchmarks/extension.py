"""Prototype of kernels as a C++ extension: rows of 24 columns and their products, by Numba
and by C++ for several processors: time to compile, time of a surfel, difference.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np

from skindb.reflectance import _mixture_kernels, _row_kernels
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.reduction import reduced_dictionary

SOURCE = Path(__file__).with_suffix(".cpp")
WIDTH = 24  # rank 16 and eight lobes
# a wheel for every processor, for those since about 2013 and 2017, and this processor
TARGETS = ("x86-64", "x86-64-v3", "x86-64-v4", "native")
FLAGS = ("-O3", "-std=c++17", "-shared", "-fPIC", "-ffast-math")


@nb.njit(nogil=True)  # type: ignore[untyped-decorator]  # not cached: its compilation is timed
def by_numba(
    table: Any, normal: Any, to_light: Any, to_camera: Any, usable: Any, rows: Any
) -> Any:
    """Products (n, 24, 24) of the rows of every surfel."""
    lights, cameras = to_light.shape[1], to_camera.shape[1]
    memory = _row_kernels.row_memory(lights, cameras)
    gloss = np.empty((0, cameras), np.float32)
    index = np.empty((lights * cameras, 2), np.int32)
    ones = np.ones(lights * cameras, np.float32)
    block = np.empty((9, 8), np.float32)
    out = np.empty((normal.shape[0], rows.shape[1], rows.shape[1]))
    right = np.empty(rows.shape[1])
    for s in range(normal.shape[0]):
        count = _row_kernels.list_rows(
            normal[s], to_light[s], to_camera[s], usable[s], gloss, memory, index
        )
        _row_kernels.interpolate_rows(table, normal[s], count, memory.way, memory, rows)
        _mixture_kernels.gram(rows, count, ones, ones, out[s], right, block)
    return out


def main(
    surfels: int = 4000, *, lights: int = 150, cameras: int = 16, repeats: int = 5
) -> int:
    """Print a line for each way to compile the kernels."""
    compiler = shutil.which("g++")
    if compiler is None:
        print("this benchmark needs g++; install a C++ compiler")
        return 1
    table = np.ascontiguousarray(
        reduced_dictionary(embedded_dictionary(), 16)[0], np.float32
    )
    inputs = _directions(surfels, lights, cameras)
    rows = np.empty((lights * cameras, WIDTH), np.float32)
    begin = time.process_time()
    by_numba(table, *(a[:1] for a in inputs), rows)
    compiled = time.process_time() - begin
    seconds, expected = _fastest(lambda: by_numba(table, *inputs, rows), repeats)
    print(f"{'way':<16}{'compile [s]':>12}{'surfel [us]':>12}{'difference':>12}")
    _print_row("Numba", compiled, seconds / surfels, 0.0)
    for target in TARGETS:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "extension.so"
            begin = time.perf_counter()
            subprocess.run(
                [compiler, *FLAGS, f"-march={target}", str(SOURCE), "-o", str(library)],
                check=True,
            )
            compiled = time.perf_counter() - begin
            function = ctypes.CDLL(str(library)).rows_and_products
        out = np.empty_like(expected)
        right = np.empty((surfels, WIDTH))
        arguments = [
            *(a.ctypes.data_as(ctypes.c_void_p) for a in (table, _shape(table))),
            *map(ctypes.c_int, (surfels, lights, cameras)),
            *(a.ctypes.data_as(ctypes.c_void_p) for a in (*inputs, rows, out, right)),
            ctypes.c_int(1),
        ]
        seconds, _ = _fastest(lambda f=function, a=arguments: f(*a), repeats)
        difference = float(np.abs(out - expected).max() / np.abs(expected).max())
        _print_row(f"C++ {target}", compiled, seconds / surfels, difference)
    return 0


def _directions(surfels: int, lights: int, cameras: int) -> tuple[np.ndarray, ...]:
    """Normals, directions to lights and cameras, and usable samples of surfels in spatial order."""
    rng = np.random.default_rng(3)
    turn = np.linspace(-1.2, 1.2, surfels)
    normal = np.stack([np.sin(turn), 0.2 * np.sin(7 * turn), np.cos(turn)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    parts = []
    for count in (lights, cameras):
        away = rng.normal(size=(count, 3))
        away[:, 2] = np.abs(away[:, 2])
        moved = away + 0.02 * turn[:, None, None]
        parts.append(moved / np.linalg.norm(moved, axis=-1, keepdims=True))
    usable = rng.random((surfels, lights, cameras)) < 0.8
    return normal, parts[0], parts[1], usable


def _shape(table: np.ndarray) -> np.ndarray:
    return np.array(table.shape, np.int32)


def _fastest(call: Any, repeats: int) -> tuple[float, Any]:
    """Shortest CPU time of several calls, and the last result."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        result = call()
        times.append(time.process_time() - begin)
    return min(times), result


def _print_row(way: str, compiled: float, surfel: float, difference: float) -> None:
    print(f"{way:<16}{compiled:12.2f}{1e6 * surfel:12.1f}{difference:12.1e}")
