"""Colour statistics of diffuse albedo, comparable between takes (Weyrich et al. 2005, section 10.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.masks import drawn_masks, own_masks
from skindb.analysis.members import Takes, consenting, groups_by, left_out, nobody, nothing_fitted, people
from skindb.numerics.statistics import Moments
from skindb.schema import FitStatus, dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.floating[Any]]
BINS = 256
LEVELS = 256  # of a quantile function
SLOPE = 1e-3  # of a cumulative sum where no colour is, so that it has an inverse
EVERYWHERE = "face"


def albedo_histograms(
    models: Takes,
    *,
    regions: tuple[str, ...] = (EVERYWHERE, "beard"),
    registered: Mapping[str, xr.Dataset] | None = None,
) -> xr.Dataset:
    """Histograms of decorrelated colour per take and region.

    Colour axes are the principal axes of all takes' surfels together, each take with the same weight, divided by
    their standard deviations (Heeger and Bergen 1995, section 3.5); bin edges are shared by all takes. Surfels count
    by their area: an area-preserving map's texels give the same histogram.

    Parameters
    ----------
    models
        Take -> version of kind "model".
    regions
        Names of region masks; "face" is everything. NaN for a take without such a region.
    registered
        From `register`: regions a capture lacks are those of `region_masks`.

    Returns
    -------
    Dataset
        `colour_mean`, `colour_axis`, `histogram_edge`, `albedo_histogram` (shares that sum to 1), `albedo_mean`.
        Attribute `regions_by_landmarks`: region -> takes whose capture does not have it.
    """
    takes = consenting(models)
    mean, axes = _colour_axes(takes)
    edges = _shared_edges(takes, mean, axes)
    counted = np.full((len(takes), len(regions), 3, BINS), np.nan)
    means = np.full((len(takes), len(regions), 3), np.nan)
    drawn: dict[str, list[str]] = {}
    for t, (take, model) in enumerate(takes.items()):
        colour, area, good = surfel_colours(model)
        own = own_masks(model["fitted"].to_dataset())
        member = {name: mask[good] for name, mask in (drawn_masks((registered or {}).get(take)) | own).items()}
        for region in set(regions) & (set(member) - set(own)):
            drawn.setdefault(region, []).append(take)
        x = decorrelate(colour, mean, axes)
        for r, region in enumerate(regions):
            inside = np.ones(len(area), np.bool_) if region == EVERYWHERE else member.get(region)
            if inside is not None and inside.any():
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
        attrs={"left_out": left_out(models), "regions_by_landmarks": drawn},
    )


def _colour_axes(takes: Takes) -> tuple[Array, Array]:
    """Common mean (3,) and axes (3, 3) in rows; every take has the same weight."""
    means, spreads = [], []
    for model in takes.values():
        colour, area, _ = surfel_colours(model)
        means.append(np.average(colour, axis=0, weights=area))
        spreads.append((colour - means[-1]).T @ ((colour - means[-1]) * (area / area.sum())[:, None]))
    mean = np.mean(means, axis=0)
    # differences between takes are part of the spread
    between = np.stack(means) - mean
    values, vectors = np.linalg.eigh(np.mean(spreads, axis=0) + between.T @ between / len(means))
    axes = (vectors / np.sqrt(np.maximum(values, 1e-12))).T[::-1]
    return mean, axes * np.where(axes.sum(axis=1, keepdims=True) < 0, -1.0, 1.0)  # brighter is larger on every axis


def _shared_edges(takes: Takes, mean: Array, axes: Array) -> Array:
    """(3, BINS + 1) edges that hold every surfel of every take."""
    ends = []
    for model in takes.values():
        x = decorrelate(surfel_colours(model)[0], mean, axes)
        ends += [x.min(axis=0), x.max(axis=0)]
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    margin = 0.02 * (high - low) + 1e-9
    return np.linspace(low - margin, high + margin, BINS + 1, axis=1)


def albedo_table(models: Takes, *, albedo: xr.Dataset, group_by: str | None = None) -> xr.Dataset:
    """Mean albedo and mean histogram of groups of takes.

    Parameters
    ----------
    models
        Take -> version of kind "model". Takes in another condition than normal count only if `group_by` is
        "condition" or one of them: a subject is one subject.
    albedo
        From `albedo_histograms` of these takes.
    group_by
        Attribute or trait (gender, ancestry, male, older, ...); None makes the one group "all".

    Returns
    -------
    Dataset
        (group, region, channel) count, mean with Student's 95 % interval, standard deviation; (group, region, axis,
        bin) mean histogram. NaN where a group has too few takes with such a region. Noise of surfels averages out over
        a region; errors of whole takes (light, white target) scatter between takes: the standard deviation and the
        interval contain them. What every take has wrong alike is in neither: even white reflection, some 0.014, counts
        as albedo.
    """
    takes = people(consenting(models), group_by)
    if not takes:
        raise nobody(models)
    groups = groups_by(takes, group_by)
    names = sorted(set(groups.values()))
    members = [[t for t in takes if groups[t] == name] for name in names]
    parts = [Moments.of(albedo["albedo_mean"].sel(take=own).values) for own in members]
    stacked = Moments(*(np.stack([getattr(part, f) for part in parts]) for f in ("count", "mean", "second")))
    low, high = stacked.mean_interval()
    known = stacked.count > 0
    histograms = [Moments.of(albedo["albedo_histogram"].sel(take=own).values) for own in members]
    mean_histograms = np.stack([np.where(h.count > 0, h.mean, np.nan) for h in histograms])
    return dataset(
        {
            "group_albedo_count": stacked.count,
            "group_albedo_mean": np.where(known, stacked.mean, np.nan),
            "group_albedo_mean_low": low,
            "group_albedo_mean_high": high,
            "group_albedo_standard_deviation": stacked.standard_deviation,
            "group_histogram": mean_histograms,
        },
        coords={"group": names, "region": albedo["region"].values, "channel": ["R", "G", "B"]},
        attrs={"takes": sorted(takes), "group_by": group_by or "", "left_out": left_out(models)},
    )


def surfel_colours(model: xr.DataTree) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Albedo (n, 3), area (n,) of the fitted surfels of a take, and which these are; `InputError` if there is none."""
    node = model["fitted"].to_dataset()
    colour = node["diffuse_reflectance"].values.astype(np.float64)
    good = (node["fit_status"].values == FitStatus.FITTED) & np.isfinite(colour).all(axis=1)
    if not good.any():
        raise nothing_fitted(model)
    return colour[good], node["surfel_area"].values[good].astype(np.float64), good


