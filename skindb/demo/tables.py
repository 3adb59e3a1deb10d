"""Results of the demo, and their tables with all columns, of which the page shows some."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from skindb.analysis.studies import tabulate_study
from skindb.demo.page import Table
from skindb.render.photographs import Comparison
from skindb.schema import FitStatus, variables
from skindb.virtual.capture import Recovery

PER_TAKE = ("models", "fits", "recovered", "compared")
ERROR_COLUMNS = ("relative_rmse", "psnr", "ssim", "delta_e_median")
SUBJECT_HEADER = (
    "take",
    "age",
    "gender",
    "ancestry",
    "condition",
    "surfels",
    "fitted_surfels",
    "fitted_percent",
    "normal_median_deg",
    "normal_95_deg",
    "diffuse_red_percent",
    "diffuse_green_percent",
    "diffuse_blue_percent",
    "held_out_percent",
)


@dataclass
class Results:
    """Models, errors, studies, edits and run times of a demo."""

    models: dict[str, xr.DataTree] = field(default_factory=dict)
    fits: dict[str, dict[str, Any]] = field(default_factory=dict)
    recovered: dict[str, Recovery] = field(default_factory=dict)
    compared: dict[str, list[Comparison]] = field(default_factory=dict)
    studies: dict[str, xr.DataTree] = field(default_factory=dict)
    edits: dict[float, xr.DataTree] = field(default_factory=dict)
    edited_take: str = ""
    target_take: str = ""  # the measured take that the edit at amount 1 should match
    seconds: dict[str, float] = field(default_factory=dict)
    began: float = field(default_factory=time.monotonic)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the time of a stage and add it to `seconds`."""
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start

    def sort_takes(self, takes: Sequence[str]) -> None:
        """Sort the takes, which processes may have finished in any order, into the given order."""
        for name in PER_TAKE:
            found = getattr(self, name)
            setattr(self, name, {take: found[take] for take in takes if take in found})

    def add(self, other: Results) -> None:
        """Add the results of another process."""
        for name in PER_TAKE:
            getattr(self, name).update(getattr(other, name))
        for name, seconds in other.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def status_counts(model: xr.DataTree) -> dict[FitStatus, int]:
    """Number of surfels with each status, including zeros."""
    counts = np.bincount(
        model["fitted"].to_dataset()[variables.FIT_STATUS].values,
        minlength=len(FitStatus),
    )
    return {status: int(counts[status]) for status in FitStatus}


def subject_table(results: Results) -> Table:
    """One row per take: attributes, number of fitted surfels, and median errors against
    the truth.
    """
    rows = []
    for take, model in results.models.items():
        counts = status_counts(model)
        traits = dict(model.attrs.get("traits", {}))
        total = sum(counts.values())
        attributes = [traits.get(name, "") for name in ("age", "gender", "ancestry")]
        fitted = [
            total,
            counts[FitStatus.FITTED],
            100 * counts[FitStatus.FITTED] / total,
        ]
        errors_of_take: Any = results.recovered[take].summary()
        errors = [
            errors_of_take["normal_median_deg"],
            errors_of_take["normal_95_deg"],
            *errors_of_take["diffuse_median_percent"],
        ]
        held = 100 * results.fits[take].get("held_out_error", {}).get(
            "median", float("nan")
        )
        rows.append(
            [
                take,
                *attributes,
                model.attrs.get("condition", "normal"),
                *fitted,
                *errors,
                held,
            ]
        )
    return Table("subjects", SUBJECT_HEADER, rows)


def status_table(results: Results) -> Table:
    """Number of surfels by take and status."""
    counted = {take: status_counts(model) for take, model in results.models.items()}
    rows = [
        [
            take,
            status.name.lower(),
            count,
            100 * count / sum(counts.values()),
            status.explanation,
        ]
        for take, counts in counted.items()
        for status, count in counts.items()
    ]
    return Table(
        "surfel_statuses", ["take", "status", "surfels", "percent", "explanation"], rows
    )


def status_sums(results: Results) -> Table:
    """Number of surfels of all takes by status, for statuses that occur."""
    counted = [status_counts(model) for model in results.models.values()]
    sums = {status: sum(counts[status] for counts in counted) for status in FitStatus}
    total = sum(sums.values())
    rows = [
        [
            status.name.lower().replace("_", " "),
            status.explanation,
            count,
            100 * count / total,
        ]
        for status, count in sums.items()
        if count
    ]
    return Table("surfel_statuses", ["status", "meaning", "surfels", "%"], rows)


def photograph_table(results: Results) -> Table:
    """Errors of the predicted photographs."""
    rows = [
        [
            take,
            comparison.light,
            comparison.camera,
            "yes" if comparison.held_out else "no",
            *(comparison.error[name] for name in ERROR_COLUMNS),
        ]
        for take, comparisons in results.compared.items()
        for comparison in comparisons
    ]
    return Table(
        "photographs", ["take", "light", "camera", "held_out", *ERROR_COLUMNS], rows
    )


def site_table(results: Results) -> Table:
    """Relative error of sigma_tr [%] at each probe site."""
    rows = []
    for take, recovery in results.recovered.items():
        summary: Any = recovery.summary()
        rows += [
            [take, site, *map(float, values)]
            for site, values in summary["sigma_tr_percent"].items()
        ]
    header = ["take", "site", "red_percent", "green_percent", "blue_percent"]
    return Table("sigma_tr_errors", header, rows)


def study_table(name: str, study: xr.DataTree) -> Table:
    """Table of a population study."""
    return Table(name, *tabulate_study(study))


def time_tables(results: Results) -> tuple[Table, Table]:
    """Wall time [s] of the stages of the demo, and of the stages of a fit as mean over takes."""
    stages: dict[str, list[float]] = {}
    for fit in results.fits.values():
        for name, seconds in fit["seconds"].items():
            stages.setdefault(name, []).append(seconds)
    demo = [
        [name, seconds] for name, seconds in results.seconds.items() if name != "report"
    ]
    inside = [[name, float(np.mean(values))] for name, values in stages.items()]
    return Table("times_demo", ["stage", "seconds"], demo), Table(
        "times_fit", ["stage", "seconds"], inside
    )
