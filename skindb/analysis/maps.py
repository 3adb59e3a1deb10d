"""Maps of the differences between groups of subjects in the common (u, v)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from xarray import Dataset

from skindb.analysis.contrasts import (
    MIN_RELIABILITY,
    Comparison,
    compare_groups,
)
from skindb.analysis.groups import SIGNIFICANT
from skindb.analysis.quantities import (
    NORMAL_95,
    REFLECTANCE,
    SURFACE,
    Quantities,
    Quantity,
    chosen_quantities,
    is_relative,
)
from skindb.analysis.study import (
    Study,
    Table,
    each_take,
    of_cohort,
    skipped_takes,
    table_of,
)
from skindb.analysis.subjects import (
    compared_conditions,
    level_error,
    notes_on_attributes,
    subjects_of,
)
from skindb.errors import Fault, InputError, require
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS
from skindb.study_parameters import DECLARED, PERMUTATIONS
from skindb.types import Array, finite_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# texels along each side: about 1 mm each, which is also the accuracy of landmarks
SIZE = 256
# minimum fraction of the compared subjects that must have a value at a texel
MIN_FRACTION = 0.8
COVERED = 0.5  # minimum fraction of a texel that must be measured
LOGARITHMIC = "sigma_tr"
SHOWN_FRACTION = 0.995  # fraction of the texels within the range of a colour scale
SHOWN = ("R_d G", SURFACE, "sigma_tr G")


def effect_maps(
    cohort: Dataset,
    *,
    group_by: str,
    adjust: Sequence[str] = (),
    quantities: Sequence[str] = (),
    size: int = SIZE,
    permutations: int = PERMUTATIONS,
    rng: np.random.Generator,
) -> Dataset:
    """Effect of an attribute on albedo, surface reflectance and log sigma_tr at every
    texel, adjusted for others.

    The regression, its intervals and the permutations are those of `group_effects`,
    with every texel as one quantity. The value of a texel in a take is the mean of the
    measured texels of the finer map. The p values are adjusted for all texels and
    channels of a variable by the largest statistic, which accounts for the correlation
    of neighbours.

    Parameters
    ----------
    cohort
        ``db.cohort("maps")``.
    group_by, adjust, quantities, rng
        See `group_effects`.
    size
        Texels along each side; it must divide the size of the maps of the cohort.
    permutations
        Maximum number of permutations; the smallest p value is 1 / (permutations + 1).

    Returns
    -------
    Dataset
        (contrast, quantity, v, u) `map_effect`, `map_effect_half_width` of its 95 %
        interval, `map_effect_p` of the single texel, `map_effect_p_adjusted`, and
        `map_effect_count`, the number of subjects; NaN at texels that less than 80 % of
        the subjects have.

    Raises
    ------
    InputError
        If there are no groups to compare, or if no texel has values of enough subjects.
    """
    require_comparable(cohort, "maps")
    adjust = (adjust,) if isinstance(adjust, str) else tuple(adjust)
    texels = cohort.sizes["v"]
    require(
        size > 0 and texels % size == 0,
        "size",
        f"must divide the {texels} texels of the maps",
        str(size),
        f"choose {texels}, {texels // 2} or {texels // 4}",
    )
    compare = partial(
        compare_groups,
        cohort,
        group_by,
        adjust,
        permutations=permutations,
        min_fraction=MIN_FRACTION,
        rng=rng,
    )
    chosen = chosen_quantities(quantities)
    unmapped = [quantity.name for quantity in chosen if not quantity.mapped]
    require(
        not unmapped,
        f"quantity {', '.join(unmapped)}",
        "must be known at texels",
        "one of regions",
        "compare it with analyze groups",
    )
    parts, flags, faults = _quantity_maps(cohort, chosen, size, compare)
    if not parts:
        cure = "fit or register more takes"
        nothing = Fault("maps", "some texels must be measured", "none", cure)
        raise InputError(faults or nothing)
    flags += notes_on_attributes(subjects_of(cohort))
    result = xr.concat(parts, "quantity")
    names = result["quantity"].values.tolist()
    return result.assign_attrs(
        group_by=group_by,
        adjust=list(adjust),
        **parts[-1].attrs,
        logarithmic=[name for name in names if name.startswith(LOGARITHMIC)],
        flags=[
            *dict.fromkeys(flags),
            *(f"{fault.where}: excluded, {fault.found}" for fault in faults),
        ],
        skipped=skipped_takes(cohort),
    )


def _quantity_maps(
    cohort: Dataset,
    chosen: Sequence[Quantity],
    size: int,
    compare: Callable[..., tuple[list[Comparison], list[Fault]]],
) -> tuple[list[Dataset], list[str], list[Fault]]:
    """Maps of the quantities with the same comparisons, and flags and faults of all."""
    parts: list[Dataset] = []
    flags = []
    faults = []
    for quantity in [quantity for quantity in chosen if quantity.mapped in cohort]:
        measure = partial(_texel_quantities, quantity=quantity, size=size)
        compared, undetermined = compare(measure)
        flags += [flag for comparison in compared for flag in comparison.flags]
        name = quantity.name
        flags += [flag for one in compared for flag in _reliability_flags(one, name)]
        faults += [replace(f, where=f"{f.where}, {name}") for f in undetermined]
        if not compared:
            continue
        maps = _arranged(compared, quantity, size)
        if parts and not maps["contrast"].equals(parts[0]["contrast"]):
            # a contrast is missing for this variable only
            rule = "every comparison must have texels"
            faults.append(Fault(name, rule, "none for some", "exclude takes"))
        else:
            parts.append(maps)
    return parts, flags, faults


def _reliability_flags(comparison: Comparison, name: str) -> list[str]:
    """What is known of the errors of the texels of a quantity."""
    if name == LOGARITHMIC:
        return [
            f"{name}: no p values of texels between the probe sites, where it is interpolated"
        ]
    reliability = comparison.contrast.reliability
    known = np.isfinite(reliability)
    if not known.any():
        return [
            "without repeats of three subjects, the reliability of texels is unknown"
        ]
    low = np.mean(reliability[known] < MIN_RELIABILITY)
    text = f"{low:.0%} of the texels have no p values: the reliability is below {MIN_RELIABILITY}"
    return [f"{comparison.contrast.name}, {name}: {text}"]


def _arranged(compared: Sequence[Comparison], quantity: Quantity, size: int) -> Dataset:
    """Statistics (contrast, quantity, v, u) of comparisons of the texels of a quantity,
    of which each channel counts as one.
    """
    titles = [quantity.name]
    if "channel" in quantity.dims:
        titles = [f"{quantity.name} {channel}" for channel in CHANNELS]
    statistics: dict[str, list[Array]] = {}
    for comparison in compared:
        test = comparison.test
        half_width = (test.effects.high - test.effects.low) / 2
        is_known = np.isfinite(comparison.contrast.quantities.values)
        for variable, texels in (
            (variables.MAP_EFFECT, test.effects.slope),
            (variables.MAP_EFFECT_HALF_WIDTH, half_width),
            (variables.MAP_EFFECT_P, test.p),
            (variables.MAP_EFFECT_P_ADJUSTED, test.p_adjusted),
            (variables.MAP_EFFECT_COUNT, is_known.sum(axis=0)),
        ):
            if "_p" in variable and quantity.name == LOGARITHMIC:
                texels = np.full_like(texels, np.nan)
            maps = np.float32(texels).reshape(size, size, len(titles))
            statistics.setdefault(variable, []).append(np.moveaxis(maps, -1, 0))
    return dataset(
        {variable: np.stack(maps) for variable, maps in statistics.items()},
        coords={
            "contrast": [comparison.contrast.name for comparison in compared],
            "quantity": titles,
        },
        attrs={
            "permutations": [c.test.permutations for c in compared],
            "smallest_p": [c.smallest_p for c in compared],
        },
    )


def _texel_quantities(takes: Dataset, *, quantity: Quantity, size: int) -> Quantities:
    """Values of a quantity at every texel (and channel) of every take, as quantities."""
    require(
        quantity.derive is None or not is_relative(takes).any(),
        f"quantity {quantity.name}",
        "needs absolute reflectance",
        f"{is_relative(takes).sum()} takes without a white target",
        "name other takes with --take, or compare R_d",
    )
    names = [quantity.mapped, variables.TEXEL_COVERAGE]
    values = np.stack(each_take(_block_means, takes, names, quantity, size))
    common = 0.0
    if quantity == REFLECTANCE:
        common = NORMAL_95 * float(np.nan_to_num(level_error(takes)))
    subject = tuple(map(str, takes["subject"].values))
    return Quantities(values, subject, (quantity.name,), common=(common,))


def _block_means(take: Dataset, quantity: Quantity, size: int) -> Array:
    """Means (size * size * channels,) of the measured texels in blocks of texels; NaN
    where too few were measured.
    """
    values = take[quantity.mapped].values.astype(float)
    texels = values.shape[:2]
    values = quantity.compared(values.reshape(*texels, -1)).reshape(*texels, -1)
    is_known = finite_rows(values)
    weight = np.where(is_known, take[variables.TEXEL_COVERAGE].values, 0.0)[..., None]
    block = len(values) // size
    shape = (size, block, size, block, -1)
    total = weight.reshape(shape).sum(axis=(1, 3))
    weighted = (np.nan_to_num(values) * weight).reshape(shape).sum(axis=(1, 3))
    mean = weighted / np.maximum(total, 1e-12)
    covered = total >= COVERED * block**2
    return np.where(covered, mean, np.nan).astype(np.float32).ravel()


def tabulate_effect_maps(maps: Dataset) -> Table:
    """Header and one row per comparison and quantity: texels, fraction that differs,
    mean and largest effect.
    """
    texel = ("v", "u")
    is_known = maps[variables.MAP_EFFECT_HALF_WIDTH].notnull()
    is_tested = maps[variables.MAP_EFFECT_P].notnull()
    effect = maps[variables.MAP_EFFECT].where(is_known).astype(float)
    differs = maps[variables.MAP_EFFECT_P_ADJUSTED] < SIGNIFICANT
    count = maps[variables.MAP_EFFECT_COUNT].where(is_known, 0)
    low = effect.min(texel)
    high = effect.max(texel)
    columns = {
        "subjects": count.max(texel).astype(int),
        "texels": is_known.sum(texel),
        "fraction_that_differs": differs.where(is_tested).mean(texel),
        "mean_effect": effect.mean(texel),
        "largest_effect": high.where(high >= -low, low),
    }
    return table_of(maps.assign(columns), list(columns))


def describe_effect_maps(maps: Dataset) -> list[str]:
    """Notes on the table, one line each."""
    names = maps["contrast"].values.tolist()
    counts = zip(
        names, maps.attrs["permutations"], maps.attrs["smallest_p"], strict=True
    )
    note = "p values are adjusted for all texels of a variable by the largest statistic"
    lines = [
        f"{name}: {note}; {count} permutations, the smallest possible p is {smallest:.2g}"
        for name, count, smallest in counts
    ]
    if maps.attrs["logarithmic"]:
        lines.append("effects of sigma_tr are differences of its natural logarithm")
    return [*lines, *maps.attrs["flags"]]


def plot_effect_maps(maps: Dataset, *, contrast: str | None = None) -> Figure:
    """Plot maps of the effect, of the half-width of its 95 % interval and of the number
    of subjects.

    Lines surround regions of adjusted p < 0.05.

    Parameters
    ----------
    maps
        From `effect_maps`.
    contrast
        Name of the comparison; by default the first.
    """
    from matplotlib import pyplot

    name = contrast or str(maps["contrast"].values[0])
    part = maps.sel(contrast=name)
    names = part["quantity"].values.tolist()
    quantities = [quantity for quantity in SHOWN if quantity in names] or names[:1]
    figure: Figure
    figure, axes = pyplot.subplots(
        len(quantities), 3, figsize=(9, 2.9 * len(quantities)), squeeze=False
    )
    known = (
        part[variables.MAP_EFFECT_HALF_WIDTH]
        .sel(quantity=quantities)
        .notnull()
        .any("quantity")
    )
    for dim, other in (("v", "u"), ("u", "v")):
        places = np.flatnonzero(known.any(other))
        part = part.isel({dim: slice(places[0], places[-1] + 1)})
    for line, quantity in zip(axes, quantities, strict=True):
        _plot_quantity(line, part.sel(quantity=quantity))
    adjusted = ", ".join(maps.attrs["adjust"])
    note = f", adjusted for {adjusted}" if adjusted else ""
    figure.suptitle(f"{name}{note}; lines surround adjusted p < 0.05", fontsize=9)
    figure.tight_layout()
    return figure


def _plot_quantity(line: Sequence[Axes], maps: Dataset) -> None:
    """Plot effect, half-width and number of subjects of one quantity on three axes."""
    quantity = str(maps["quantity"].values)
    is_logarithm = quantity in maps.attrs["logarithmic"]
    unit = "change of the logarithm" if is_logarithm else "difference"
    maps = maps.where(maps[variables.MAP_EFFECT_HALF_WIDTH].notnull())
    size = abs(maps[variables.MAP_EFFECT])
    half_width = maps[variables.MAP_EFFECT_HALF_WIDTH]
    largest, widest = (
        float(values.quantile(SHOWN_FRACTION)) for values in (size, half_width)
    )
    largest = max(largest, 1e-12)
    diverging = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
    from_zero = {"cmap": "cividis", "vmin": 0.0, "vmax": widest}
    images: list[tuple[str, dict[str, Any], str, str]] = [
        (variables.MAP_EFFECT, diverging, f"effect on {quantity}", unit),
        (
            variables.MAP_EFFECT_HALF_WIDTH,
            from_zero,
            "half-width of the 95 % CI",
            unit,
        ),
        (variables.MAP_EFFECT_COUNT, {"cmap": "cividis"}, "subjects", "n"),
    ]
    for ax, (name, options, title, label) in zip(line, images, strict=True):
        image = ax.imshow(maps[name], interpolation="none", **options)
        ax.figure.colorbar(image, ax=ax, shrink=0.8, label=label)
        ax.set(title=title, xticks=[], yticks=[])
        ax.title.set_fontsize(8)
    differ = maps[variables.MAP_EFFECT_P_ADJUSTED].values < SIGNIFICANT
    if differ.any() and not differ.all():
        line[0].contour(differ, levels=[0.5], colors="black", linewidths=0.6)


STUDY = Study(
    *DECLARED["maps"],
    layout="maps",
    compute=of_cohort("effect_maps", effect_maps),
    shown=("effect_maps",),
    tabulate=tabulate_effect_maps,
    plot=plot_effect_maps,
    describe=describe_effect_maps,
    conditions=compared_conditions,
)
