"""The report of the demo: its results with their tables, and its sections on subjects,
populations, an edit and its distance from the data.
"""

from __future__ import annotations

import base64
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import xarray as xr
from pandas import DataFrame

from skindb import __version__
from skindb.analysis import plot_albedo, plot_basis_size, plot_translucency
from skindb.analysis.studies import tabulate_study
from skindb.demo.page import (
    Picture,
    Portraits,
    axes,
    draw_portraits,
    map_pictures,
    plot_png,
    portrait,
    predictions,
    reflectance_plot,
)
from skindb.files import csv_text, filled_template, private_file
from skindb.render.photographs import Comparison, compare_images
from skindb.schema import FitStatus, variables
from skindb.types import Progress
from skindb.virtual.capture import Recovery

PER_TAKE = ("models", "fits", "recovered", "compared")
ERROR_COLUMNS = ("relative_rmse", "psnr", "ssim", "delta_e_median")
CHANNELS = ("red_percent", "green_percent", "blue_percent")
# largest distance of an edit inside the data, in median distances between takes
INSIDE = 1.0
SHOWN = ["trait", "takes_with", "takes_without", "brdf_shift", "colour_shift"]
VIEWER = "viewer.html"  # beside the report
LEAST_PERCENT = 0.1  # smallest percentage that is written as a number


@dataclass
class Results:
    """Models, errors, studies and edits of a demo."""

    models: dict[str, xr.DataTree] = field(default_factory=dict)
    fits: dict[str, dict[str, Any]] = field(default_factory=dict)
    recovered: dict[str, Recovery] = field(default_factory=dict)
    compared: dict[str, list[Comparison]] = field(default_factory=dict)
    studies: dict[str, xr.DataTree] = field(default_factory=dict)
    edits: dict[float, xr.DataTree] = field(default_factory=dict)
    edited_take: str = ""
    target_take: str = ""  # the measured take that the edit at amount 1 should match
    began: float = field(default_factory=time.monotonic)

    def sort_takes(self, takes: Sequence[str]) -> None:
        """Sort the takes, which processes may have finished in any order, into the given order."""
        for name in PER_TAKE:
            results = getattr(self, name)
            setattr(
                self, name, {take: results[take] for take in takes if take in results}
            )

    def add(self, results: Results) -> None:
        """Add the results of another process."""
        for name in PER_TAKE:
            getattr(self, name).update(getattr(results, name))


def status_counts(model: xr.DataTree) -> dict[FitStatus, int]:
    """Number of surfels with each status, including zeros."""
    counts = np.bincount(
        model["fitted"].to_dataset()[variables.FIT_STATUS].values,
        minlength=len(FitStatus),
    )
    return {status: int(counts[status]) for status in FitStatus}


def subject_table(results: Results) -> DataFrame:
    """One row per take: attributes, number of fitted surfels, and median errors against
    the truth.
    """
    rows = []
    for take, model in results.models.items():
        counts = status_counts(model)
        total = sum(counts.values())
        traits = model.attrs.get("traits", {})
        errors: Any = results.recovered[take].summary()
        held_out = results.fits[take].get(variables.HELD_OUT_ERROR, {})
        diffuse = errors["diffuse_median_percent"]
        rows.append(
            {
                "take": take,
                **{
                    name: traits.get(name, "") for name in ("age", "gender", "ancestry")
                },
                "condition": model.attrs.get("condition", "normal"),
                "surfels": total,
                "fitted_surfels": counts[FitStatus.FITTED],
                "fitted_percent": 100 * counts[FitStatus.FITTED] / total,
                "normal_median_deg": errors["normal_median_deg"],
                "normal_95_deg": errors["normal_95_deg"],
                **{f"diffuse_{c}": x for c, x in zip(CHANNELS, diffuse, strict=True)},
                "held_out_percent": 100 * held_out.get("median", float("nan")),
            }
        )
    return DataFrame(rows)


def status_table(results: Results) -> DataFrame:
    """Number of surfels by take and status."""
    rows = []
    for take, model in results.models.items():
        counts = status_counts(model)
        for status, count in counts.items():
            name = status.name.lower()
            percent = 100 * count / sum(counts.values())
            rows.append((take, name, count, percent, status.explanation))
    return DataFrame(
        rows, columns=["take", "status", "surfels", "percent", "explanation"]
    )


