"""Error against CPU time of first passes, joint and in sequence, by rank of the
dictionary.

    python -m benchmarks fit_curves CAPTURE [--plot curves.png]

The truth of the capture is in <folder>.truth.npz. Corrections are off and a tenth of the
lights is held out. CPU time is that of normals, R_d and the fit by the dictionary, after
compiling; errors are medians over fitted surfels after the second pass.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

import skindb
from benchmarks.truth import Truth, read_truth
from skindb.bench.curve import Curve, Point, cpu_time, plot_curves
from skindb.fit import FitParameters
from skindb.fit.model import first_pass, second_pass
from skindb.virtual.capture import recovered_against_true
from skindb.workflow import ingest_take

STAGES = ("sequential", "joint")
RANKS = (8, 16, 59)
ERRORS = {
    "angle between normals [degree]": lambda r: r["normal_median_deg"],
    "relative error of R_d, mean of the channels [%]": lambda r: np.mean(
        r["diffuse_median_percent"]
    ),
    "relative error at held-out lights [%]": lambda r: r["held_out_percent"],
}


def measure(capture: xr.DataTree, truth: Truth) -> list[tuple[Point, dict]]:
    """CPU time of every setting, and its errors."""
    rows = []
    with threadpool_limits(1):  # waiting threads of BLAS would count as CPU time
        for stages in STAGES:
            for rank in RANKS:
                parameters = FitParameters(
                    stages=stages,
                    rank=rank,
                    hold_out_lights=0.1,
                    light_gains=False,
                    inter_reflection=False,
                )
                work = partial(first_pass, capture, parameters)
                work()  # compiles
                seconds, first = cpu_time(work)
                model = second_pass(capture, first)
                errors = recovered_against_true(model, truth).summary()
                held = model.attrs["held_out_error"]["median"]
                point = Point(stages, f"rank {rank}", seconds, np.nan)
                rows.append((point, errors | {"held_out_percent": 100 * held}))
    return rows


def curves_of(rows: list[tuple[Point, dict]], name: str) -> list[Curve]:
    """One curve for each kind of error."""
    return [
        Curve(
            kernel="first pass",
            error_of=title,
            reference=f"the truth of {name}",
            seconds_of="the first pass of the capture",
            base="sequential, rank 16",
            points=[
                Point(p.method, p.parameter, p.seconds, float(error(errors)))
                for p, errors in rows
            ],
        )
        for title, error in ERRORS.items()
    ]


def main(
    capture: Path,
    *,
    spacing: float = 1.5,
    plot: Annotated[Path | None, "File for the plot."] = None,
) -> None:
    """Measure and print."""
    with TemporaryDirectory() as folder:
        db = skindb.open(folder)
        ingest_take(db, capture, spacing_mm=spacing)
        (take,) = db.takes("capture")
        rows = measure(db.read("capture", take).load(), read_truth(capture))
    curves = curves_of(rows, capture.name)
    columns = ("CPU time [s]", "relative", *ERRORS)
    print(f"| first pass | {' | '.join(columns)} |")
    print("|---" * (len(columns) + 1) + "|")
    for i, (point, _) in enumerate(rows):
        errors = " | ".join(f"{curve.points[i].error:.2f}" for curve in curves)
        ratio = curves[0].ratio(point)
        print(f"| {point.name} | {point.seconds:.1f} | {ratio:.2f} | {errors} |")
    if plot:
        plot_curves(curves, plot)
