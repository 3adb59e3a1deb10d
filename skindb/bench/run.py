"""One run of `skindb bench`: measures the curves, runs the stress set, writes
bench.json and one plot per kernel.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from skindb.bench.case import Case, failure_of
from skindb.bench.curve import Curve, plot_curves
from skindb.bench.diffusion import (
    PROBE,
    inverse_curves,
    probe_curves,
    require_mpmath,
    transport_curves,
)
from skindb.bench.light import (
    EXPOSURES,
    TABLES,
    disc_curves,
    exposures_curves,
    subsurface_curves,
)
from skindb.bench.optics_cases import OPTICS
from skindb.bench.photometry import ALBEDO, NORMAL, albedo_curves, normals_curves
from skindb.bench.population import (
    POPULATION,
    components_curves,
    permutations_curves,
    pyramid_curves,
    textures_curves,
)
from skindb.bench.solvers import SOLVERS, nmf_curves
from skindb.bench.surface import refit_curves, surface_curves
from skindb.bench.surface_cases import SURFACE
from skindb.files import make_private, private_file
from skindb.schema.plain import plain
from skindb.types import Progress

CURVES: dict[str, Callable[[bool], list[Curve]]] = {
    "surface": surface_curves,
    "refit": refit_curves,
    "normals": normals_curves,
    "albedo": albedo_curves,
    "nmf": nmf_curves,
    "probe": probe_curves,
    "transport": transport_curves,
    "inverse": inverse_curves,
    "subsurface": subsurface_curves,
    "disc": disc_curves,
    "exposures": exposures_curves,
    "pyramid": pyramid_curves,
    "textures": textures_curves,
    "components": components_curves,
    "permutations": permutations_curves,
}
CASES: tuple[Case, ...] = (
    *SOLVERS,
    *SURFACE,
    *NORMAL,
    *ALBEDO,
    *PROBE,
    *OPTICS,
    *TABLES,
    *EXPOSURES,
    *POPULATION,
)


def run_bench(
    out: Path,
    *,
    only: Sequence[str] = (),
    quick: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure every kernel, or those of `only`, and run the stress set on them.

    Parameters
    ----------
    out
        Folder for bench.json and one PNG per kernel; created if it does not exist.
    only
        Kernels of `skindb.bench.KERNELS`; empty for all.
    quick
        Smaller problems and fewer settings; these numbers are not for publication.
    progress
        Called with the stage, the steps done and the steps in all.

    Returns
    -------
    dict
        Content of bench.json: `points` (kernel, method, parameter, CPU time and its
        unit of work, its ratio to `ratio_to`, error and its definition, reference,
        failure), `stress` (kernel, name, promise, failure) and `failures` (one line for
        each unsuitable method and each broken promise).
    """
    kernels = [kernel for kernel in CURVES if kernel in only or not only]
    if "inverse" in kernels:
        require_mpmath()  # fails before the work begins
    make_private(out)
    report = progress or (lambda *_: None)
    begin = time.perf_counter()
    points = []
    seconds = {}
    with threadpool_limits(1):  # waiting threads of BLAS would count as CPU time
        for i, kernel in enumerate(kernels):
            report(f"curves: {kernel}", i, len(kernels))
            since = time.perf_counter()
            curves = CURVES[kernel](quick)
            plot_curves(curves, out / f"{kernel}.png")
            points += [_flat(curve) for curve in curves]
            seconds[kernel] = round(time.perf_counter() - since, 1)
        report("curves", len(kernels), len(kernels))
        stress = _stress(kernels, report)
    flat = [point for curve in points for point in curve]
    result = {
        "quick": quick,
        "software": {
            name: version(name)
            for name in ("skindb", "numpy", "numba", "scipy", "scikit-learn")
        },
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
        "seconds": seconds | {"all": round(time.perf_counter() - begin, 1)},
        "points": flat,
        "stress": stress,
        "failures": _failures(flat, stress),
        "broken": sum(bool(case["failure"]) for case in stress),
    }
    private_file(out / "bench.json").write_text(
        json.dumps(plain(result), indent=1, allow_nan=False), encoding="utf-8"
    )
    return result


def _flat(curve: Curve) -> list[dict[str, Any]]:
    shared = {
        "kernel": curve.kernel,
        "error_of": curve.error_of,
        "reference": curve.reference,
    }
    shared |= {"seconds_of": curve.seconds_of, "ratio_to": curve.base}
    return [
        shared
        | {
            "method": p.method,
            "parameter": p.parameter,
            "seconds": p.seconds,
            "ratio": curve.ratio(p),
        }
        | {"error": p.error, "failure": p.failure, "more": p.more}
        for p in curve.points
    ]


def _stress(kernels: Sequence[str], report: Progress) -> list[dict[str, str]]:
    chosen = [case for case in CASES if case.kernel in kernels]
    results = []
    for i, case in enumerate(chosen):
        report("stress set", i, len(chosen))
        result = {"kernel": case.kernel, "name": case.name, "promise": case.promise}
        results.append(result | {"failure": failure_of(case)})
    report("stress set", len(chosen), len(chosen))
    return results


def _failures(
    points: Sequence[dict[str, Any]], stress: Sequence[dict[str, str]]
) -> list[str]:
    lines = {
        f"{p['kernel']}: {p['method']}, {p['parameter']}: {p['failure']}": None
        for p in points
        if p["failure"]
    }
    broken = [
        f"{c['kernel']}: {c['name']}: broken: {c['promise']} {c['failure']}"
        for c in stress
        if c["failure"]
    ]
    return [*(line.replace(", : ", ": ") for line in lines), *broken]


def table_of(result: dict[str, Any]) -> list[list[Any]]:
    """Header and rows: kernel, method, setting, relative CPU time, CPU time, error, and
    its definition.
    """
    rows: list[list[Any]] = [
        [
            "kernel",
            "method",
            "setting",
            "relative time",
            "CPU time [s]",
            "error",
            "error of",
        ]
    ]
    for p in result["points"]:
        ratio = "1 (base)" if p["ratio"] == 1 else float(p["ratio"])
        rows.append(
            [
                p["kernel"],
                p["method"],
                p["parameter"] or "-",
                ratio,
                p["seconds"],
                p["error"],
                p["error_of"],
            ]
        )
    return rows