def status_sums(statuses: DataFrame) -> DataFrame:
    """Number of surfels of all takes by status, for statuses that occur."""
    keys = ["status", "explanation"]
    sums = statuses.groupby(keys, sort=False, as_index=False)["surfels"].sum()
    sums = sums[sums["surfels"] > 0]
    return DataFrame(
        {
            "status": sums["status"].str.replace("_", " "),
            "meaning": sums["explanation"],
            "surfels": sums["surfels"],
            "%": 100 * sums["surfels"] / sums["surfels"].sum(),
        }
    )


def photograph_table(results: Results) -> DataFrame:
    """Errors of the predicted photographs."""
    rows = [
        {
            "take": take,
            "light": comparison.light,
            "camera": comparison.camera,
            "held_out": "yes" if comparison.held_out else "no",
            **{name: comparison.error[name] for name in ERROR_COLUMNS},
        }
        for take, comparisons in results.compared.items()
        for comparison in comparisons
    ]
    return DataFrame(rows)


def site_table(results: Results) -> DataFrame:
    """Relative error of sigma_tr [%] at each probe site."""
    rows = []
    for take, recovery in results.recovered.items():
        summary: Any = recovery.summary()
        for site, errors in summary["sigma_tr_percent"].items():
            rows.append((take, site, *map(float, errors)))
    return DataFrame(rows, columns=["take", "site", *CHANNELS])


def study_table(study: xr.DataTree) -> DataFrame:
    """Table of a population study."""
    header, rows = tabulate_study(study)
    return DataFrame(rows, columns=list(header), dtype=object)


def cell(value: Any) -> str:
    """The text of a value: floats with three significant digits, NaN as a dash, counts
    with commas.
    """
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        return f"{value:,}"
    if not isinstance(value, (float, np.floating)):
        return str(value)
    if np.isnan(value):
        return "-"
    return f"{value:.3g}" if -1000 < value < 1000 else f"{value:,.0f}"


def rows_of(frame: DataFrame) -> list[list[Any]]:
    """Rows of a table."""
    rows: list[list[Any]] = frame.to_dict("split")["data"]
    return rows


def csv_of(frame: DataFrame) -> bytes:
    """A table as CSV with all digits."""
    return csv_text([*frame], rows_of(frame)).encode()


