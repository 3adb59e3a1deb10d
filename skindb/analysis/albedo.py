"""Colour statistics of diffuse albedo, comparable between takes (Weyrich et al. 2005, section 10.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.members import Takes, consenting, left_out
from skindb.numerics.statistics import Moments
from skindb.schema import FitStatus, dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.floating[Any]]
BINS = 256
EVERYWHERE = "face"


def albedo_histograms(models: Takes, *, regions: tuple[str, ...] = (EVERYWHERE, "beard")) -> xr.Dataset:
    """Histograms of decorrelated colour per take and region.

    Colour axes are the principal axes of all takes' surfels together, each take with the same weight, divided by
    their standard deviations (Heeger and Bergen 1995, section 3.5); bin edges are shared by all takes. Surfels count
    by their area: an area-preserving map's texels give the same histogram.

    Parameters
    ----------
    models
        Take -> version of kind "model".
    regions
        Names of region masks; "face" is everything. Absent regions have an all-zero histogram.

    Returns
    -------
    Dataset
        `colour_mean`, `colour_axis`, `histogram_edge`, `albedo_histogram` (shares that sum to 1), `albedo_mean`.
    """
    takes = consenting(models)
    parts = {take: surfel_colours(model) for take, model in takes.items()}
    mean = np.mean([np.average(c, axis=0, weights=a) for c, a, _ in parts.values()], axis=0)
    # about the common mean: differences between takes are part of the spread
    spread = np.mean([(c - mean).T @ ((c - mean) * (a / a.sum())[:, None]) for c, a, _ in parts.values()], axis=0)
    values, vectors = np.linalg.eigh(spread)
    axes = (vectors / np.sqrt(np.maximum(values, 1e-12))).T[::-1]
    axes = axes * np.sign(axes.sum(axis=1, keepdims=True))  # brighter is larger on every axis
    flat = [decorrelate(c, mean, axes) for c, _, _ in parts.values()]
    low, high = (np.stack([f(x, axis=0) for x in flat]) for f in (np.min, np.max))
    margin = 0.02 * (high.max(axis=0) - low.min(axis=0)) + 1e-9
    edges = np.linspace(low.min(axis=0) - margin, high.max(axis=0) + margin, BINS + 1, axis=1)
    counted = np.zeros((len(takes), len(regions), 3, BINS))
    means = np.full((len(takes), len(regions), 3), np.nan)
    for t, ((colour, area, member), x) in enumerate(zip(parts.values(), flat, strict=True)):
        for r, region in enumerate(regions):
            inside = (
                np.ones(len(area), np.bool_)
                if region == EVERYWHERE
                else member.get(region, np.zeros(len(area), np.bool_))
            )
            if inside.any():
                counted[t, r] = histogram(x[inside], area[inside], edges)
                means[t, r] = np.average(colour[inside], axis=0, weights=area[inside])
    return dataset(
        {
            "colour_mean": mean,
            "colour_axis": axes,
            "histogram_edge": edges,
            "albedo_histogram": counted,
            "albedo_mean": means,
        },
        coords={"take": list(takes), "region": list(regions), "channel": ["R", "G", "B"]},
        attrs={"left_out": left_out(models)},
    )


def surfel_colours(model: xr.DataTree) -> tuple[Array, Array, dict[str, NDArray[np.bool_]]]:
    """Albedo (n, 3), area (n,) and region masks of the fitted surfels of a take."""
    node = model["fitted"].to_dataset()
    colour = node["diffuse_reflectance"].values.astype(np.float64)
    good = (node["fit_status"].values == FitStatus.FITTED) & np.isfinite(colour).all(axis=1)
    masks = {}
    if "region_mask" in node:
        masks = {str(r): node["region_mask"].sel(region=r).values[good] for r in node["region"].values}
    return colour[good], node["surfel_area"].values[good].astype(np.float64), masks


def decorrelate(colour: Array, mean: Array, axes: Array) -> Array:
    """Coordinates (n, 3) on the decorrelated axes."""
    return np.asarray((colour - mean) @ axes.T)


def histogram(values: Array, area: Array, edges: Array) -> Array:
    """Shares of the area (3, bins) per axis; edges (3, bins + 1)."""
    counts = np.stack([np.histogram(values[:, a], edges[a], weights=area)[0] for a in range(values.shape[1])])
    return np.asarray(counts / area.sum())


def mean_albedo_table(histograms: xr.Dataset, *, region: str = EVERYWHERE) -> Moments:
    """Moments over takes of the mean albedo of a region."""
    return Moments.of(histograms["albedo_mean"].sel(region=region).values)


def plot_albedo(histograms: xr.Dataset, *, axis: int = 0, region: str = EVERYWHERE, ax: Axes | None = None) -> Axes:
    """Histograms of one decorrelated axis, one line a take."""
    from matplotlib import pyplot

    if ax is None:
        _, ax = pyplot.subplots(figsize=(6, 3.6))
    edges = histograms["histogram_edge"].isel(axis=axis).values
    width = 8  # bins a drawn bin: 256 are for matching, not for looking
    centres = edges[:-1].reshape(-1, width).mean(axis=1)
    for take in histograms["take"].values:
        shares = histograms["albedo_histogram"].sel(take=take, region=region).isel(axis=axis).values
        ax.plot(centres, shares.reshape(-1, width).sum(axis=1), label=str(take))
    ax.set_xlabel(f"decorrelated colour, axis {axis} [standard deviations]")
    ax.set_ylabel("share of the area")
    ax.legend(fontsize=7)
    return ax
