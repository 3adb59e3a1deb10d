"""Curves of error against CPU time of every kernel, with methods that fail and the reason.

    python -m benchmarks curves [KERNEL ...] [--out curves] [--quick]

Writes curves.json, which has every point and every failure with its reason, and one plot for
each kernel. If a kernel stops with an error, the others are measured all the same, and the exit
status is 1.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

from threadpoolctl import threadpool_limits

from benchmarks.curve import Curve, plot_curves
from benchmarks.curves_internal import (
    components_curves,
    disc_curves,
    permutations_curves,
    transport_curves,
)
from benchmarks.curves_photometry import (
    albedo_curves,
    exposures_curves,
    normals_curves,
)
from benchmarks.curves_population import pyramid_curves, textures_curves
from benchmarks.curves_subsurface import (
    inverse_curves,
    probe_curves,
    subsurface_curves,
)
from benchmarks.curves_surface import nmf_curves, refit_curves, surface_curves
from skindb.cli.shared import aligned
from skindb.files import plain

CURVES: dict[str, Callable[[bool], list[Curve]]] = {
    "surface": surface_curves,
    "refit": refit_curves,
    "disc": disc_curves,
    "normals": normals_curves,
    "albedo": albedo_curves,
    "nmf": nmf_curves,
    "probe": probe_curves,
    "inverse": inverse_curves,
    "transport": transport_curves,
    "subsurface": subsurface_curves,
    "exposures": exposures_curves,
    "pyramid": pyramid_curves,
    "textures": textures_curves,
    "components": components_curves,
    "permutations": permutations_curves,
}
PACKAGES = ("skindb", "numpy", "numba", "scipy", "scikit-learn")


def rows_of(curve: Curve) -> list[dict[str, Any]]:
    """The points of a curve as they stand in curves.json."""
    shared = {
        "kernel": curve.kernel,
        "error_of": curve.error_of,
        "reference": curve.reference,
        "seconds_of": curve.seconds_of,
        "ratio_to": curve.base,
    }
    return [shared | vars(p) | {"ratio": curve.ratio(p)} for p in curve.points]


def table_of(points: Sequence[dict[str, Any]]) -> list[list[Any]]:
    """Header and rows: kernel, method, setting, relative CPU time, CPU time, error, and
    its definition.
    """
    header = "kernel,method,setting,relative time,CPU time [s],error,error of"
    rows: list[list[Any]] = [header.split(",")]
    for p in points:
        ratio = "1 (base)" if p["ratio"] == 1 else float(p["ratio"])
        method = [p["kernel"], p["method"], p["parameter"] or "-"]
        rows.append([*method, ratio, p["seconds"], p["error"], p["error_of"]])
    return rows


def main(
    kernels: Annotated[Sequence[str], "Kernels to measure, by default all."] = (),
    *,
    out: Annotated[Path, "Folder for curves.json and the plots."] = Path("curves"),
    quick: Annotated[
        bool, "Smaller problems; these numbers are not for pages."
    ] = False,
) -> int:
    """Measure and print the curves of every kernel; 1 if one of them stopped."""
    unknown = sorted(set(kernels) - set(CURVES))
    if unknown:
        print(f"no kernel {', '.join(unknown)}; choose from {', '.join(CURVES)}")
        return 2
    out.mkdir(parents=True, exist_ok=True)
    points = []
    seconds = {}
    errors = {}
    with threadpool_limits(1):  # waiting threads of BLAS would count as CPU time
        for kernel in kernels or CURVES:
            start = time.perf_counter()
            try:
                curves = CURVES[kernel](quick)
                plot_curves(curves, out / f"{kernel}.png")
                points += [row for curve in curves for row in rows_of(curve)]
            # the other kernels are measured, and the error is reported
            except Exception as error:  # noqa: BLE001
                errors[kernel] = f"{type(error).__name__}: {error}"
            seconds[kernel] = round(time.perf_counter() - start, 1)
    result = {
        "quick": quick,
        "software": {name: version(name) for name in PACKAGES},
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
        "seconds": seconds,
        "points": points,
        "errors": errors,
    }
    text = json.dumps(plain(result), indent=1, allow_nan=False)
    (out / "curves.json").write_text(text, encoding="utf-8")
    print(*aligned(table_of(points)), "", sep="\n")
    for p in points:
        if p["failure"]:
            print(
                f"fails: {p['kernel']}: {p['method']}, {p['parameter']}: {p['failure']}"
            )
    for kernel, reason in errors.items():
        print(f"fails: {kernel}: {reason}")
    return int(bool(errors))