def data_url(kind: str, data: bytes | bytearray) -> str:
    """Data as an address that contains them."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def image_url(image: Picture) -> str:
    """An sRGB picture (rows, cols, 3) as an address that contains it."""
    return data_url("image/png", imagecodecs.png_encode(np.ascontiguousarray(image)))


def write_report(path: Path, results: Results, *, progress: Progress) -> Path:
    """Write the report, which is viewed without a network, and return its path."""
    portraits = draw_portraits(results.models)
    content: dict[str, Any] = {
        "version": __version__,
        "viewer": VIEWER,
        "minutes": (time.monotonic() - results.began) / 60,
    }
    sections = (_subjects, _photographs, _recovered, _population, _edit)
    for i, section in enumerate(sections):
        progress("report", i, len(sections))
        content |= section(results, portraits)
    functions = (cell, rows_of, csv_of, data_url, image_url)
    content |= {function.__name__: function for function in functions}
    page = filled_template("skindb.demo", "report.html.jinja", **content)
    private_file(path).write_text(page, encoding="utf-8")
    progress("report", len(sections), len(sections))
    return path


def _subjects(results: Results, portraits: Portraits) -> dict[str, Any]:
    subjects = subject_table(results)
    statuses = status_table(results)
    drawn = portraits.cut(portraits.images)
    maps = map_pictures(results.models)
    shown = {
        take: min(compared, key=lambda comparison: not comparison.held_out)
        for take, compared in results.compared.items()
        if compared
    }
    exposure = min((c.error["exposure"] for c in shown.values()), default=1.0)
    strips = dict(zip(shown, predictions([*shown.values()], exposure), strict=True))
    takes = []
    for record in subjects.to_dict("records"):
        take = record["take"]
        who = [record[name] for name in ("age", "gender", "ancestry", "condition")]
        takes.append(
            {
                **record,
                "who": ", ".join(str(x) for x in who if x != "").replace("_", " "),
                "not_fitted": _reasons(statuses[statuses["take"] == take]),
                "portrait": drawn[take],
                "small": drawn[take][::2, ::2],
                "maps": maps[take],
                "prediction": shown.get(take),
                "strip": strips.get(take),
            }
        )
    return {
        "takes": takes,
        "subjects": subjects,
        "statuses": statuses,
        "status_sums": status_sums(statuses),
    }


def _reasons(statuses: DataFrame) -> str:
    """Statuses of surfels of one take without a fit, the most frequent first."""
    chosen = (statuses["surfels"] > 0) & (statuses["status"] != "fitted")
    texts = []
    for _, row in statuses[chosen].sort_values("surfels", ascending=False).iterrows():
        percent = f"below {LEAST_PERCENT}"
        if row["percent"] >= LEAST_PERCENT:
            percent = f"{row['percent']:.1f}"
        texts.append(f"{row['status'].replace('_', ' ')} {percent} %")
    return ", ".join(texts) or "none"


def _photographs(results: Results, _: Portraits) -> dict[str, Any]:
    photographs = photograph_table(results)
    held = photographs[photographs["held_out"] == "yes"]
    names = ["relative_rmse", "delta_e_median"]
    shown = photographs[["take", "light", "held_out", *names]]
    header = ["take", "light", "held out", "relative RMSE", "delta E"]
    medians = {"count": len(held), **held[names].median()}
    return {
        "photographs": photographs,
        "photograph_errors": shown.set_axis(header, axis=1),
        "held_out": medians if len(held) else None,
    }


def _recovered(results: Results, _: Portraits) -> dict[str, Any]:
    recovered = results.recovered
    study = {name: results.studies[name] for name in ("translucency", "albedo", "brdf")}
    table = study["translucency"]["translucency_table"].to_dataset().load()
    histograms = study["albedo"]["albedo"].to_dataset().load()
    curve = study["brdf"]["basis_size"].to_dataset().load()
    plots = {
        "reflectance": reflectance_plot(recovered),
        "translucency": plot_png(plot_translucency(table, ax=axes())),
        "albedo": plot_png(plot_albedo(histograms, ax=axes())),
        "basis_size": plot_png(plot_basis_size(curve, ax=axes())),
    }
    near = 100 * float(curve[variables.PLATEAU_TOLERANCE])
    sites = site_table(results)
    header = ["take", "site", "red [%]", "green [%]", "blue [%]"]
    return {
        "plots": plots,
        "sites": sites,
        "site_errors": sites.set_axis(header, axis=1),
        "basis_size": curve,
        "plateau_percent": near,
    }


def _population(results: Results, _: Portraits) -> dict[str, Any]:
    names = ("translucency", "brdf", "albedo")
    studies = {name: study_table(results.studies[name]) for name in names}
    columns = [
        "site",
        "channel",
        variables.SIGMA_TR_MEAN,
        variables.SIGMA_TR_MEAN_LOW,
        variables.SIGMA_TR_MEAN_HIGH,
    ]
    shown = studies["translucency"][columns]
    header = ["site", "channel", "mean", "95 % from", "to"]
    return {"studies": studies, "translucency": shown.set_axis(header, axis=1)}


def _edit(results: Results, portraits: Portraits) -> dict[str, Any]:
    """Pictures of the edited models, their distance from the data, and their colour difference
    from the measured take; None if no model was edited.
    """
    if not results.edits:
        return {"edit": None}
    images = {}
    for amount, tree in results.edits.items():
        distance = tree.attrs["edit_distance"]
        is_inside = 0 <= amount <= 1 and round(distance, 2) <= INSIDE
        place = "inside the data" if is_inside else "outside the data"
        images[f"amount {amount:g}, distance {distance:.2f}: {place}"] = portrait(tree)
    by_amount = dict(zip(results.edits, images.values(), strict=True))
    errors: tuple[float, ...] = ()
    target = results.target_take
    if target in portraits.images:
        measured = portraits.images[target]
        images[f"{target}: the measured take"] = measured
        if {0.0, 1.0} <= set(by_amount):
            errors = tuple(
                compare_images(
                    by_amount[amount], measured, exposure=portraits.exposure
                )["delta_e_mean"]
                for amount in (0.0, 1.0)
            )
    traits = study_table(results.studies["traits"])
    shifts = traits[SHOWN].set_axis([_breakable(name) for name in SHOWN], axis=1)
    edit = {
        "take": results.edited_take,
        "target": target,
        "trait": next(iter(next(iter(results.edits.values())).attrs["edit"])),
        "pictures": [(image, text) for text, image in portraits.cut(images).items()],
        "errors": errors,
        "traits": traits,
        "shifts": shifts.assign(trait=shifts["trait"].map(_breakable)),
    }
    return {"edit": edit}


def _breakable(name: str) -> str:
    """A name with spaces, so that it can be broken on a narrow page."""
    return name.replace(":", ": ").replace("_", " ")