def decorrelate(colour: Array, mean: Array, axes: Array) -> Array:
    """Coordinates (n, 3) on the decorrelated axes."""
    return np.asarray((colour - mean) @ axes.T)


def histogram(values: Array, area: Array, edges: Array) -> Array:
    """Shares of the area (3, bins) per axis; edges (3, bins + 1)."""
    counts = np.stack([np.histogram(values[:, a], edges[a], weights=area)[0] for a in range(values.shape[1])])
    return np.asarray(counts / area.sum())


def quantiles(shares: Array, edges: Array) -> Array:
    """Quantile functions (..., axis, LEVELS) of histograms (..., axis, bins); NaN stays NaN."""
    flat = shares.reshape(-1, *shares.shape[-2:])
    out = np.empty((*flat.shape[:2], LEVELS))
    for i, axis in np.ndindex(flat.shape[:2]):
        out[i, axis] = np.interp(levels(), cumulative(flat[i, axis]), edges[axis])
    out[np.isnan(flat).any(axis=-1)] = np.nan
    return out.reshape(*shares.shape[:-1], LEVELS)


def levels() -> Array:
    """(LEVELS,) shares at which quantiles are kept."""
    return (np.arange(LEVELS) + 0.5) / LEVELS


def cumulative(shares: Array) -> Array:
    """Cumulative sum (bins + 1,) from 0 to 1, rising everywhere."""
    total = np.concatenate([[0.0], np.cumsum(shares)])
    return np.asarray((1 - SLOPE) * total / max(total[-1], 1e-12) + SLOPE * np.linspace(0.0, 1.0, len(total)))


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
