"""Prediction errors of a fitted model by region and status, in one table."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.fit.held_out import ERRORS
from skindb.schema import FitStatus, check, dataset
from skindb.schema.regions import FACE

Array = NDArray[Any]
ANY = "any"
SAMPLES = {"fit": ("fit_residual", "fit_residual_perceptual")} | {
    f"held_out_{of}s": e for of, e in ERRORS.items()
}
SPACES = ("linear", "perceptual")
QUANTILES = {"median": 0.5, "p95": 0.95}


def prediction_table(fitted: xr.Dataset) -> xr.Dataset:
    """Errors of the samples that were fitted and of those held out, by region and by status.

    Parameters
    ----------
    fitted
        Group "fitted" of a model. Errors that it does not contain (nothing held out) are NaN.

    Returns
    -------
    Dataset
        `prediction_surfels`, `prediction_fraction` (of the region's surfels) and
        `prediction_outlier_fraction` (mean over area) by region and status;
        `prediction_error`, area-weighted median and 95 % quantile over surfels of the
        relative RMS error, also by samples ("fit", "held_out_lights",
        "held_out_cameras") and space ("linear", or "perceptual": cube-root space).
        Region "face" and status "any" include all surfels.
    """
    check(fitted, ("fit_status", "surfel_area"), where="fitted")
    status = fitted["fit_status"].values
    area = fitted["surfel_area"].values.astype(np.float64)
    errors = [[_values(fitted, name) for name in names] for names in SAMPLES.values()]
    outliers = _values(fitted, "outlier_fraction")
    regions = _regions(fitted)
    shape = len(regions), len(FitStatus) + 1
    count = np.zeros(shape, np.int64)
    share = np.full(shape, np.nan)
    strange = np.full(shape, np.nan)
    error = np.full((*shape, len(SAMPLES), len(SPACES), len(QUANTILES)), np.nan)
    for r, inside in enumerate(regions.values()):
        for s, member in enumerate((None, *FitStatus)):
            index = inside if member is None else inside[status[inside] == member]
            if index.size:
                count[r, s], share[r, s] = index.size, index.size / inside.size
                error[r, s] = [
                    [_quantiles(v[index], area[index]) for v in pair] for pair in errors
                ]
                strange[r, s] = _mean(outliers[index], area[index])
    coords = {
        "region": list(regions),
        "status": [ANY, *(member.name.lower() for member in FitStatus)],
    }
    return dataset(
        {
            "prediction_surfels": count,
            "prediction_fraction": share,
            "prediction_outlier_fraction": strange,
            "prediction_error": error,
        },
        coords=coords
        | {
            "samples": list(SAMPLES),
            "space": list(SPACES),
            "statistic": list(QUANTILES),
        },
    )


def describe_prediction(table: xr.Dataset) -> dict[str, Any]:
    """The table as nested dicts, without what is empty: by region all surfels, by
    status all regions.
    """
    return {
        "regions": {
            str(name): _row(table.sel(region=name, status=ANY))
            for name in table["region"].values
        },
        "statuses": {
            str(name): _row(table.sel(region=FACE, status=name))
            for name in table["status"].values[1:]
        },
    }


def tabulate_prediction(described: dict[str, Any]) -> list[list[str]]:
    """Header and rows of `describe_prediction` for a terminal: median / 95 %, in per cent."""
    kinds = [(what, space) for what in SAMPLES for space in SPACES]
    rows = [
        (name, row)
        for part in described.values()
        for name, row in part.items()
        if row["surfels"]
    ]
    kinds = [
        (what, space) for what, space in kinds if any(what in row for _, row in rows)
    ]
    titles = [
        "roots" if space == "perceptual" else what.replace("held_out_", "unseen ")
        for what, space in kinds
    ]
    lines = [["median / 95 % [%]", "surfels", "outliers", *titles]]
    for name, row in rows:
        cells = [row.get(what, {}).get(space) for what, space in kinds]
        shown = [
            f"{100 * c['median']:.1f} / {100 * c['p95']:.1f}" if c else "-"
            for c in cells
        ]
        lines.append(
            [
                name,
                str(row["surfels"]),
                f"{100 * row['outlier_fraction']:.1f}"
                if "outlier_fraction" in row
                else "-",
                *shown,
            ]
        )
    return lines


def _row(one: xr.Dataset) -> dict[str, Any]:
    """Values of one region or status."""
    found: dict[str, Any] = {"surfels": int(one["prediction_surfels"])}
    if found["surfels"]:
        found["fraction"] = float(one["prediction_fraction"])
    if np.isfinite(one["prediction_outlier_fraction"]):
        found["outlier_fraction"] = float(one["prediction_outlier_fraction"])
    for what in SAMPLES:
        error = (
            one["prediction_error"]
            .sel(samples=what)
            .transpose("space", "statistic")
            .values
        )
        if np.isfinite(error).all():
            found[what] = {
                k: dict(zip(QUANTILES, map(float, v), strict=True))
                for k, v in zip(SPACES, error, strict=True)
            }
    return found


def _values(fitted: xr.Dataset, name: str) -> Array:
    return (
        fitted[name].values
        if name in fitted
        else np.full(fitted.sizes["surfel"], np.nan)
    )


def _regions(fitted: xr.Dataset) -> dict[str, Array]:
    """Indices of the surfels of the face and of each non-empty region."""
    found = {FACE: np.arange(fitted.sizes["surfel"])}
    if "region_mask" in fitted:
        mask = fitted["region_mask"].transpose("region", "surfel").astype(bool)
        names = mask["region"].values if "region" in mask.coords else range(len(mask))
        found |= {
            str(name): np.flatnonzero(one)
            for name, one in zip(names, mask.values, strict=True)
            if one.any()
        }
    return found


def _quantiles(values: Array, area: Array) -> Array:
    """Area-weighted quantiles; NaN without values."""
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(QUANTILES), np.nan)
    order = np.argsort(values[known], kind="stable")
    below = np.cumsum(area[known][order])
    place = np.searchsorted(below, np.array([*QUANTILES.values()]) * below[-1])
    return np.asarray(values[known][order][np.minimum(place, len(below) - 1)])


def _mean(values: Array, area: Array) -> float:
    known = np.isfinite(values)
    return (
        float(np.average(values[known], weights=area[known])) if known.any() else np.nan
    )
