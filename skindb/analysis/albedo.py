"""Colour statistics of diffuse albedo that are comparable between takes (Weyrich et al.
2005, section 10.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from xarray import Dataset

from skindb import plots
from skindb.analysis import texture
from skindb.analysis.study import (
    Population,
    Results,
    Study,
    Table,
    each_take,
    skipped_takes,
    table_of,
)
from skindb.analysis.subjects import compared_conditions, grouped, level_error
from skindb.analysis.summary import SAMPLED
from skindb.errors import counted, require
from skindb.numerics.statistics import SUMMARY, known_mean
from skindb.numerics.texture import QUANTILES, quantile_levels
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS, FACE
from skindb.study_parameters import DECLARED, GroupParameters
from skindb.types import Array, Mask, finite_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOUR_VARIABLES = (
    variables.DIFFUSE_REFLECTANCE,
    variables.SURFEL_AREA,
    variables.REGION_MASK,
    variables.SURFEL_INDEX,
    "take",
    "region",
)
BINS = 256
MAX_LEGEND_ENTRIES = 30  # takes; plots of more lines have no legend
LINES = ("-", "--", ":", "-.", (0, (1, 3)))
# minimum slope of a cumulative sum, so that it can be inverted where a histogram is
# empty
SLOPE = 1e-3


@dataclass(frozen=True)
class Colours:
    """The sampled surfels of one take."""

    colour: Array  # (n, 3)
    area: Array  # (n,)
    regions: dict[str, Mask]  # region -> (n,)


def albedo_histograms(
    cohort: Dataset,
    *,
    regions: Sequence[str] = (FACE, "beard"),
    drawn: Dataset | None = None,
) -> Dataset:
    """Histograms of decorrelated colour for every take and region.

    The colour axes are the principal axes of the surfels of all takes, each take with
    the same weight, divided by their standard deviations (Heeger and Bergen 1995,
    section 3.5); all takes have the same bin edges. Surfels are weighted by their area:
    the texels of an area-preserving map would give the same histogram.

    Parameters
    ----------
    cohort
        ``db.cohort("surfels")``.
    regions
        Names of region masks; "face" is the whole surface. Results are NaN for a take
        without such a region.
    drawn
        ``db.cohort("surfels", kind="registration")`` of the same sample, with the
        regions defined by landmarks, which are used for takes whose capture lacks them.

    Returns
    -------
    Dataset
        `colour_mean`, `colour_axis`, `histogram_edge`, `albedo_histogram` (fractions
        that sum to 1), `albedo_mean`.
    """
    require_comparable(cohort, "surfels")
    takes = cohort["take"].values.tolist()
    loaded = each_take(Dataset.load, cohort, COLOUR_VARIABLES)
    drawn = None if drawn is None else drawn.load()
    samples = [_colours(sample, drawn) for sample in loaded]
    mean, axes = _colour_axes(samples)
    decorrelated = [decorrelate(sample.colour, mean, axes) for sample in samples]
    edges = _shared_edges(decorrelated)
    counted = np.full((len(takes), len(regions), 3, BINS), np.nan)
    means = np.full((len(takes), len(regions), 3), np.nan)
    for t, (sample, x) in enumerate(zip(samples, decorrelated, strict=True)):
        for r, region in enumerate(regions):
            inside = (
                np.ones(len(x), bool) if region == FACE else sample.regions.get(region)
            )
            if inside is None or not inside.any():
                continue
            counted[t, r] = histogram(x[inside], sample.area[inside], edges)
            means[t, r] = np.average(
                sample.colour[inside], axis=0, weights=sample.area[inside]
            )
    return dataset(
        {
            variables.COLOUR_MEAN: mean,
            variables.COLOUR_AXIS: axes,
            variables.HISTOGRAM_EDGE: edges,
            variables.ALBEDO_HISTOGRAM: counted,
            variables.ALBEDO_MEAN: means,
        },
        coords={"take": takes, "region": list(regions), "channel": CHANNELS},
        attrs={"skipped": skipped_takes(cohort)},
    )


def _colours(take: Dataset, drawn: Dataset | None) -> Colours:
    """Sampled surfels of one take of a cohort, with the regions of its capture or those
    defined by landmarks.
    """
    name = str(take["take"].values)
    colour = take[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    area = take[variables.SURFEL_AREA].values.astype(float)
    good = finite_rows(colour) & (area > 0)
    require(
        good.any(),
        name,
        "a take of a population must have fitted surfels",
        "none",
        "skip the take or fit it again",
    )
    masks = {}
    if drawn is not None and name in drawn["take"].values:
        registered = drawn.sel(take=name).isel(surfel=slice(len(good)))
        first, second = (
            ds[variables.SURFEL_INDEX].values[good] for ds in (registered, take)
        )
        require(
            np.array_equal(first, second),
            name,
            "regions by landmarks must belong to the sampled surfels",
            "a different sample",
            "open both cohorts with the same seed",
        )
        masks = _masks(registered, good)
    return Colours(colour[good], area[good], masks | _masks(take, good))


def _masks(take: Dataset, good: Mask) -> dict[str, Mask]:
    """Masks of the sampled surfels by region, for the regions that contain any."""
    if variables.REGION_MASK not in take:
        return {}
    stored = take[variables.REGION_MASK].transpose("region", "surfel").values
    masks = zip(map(str, take["region"].values), stored[:, good] > 0, strict=True)
    return {name: mask for name, mask in masks if mask.any()}


def _colour_axes(samples: Sequence[Colours]) -> tuple[Array, Array]:
    """Common mean (3,) and axes (3, 3) in rows."""
    means = []
    scatters = []
    for sample in samples:
        means.append(np.average(sample.colour, axis=0, weights=sample.area))
        from_mean = sample.colour - means[-1]
        weight = (sample.area / sample.area.sum())[:, None]
        scatters.append(from_mean.T @ (from_mean * weight))
    return texture.colour_axes(means, scatters)


def _shared_edges(decorrelated: Sequence[Array]) -> Array:
    """Bin edges (3, BINS + 1) that contain every surfel of every take."""
    low = np.min([x.min(axis=0) for x in decorrelated], axis=0)
    high = np.max([x.max(axis=0) for x in decorrelated], axis=0)
    margin = 0.02 * (high - low) + 1e-9
    return np.linspace(low - margin, high + margin, BINS + 1, axis=1)


def albedo_table(
    cohort: Dataset, *, albedo: Dataset, group_by: str | None = None
) -> Dataset:
    """Mean albedo and mean histogram of groups of takes.

    Parameters
    ----------
    cohort
        Any cohort of the takes; only its coordinates are used. Takes in other
        conditions than normal are used only if `group_by` is "condition" or a trait of
        it, so that no subject counts several times.
    albedo
        From `albedo_histograms` of these takes.
    group_by
        Attribute or trait (gender, ancestry, gender:male, age:older, ...); None puts
        all takes into the group "all".

    Returns
    -------
    Dataset
        (group, region, channel) count, mean with Student's 95 % interval, standard
        deviation; (group, region, axis, bin) mean histogram. NaN where a group has too
        few takes with such a region. The noise of surfels averages out over a region.
        Errors of whole takes (light, white target) differ between takes, so that the
        standard deviation and the interval include them. They do not include the error
        that is common to all takes, `group_even_reflection_error`: the even reflection of
        the surface is known by a prior. It shifts all groups equally, so that it cancels
        in differences of groups but not in ratios, and it matters most for dark skin.
    """
    groups = grouped(cohort, group_by)
    members = groups.members.values()
    means, histograms = (
        albedo[name].sel(take=groups.takes["take"].values.tolist()).values
        for name in (variables.ALBEDO_MEAN, variables.ALBEDO_HISTOGRAM)
    )
    errors = [level_error(groups.takes.isel(take=rows)) for rows in members]
    mean_histograms = [known_mean(histograms[rows]) for rows in members]
    return dataset(
        {
            **groups.moments(means).summary("group_albedo"),
            variables.GROUP_EVEN_REFLECTION_ERROR: errors,
            variables.GROUP_HISTOGRAM: np.stack(mean_histograms),
        },
        coords={
            "group": [*groups.members],
            "region": albedo["region"].values,
            "channel": CHANNELS,
        },
        attrs=groups.attrs,
    )


def decorrelate(colour: Array, mean: Array, axes: Array) -> Array:
    """Coordinates (n, 3) on the decorrelated axes."""
    return (colour - mean) @ axes.T


def histogram(values: Array, area: Array, edges: Array) -> Array:
    """Histograms (3, bins) as fractions of the area, one per axis; edges (3, bins + 1)."""
    counts = np.stack(
        [
            np.histogram(values[:, a], edges[a], weights=area)[0]
            for a in range(values.shape[1])
        ]
    )
    return np.asarray(counts / area.sum())


def quantiles(histograms: Array, edges: Array) -> Array:
    """Quantile functions (..., axis, QUANTILES) of histograms (..., axis, bins); NaN stays NaN."""
    flat = histograms.reshape(-1, *histograms.shape[-2:])
    out = np.empty((*flat.shape[:2], QUANTILES))
    for i, axis in np.ndindex(flat.shape[:2]):
        out[i, axis] = np.interp(
            quantile_levels(), cumulative(flat[i, axis]), edges[axis]
        )
    out[np.isnan(flat).any(axis=-1)] = np.nan
    return out.reshape(*histograms.shape[:-1], QUANTILES)


def cumulative(fractions: Array) -> Array:
    """Strictly increasing cumulative sum (bins + 1,) from 0 to 1 of a histogram (bins,)."""
    total = np.concatenate([[0.0], np.cumsum(fractions)])
    return np.asarray(
        (1 - SLOPE) * total / max(total[-1], 1e-12)
        + SLOPE * np.linspace(0.0, 1.0, len(total))
    )


def plot_albedo(
    histograms: Dataset,
    *,
    table: Dataset | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Plot histograms of the whole face along the first decorrelated axis, one line per
    take, or per group of `table` (from `albedo_table`).
    """
    ax = ax or plots.new_axes(6, 3.6)
    edges = histograms[variables.HISTOGRAM_EDGE].isel(axis=0).values
    # bins that are joined for the plot; the full number is needed only for matching
    width = 8
    centres = edges[:-1].reshape(-1, width).mean(axis=1)
    is_grouped = table is not None and bool(table.attrs["group_by"])
    if table is not None and is_grouped:
        part = table.sel(region=FACE)
        counts = part[variables.GROUP_ALBEDO_COUNT].max("channel").values
        groups = zip(part["group"].values.tolist(), counts.tolist(), strict=True)
        names = [f"{name} (n = {n})" for name, n in groups]
        lines = part[variables.GROUP_HISTOGRAM].isel(axis=0).values
    else:
        part = histograms.sel(region=FACE)
        names = part["take"].values.tolist()
        lines = part[variables.ALBEDO_HISTOGRAM].isel(axis=0).values
    has_legend = len(names) <= MAX_LEGEND_ENTRIES
    for i, (name, fractions) in enumerate(zip(names, lines, strict=True)):
        style: dict[str, Any] = {"color": "0.4", "linewidth": 0.5}
        if has_legend:
            style = {
                "label": plots.legend_entry(name),
                "color": plots.CYCLE[i % len(plots.CYCLE)],
            }
        joined = fractions.reshape(-1, width).sum(axis=1)
        linestyle = LINES[i // len(plots.CYCLE) % len(LINES)]
        ax.plot(centres, joined, linestyle=linestyle, **style)
    if has_legend:
        plots.legend_beside(ax)
    else:
        kind = "group" if is_grouped else "take"
        ax.set_title(counted(len(names), kind), fontsize=8)
    ax.set_xlabel("decorrelated colour, axis 0 [standard deviations]")
    ax.set_ylabel("fraction of the area")
    ax.set_ylim(bottom=0)
    return ax


def tabulate_albedo(table: Dataset, histograms: Dataset) -> Table:
    """Header and one row per region and channel of every group, or of every take if
    they are not grouped.
    """
    if not table.attrs["group_by"]:
        return table_of(histograms, [variables.ALBEDO_MEAN])
    return table_of(table, [f"group_albedo_{name}" for name in SUMMARY])


def albedo_and_texture(population: Population) -> Results:
    """Histograms of albedo, and distributions at every scale of the takes that are
    registered, whose landmarks draw the regions that captures lack.
    """
    if not population.registered:
        return {"albedo": albedo_histograms(population.cohort)}
    drawn = population.open_cohort(
        "surfels",
        kind="registration",
        surfels=SAMPLED,
        variables=[variables.REGION_MASK, variables.SURFEL_INDEX],
    )
    maps = population.open_cohort("maps", size=texture.SIZE, variables=texture.MAPPED)
    distributions = texture.texture_statistics(maps, landmarks=population.landmarks)
    histograms = albedo_histograms(
        population.cohort, regions=texture.REGIONS, drawn=drawn
    )
    return {"albedo": histograms, "texture": distributions}


def compute(population: Population, parameters: GroupParameters) -> Results:
    """The results of the study."""
    results = albedo_and_texture(population)
    table = albedo_table(
        population.cohort, albedo=results["albedo"], group_by=parameters.group_by
    )
    return results | {"albedo_table": table}


STUDY = Study(
    *DECLARED["albedo"],
    layout="surfels",
    compute=compute,
    shown=("albedo_table", "albedo"),
    tabulate=tabulate_albedo,
    plot=lambda table, histograms: plot_albedo(histograms, table=table),
    cohort_options={"surfels": SAMPLED},
    uses_registration=True,
    conditions=compared_conditions,
)
