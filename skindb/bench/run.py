"""One run of `skindb bench`: measures the curves, writes bench.json and one plot per
kernel.
"""

import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from skindb.bench.curve import Curve, plot_curves
from skindb.bench.photometry import albedo_curves, exposures_curves, normals_curves
from skindb.bench.population import (
    pyramid_curves,
    textures_curves,
)
from skindb.bench.subsurface import (
    inverse_curves,
    probe_curves,
    require_mpmath,
    subsurface_curves,
)
from skindb.bench.surface import nmf_curves, refit_curves, surface_curves
from skindb.files import make_private, plain, private_file
from skindb.types import Progress

Curves = Callable[[bool], list[Curve]]
CURVES: dict[str, Curves] = {
    "surface": surface_curves,
    "refit": refit_curves,
    "normals": normals_curves,
    "albedo": albedo_curves,
    "nmf": nmf_curves,
    "probe": probe_curves,
    "inverse": inverse_curves,
    "subsurface": subsurface_curves,
    "exposures": exposures_curves,
    "pyramid": pyramid_curves,
    "textures": textures_curves,
}
MAX_REASON = 300  # characters


def run_bench(
    out: Path,
    *,
    only: Sequence[str] = (),
    curves: Mapping[str, Curves] = CURVES,
    quick: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure every kernel, or those of `only`.

    Parameters
    ----------
    out
        Folder for bench.json and one PNG per kernel; created if it does not exist.
    only
        Kernels to measure; empty for all.
    curves
        Function that measures the curves of each kernel; by default those of
        `skindb.bench.KERNELS`.
    quick
        Smaller problems and fewer settings; these numbers are not for publication.
    progress
        Called with the stage, the steps done and the steps in all.

    Returns
    -------
    dict
        Content of bench.json: `points` (kernel, method, parameter, CPU time and its
        unit of work, its ratio to `ratio_to`, error and its definition, reference,
        failure), `errors` (the reason for every kernel that stopped with an error) and
        `failures` (one line for each unsuitable method and each error).
    """
    kernels = [kernel for kernel in curves if kernel in only or not only]
    if "inverse" in kernels:
        require_mpmath()  # fails before the work begins
    make_private(out)
    report = progress or (lambda *_: None)
    begin = time.perf_counter()
    points: list[dict[str, Any]] = []
    seconds = {}
    errors = {}
    with threadpool_limits(1):  # waiting threads of BLAS would count as CPU time
        for i, kernel in enumerate(kernels):
            report(f"curves: {kernel}", i, len(kernels))
            since = time.perf_counter()
            try:
                measured = curves[kernel](quick)
                plot_curves(measured, out / f"{kernel}.png")
                points += [row for curve in measured for row in _rows(curve)]
            # the other kernels are measured, and the error is reported
            except Exception as error:  # noqa: BLE001
                errors[kernel] = _reason(error)
            seconds[kernel] = round(time.perf_counter() - since, 1)
        report("curves", len(kernels), len(kernels))
    packages = ("skindb", "numpy", "numba", "scipy", "scikit-learn")
    result = {
        "quick": quick,
        "software": {name: version(name) for name in packages},
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
        "seconds": seconds | {"all": round(time.perf_counter() - begin, 1)},
        "points": points,
        "errors": errors,
        "failures": _failures(points, errors),
    }
    private_file(out / "bench.json").write_text(
        json.dumps(plain(result), indent=1, allow_nan=False), encoding="utf-8"
    )
    return result


def _rows(curve: Curve) -> list[dict[str, Any]]:
    """The points of a curve as they stand in bench.json."""
    shared = {
        "kernel": curve.kernel,
        "error_of": curve.error_of,
        "reference": curve.reference,
        "seconds_of": curve.seconds_of,
        "ratio_to": curve.base,
    }
    return [shared | vars(p) | {"ratio": curve.ratio(p)} for p in curve.points]


def _reason(error: Exception) -> str:
    """Type and message of an error in one line."""
    message = " ".join(str(error).split()) or "no message"
    return f"{type(error).__name__}: {message[:MAX_REASON]}"


def _failures(points: Sequence[dict[str, Any]], errors: dict[str, str]) -> list[str]:
    lines = []
    for p in points:
        if p["failure"]:
            name = ", ".join(filter(None, (p["method"], p["parameter"])))
            lines.append(f"{p['kernel']}: {name}: {p['failure']}")
    lines += [f"{kernel}: {reason}" for kernel, reason in errors.items()]
    return list(dict.fromkeys(lines))


def table_of(result: dict[str, Any]) -> list[list[Any]]:
    """Header and rows: kernel, method, setting, relative CPU time, CPU time, error, and
    its definition.
    """
    header = "kernel,method,setting,relative time,CPU time [s],error,error of"
    rows: list[list[Any]] = [header.split(",")]
    for p in result["points"]:
        ratio = "1 (base)" if p["ratio"] == 1 else float(p["ratio"])
        method = [p["kernel"], p["method"], p["parameter"] or "-"]
        rows.append([*method, ratio, p["seconds"], p["error"], p["error_of"]])
    return rows
