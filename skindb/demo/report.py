"""The report of the demo: its results with their tables, and its sections on subjects,
populations, an edit and its distance from the data.
"""

from __future__ import annotations

import html
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb import __version__
from skindb.analysis.studies import tabulate_study
from skindb.demo import page
from skindb.demo.page import (
    Image,
    Portraits,
    Table,
    draw_portraits,
    map_pictures,
    portrait,
    predictions,
)
from skindb.files import private_file
from skindb.render.photographs import Comparison, compare_images
from skindb.schema import FitStatus, variables
from skindb.types import Progress
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
# largest distance of an edit inside the data, in median distances between takes
INSIDE = 1.0
MEASURED = "measured"
SHOWN = ("trait", "takes_with", "takes_without", "brdf_shift", "colour_shift")
VIEWER = "viewer.html"  # beside the report
ERROR_NAMES = ("Normal [deg]", "R_d [%]", "Held-out lights [%]")
LEAST_PERCENT = 0.1  # smallest percentage that is written as a number
Record = Mapping[str, Any]
Section = Callable[["Results", Portraits], list[str]]


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
            results = getattr(self, name)
            setattr(
                self, name, {take: results[take] for take in takes if take in results}
            )

    def add(self, results: Results) -> None:
        """Add the results of another process."""
        for name in PER_TAKE:
            getattr(self, name).update(getattr(results, name))
        for name, seconds in results.seconds.items():
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
        held = 100 * results.fits[take].get(variables.HELD_OUT_ERROR, {}).get(
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


def edit_section(results: Results, portraits: Portraits) -> list[str]:
    """Pictures of the edited models and their distance from the data; empty if no model
    was edited.
    """
    if not results.edits:
        return []
    images = {f"{amount:g}": portrait(tree) for amount, tree in results.edits.items()}
    captions = {
        f"{amount:g}": _edit_caption(amount, tree.attrs)
        for amount, tree in results.edits.items()
    }
    if results.target_take in portraits.images:
        images[MEASURED] = portraits.images[results.target_take]
        captions[MEASURED] = f"{results.target_take}: the measured take"
    drawn = portraits.cut(images)
    figures = [
        page.picture(
            drawn[key], f"{results.edited_take}: {captions[key]}", caption=captions[key]
        )
        for key in drawn
    ]
    trait = next(iter(next(iter(results.edits.values())).attrs["edit"]))
    text = (
        f"{results.edited_take} is moved along the trait vector of {trait}: the "
        "mean of the takes with the trait minus "
        "the mean of those without it. The takes span amounts from 0 to 1. The "
        "distance of an edit is the distance to "
        "its nearest take, divided by the median distance between takes. If it is "
        "at most 1, the edit is inside the "
        "data."
    )
    full = study_table("traits", results.studies["traits"])
    rows = [[_breakable(row[0]), *row[1:]] for row in full.columns(SHOWN).rows]
    named = page.Table("traits", [_breakable(name) for name in SHOWN], rows)
    note = (
        "Shifts are root mean squares of the parts of a vector: coefficients of "
        "the common basis, and quantiles of "
        "colour. The file also contains standard errors from a bootstrap over "
        "subjects. If there is only one take on a "
        "side, a vector is a difference of two takes and has no standard error."
    )
    listed = page.details("Trait vectors", [page.paragraph(note), page.table(named)])
    comparison = _edit_error(results, portraits, images)
    return [
        page.paragraph(text),
        page.row(figures),
        *comparison,
        listed,
        page.downloads([full]),
    ]


def _breakable(name: str) -> str:
    """A name with spaces, so that it can be broken on a narrow page."""
    return name.replace(":", ": ").replace("_", " ")


def _edit_caption(amount: float, attrs: Mapping[Any, Any]) -> str:
    distance = attrs["edit_distance"]
    place = (
        "inside the data"
        if 0 <= amount <= 1 and round(distance, 2) <= INSIDE
        else "outside the data"
    )
    return f"amount {amount:g}, distance {distance:.2f}: {place}"


def _edit_error(
    results: Results, portraits: Portraits, images: Mapping[str, Image]
) -> list[str]:
    """Colour differences of the unedited model and of the edit at amount 1 from the
    measured take.
    """
    if MEASURED not in images or not {"0", "1"} <= set(images):
        return []
    target = images[MEASURED]
    errors = {
        amount: compare_images(images[amount], target, exposure=portraits.exposure)[
            "delta_e_mean"
        ]
        for amount in ("0", "1")
    }
    return [
        page.paragraph(
            f"The mean colour difference to the picture of {results.target_take} "
            f"is {errors['0']:.2g} for the unedited "
            f"model and {errors['1']:.2g} at amount 1 (CIEDE2000)."
        )
    ]


def subjects_section(results: Results, portraits: Portraits) -> list[str]:
    """Table of all takes with small pictures; maps and a predicted photograph can be
    opened below each row.
    """
    viewed = next(iter(results.models))
    viewer = (
        f'<p><a href="{VIEWER}">Turn {html.escape(viewed)} and move its lights</a> in '
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
    for values in subject_table(results).rows:
        record = dict(zip(SUBJECT_HEADER, values, strict=True))
        take = str(record["take"])
        pictures_of_take = [(drawn[take], "portrait"), *maps[take]]
        blocks = [
            page.row(
                page.picture(image, f"{take}: {name}", caption=name)
                for image, name in pictures_of_take
            )
        ]
        blocks += [page.row([strips[take]], kind="strip")] if take in strips else []
        bodies.append(
            _subject(
                record,
                results,
                page.picture(drawn[take][::2, ::2], _alt(take, record)),
                blocks,
            )
        )
    head = "".join(
        f'<th scope="col">{name}</th>'
        for name in ("Portrait", "Take", "Fitted", "Not fitted", *ERROR_NAMES)
    )
    listed = f'<table class="subjects"><thead><tr>{head}</tr></thead>{"".join(bodies)}</table>'
    saved = page.downloads([subject_table(results), status_table(results)])
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
    counts = status_counts(results.models[take])
    total = sum(counts.values())
    statuses = [
        f"{status.name.lower().replace('_', ' ')} {_percent(100 * count / total)} %"
        for status, count in sorted(counts.items(), key=lambda item: -item[1])
        if count and status != FitStatus.FITTED
    ]
    channels = [record[f"diffuse_{name}_percent"] for name in ("red", "green", "blue")]
    cells = {
        "Fitted": (
            f"{record['fitted_surfels']:,} of {total:,} surfels "
            f"({record['fitted_percent']:.1f} %)"
        ),
        "Not fitted": ", ".join(statuses) or "none",
        ERROR_NAMES[0]: page.cell(record["normal_median_deg"]),
        ERROR_NAMES[1]: page.cell(float(np.mean(channels))),
        ERROR_NAMES[2]: page.cell(record["held_out_percent"]),
    }
    name = f"<b>{html.escape(take)}</b><br>{html.escape(_who(record))}"
    values = "".join(
        f'<td data-label="{key}">{html.escape(value)}</td>'
        for key, value in cells.items()
    )
    opened = page.details(f"Pictures and maps of {take}", maps)
    return (
        f"<tbody><tr><td>{small}</td><td>{name}</td>{values}</tr><tr><td "
        f'colspan="7">{opened}</td></tr></tbody>'
    )


def _percent(value: float) -> str:
    return f"{value:.1f}" if value >= LEAST_PERCENT else f"below {LEAST_PERCENT}"


def _strips(results: Results) -> dict[str, str]:
    """For each take a photograph, its prediction and their difference, under a held-out
    light if there is one.
    """
    chosen = {
        take: min(compared, key=lambda comparison: not comparison.held_out)
        for take, compared in results.compared.items()
        if compared
    }
    if not chosen:
        return {}
    exposure = min(comparison.error["exposure"] for comparison in chosen.values())
    strips = predictions(list(chosen.values()), exposure)
    pictures_by_take = {}
    for (take, comparison), strip in zip(chosen.items(), strips, strict=True):
        held = "not used by the fit" if comparison.held_out else "used by the fit"
        caption = (
            "Photograph, prediction and ten times their difference (grey is "
            f"none). Light {comparison.light}, {held}; "
            f"relative RMSE {100 * comparison.error['relative_rmse']:.1f} %."
        )
        pictures_by_take[take] = page.picture(
            strip, f"{take}: {caption}", caption=caption
        )
    return pictures_by_take


def write_report(path: Path, results: Results, *, progress: Progress) -> Path:
    """Write the report, which is viewed without a network, and return its path."""
    portraits = draw_portraits(results.models)
    parts = (
        ("Subjects", subjects_section),
        ("Surfels without a fit", _statuses),
        ("Predicted photographs", _predicted),
        ("Recovered and true values", _recovered),
        ("Population", _population),
        ("An edit and its distance from the data", edit_section),
        ("Run time", _run_time),
    )
    sections: list[tuple[str, list[str]]] = []
    for i, (name, make) in enumerate(parts):
        progress("report", i, len(parts))
        if blocks := make(results, portraits):
            sections.append((name, blocks))
    minutes = (time.monotonic() - results.began) / 60
    lead = (
        f"skindb {__version__} simulated, fitted and analysed "
        f"{len(results.models)} virtual takes in {minutes:.1f} "
        "minutes. Their true values are known, so that every error on this page is measured."
    )
    private_file(path).write_text(
        page.page("skindb: measured faces", lead, sections), encoding="utf-8"
    )
    progress("report", len(parts), len(parts))
    return path


def _statuses(results: Results, _: Portraits) -> list[str]:
    text = "Every surfel has a status. Surfels without a fit have a position but no values."
    return [page.paragraph(text), page.table(status_sums(results))]


def _predicted(results: Results, _: Portraits) -> list[str]:
    full = photograph_table(results)
    columns = full.columns(
        ["take", "light", "held_out", "relative_rmse", "delta_e_median"]
    )
    held = [row for row in columns.rows if row[2] == "yes"]
    text = "The fit used the lights of all photographs."
    if held:
        error, colour = (float(np.median([row[i] for row in held])) for i in (3, 4))
        text = (
            f"The fit did not use the lights of {len(held)} of {len(columns.rows)} "
            "photographs; for these the median "
            f"relative RMSE is {100 * error:.1f} % and the median colour "
            f"difference is {colour:.2g} (CIEDE2000)."
        )
    text = (
        "The photographs that ingest kept are predicted by rendering the model and "
        "compared over all pixels of the "
        f"face, including folds and shadow edges. {text}"
    )
    named = columns.renamed(["take", "light", "held out", "relative RMSE", "delta E"])
    listed = page.details(
        f"Errors of {len(columns.rows)} photographs", [page.table(named)]
    )
    return [page.paragraph(text), listed, page.downloads([full])]


def _recovered(results: Results, _: Portraits) -> list[str]:
    text = (
        "R_d of dark skin is overestimated, because measured BRDFs reflect about "
        "0.02 evenly in all directions, which "
        "cannot be separated from diffuse reflection. The errors of sigma_tr "
        "include the noise of the simulated "
        "photons of the probe and the effect of the finite size of its fibres."
    )
    normals = page.details(
        "Distribution of the error of normals",
        [page.normal_plot(results.recovered)],
    )
    full = site_table(results)
    table = full.renamed(["take", "site", "red [%]", "green [%]", "blue [%]"])
    sites = (
        [
            page.details(
                "Errors of sigma_tr at the sites of the probe", [page.table(table)]
            )
        ]
        if full.rows
        else []
    )
    return [
        page.paragraph(text),
        page.reflectance_plot(results.recovered),
        normals,
        *sites,
        page.downloads([full]),
    ]


def _population(results: Results, _: Portraits) -> list[str]:
    text = (
        "Mean of sigma_tr over the subjects with its 95 % interval, and the "
        "distribution of the area of the face by "
        "albedo along its first decorrelated axis, which is mostly brightness."
    )
    study = results.studies["translucency"]
    plots = [
        page.translucency_plot(study["translucency_table"].to_dataset().load()),
        page.albedo_plot(results.studies["albedo"]["albedo"].to_dataset().load()),
    ]
    saved = [
        study_table(name, results.studies[name])
        for name in ("translucency", "brdf", "albedo")
    ]
    columns = saved[0].columns(
        [
            "site",
            "channel",
            variables.SIGMA_TR_MEAN,
            variables.SIGMA_TR_MEAN_LOW,
            variables.SIGMA_TR_MEAN_HIGH,
        ]
    )
    named = columns.renamed(["site", "channel", "mean", "95 % from", "to"])
    listed = page.details("sigma_tr in 1/mm by site and channel", [page.table(named)])
    return [
        page.paragraph(text),
        page.row(plots, kind="plots"),
        listed,
        _basis_size(results),
        page.downloads(saved),
    ]


def _basis_size(results: Results) -> str:
    curve = results.studies["brdf"]["basis_size"].to_dataset().load()
    near = 100 * float(curve[variables.PLATEAU_TOLERANCE])
    text = (
        f"Sufficient number of basis BRDFs: {curve.attrs['size_status']}. Its "
        f"error must be within {near:g} % of that "
        "of the largest number tried. The error is measured on "
        f"{curve.attrs['surfels']} surfels of all takes."
    )
    return page.details(
        "Number of basis BRDFs", [page.paragraph(text), page.basis_size_plot(curve)]
    )


def _run_time(results: Results, _: Portraits) -> list[str]:
    demo, fit = time_tables(results)
    text = (
        "Wall time in seconds. Takes are processed in parallel, and the times of their "
        "stages are summed."
    )
    listed = [
        page.details("Stages of the demo", [page.table(demo)]),
        page.details("Stages of a fit, mean over takes", [page.table(fit)]),
    ]
    return [page.paragraph(text), *listed, page.downloads([demo, fit])]
