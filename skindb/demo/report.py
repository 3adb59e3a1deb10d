"""The report of the demo: subjects, errors against the truth, population, an edit, run times."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from skindb import __version__
from skindb.demo import figures, page, tables
from skindb.demo.edit_section import edit_section
from skindb.demo.pictures import Portraits, draw_portraits
from skindb.demo.results import Results
from skindb.demo.subjects_section import subjects_section
from skindb.files import private_file
from skindb.types import Progress

Section = Callable[[Results, Portraits], list[str]]


def write_report(path: Path, results: Results, *, progress: Progress) -> Path:
    """Write the report, which is viewed without a network, and return its path."""
    portraits = draw_portraits(results.models)
    parts: tuple[tuple[str, Section], ...] = (
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
    return [page.paragraph(text), page.table(tables.status_sums(results))]


def _predicted(results: Results, _: Portraits) -> list[str]:
    full = tables.photograph_table(results)
    shown = full.columns(
        ["take", "light", "held_out", "relative_rmse", "delta_e_median"]
    )
    held = [row for row in shown.rows if row[2] == "yes"]
    found = "The fit used the lights of all photographs."
    if held:
        error, colour = (float(np.median([row[i] for row in held])) for i in (3, 4))
        found = (
            f"The fit did not use the lights of {len(held)} of {len(shown.rows)} "
            "photographs; for these the median "
            f"relative RMSE is {100 * error:.1f} % and the median colour "
            f"difference is {colour:.2g} (CIEDE2000)."
        )
    text = (
        "The photographs that ingest kept are predicted by rendering the model and "
        "compared over all pixels of the "
        f"face, including folds and shadow edges. {found}"
    )
    named = shown.renamed(["take", "light", "held out", "relative RMSE", "delta E"])
    listed = page.details(
        f"Errors of {len(shown.rows)} photographs", [page.table(named)]
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
        "Distribution of the error of normals", [figures.normal_plot(results.recovered)]
    )
    full = tables.site_table(results)
    shown = full.renamed(["take", "site", "red [%]", "green [%]", "blue [%]"])
    sites = (
        [
            page.details(
                "Errors of sigma_tr at the sites of the probe", [page.table(shown)]
            )
        ]
        if full.rows
        else []
    )
    return [
        page.paragraph(text),
        figures.reflectance_plot(results.recovered),
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
        figures.translucency_plot(study["translucency_table"].to_dataset().load()),
        figures.albedo_plot(results.studies["albedo"]["albedo"].to_dataset().load()),
    ]
    saved = [
        tables.study_table(name, results.studies[name])
        for name in ("translucency", "brdf", "albedo")
    ]
    shown = saved[0].columns(
        ["site", "channel", "sigma_tr_mean", "sigma_tr_mean_low", "sigma_tr_mean_high"]
    )
    named = shown.renamed(["site", "channel", "mean", "95 % from", "to"])
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
    near = 100 * float(curve["plateau_tolerance"])
    text = (
        f"Sufficient number of basis BRDFs: {curve.attrs['size_status']}. Its "
        f"error must be within {near:g} % of that "
        "of the largest number tried. The error is measured on "
        f"{curve.attrs['surfels']} surfels of all takes."
    )
    return page.details(
        "Number of basis BRDFs", [page.paragraph(text), figures.basis_size_plot(curve)]
    )


def _run_time(results: Results, _: Portraits) -> list[str]:
    demo, fit = tables.time_tables(results)
    text = (
        "Wall time in seconds. Takes are processed in parallel, and the times of their "
        "stages are summed."
    )
    listed = [
        page.details("Stages of the demo", [page.table(demo)]),
        page.details("Stages of a fit, mean over takes", [page.table(fit)]),
    ]
    return [page.paragraph(text), *listed, page.downloads([demo, fit])]
