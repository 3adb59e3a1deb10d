"""Comparison of groups of subjects: effects with intervals, p values and detectable effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from scipy.special import gammaln

from skindb import plots
from skindb.analysis.contrasts import (
    CONTRAST_CURE,
    CONTRAST_RULE,
    SURFACE,
    Contrast,
    Quantities,
    associations,
    contrast_counts,
    contrast_flags,
    contrasts,
    other_attributes,
    quantities_of,
)
from skindb.analysis.study import Population, Results, Study, Table, table_of
from skindb.analysis.subjects import notes_on_attributes, subjects_of
from skindb.errors import Fault, InputError
from skindb.numerics.inference import (
    Effects,
    effects,
    paired_effects,
    permutation_p,
    sign_flip_p,
)
from skindb.numerics.statistics import (
    benjamini_hochberg,
    detectable_difference,
    known_mean,
)
from skindb.parameters import (
    adjust_option,
    compared_option,
    permutations_option,
    seed_option,
)
from skindb.schema import dataset
from skindb.schema.cohort import require_same_fit, require_takes
from skindb.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIGNIFICANT = 0.05  # of adjusted p values
SIDES = ("with", "without")
COLUMNS = (
    "effect",
    "effect_low",
    "effect_high",
    "effect_percent",
    "effect_percent_low",
    "effect_percent_high",
    "effect_p",
    "effect_p_adjusted",
    "effect_p_false_discovery",
    "effect_detectable",
)


def group_effects(
    cohort: xr.Dataset,
    *,
    group_by: str,
    adjust: Sequence[str] = (),
    permutations: int = 10_000,
    mixed_fits: bool = False,
    rng: np.random.Generator,
) -> xr.Dataset:
    """Differences between groups of subjects in all measured quantities.

    Subjects are compared in the condition normal, each with the mean of its takes.
    Conditions are compared within the subjects who were measured in both.

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
    permutations
        Maximum number of permutations for p values; if there are fewer, all of them are used.
    mixed_fits
        Accept takes that were fitted with different parameters.
    rng
        Random generator of the permutations.

    Returns
    -------
    Dataset
        (contrast, quantity), see the variables of the group "effects": effect with HC3
        interval, also in per cent and in standard deviations; p values (unadjusted,
        adjusted by the largest statistic, and by the false discovery rate); and the
        smallest detectable effect. sigma_tr is compared by its logarithm. NaN where too
        few subjects have a quantity. R_d may be too high by the same amount in all
        takes (even reflection): this cancels in differences, and the outer ends of the
        intervals in per cent include it. Attribute "flags": small or missing groups,
        and confounded attributes.

    Raises
    ------
    InputError
        If there are no groups to compare, or if the takes were fitted with different parameters.

    References
    ----------
    MacKinnon and White 1985 (HC3); Freedman and Lane 1983; Westfall and Young 1993;
    Benjamini and Hochberg 1995.
    """
    require_takes(cohort, "tables")
    adjust = (adjust,) if isinstance(adjust, str) else tuple(adjust)
    if not mixed_fits:
        require_same_fit(cohort)
    subjects = subjects_of(cohort)
    others = other_attributes(subjects, group_by)
    columns: dict[str, list[Array]] = {}
    names = []
    counts = []
    smallest = []
    flags = []
    faults = []
    for contrast in contrasts(cohort, group_by, adjust, quantities_of):
        try:
            variables, count = _contrast_statistics(contrast, permutations, rng)
        except ValueError as error:
            faults.append(
                Fault(contrast.name, CONTRAST_RULE, str(error), CONTRAST_CURE)
            )
            continue
        measured = contrast.quantities
        associated = associations(contrast, subjects, others)
        for name, values in {
            **variables,
            "attribute_association": np.array(list(associated.values())),
        }.items():
            columns.setdefault(name, []).append(values)
        names.append(contrast.name)
        counts.append(count)
        flags += contrast_flags(
            contrast, subjects, associated, adjust, variables["effect_count"]
        ) + _surface_flag(contrast, variables)
        smallest.append(least := _least_p(contrast, count))
        if least >= SIGNIFICANT:
            few = f"with {len(contrast.regressor)} subjects no p value can be below {least:.2g}"
            flags.append(
                f"{contrast.name}: {few}, so that no difference can be significant at 5 %"
            )
    if not names:
        raise InputError(faults)
    flags += [f"{fault.where}: excluded, {fault.found}" for fault in faults]
    flags += notes_on_attributes(subjects)
    return dataset(
        {name: np.stack(values) for name, values in columns.items()},
        coords={
            "contrast": names,
            "quantity": list(measured.names),
            "side": list(SIDES),
            "attribute": others,
        },
        attrs={
            "group_by": group_by,
            "adjust": list(adjust),
            "permutations": counts,
            "smallest_p": smallest,
            "logarithmic": [
                name
                for name, is_log in zip(measured.names, measured.is_log, strict=True)
                if is_log
            ],
            "flags": flags,
            "skipped": list(cohort.attrs.get("skipped", [])),
        },
    )


def _contrast_statistics(
    contrast: Contrast, max_draws: int, rng: np.random.Generator
) -> tuple[dict[str, Array], int]:
    """Variables of a contrast for every quantity, and the number of permutations."""
    values = contrast.quantities.values
    if contrast.before is not None:
        fit = paired_effects(values)
        p, adjusted, count = sign_flip_p(values, max_draws=max_draws, rng=rng)
        reference = known_mean(np.where(np.isfinite(values), contrast.before, np.nan))
    else:
        fit = effects(values, contrast.regressor, contrast.covariates)
        p, adjusted, count = permutation_p(
            values,
            contrast.regressor,
            contrast.covariates,
            max_draws=max_draws,
            rng=rng,
        )
        is_known = np.isfinite(values)
        centre = known_mean(np.where(is_known, contrast.regressor[:, None], np.nan))
        reference = known_mean(values) - (
            0.0 if contrast.is_number else fit.slope * centre
        )
    percent, low, high = _percent(fit, reference, contrast.quantities)
    discovered = np.full(len(p), np.nan)
    discovered[np.isfinite(p)] = benjamini_hochberg(p[np.isfinite(p)])
    standardised = np.divide(
        fit.slope, fit.spread, out=np.full_like(fit.slope, np.nan), where=fit.spread > 0
    )
    return {
        "effect_count": contrast_counts(contrast),
        "effect": fit.slope,
        "effect_low": fit.low,
        "effect_high": fit.high,
        "effect_percent": percent,
        "effect_percent_low": low,
        "effect_percent_high": high,
        "effect_standardised": standardised,
        "effect_p": p,
        "effect_p_adjusted": adjusted,
        "effect_p_false_discovery": discovered,
        "effect_detectable": detectable_difference(fit.error, fit.free)
        if _least_p(contrast, count) < SIGNIFICANT
        else np.full_like(fit.error, np.nan),
    }, count


def _least_p(contrast: Contrast, count: int) -> float:
    """The smallest p value that is possible with this number of permutations and subjects."""
    smallest = 1 / (count + 1)
    if (
        contrast.is_paired
    ):  # with all signs changed, the statistic has the same magnitude
        return max(smallest, 2.0 ** (1 - len(contrast.regressor)))
    if contrast.covariates.shape[1]:
        return smallest
    # permutations within a group change nothing
    sizes = np.unique(contrast.regressor, return_counts=True)[1]
    # exchanging both groups only changes the sign
    mirrored = 2.0 if len(sizes) == 2 and sizes[0] == sizes[1] else 1.0
    allocations = float(
        np.exp(
            gammaln(len(contrast.regressor) + 1)
            - sum(gammaln(size + 1) for size in sizes)
        )
    )
    return max(smallest, mirrored / allocations)


def _percent(
    fit: Effects, reference: Array, quantities: Quantities
) -> tuple[Array, ...]:
    """Effects and ends of intervals in per cent; the outer ends include the bias that
    all takes have in common.

    A decrease is at most 100 %; the upper end is NaN where the true level may be 0.
    """
    lowest = np.maximum(reference - quantities.common, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = fit.slope / reference
        low = np.maximum(fit.low / np.where(fit.low < 0, lowest, reference), -1.0)
        high = fit.high / np.where(fit.high > 0, lowest, reference)
    ratios = zip((slope, low, high), (fit.slope, fit.low, fit.high), strict=True)
    percent = [
        100 * np.where(quantities.is_log, np.expm1(logs), ratio)
        for ratio, logs in ratios
    ]
    return tuple(
        np.where(np.isfinite(contrast), contrast, np.nan) for contrast in percent
    )


def _surface_flag(contrast: Contrast, variables: dict[str, Array]) -> list[str]:
    """Warning if surface reflectance differs, because its diffuse part is counted as albedo."""
    names = np.array(contrast.quantities.names)
    differ = variables["effect_p_adjusted"] < SIGNIFICANT
    small = differ & (np.abs(variables["effect"]) < contrast.quantities.common)
    if not (differ & np.char.startswith(names, SURFACE)).any() or not small.any():
        return []
    limit = float(contrast.quantities.common.max())
    note = f"differences of R_d up to {limit:g} may be due to its even reflection"
    return [f"{contrast.name}: the surface reflectance differs as well; {note}"]


def describe_group_effects(table: xr.Dataset) -> list[str]:
    """Numbers of significant effects, detectable effects and flags of the comparisons,
    one line each.
    """
    lines = []
    held = ", ".join(table.attrs["adjust"])
    counts = table.attrs["permutations"]
    smallest_p = table.attrs["smallest_p"]
    for name, count, least_p in zip(
        table["contrast"].values, counts, smallest_p, strict=True
    ):
        part = table.sel(contrast=name)
        compared = np.isfinite(part["effect_p"].values)
        differ = part["effect_p_adjusted"].values < SIGNIFICANT
        subjects = int(part["effect_count"].sum("side").max())
        limit = ""
        if least_p > 1.5 / (count + 1):
            limit = f", the smallest possible p is {least_p:.2g}"
        lines.append(
            f"{name}: {differ.sum()} of {compared.sum()} quantities differ "
            f"{f'with {held} held fixed ' if held else ''}"
            f"(adjusted p < 0.05; {count} permutations of {subjects} subjects"
            f"{limit})"
        )
        if not differ.any() and compared.any():
            detectable = [
                f"{quantity} {_amount(value, quantity in table.attrs['logarithmic'])}"
                for quantity, value in zip(
                    table["quantity"].values,
                    part["effect_detectable"].values,
                    strict=True,
                )
                if np.isfinite(value)
            ]
            listed = ", ".join(detectable[:6]) + (
                f" and {len(detectable) - 6} more" if len(detectable) > 6 else ""
            )
            lines += (
                []
                if not detectable
                else [f"{name}: detectable differences (power 80 %): {listed}"]
            )
    logarithmic = (
        ", effects of sigma_tr are differences of its natural logarithm"
        if table.attrs["logarithmic"]
        else ""
    )
    lines.append(f"low and high are the ends of 95 % intervals{logarithmic}")
    lines.append(
        "adjusted p values account for the number of quantities (largest "
        "statistic, Westfall and Young)"
    )
    return [*lines, *table.attrs["flags"]]


def _amount(value: float, is_log: bool) -> str:
    return f"{100 * np.expm1(value):.0f} %" if is_log else f"{value:.2g}"


def plot_group_effects(table: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot effects with their 95 % intervals in standard deviations between subjects,
    one row per quantity.
    """
    names = [str(name) for name in table["quantity"].values]
    ax = ax or plots.new_axes(6.5, 1.2 + 0.22 * len(names))
    ax.axvline(0, color="0.6", linewidth=1)
    places = np.arange(len(names))[::-1]
    contrasts = [str(name) for name in table["contrast"].values]
    for i, contrast in enumerate(contrasts):
        part = table.sel(contrast=contrast)
        effect = part["effect"].values
        scale = part["effect"].values / part["effect_standardised"].values
        bars = np.abs(
            np.stack(
                [
                    effect - part["effect_low"].values,
                    part["effect_high"].values - effect,
                ]
            )
            / scale
        )
        is_significant = part["effect_p_adjusted"].values < SIGNIFICANT
        y = places + 0.6 * ((i + 0.5) / len(contrasts) - 0.5)
        colour = plots.CYCLE[i % len(plots.CYCLE)]
        count = int(part["effect_count"].sum("side").max())
        label = f"{contrast} (n = {count})"
        ax.plot([], [], "osD^v"[i % 5], color=colour, markersize=4, label=label)
        for rows, fill in ((is_significant, colour), (~is_significant, "white")):
            ax.errorbar(
                (effect / scale)[rows],
                y[rows],
                xerr=bars[:, rows],
                fmt="osD^v"[i % 5],
                color=colour,
                mfc=fill,
                markersize=4,
                capsize=2,
                linewidth=1,
            )
    ax.set_yticks(places, names, fontsize=7)
    ax.set_ylim(-0.6, len(names) - 0.4)
    held = (
        f", {', '.join(table.attrs['adjust'])} held fixed"
        if table.attrs["adjust"]
        else ""
    )
    ax.set_xlabel(
        f"effect, 95 % CI [standard deviations between subjects]{held}\nfilled: adjusted p < 0.05"
    )
    ax.legend(
        fontsize=7,
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=2,
        frameon=False,
    )
    return ax


