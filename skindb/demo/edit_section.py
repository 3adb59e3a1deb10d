"""The section of the report with an edit and its distance from the data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skindb.demo import page, tables
from skindb.demo.pictures import Image, Portraits, portrait
from skindb.demo.results import Results
from skindb.render.photographs import compare_images

# largest distance of an edit inside the data, in median distances between takes
INSIDE = 1.0
MEASURED = "measured"
SHOWN = ("trait", "takes_with", "takes_without", "brdf_shift", "colour_shift")


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
    shown = [
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
    full = tables.study_table("traits", results.studies["traits"])
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
    said = _edit_error(results, portraits, images)
    return [
        page.paragraph(text),
        page.row(shown),
        *said,
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
