"""Work-precision curves: their records, the measurement of CPU time, and plots."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from skindb.files import private_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes


T = TypeVar("T")
# number of rounds, of which the best counts; no further round after this time [s]
ROUNDS = 3
LONG = 2.0
EXACT = 1e-17  # position of errors of zero


@dataclass(frozen=True)
class Point:
    """One method at one setting."""

    method: str
    parameter: str
    seconds: float  # CPU time of all threads; NaN where the time is not comparable
    error: float
    failure: str = ""  # reason why the method is unsuitable, if it is

    @property
    def name(self) -> str:
        """Method and setting."""
        return f"{self.method}, {self.parameter}" if self.parameter else self.method

    @property
    def label(self) -> str:
        """Method, and whether it fails."""
        return f"{self.method} (fails)" if self.failure else self.method


@dataclass(frozen=True)
class Curve:
    """Points of one kernel with comparable errors and CPU times."""

    kernel: str
    error_of: str
    reference: str
    seconds_of: str
    base: str  # name of the point to whose CPU time the others are compared
    points: Sequence[Point]

    @property
    def base_seconds(self) -> float:
        """CPU time of the base [s]."""
        return next(p.seconds for p in self.points if p.name == self.base)

    def ratio(self, point: Point) -> float:
        """CPU time of a point over that of the base; below 1 is faster."""
        return point.seconds / self.base_seconds


def cpu_time(work: Callable[[], T], per: float = 1.0) -> tuple[float, T]:
    """CPU time [s] divided by `per`, the best of up to three rounds, and the result;
    warm up before.
    """
    times: list[float] = []
    while len(times) < ROUNDS and sum(times) < LONG:
        start = time.process_time()
        result = work()
        times.append(time.process_time() - start)
    return min(times) / per, result


def plot_curves(curves: Sequence[Curve], path: Path) -> None:
    """Write one panel per curve, side by side, to a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5 * len(curves), 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(curves), squeeze=False)[0]
    for ax, curve in zip(axes, curves, strict=True):
        plot_curve(curve, ax=ax)
    figure.savefig(private_file(path), dpi=100)


def plot_curve(curve: Curve, *, ax: Axes) -> Axes:
    """Plot error against CPU time; unsuitable methods are crosses, and those without a
    time horizontal lines.
    """
    ax.set(xscale="log", yscale="log")
    for i, method in enumerate(dict.fromkeys(p.method for p in curve.points)):
        points = [p for p in curve.points if p.method == method]
        _plot_method(ax, [p for p in points if np.isfinite(p.error)], i)
    top = f"top axis relative to {curve.base}"
    ax.set_xlabel(f"CPU time for {curve.seconds_of} [s]; {top}", fontsize=8)
    ax.set_ylabel(fill(curve.error_of, 60), fontsize=8)
    title = f"{curve.kernel}, compared with {curve.reference}"
    ax.set_title(fill(title, 80), fontsize=9)
    base = curve.base_seconds
    ax.secondary_xaxis(
        "top", functions=(partial(np.multiply, 1 / base), partial(np.multiply, base))
    )
    ax.grid(visible=True, which="both", alpha=0.2)
    ax.margins(x=0.15)  # space for the names of the settings
    ax.legend(fontsize=7)
    return ax


def _plot_method(ax: Axes, points: Sequence[Point], number: int) -> None:
    colour = f"C{number}"
    timed = [p for p in points if np.isfinite(p.seconds)]
    for p in points:
        y = max(p.error, EXACT)
        if p in timed:
            ax.annotate(p.parameter, (p.seconds, y), fontsize=6)
        else:
            ax.axhline(y, color=colour, ls=":", lw=1, label=p.label)
    if timed:
        x = [p.seconds for p in timed]
        errors = [max(p.error, EXACT) for p in timed]
        marker = "x" if all(p.failure for p in timed) else "o"
        ax.plot(x, errors, marker=marker, lw=0.4, color=colour, label=timed[0].label)
