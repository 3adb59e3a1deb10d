"""Predictions of photographs with and without light between parts of the face.

    python -m benchmarks inter_reflection DB TAKE...

The takes must have been fitted with inter-reflection subtracted. All photographs that
ingest kept are predicted twice. The Markdown table has the root mean square of prediction
minus photograph over that of the photographs, for the whole face and for the nose, and the
same and the mean difference where the added light is at least 5 % of the prediction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

import skindb
from benchmarks.validate import header
from skindb.errors import Fault, InputError
from skindb.render.photographs import Comparison, compare_photographs
from skindb.schema import label, variables
from skindb.types import Array

STRONG = 0.05  # of the prediction
COLUMNS = (
    "added",
    "face [%]",
    "nose [%]",
    "where it is strong [%]",
    "mean there [%]",
    "pixels there [%]",
)


def predictions(
    model: xr.DataTree, capture: xr.DataTree, *, added: bool
) -> list[Comparison]:
    """The photographs of a capture and their predictions with or without the light."""
    switch = label(variables.INTER_REFLECTION, int(added))
    switched = model.copy()
    switched["fitted"] = model["fitted"].to_dataset().assign(inter_reflection=switch)
    return compare_photographs(switched, capture)


def relative_rms(difference: Array, photographed: Array) -> float:
    """Root mean square of a difference over that of the photographs."""
    return float(np.sqrt(np.mean(difference**2) / np.mean(photographed**2)))


def measure(model: xr.DataTree, capture: xr.DataTree) -> dict[str, list[float]]:
    """Values of the table in percent, without and with the light."""
    pair = [predictions(model, capture, added=added) for added in (False, True)]
    without, with_light = (
        np.concatenate([c.rendered[c.mask] for c in pictures]).astype(np.float64)
        for pictures in pair
    )
    photographed = np.concatenate([c.photographed[c.mask] for c in pair[0]])
    photographed = photographed.astype(np.float64)
    bounce = (with_light - without).mean(axis=1)
    strong = bounce >= STRONG * with_light.mean(axis=1)
    rows = {}
    for name, pictures, rendered in zip(
        ("no", "yes"), pair, (without, with_light), strict=True
    ):
        off = rendered - photographed
        nose = [c.regions["nose"] for c in pictures if "nose" in c.regions]
        values = (
            relative_rms(off, photographed),
            float(np.sqrt(np.mean([n["relative_rmse"] ** 2 for n in nose]))),
            relative_rms(off[strong], photographed[strong]),
            off[strong].mean() / photographed[strong].mean(),
            strong.mean(),
        )
        rows[name] = [100 * value for value in values]
    return rows


def main(db: str, takes: Sequence[str]) -> None:
    """Measure and print."""
    database = skindb.open(db)
    print(header(*COLUMNS))
    for take in takes:
        model = database.read("model", take)
        if not model.attrs["parameters"]["inter_reflection"]:
            rule = "inter-reflection must have been subtracted"
            cure = "fit with --inter-reflection on"
            raise InputError(Fault(take, rule, "a fit without it", cure))
        for name, values in measure(model, database.source(model)).items():
            cells = " | ".join(f"{value:.1f}" for value in values)
            print(f"| {take} | {name} | {cells} |", flush=True)
