"""Comparison of groups of subjects: effects with intervals, p values and detectable effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy.special import gammaln

from skindb.analysis import colours
from skindb.analysis.members import (
    CONDITION,
    NORMAL,
    attributes,
    comparable_takes,
    has_attribute,
    has_trait,
    takes_to_compare,
    texts,
    trait_of,
)
from skindb.analysis.quantities import (
    SURFACE,
    Quantities,
    attribute_has_two_kinds,
    attribute_notes,
    attribute_of_subjects,
    columns_of,
    is_number,
    quantities_of,
    require_adjustable,
    require_one_kind,
)
from skindb.analysis.study import (
    Population,
    Results,
    Study,
    Table,
    adjust_option,
    compared_option,
    permutations_option,
    seed_option,
    table_of,
)
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
from skindb.schema import dataset
from skindb.schema.cohort import require_same_fit, require_takes
from skindb.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# subjects of a group, below which intervals depend on the assumption of normal values
FEW = 10
# multiple correlation from which an attribute counts as confounder: a quarter of the
# variance
ASSOCIATED = 0.5
# of the standardised regressors, above which coefficients can hardly be separated
MAX_CONDITION_NUMBER = 30.0
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
CONTRAST_RULE = "the subjects must determine the effect"
CONTRAST_CURE = "adjust for fewer attributes, compare other groups, or add subjects"


@dataclass(frozen=True)
class Contrast:
    """One comparison, between subjects or of differences within subjects."""

    name: str
    quantities: Quantities  # of the subjects, or differences within subjects
    regressor: Array  # (n,) compared attribute; 1 for differences within subjects
    covariates: Array  # (n, c)
    is_number: bool = False  # whether the compared attribute is numeric
    # (n, q) values in the condition normal, for differences within subjects
    before: Array | None = None

    @property
    def is_paired(self) -> bool:
        """Whether the contrast is of differences within subjects."""
        return self.before is not None


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
    others = other_attributes(cohort, group_by)
    columns: dict[str, list[Array]] = {}
    names = []
    counts = []
    smallest = []
    flags = []
    faults = []
    for one in contrasts(cohort, group_by, adjust, quantities_of):
        try:
            found, count = _contrast_statistics(one, permutations, rng)
        except ValueError as error:
            faults.append(Fault(one.name, CONTRAST_RULE, str(error), CONTRAST_CURE))
            continue
        measured = one.quantities
        associated = associations(one, cohort, others)
        for name, values in {
            **found,
            "attribute_association": np.array(list(associated.values())),
        }.items():
            columns.setdefault(name, []).append(values)
        names.append(one.name)
        counts.append(count)
        flags += contrast_flags(
            one, cohort, associated, adjust, found["effect_count"]
        ) + _surface_flag(one, found)
        smallest.append(least := _least_p(one, count))
        if least >= SIGNIFICANT:
            few = f"with {len(one.regressor)} subjects no p value can be below {least:.2g}"
            flags.append(
                f"{one.name}: {few}, so that no difference can be significant at 5 %"
            )
    if not names:
        raise InputError(faults)
    flags += [f"{fault.where}: excluded, {fault.found}" for fault in faults]
    flags += notes_on_attributes(cohort)
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


def contrasts(
    cohort: xr.Dataset,
    group_by: str,
    adjust: Sequence[str],
    measure: Callable[[xr.Dataset], Quantities],
) -> list[Contrast]:
    """Comparisons by an attribute of the quantities that `measure` computes from takes;
    see `group_effects`.
    """
    own = _attribute_of(cohort, group_by)
    if own == CONDITION:
        if adjust:
            rule = "conditions are compared within subjects, which holds everything else fixed"
            raise InputError(
                Fault("adjust", rule, ", ".join(adjust), "omit this option")
            )
        return _paired(cohort, group_by, measure)
    require_adjustable(cohort, adjust, own)
    takes = takes_to_compare(cohort, group_by)
    quantities = measure(takes).of_subjects()
    for name in (own, *adjust):
        require_one_kind(name, attribute_of_subjects(takes, name, quantities.subject))
    held = [
        columns_of(attribute_of_subjects(takes, name, quantities.subject))
        for name in adjust
    ]
    covariates = np.concatenate([np.empty((len(quantities.subject), 0)), *held], axis=1)

    def contrast(name: str, regressor: Array, *, number: bool = False) -> Contrast:
        known = np.isfinite(regressor) & np.isfinite(covariates).all(axis=1)
        return Contrast(
            name,
            quantities.of_takes(known),
            regressor[known],
            covariates[known],
            number,
        )

    if group_by not in attributes(cohort):
        trait = trait_of(cohort, group_by)
        usable = comparable_takes(takes, trait) & has_attribute(takes, trait)
        carries: dict[str | None, float] = {}
        # has_trait reads all takes, because the median age is that of all subjects
        whole = dict(zip(texts(cohort["take"]), has_trait(cohort, trait), strict=True))
        carried = [whole[take] for take in texts(takes["take"])]
        for subject, with_it, is_usable in zip(
            texts(takes["subject"]), carried, usable, strict=True
        ):
            if is_usable:
                carries.setdefault(subject, float(with_it))
        return [
            contrast(
                f"{trait} less others",
                np.array([carries.get(one, np.nan) for one in quantities.subject]),
            )
        ]
    stated = attribute_of_subjects(takes, group_by, quantities.subject)
    words = sorted({_word(one) for one in stated if one is not None})
    if len(words) < 2:
        found = f"only {words[0]}" if words else "no subject with this attribute"
        rule = "there must be subjects of two groups"
        raise InputError(
            Fault(f"group by {group_by}", rule, found, "group by another attribute")
        )
    if is_number(stated):
        numbers = np.array(
            [np.nan if one is None else float(str(one)) for one in stated]
        )
        return [contrast(f"{group_by}, per unit", numbers, number=True)]
    each = words[1:] if len(words) == 2 else words
    rest = words[0] if len(words) == 2 else "others"

    def is_of(word: str) -> Array:
        return np.array(
            [np.nan if one is None else float(_word(one) == word) for one in stated]
        )

    return [contrast(f"{word} less {rest}", is_of(word)) for word in each]


def _paired(
    cohort: xr.Dataset, group_by: str, measure: Callable[[xr.Dataset], Quantities]
) -> list[Contrast]:
    """Differences of each condition to normal, within the subjects who were measured in both."""
    conditions = np.array([str(one) for one in texts(cohort[CONDITION])])
    named = sorted(set(conditions) - {NORMAL})
    if group_by != CONDITION:
        named = [trait_of(cohort, group_by).partition(":")[2]]
    every = measure(cohort)
    plain = every.of_takes(conditions == NORMAL)
    found = []
    for name in named:
        changed = every.of_takes(conditions == name)
        both = [one for one in dict.fromkeys(changed.subject) if one in plain.subject]
        if not both:
            continue
        after, before = (
            _select_subjects(one.of_subjects(), both) for one in (changed, plain)
        )
        errors = np.hypot(after.errors, before.errors)
        difference = replace(after, values=after.values - before.values, errors=errors)
        ones = np.ones(len(both))
        nothing = np.empty((len(both), 0))
        found.append(
            Contrast(
                f"{name} less {NORMAL}", difference, ones, nothing, before=before.values
            )
        )
    if not found:
        rule = "some subjects must be measured in both conditions"
        raise InputError(
            Fault(
                f"group by {group_by}",
                rule,
                "none",
                "measure subjects in two conditions",
            )
        )
    return found


def _select_subjects(quantities: Quantities, subjects: Sequence[str]) -> Quantities:
    """The quantities of the named subjects, in their order."""
    rows = [quantities.subject.index(one) for one in subjects]
    return replace(
        quantities,
        values=quantities.values[rows],
        errors=quantities.errors[rows],
        subject=tuple(subjects),
    )


def _contrast_statistics(
    one: Contrast, most: int, rng: np.random.Generator
) -> tuple[dict[str, Array], int]:
    """Variables of a contrast for every quantity, and the number of permutations."""
    values = one.quantities.values
    if one.before is not None:
        fit = paired_effects(values)
        p, adjusted, count = sign_flip_p(values, max_draws=most, rng=rng)
        reference = known_mean(np.where(np.isfinite(values), one.before, np.nan))
    else:
        fit = effects(values, one.regressor, one.covariates)
        p, adjusted, count = permutation_p(
            values, one.regressor, one.covariates, max_draws=most, rng=rng
        )
        known = np.isfinite(values)
        centre = known_mean(np.where(known, one.regressor[:, None], np.nan))
        reference = known_mean(values) - (0.0 if one.is_number else fit.slope * centre)
    percent, low, high = _percent(fit, reference, one.quantities)
    discovered = np.full(len(p), np.nan)
    discovered[np.isfinite(p)] = benjamini_hochberg(p[np.isfinite(p)])
    standardised = np.divide(
        fit.slope, fit.spread, out=np.full_like(fit.slope, np.nan), where=fit.spread > 0
    )
    return {
        "effect_count": contrast_counts(one),
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
        if _least_p(one, count) < SIGNIFICANT
        else np.full_like(fit.error, np.nan),
    }, count


def _least_p(one: Contrast, count: int) -> float:
    """The smallest p value that is possible with this number of permutations and subjects."""
    least = 1 / (count + 1)
    if one.is_paired:  # with all signs changed, the statistic has the same magnitude
        return max(least, 2.0 ** (1 - len(one.regressor)))
    if one.covariates.shape[1]:
        return least
    # permutations within a group change nothing
    sizes = np.unique(one.regressor, return_counts=True)[1]
    # exchanging both groups only changes the sign
    mirrored = 2.0 if len(sizes) == 2 and sizes[0] == sizes[1] else 1.0
    allocations = float(
        np.exp(
            gammaln(len(one.regressor) + 1) - sum(gammaln(size + 1) for size in sizes)
        )
    )
    return max(least, mirrored / allocations)


def _percent(
    fit: Effects, reference: Array, quantities: Quantities
) -> tuple[Array, ...]:
    """Effects and ends of intervals in per cent; the outer ends include the bias that
    all takes have in common.

    A decrease is at most 100 %; the upper end is NaN where the true level may be 0.
    """
    least = np.maximum(reference - quantities.common, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = fit.slope / reference
        low = np.maximum(fit.low / np.where(fit.low < 0, least, reference), -1.0)
        high = fit.high / np.where(fit.high > 0, least, reference)
    ratios = zip((slope, low, high), (fit.slope, fit.low, fit.high), strict=True)
    percent = [
        100 * np.where(quantities.is_log, np.expm1(logs), ratio)
        for ratio, logs in ratios
    ]
    return tuple(np.where(np.isfinite(one), one, np.nan) for one in percent)


def contrast_counts(one: Contrast) -> Array:
    """Numbers (quantity, side) of subjects with and without; for numeric attributes and
    pairs, all count as "with".
    """
    known = np.isfinite(one.quantities.values)
    is_with = (
        np.ones(len(known), np.bool_)
        if one.is_number or one.is_paired
        else one.regressor > 0
    )
    return np.stack([known[is_with].sum(axis=0), known[~is_with].sum(axis=0)], axis=1)


def _association(one: Contrast, cohort: xr.Dataset, other: str) -> float:
    """Multiple correlation of the compared attribute with another; 0 within subjects,
    NaN if it is unknown.
    """
    if one.is_paired:
        return 0.0
    stated = attribute_of_subjects(cohort, other, one.quantities.subject)
    if attribute_has_two_kinds(stated):
        return float("nan")
    columns = columns_of(stated)
    known = np.isfinite(columns).all(axis=1)
    y = one.regressor[known]
    x = np.column_stack([np.ones(known.sum()), columns[known]])
    if not known.any() or np.ptp(y) == 0:
        return float("nan")
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    free = len(y) - np.linalg.matrix_rank(x)
    if free < 1:
        return float("nan")
    unexplained = (left @ left / free) / (np.var(y) * len(y) / (len(y) - 1))
    return float(np.sqrt(max(0.0, 1.0 - unexplained)))


def notes_on_attributes(cohort: xr.Dataset) -> list[str]:
    """Lines about values of attributes that are likely to be mistakes."""
    subjects = tuple(dict.fromkeys(str(one) for one in texts(cohort["subject"])))
    named = [name for name in attributes(cohort) if name != CONDITION]
    return [
        line
        for name in named
        for line in attribute_notes(name, attribute_of_subjects(cohort, name, subjects))
    ]


def other_attributes(cohort: xr.Dataset, group_by: str) -> list[str]:
    """Attributes that may be confounded with the compared one."""
    return [
        name
        for name in attributes(cohort)
        if name not in (CONDITION, _attribute_of(cohort, group_by))
    ]


def associations(
    one: Contrast, cohort: xr.Dataset, others: Sequence[str]
) -> dict[str, float]:
    """Multiple correlations of the compared attribute with each of the others."""
    return {other: _association(one, cohort, other) for other in others}


def contrast_flags(
    one: Contrast,
    cohort: xr.Dataset,
    associated: dict[str, float],
    adjust: Sequence[str],
    count: Array,
) -> list[str]:
    """Warnings about a comparison: few subjects, correlated attributes and extrapolation."""
    most = [int(side) for side in count.max(axis=0)]
    sides = most[:1] if one.is_number or one.is_paired else most
    flags = []
    if min(sides) < FEW:
        among = (
            f"{sides[0]} subjects"
            if len(sides) == 1
            else f"{sides[0]} subjects with and {sides[1]} without"
        )
        flags.append(
            f"{one.name}: {among}; with fewer than {FEW} the intervals assume normal values"
        )
    if one.is_paired:
        return flags
    for other, value in associated.items():
        if not value >= ASSOCIATED or other in adjust:
            continue
        cure = f"adjust for {other} if it may cause the effect"
        flags.append(
            f"{one.name}: is correlated with {other} (adjusted multiple "
            f"correlation {value:.2f}); {cure}"
        )
    for other in adjust:
        stated = attribute_of_subjects(cohort, other, one.quantities.subject)
        if is_number(stated) or one.is_number:
            continue
        for word in sorted({_word(value) for value in stated}):
            has = np.array([_word(value) == word for value in stated])
            for side, name in (
                (one.regressor > 0, "with"),
                (one.regressor == 0, "without"),
            ):
                if not (has & side).any():
                    flags.append(
                        f"{one.name}: no subject {name} the compared value has {other} {word}; "
                        "the adjustment extrapolates there"
                    )
    spread = np.column_stack([one.regressor, one.covariates])
    spread = (spread - spread.mean(axis=0)) / np.maximum(spread.std(axis=0), 1e-300)
    if (number := float(np.linalg.cond(spread))) > MAX_CONDITION_NUMBER:
        flags.append(
            f"{one.name}: can hardly be separated from {', '.join(adjust)} "
            f"(condition number {number:.0f})"
        )
    return flags


def _surface_flag(one: Contrast, found: dict[str, Array]) -> list[str]:
    """Warning if surface reflectance differs, because its diffuse part is counted as albedo."""
    names = np.array(one.quantities.names)
    differ = found["effect_p_adjusted"] < SIGNIFICANT
    small = differ & (np.abs(found["effect"]) < one.quantities.common)
    if not (differ & np.char.startswith(names, SURFACE)).any() or not small.any():
        return []
    limit = float(one.quantities.common.max())
    note = f"differences of R_d up to {limit:g} may be due to its even reflection"
    return [f"{one.name}: the surface reflectance differs as well; {note}"]


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
        one = table.sel(contrast=name)
        compared = np.isfinite(one["effect_p"].values)
        differ = one["effect_p_adjusted"].values < SIGNIFICANT
        subjects = int(one["effect_count"].sum("side").max())
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
            least = [
                f"{quantity} {_amount(value, quantity in table.attrs['logarithmic'])}"
                for quantity, value in zip(
                    table["quantity"].values,
                    one["effect_detectable"].values,
                    strict=True,
                )
                if np.isfinite(value)
            ]
            shown = ", ".join(least[:6]) + (
                f" and {len(least) - 6} more" if len(least) > 6 else ""
            )
            lines += (
                []
                if not least
                else [f"{name}: detectable differences (power 80 %): {shown}"]
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
    from matplotlib import pyplot

    names = [str(name) for name in table["quantity"].values]
    if ax is None:
        _, ax = pyplot.subplots(figsize=(6.5, 1.2 + 0.22 * len(names)))
    ax.axvline(0, color="0.6", linewidth=1)
    places = np.arange(len(names))[::-1]
    contrasts = [str(name) for name in table["contrast"].values]
    for i, contrast in enumerate(contrasts):
        one = table.sel(contrast=contrast)
        effect = one["effect"].values
        scale = one["effect"].values / one["effect_standardised"].values
        bars = np.abs(
            np.stack(
                [effect - one["effect_low"].values, one["effect_high"].values - effect]
            )
            / scale
        )
        found = one["effect_p_adjusted"].values < SIGNIFICANT
        y = places + 0.6 * ((i + 0.5) / len(contrasts) - 0.5)
        colour = colours.CYCLE[i % len(colours.CYCLE)]
        count = int(one["effect_count"].sum("side").max())
        label = f"{contrast} (n = {count})"
        ax.plot([], [], "osD^v"[i % 5], color=colour, markersize=4, label=label)
        for kept, fill in ((found, colour), (~found, "white")):
            ax.errorbar(
                (effect / scale)[kept],
                y[kept],
                xerr=bars[:, kept],
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


def _attribute_of(cohort: xr.Dataset, name: str) -> str:
    """The attribute to which a trait belongs; the name itself if it is an attribute."""
    return (
        name if name in attributes(cohort) else trait_of(cohort, name).partition(":")[0]
    )


def _word(value: Any) -> str:
    return (
        str(int(value))
        if isinstance(value, float) and value.is_integer()
        else str(value)
    )


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
