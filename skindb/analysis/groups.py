"""Comparison of groups of subjects: effects with intervals, p values and detectable effects."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import scipy  # scipy.stats takes longer to load, at its first use, than commands run
from xarray import Dataset

from skindb import plots
from skindb.analysis.colour import colour_difference
from skindb.analysis.contrasts import (
    MIN_RELIABILITY,
    Comparison,
    Contrast,
    compare_groups,
    contrast_counts,
)
from skindb.analysis.quantities import (
    SURFACE,
    TYPOLOGY_ANGLE,
    Quantities,
    quantities_of,
)
from skindb.analysis.study import Study, Table, of_cohort, skipped_takes, table_of
from skindb.analysis.subjects import (
    compared_conditions,
    notes_on_attributes,
    subjects_of,
)
from skindb.errors import InputError, few_names
from skindb.numerics.inference import Effects
from skindb.numerics.statistics import detectable_difference, known_mean
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS
from skindb.study_parameters import DECLARED
from skindb.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIGNIFICANT = 0.05  # of adjusted p values
MAX_LISTED = 6  # detectable differences that are named in a line
SIDES = ("with", "without")
INTERVAL = (variables.EFFECT, variables.EFFECT_LOW, variables.EFFECT_HIGH)
PERCENT = (
    variables.EFFECT_PERCENT,
    variables.EFFECT_PERCENT_LOW,
    variables.EFFECT_PERCENT_HIGH,
)
COLUMNS = (
    *INTERVAL,
    *PERCENT,
    variables.EFFECT_RELIABILITY,
    variables.EFFECT_P,
    variables.EFFECT_P_ADJUSTED,
    variables.EFFECT_P_FALSE_DISCOVERY,
    variables.EFFECT_DETECTABLE,
)


def group_effects(
    cohort: Dataset,
    *,
    group_by: str,
    adjust: Sequence[str] = (),
    quantities: Sequence[str] = (),
    permutations: int = 10_000,
    rng: np.random.Generator,
) -> Dataset:
    """Differences between groups of subjects in all measured quantities.

    Subjects are compared in the condition normal, each with the mean of its takes.
    Conditions are compared within the subjects who were measured in both; if it is only
    one, intervals are of the errors of its fits and repeats, without p values.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    group_by
        Attribute or trait. An attribute with two values gives one comparison; with more
        values, each is compared with all others. The effect of a numeric attribute
        (age) is that of one unit. "condition" compares each condition with normal.
    adjust
        Attributes for which the regression adjusts. Subjects without them are excluded.
    quantities
        Names of quantities; default albedo, surface reflectance and sigma_tr.
    permutations
        Maximum number of permutations for p values; if there are fewer, all of them are used.
    rng
        Random generator of the permutations.

    Returns
    -------
    Dataset
        (contrast, quantity), see the variables of the group "effects": effect with HC3
        interval, also in per cent and in standard deviations; p values (unadjusted,
        adjusted by the largest statistic, and by the false discovery rate); and the
        smallest detectable effect; and the reliability, the fraction of the variance
        between subjects, or of the mean square of changes within them, that the errors
        of the fits and the differences between repeated takes leave: where it is below
        0.5, there are no p values. sigma_tr is compared by its logarithm. NaN where too
        few subjects have a quantity. R_d may be wrong by the same amount in all takes
        (even reflection): this cancels in differences, and the intervals in per cent
        include it. Where conditions have other surfaces, intervals contain the error of
        both, and effects within this error have no p values. Attribute "flags": small
        or missing groups, confounded attributes, and low reliability.

    Raises
    ------
    InputError
        If there are no groups to compare, or if the takes were fitted with different parameters.

    References
    ----------
    MacKinnon and White 1985 (HC3); Freedman and Lane 1983; Westfall and Young 1993;
    Benjamini and Hochberg 1995.
    """
    require_comparable(cohort, "tables")
    adjust = (adjust,) if isinstance(adjust, str) else tuple(adjust)
    measure = partial(quantities_of, names=tuple(quantities))
    compared, faults = compare_groups(
        cohort, group_by, adjust, measure, permutations=permutations, rng=rng
    )
    if not compared:
        raise InputError(faults)
    statistics = [_statistics(comparison) for comparison in compared]
    measured = compared[0].contrast.quantities
    flags = [
        flag
        for comparison, values in zip(compared, statistics, strict=True)
        for flag in _flags(comparison, values)
    ]
    flags += [f"{fault.where}: excluded, {fault.found}" for fault in faults]
    return dataset(
        {
            name: np.stack([values[name] for values in statistics])
            for name in statistics[0]
        },
        coords={
            "contrast": [comparison.contrast.name for comparison in compared],
            "quantity": list(measured.names),
            "side": list(SIDES),
            "attribute": list(compared[0].associated),
        },
        attrs={
            "group_by": group_by,
            "adjust": list(adjust),
            "permutations": [comparison.test.permutations for comparison in compared],
            "smallest_p": [comparison.smallest_p for comparison in compared],
            "logarithmic": list(itertools.compress(measured.names, measured.is_log)),
            "flags": flags + notes_on_attributes(subjects_of(cohort)),
            "skipped": skipped_takes(cohort),
        },
    )


def _statistics(comparison: Comparison) -> dict[str, Array]:
    """Variables of a comparison for every quantity, and its associated attributes."""
    contrast = comparison.contrast
    test = comparison.test
    fit = test.effects
    p = test.p
    percent, low, high = _percent(fit, _reference(contrast, fit), contrast.quantities)
    discovered = np.full(len(p), np.nan)
    discovered[np.isfinite(p)] = scipy.stats.false_discovery_control(p[np.isfinite(p)])
    standardised = np.divide(
        fit.slope, fit.spread, out=np.full_like(fit.slope, np.nan), where=fit.spread > 0
    )
    detectable = np.full_like(fit.error, np.nan)
    if comparison.smallest_p < SIGNIFICANT:
        detectable = detectable_difference(fit.error, fit.free)
    return {
        variables.EFFECT_COUNT: contrast_counts(contrast),
        variables.EFFECT: fit.slope,
        variables.EFFECT_LOW: fit.low,
        variables.EFFECT_HIGH: fit.high,
        variables.EFFECT_PERCENT: percent,
        variables.EFFECT_PERCENT_LOW: low,
        variables.EFFECT_PERCENT_HIGH: high,
        variables.EFFECT_STANDARDISED: standardised,
        variables.EFFECT_P: p,
        variables.EFFECT_P_ADJUSTED: test.p_adjusted,
        variables.EFFECT_P_FALSE_DISCOVERY: discovered,
        variables.EFFECT_DETECTABLE: detectable,
        variables.EFFECT_RELIABILITY: contrast.reliability,
        variables.ATTRIBUTE_ASSOCIATION: np.array(list(comparison.associated.values())),
    }


def _reference(contrast: Contrast, fit: Effects) -> Array:
    """Level (q,) of the subjects without the compared value, to which effects in per
    cent refer.
    """
    values = contrast.quantities.values
    is_known = np.isfinite(values)
    if contrast.before is not None:
        return known_mean(np.where(is_known, contrast.before, np.nan))
    if contrast.is_number:
        return known_mean(values)
    centre = known_mean(np.where(is_known, contrast.regressor[:, None], np.nan))
    return known_mean(values) - fit.slope * centre


def _percent(
    fit: Effects, reference: Array, quantities: Quantities
) -> tuple[Array, ...]:
    """Effects and ends of intervals in per cent, including the error of the level that
    all takes have in common.

    A decrease is at most 100 %; the upper end is NaN where the true level may be 0. Angles
    have none, and are negative for dark skin.
    """
    is_angle = np.char.startswith(quantities.names, TYPOLOGY_ANGLE)
    reference = np.where(is_angle, np.nan, reference)
    lowest = np.maximum(reference - quantities.common, 0.0)
    highest = reference + quantities.common
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = fit.slope / reference
        low = np.maximum(fit.low / np.where(fit.low < 0, lowest, highest), -1.0)
        high = fit.high / np.where(fit.high > 0, lowest, highest)
    ratios = zip((slope, low, high), (fit.slope, fit.low, fit.high), strict=True)
    percent = [
        100 * np.where(quantities.is_log, np.expm1(logs), ratio)
        for ratio, logs in ratios
    ]
    return tuple(
        np.where(np.isfinite(contrast), contrast, np.nan) for contrast in percent
    )


def _flags(comparison: Comparison, statistics: dict[str, Array]) -> list[str]:
    """Warnings about a comparison and the significance that it can reach."""
    contrast = comparison.contrast
    flags = comparison.flags + _surface_flag(contrast, statistics)
    flags += _colour_flag(contrast)
    names = contrast.quantities.names
    reliability = statistics[variables.EFFECT_RELIABILITY]
    is_even = np.abs(statistics[variables.EFFECT]) < contrast.even
    for values, where, reason in (
        (
            reliability,
            reliability < MIN_RELIABILITY,
            f"the reliability is below {MIN_RELIABILITY}",
        ),
        (statistics[variables.EFFECT], is_even, "even reflection may cause the effect"),
    ):
        low = [f"{names[i]} {values[i]:.2g}" for i in np.flatnonzero(where)]
        if low and len(contrast.regressor) > 1:
            flags.append(
                f"{contrast.name}: no p values where {reason}: {', '.join(low)}"
            )
    smallest = comparison.smallest_p
    if smallest >= SIGNIFICANT and np.isfinite(statistics[variables.EFFECT_P]).any():
        flags.append(
            f"{contrast.name}: with {len(contrast.regressor)} subjects no p value can be "
            f"below {smallest:.2g}, so that no difference can be significant at 5 %"
        )
    return flags


def _colour_flag(contrast: Contrast) -> list[str]:
    """Mean differences of colour of the regions, where conditions are compared."""
    if contrast.before is None:
        return []
    names = contrast.quantities.names
    differences = []
    for region in (name[4:-2] for name in names if re.fullmatch("R_d .* R", name)):
        channels = [f"R_d {region} {channel}" for channel in CHANNELS]
        if {*channels} <= {*names}:
            columns = [names.index(channel) for channel in channels]
            before = contrast.before[:, columns]
            change = contrast.quantities.values[:, columns]
            mean = float(known_mean(colour_difference(before + change, before)))
            if np.isfinite(mean):  # both takes have the region
                differences.append(f"{region} {mean:.2g}")
    if not differences:
        return []
    return [
        f"{contrast.name}: mean delta E (CIEDE2000), which noise makes larger: "
        + ", ".join(differences)
    ]


def _surface_flag(contrast: Contrast, statistics: dict[str, Array]) -> list[str]:
    """Warning if surface reflectance differs, because its even part is known by a prior alone."""
    names = np.array(contrast.quantities.names)
    differ = statistics[variables.EFFECT_P_ADJUSTED] < SIGNIFICANT
    small = differ & (np.abs(statistics[variables.EFFECT]) < contrast.quantities.common)
    differs = (differ & np.char.startswith(names, SURFACE)).any()
    if contrast.is_paired or not differs or not small.any():
        return []
    limit = max(contrast.quantities.common)
    note = f"differences of R_d up to {limit:.2g} may be due to its even reflection"
    return [f"{contrast.name}: the surface reflectance differs as well; {note}"]


def describe_group_effects(table: Dataset) -> list[str]:
    """Numbers of significant effects, detectable effects and flags of the comparisons,
    one line each.
    """
    lines = []
    permutations = (table.attrs["permutations"], table.attrs["smallest_p"])
    contrasts = zip(table["contrast"].values, *permutations, strict=True)
    for name, count, smallest_p in contrasts:
        part = table.sel(contrast=name)
        if part[variables.EFFECT_COUNT].sum("side").max() == 1:
            lines.append(
                f"{name}: one subject, so that intervals are of the errors of its fits "
                "and repeats, and say nothing of other subjects"
            )
            continue
        compared = np.isfinite(part[variables.EFFECT_P].values)
        differ = part[variables.EFFECT_P_ADJUSTED].values < SIGNIFICANT
        lines.append(
            f"{name}: {differ.sum()} of {compared.sum()} quantities differ "
            + _test_summary(part, count, smallest_p)
        )
        if not differ.any() and compared.any():
            lines += _detectable_line(str(name), part)
    interval = "low and high are the ends of 95 % intervals"
    if table.attrs["logarithmic"]:
        interval += ", effects of sigma_tr are differences of its natural logarithm"
    adjusted = (
        "adjusted p values account for the number of quantities (largest "
        "statistic, Westfall and Young)"
    )
    return [*lines, interval, adjusted, *table.attrs["flags"]]


def _test_summary(part: Dataset, count: int, smallest_p: float) -> str:
    """Adjustment, permutations and subjects of a comparison."""
    held = ", ".join(part.attrs["adjust"])
    subjects = int(part[variables.EFFECT_COUNT].sum("side").max())
    limit = ""
    if smallest_p > 1.5 / (count + 1):
        limit = f", the smallest possible p is {smallest_p:.2g}"
    return (
        f"{f'with {held} held fixed ' if held else ''}"
        f"(adjusted p < 0.05; {count} permutations of {subjects} subjects{limit})"
    )


def _detectable_line(name: str, part: Dataset) -> list[str]:
    """A line with the smallest detectable differences, if any is known."""
    detectable = []
    known = part[variables.EFFECT_DETECTABLE].to_series()
    for quantity, value in known[np.isfinite(known)].items():
        amount = f"{value:.2g}"
        if quantity in part.attrs["logarithmic"]:
            amount = f"{100 * np.expm1(value):.0f} %"
        detectable.append(f"{quantity} {amount}")
    if not detectable:
        return []
    listed = few_names(detectable, MAX_LISTED)
    return [f"{name}: detectable differences (power 80 %): {listed}"]


def plot_group_effects(table: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot effects with their 95 % intervals in standard deviations between subjects, or
    within one subject in per cent, one row per quantity.
    """
    names = table["quantity"].values.tolist()
    contrasts = table["contrast"].values.tolist()
    ax, places = plots.axes_of_rows(names, ax, lines=len(contrasts))
    ax.axvline(0, color="0.6", linewidth=1)
    is_standardised = bool(table[variables.EFFECT_STANDARDISED].notnull().any())
    unit = "standard deviations between subjects" if is_standardised else "%"
    for i, contrast in enumerate(contrasts):
        part = table.sel(contrast=contrast)
        shown = part[list(INTERVAL)]
        if is_standardised:
            shown = shown / (
                part[variables.EFFECT] / part[variables.EFFECT_STANDARDISED]
            )
        else:
            shown = part[list(PERCENT)].rename(
                dict(zip(PERCENT, INTERVAL, strict=True))
            )
        colour = plots.CYCLE[i % len(plots.CYCLE)]
        marker = "osD^v"[i % 5]
        count = int(part[variables.EFFECT_COUNT].sum("side").max())
        label = plots.legend_entry(f"{contrast} (n = {count})")
        ax.plot([], [], marker, color=colour, markersize=4, label=label)
        plots.significant_intervals(
            ax,
            shown,
            variables.EFFECT,
            places - 0.6 * ((i + 0.5) / len(contrasts) - 0.5),
            part[variables.EFFECT_P_ADJUSTED].values < SIGNIFICANT,
            colour=colour,
            marker=marker,
        )
    adjusted = ", ".join(table.attrs["adjust"])
    held = f", {adjusted} held fixed" if adjusted else ""
    filled = "\nfilled: adjusted p < 0.05" if is_standardised else ""
    ax.set_xlabel(f"effect, 95 % CI [{unit}]{held}{filled}")
    plots.legend_above(ax)
    return ax


def tabulate_group_effects(table: Dataset) -> Table:
    """Header and one row per comparison and quantity."""
    counts = {
        f"subjects_{side}": table[variables.EFFECT_COUNT].sel(side=side, drop=True)
        for side in SIDES
    }
    names = [*counts, *COLUMNS]
    return table_of(table.assign(counts), names, ("contrast", "quantity"))


STUDY = Study(
    *DECLARED["groups"],
    layout="tables",
    compute=of_cohort("effects", group_effects),
    shown=("effects",),
    tabulate=tabulate_group_effects,
    plot=plot_group_effects,
    describe=describe_group_effects,
    columns_of_files=(
        variables.EFFECT_PERCENT_LOW,
        variables.EFFECT_PERCENT_HIGH,
        variables.EFFECT_P_FALSE_DISCOVERY,
        variables.EFFECT_DETECTABLE,
    ),
    conditions=compared_conditions,
)
