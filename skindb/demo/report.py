"""The report of the demo: its results, and its sections on subjects, populations, an edit and
its distance from the data.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb import __version__
from skindb.analysis.studies import describe_study, plot_study, tabulate_study
from skindb.demo.page import (
    Portraits,
    draw_portraits,
    map_pictures,
    portrait,
    predictions,
)
from skindb.files import Json, filled_template, make_private, private_file
from skindb.render.image import image_url
from skindb.render.photographs import Comparison, compare_images
from skindb.schema import FitStatus, variables
from skindb.types import Progress
from skindb.virtual.capture import Recovery

PER_TAKE = ("models", "fits", "recovered", "compared")
# largest distance of an edit inside the data, in median distances between takes
INSIDE = 1.0
VIEWER = "viewer.html"  # beside the report
PLOTS = "plots"  # folder beside the report


@dataclass
class Results:
    """Models, errors, studies and edits of a demo."""

    models: dict[str, xr.DataTree] = field(default_factory=dict)
    fits: dict[str, Json] = field(default_factory=dict)
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


def write_report(path: Path, results: Results, *, progress: Progress) -> Path:
    """Write the report and the plots of the studies beside it, and return its path."""
    progress("report", 0, 2)
    portraits = draw_portraits(results.models)
    counts = {
        take: np.bincount(
            model["fitted"].dataset[variables.FIT_STATUS].values,
            minlength=len(FitStatus),
        )
        for take, model in results.models.items()
    }
    held_out = [
        comparison.error
        for compared in results.compared.values()
        for comparison in compared
        if comparison.held_out
    ]
    content = {
        "version": __version__,
        "viewer": VIEWER,
        "minutes": (time.monotonic() - results.began) / 60,
        "takes": _takes(results, portraits, counts),
        "statuses": [
            (_spaced(status.name.lower()), status.explanation, count)
            for status, count in zip(
                FitStatus, np.sum([*counts.values()], axis=0), strict=True
            )
            if count
        ],
        "photographs": sum(map(len, results.compared.values())),
        "held_out": {
            name: [error[name] for error in held_out]
            for name in ("relative_rmse", "relative_median", "delta_e_median")
        },
        "sites": [
            (take, site, *(100 * errors))
            for take, recovery in results.recovered.items()
            for site, errors in recovery.sigma_tr_error.items()
        ],
        "edit": _edit(results, portraits),
    }
    progress("report", 1, 2)
    content["studies"] = [
        _study(name, study, path.parent) for name, study in results.studies.items()
    ]
    functions = {"cell": cell, "image_url": image_url, "median": np.median}
    page = filled_template("skindb.demo", "report.html.jinja", **content, **functions)
    private_file(path).write_text(page, encoding="utf-8")
    progress("report", 2, 2)
    return path


def _takes(results: Results, portraits: Portraits, counts: Json) -> list[Json]:
    """Attributes, errors and pictures of each take."""
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
    for take, model in results.models.items():
        traits = model.attrs.get("traits", {})
        who = [traits.get(name, "") for name in ("age", "gender", "ancestry")]
        who.append(model.attrs.get("condition", "normal"))
        percent = 100 * counts[take] / counts[take].sum()
        unfitted = sorted(
            set(FitStatus) - {FitStatus.FITTED}, key=lambda s: -percent[s]
        )
        errors: Any = results.recovered[take].summary()
        held_out = results.fits[take].get(variables.HELD_OUT_ERROR, {})
        takes.append(
            {
                "take": take,
                "who": _spaced(", ".join(str(x) for x in who if x != "")),
                "surfels": int(counts[take].sum()),
                "fitted": percent[FitStatus.FITTED],
                "not_fitted": ", ".join(
                    f"{_spaced(status.name.lower())} {percent[status]:.2g} %"
                    for status in unfitted
                    if percent[status]
                ),
                "normal": errors["normal_median_deg"],
                "diffuse": np.mean(errors["diffuse_median_percent"]),
                "held_out": 100 * held_out.get("median", np.nan),
                "portrait": drawn[take],
                "small": drawn[take][::2, ::2],
                "maps": maps[take],
                "prediction": shown.get(take),
                "strip": strips.get(take),
            }
        )
    return takes


def _study(name: str, study: xr.DataTree, folder: Path) -> Json:
    """Plot, notes and table of a study."""
    plot = f"{PLOTS}/{name}.png"
    make_private(folder / PLOTS)
    plot_study(study, folder / plot)
    header, rows = tabulate_study(study)
    notes = describe_study(study)
    return {"name": name, "plot": plot, "notes": notes, "header": header, "rows": rows}


def _edit(results: Results, portraits: Portraits) -> Json | None:
    """Pictures of the edited models, their distance from the data, and their colour difference
    from the measured take; None if no model was edited.
    """
    if not results.edits:
        return None
    images = {}
    for amount, tree in results.edits.items():
        distance = tree.attrs["edit_distance"]
        is_inside = 0 <= amount <= 1 and round(distance, 2) <= INSIDE
        place = "inside the data" if is_inside else "outside the data"
        images[f"amount {amount:g}, distance {distance:.2f}: {place}"] = portrait(tree)
    by_amount = dict(zip(results.edits, images.values(), strict=True))
    target = results.target_take
    measured = portraits.images[target]
    images[f"{target}: the measured take"] = measured
    errors = [
        compare_images(by_amount[amount], measured, exposure=portraits.exposure)
        for amount in (0.0, 1.0)
    ]
    return {
        "take": results.edited_take,
        "target": target,
        "trait": next(iter(next(iter(results.edits.values())).attrs["edit"])),
        "pictures": [(image, text) for text, image in portraits.cut(images).items()],
        "errors": [error["delta_e_mean"] for error in errors],
    }


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
    text = f"{value:.3g}" if -1000 < value < 1000 else f"{value:,.0f}"
    return "0" if text == "-0" else text


def _spaced(name: str) -> str:
    return name.replace("_", " ")
