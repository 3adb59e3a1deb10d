"""The section of the report with one row for each take, below which its maps can be opened."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

import numpy as np

from skindb.demo import page, tables
from skindb.demo.pictures import Portraits, half_size, map_pictures, predictions
from skindb.demo.results import Results
from skindb.schema import FitStatus

VIEWER = "viewer.html"  # beside the report
ERROR_NAMES = ("Normal [deg]", "R_d [%]", "Held-out lights [%]")
LEAST_PERCENT = 0.1  # smallest percentage that is written as a number
Record = Mapping[str, Any]


def subjects_section(results: Results, portraits: Portraits) -> list[str]:
    """Table of all takes with small pictures; maps and a predicted photograph can be
    opened below each row.
    """
    first = next(iter(results.models))
    viewer = (
        f'<p><a href="{VIEWER}">Turn {html.escape(first)} and move its lights</a> in '
        "this browser (WebGL2).</p>"
    )
    text = (
        "The portraits show the fitted models from the front under two lights of "
        "the dome. Pictures of one kind have "
        "the same exposure and the same scale for all subjects. Errors are medians "
        "over the fitted surfels: the angle "
        "between recovered and true normals, the relative error of the diffuse "
        "reflectance R_d (mean of the channels), "
        "and the relative error of samples under lights that the fit did not use."
    )
    drawn = portraits.cut(portraits.images)
    maps = map_pictures(results.models)
    strips = _strips(results)
    bodies = []
    for values in tables.subject_table(results).rows:
        record = dict(zip(tables.SUBJECT_HEADER, values, strict=True))
        take = str(record["take"])
        shown = [(drawn[take], "portrait"), *maps[take]]
        blocks = [
            page.row(
                page.picture(one, f"{take}: {name}", caption=name)
                for one, name in shown
            )
        ]
        blocks += [page.row([strips[take]], kind="strip")] if take in strips else []
        bodies.append(
            _subject(
                record,
                results,
                page.picture(half_size(drawn[take]), _alt(take, record)),
                blocks,
            )
        )
    head = "".join(
        f'<th scope="col">{name}</th>'
        for name in ("Portrait", "Take", "Fitted", "Not fitted", *ERROR_NAMES)
    )
    listed = f'<table class="subjects"><thead><tr>{head}</tr></thead>{"".join(bodies)}</table>'
    saved = page.downloads(
        [tables.subject_table(results), tables.status_table(results)]
    )
    return [viewer, page.paragraph(text), listed, saved]


def _alt(take: str, record: Record) -> str:
    return f"Portrait of the fitted model of {take}: {_who(record)}"


def _who(record: Record) -> str:
    words = [
        str(record[name])
        for name in ("age", "gender", "ancestry", "condition")
        if record[name] != ""
    ]
    return ", ".join(words).replace("_", " ")


def _subject(record: Record, results: Results, small: str, maps: list[str]) -> str:
    """Two rows of the table: the values of a take, and its maps, which can be opened."""
    take = str(record["take"])
    counts = tables.status_counts(results.models[take])
    total = sum(counts.values())
    others = [
        f"{status.name.lower().replace('_', ' ')} {_percent(100 * count / total)} %"
        for status, count in sorted(counts.items(), key=lambda one: -one[1])
        if count and status != FitStatus.FITTED
    ]
    channels = [record[f"diffuse_{name}_percent"] for name in ("red", "green", "blue")]
    cells = {
        "Fitted": (
            f"{record['fitted_surfels']:,} of {total:,} surfels "
            f"({record['fitted_percent']:.1f} %)"
        ),
        "Not fitted": ", ".join(others) or "none",
        ERROR_NAMES[0]: page.cell(record["normal_median_deg"]),
        ERROR_NAMES[1]: page.cell(float(np.mean(channels))),
        ERROR_NAMES[2]: page.cell(record["held_out_percent"]),
    }
    name = f"<b>{html.escape(take)}</b><br>{html.escape(_who(record))}"
    values = "".join(
        f'<td data-label="{key}">{html.escape(value)}</td>'
        for key, value in cells.items()
    )
    shown = page.details(f"Pictures and maps of {take}", maps)
    return (
        f"<tbody><tr><td>{small}</td><td>{name}</td>{values}</tr><tr><td "
        f'colspan="7">{shown}</td></tr></tbody>'
    )


def _percent(value: float) -> str:
    return f"{value:.1f}" if value >= LEAST_PERCENT else f"below {LEAST_PERCENT}"


def _strips(results: Results) -> dict[str, str]:
    """For each take a photograph, its prediction and their difference, under a held-out
    light if there is one.
    """
    shown = {
        take: min(found, key=lambda one: not one.held_out)
        for take, found in results.compared.items()
        if found
    }
    if not shown:
        return {}
    exposure = min(one.error["exposure"] for one in shown.values())
    strips = predictions(list(shown.values()), exposure)
    made = {}
    for (take, one), strip in zip(shown.items(), strips, strict=True):
        held = "not used by the fit" if one.held_out else "used by the fit"
        caption = (
            "Photograph, prediction and ten times their difference (grey is "
            f"none). Light {one.light}, {held}; "
            f"relative RMSE {100 * one.error['relative_rmse']:.1f} %."
        )
        made[take] = page.picture(strip, f"{take}: {caption}", caption=caption)
    return made