def tabulate_group_effects(table: xr.Dataset) -> Table:
    """Header and one row per comparison and quantity."""
    counts = {
        f"subjects_{side}": table["effect_count"].sel(side=side, drop=True)
        for side in SIDES
    }
    names = [*counts, *COLUMNS]
    return table_of(table.assign(counts), names, ("contrast", "quantity"))


@dataclass(frozen=True)
class Parameters:
    """Parameters of the study of groups."""

    group_by: str = compared_option()
    adjust: tuple[str, ...] = adjust_option()
    permutations: int = permutations_option()
    seed: int = seed_option("the permutations")


def compute(population: Population, parameters: Parameters) -> Results:
    """The results of the study."""
    effects = group_effects(
        population.cohort,
        group_by=parameters.group_by,
        adjust=parameters.adjust,
        permutations=parameters.permutations,
        mixed_fits=population.mixed_fits,
        rng=np.random.default_rng(parameters.seed),
    )
    return {"effects": effects}


STUDY = Study(
    name="groups",
    description="differences between groups of subjects, with intervals and p values",
    layout="tables",
    parameters=Parameters,
    compute=compute,
    shown=("effects",),
    tabulate=tabulate_group_effects,
    plot=plot_group_effects,
    describe=describe_group_effects,
    columns_of_files=(
        "effect_percent_low",
        "effect_percent_high",
        "effect_p_false_discovery",
        "effect_detectable",
    ),
    compares_normal=True,
)
