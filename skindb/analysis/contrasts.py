"""Comparisons of groups of subjects in the measured quantities: what the studies of groups
and of maps have in common. The unit of inference is the subject.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.subjects import (
    CONDITION,
    NORMAL,
    Subjects,
    attribute_of,
    comparable_takes,
    has_attribute,
    has_trait,
    multiple_correlation,
    require_adjustable,
    subjects_of,
    takes_to_compare,
    trait_of,
    word_of,
)
from skindb.errors import Fault, InputError
from skindb.numerics.statistics import known_mean
from skindb.schema import IDENTIFIED
from skindb.types import Array, Mask

CHANNELS = ("R", "G", "B")
SURFACE = "surface reflectance"
# subjects of a group, below which intervals depend on the assumption of normal values
FEW = 10
# multiple correlation from which an attribute counts as confounder: a quarter of the
# variance
ASSOCIATED = 0.5
# of the standardised regressors, above which coefficients can hardly be separated
MAX_CONDITION_NUMBER = 30.0
CONTRAST_RULE = "the subjects must determine the effect"
CONTRAST_CURE = "adjust for fewer attributes, compare other groups, or add subjects"


@dataclass(frozen=True)
class Quantities:
    """Measured values of takes or of subjects."""

    names: tuple[str, ...]  # for example "R_d face G"
    values: Array  # (n, q) NaN where there is no value; logarithms where `is_log`
    # (n, q) standard errors that are independent between takes; NaN where none is
    # stated
    errors: Array
    # (q,) whether logarithms are compared, so that intervals stay positive
    is_log: Mask
    # (q,) limit of a bias to higher values that all takes have in common; 0 where there
    # is none
    common: Array
    subject: tuple[str, ...]  # (n,) names of the subjects

    def of_subjects(self) -> Quantities:
        """Means over the takes of every subject."""
        names = list(dict.fromkeys(self.subject))
        takes = [
            np.array([name == subject for subject in self.subject]) for name in names
        ]
        values = np.stack([known_mean(self.values[rows]) for rows in takes])
        squares = np.stack(
            [known_mean(self.errors[rows] ** 2) / rows.sum() for rows in takes]
        )
        return replace(
            self, values=values, errors=np.sqrt(squares), subject=tuple(names)
        )

    def of_takes(self, rows: Mask) -> Quantities:
        """The quantities of the selected takes."""
        return self._select(np.flatnonzero(rows))

    def of_named(self, subjects: Sequence[str]) -> Quantities:
        """The quantities of the named subjects, in their order."""
        return self._select([self.subject.index(name) for name in subjects])

    def _select(self, rows: Sequence[int] | NDArray[np.intp]) -> Quantities:
        return replace(
            self,
            values=self.values[rows],
            errors=self.errors[rows],
            subject=tuple(self.subject[i] for i in rows),
        )


def quantities_of(cohort: xr.Dataset) -> Quantities:
    """Albedo and surface reflectance of regions and log sigma_tr of probe sites, for every take.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.

    Raises
    ------
    InputError
        If no take has any of these quantities.
    """
    limit = 0.0
    if (
        "fit_even_reflection" in cohort.coords
        and np.isfinite(cohort["fit_even_reflection"].values.astype(float)).any()
    ):
        limit = float(np.nanmax(cohort["fit_even_reflection"].values.astype(float)))
    names: list[str] = []
    columns: list[tuple[Array, Array, bool, float]] = []

    def add(
        prefix: str,
        variable: str,
        dims: tuple[str, ...],
        *,
        is_log: bool = False,
        common: float = 0.0,
    ) -> None:
        if variable not in cohort:
            return
        values = np.asarray(
            cohort[variable].transpose("take", *dims).values, np.float64
        )
        has_errors = f"{variable}_error" in cohort
        errors = (
            np.asarray(cohort[f"{variable}_error"].transpose("take", *dims).values)
            if has_errors
            else values * np.nan
        )
        if is_log:
            good = cohort["site_status"].isin(IDENTIFIED).transpose(
                "take", *dims[:-1], "channel"
            ).values & (values > 0)
            errors = np.where(good, errors / np.where(good, values, 1.0), np.nan)
            values = np.where(good, np.log(np.where(good, values, 1.0)), np.nan)
        for index in np.ndindex(values.shape[1:]):
            labels = [
                CHANNELS if dim == "channel" else cohort[dim].values for dim in dims
            ]
            names.append(
                " ".join(
                    [
                        prefix,
                        *(
                            str(names_of_dim[i])
                            for names_of_dim, i in zip(labels, index, strict=True)
                        ),
                    ]
                )
            )
            columns.append((values[:, *index], errors[:, *index], is_log, common))

    cohort = cohort[
        [name for name in cohort if str(name).startswith(("region_", "site_"))]
    ].load()
    add("R_d", "region_diffuse_reflectance", ("region", "channel"), common=limit)
    add(SURFACE, "region_surface_reflectance", ("region",))
    add("sigma_tr", "site_sigma_tr", ("site", "channel"), is_log=True)
    measured = [i for i, column in enumerate(columns) if np.isfinite(column[0]).any()]
    if not measured:
        rule = "some take must have albedo, surface reflectance or sigma_tr"
        raise InputError(
            Fault("population", rule, "none of them", "fit the takes again")
        )
    values, errors, is_log, common = zip(*(columns[i] for i in measured), strict=True)
    subject = tuple(map(str, cohort["subject"].values))
    stacked = np.stack(values, axis=1), np.stack(errors, axis=1)
    return Quantities(
        tuple(names[i] for i in measured),
        *stacked,
        np.array(is_log),
        np.array(common),
        subject,
    )


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


def contrasts(
    cohort: xr.Dataset,
    group_by: str,
    adjust: Sequence[str],
    measure: Callable[[xr.Dataset], Quantities],
) -> list[Contrast]:
    """Comparisons by an attribute of the quantities that `measure` computes from takes;
    see `group_effects`.
    """
    everyone = subjects_of(cohort)
    compared = attribute_of(everyone, group_by)
    if compared == CONDITION:
        if adjust:
            rule = "conditions are compared within subjects, which holds everything else fixed"
            raise InputError(
                Fault("adjust", rule, ", ".join(adjust), "omit this option")
            )
        return _paired(cohort, group_by, measure)
    require_adjustable(everyone, adjust, compared)
    takes, subjects = takes_to_compare(cohort, group_by)
    quantities = measure(takes).of_subjects()
    names = quantities.subject
    stated = subjects.by_subject(compared, names)
    held = [subjects.by_subject(name, names) for name in adjust]
    for attribute in (stated, *held):
        attribute.require_one_kind()
    nothing = np.empty((len(names), 0))
    covariates = np.concatenate([nothing, *(one.columns for one in held)], axis=1)

    def contrast(name: str, regressor: Array, *, is_number: bool = False) -> Contrast:
        is_complete = np.isfinite(regressor) & np.isfinite(covariates).all(axis=1)
        return Contrast(
            name,
            quantities.of_takes(is_complete),
            regressor[is_complete],
            covariates[is_complete],
            is_number,
        )

    if group_by not in everyone.attributes:
        trait = trait_of(everyone, group_by)
        carries = _carriers(everyone, subjects, trait)
        regressor = np.array([carries.get(name, np.nan) for name in names])
        return [contrast(f"{trait} less others", regressor)]
    words = sorted({word_of(value) for value in stated.known})
    if len(words) < 2:
        finding = f"only {words[0]}" if words else "no subject with this attribute"
        rule = "there must be subjects of two groups"
        raise InputError(
            Fault(f"group by {group_by}", rule, finding, "group by another attribute")
        )
    if stated.is_numeric:
        return [contrast(f"{group_by}, per unit", stated.numbers, is_number=True)]

    def is_of(word: str) -> Array:
        is_known = np.array([value is not None for value in stated.values])
        is_word = np.array([word_of(value) == word for value in stated.values])
        return np.where(is_known, is_word.astype(np.float64), np.nan)

    if len(words) == 2:
        return [contrast(f"{words[1]} less {words[0]}", is_of(words[1]))]
    return [contrast(f"{word} less others", is_of(word)) for word in words]


def _carriers(everyone: Subjects, subjects: Subjects, trait: str) -> dict[str, float]:
    """Subject -> 1 with and 0 without a trait, from its first take that is compared."""
    usable = comparable_takes(subjects, trait) & has_attribute(subjects, trait)
    # of all takes, because the median age is that of all subjects
    of_take = dict(zip(everyone.take, has_trait(everyone, trait).tolist(), strict=True))
    carries: dict[str, float] = {}
    for i in np.flatnonzero(usable):
        carries.setdefault(subjects.subject[i], float(of_take[subjects.take[i]]))
    return carries


def _paired(
    cohort: xr.Dataset, group_by: str, measure: Callable[[xr.Dataset], Quantities]
) -> list[Contrast]:
    """Differences of each condition to normal, within the subjects who were measured in both."""
    subjects = subjects_of(cohort)
    conditions = np.array(list(map(str, subjects.attributes[CONDITION].values)))
    names = sorted(set(conditions) - {NORMAL})
    if group_by != CONDITION:
        names = [trait_of(subjects, group_by).partition(":")[2]]
    quantities = measure(cohort)
    plain = quantities.of_takes(conditions == NORMAL)
    pairs = []
    for name in names:
        changed = quantities.of_takes(conditions == name)
        both = [
            subject
            for subject in dict.fromkeys(changed.subject)
            if subject in plain.subject
        ]
        if not both:
            continue
        after = changed.of_subjects().of_named(both)
        before = plain.of_subjects().of_named(both)
        difference = replace(
            after,
            values=after.values - before.values,
            errors=np.hypot(after.errors, before.errors),
        )
        pairs.append(
            Contrast(
                f"{name} less {NORMAL}",
                difference,
                np.ones(len(both)),
                np.empty((len(both), 0)),
                before=before.values,
            )
        )
    if not pairs:
        rule = "some subjects must be measured in both conditions"
        cure = "measure subjects in two conditions"
        raise InputError(Fault(f"group by {group_by}", rule, "none", cure))
    return pairs


def contrast_counts(contrast: Contrast) -> Array:
    """Numbers (quantity, side) of subjects with and without; for numeric attributes and
    pairs, all count as "with".
    """
    is_known = np.isfinite(contrast.quantities.values)
    is_with = (
        np.ones(len(is_known), np.bool_)
        if contrast.is_number or contrast.is_paired
        else contrast.regressor > 0
    )
    return np.stack(
        [is_known[is_with].sum(axis=0), is_known[~is_with].sum(axis=0)], axis=1
    )


def other_attributes(subjects: Subjects, group_by: str) -> list[str]:
    """Attributes that may be confounded with the compared one."""
    compared = attribute_of(subjects, group_by)
    return [name for name in subjects.described if name != compared]


def associations(
    contrast: Contrast, subjects: Subjects, others: Sequence[str]
) -> dict[str, float]:
    """Multiple correlations of the compared attribute with each of the others; 0 within
    subjects, NaN where it is unknown.
    """
    return {name: _association(contrast, subjects, name) for name in others}


def _association(contrast: Contrast, subjects: Subjects, name: str) -> float:
    if contrast.is_paired:
        return 0.0
    other = subjects.by_subject(name, contrast.quantities.subject)
    if other.odd_words:
        return float("nan")
    columns = other.columns
    is_known = np.isfinite(columns).all(axis=1)
    if not is_known.any():
        return float("nan")
    return multiple_correlation(contrast.regressor[is_known], columns[is_known])


def contrast_flags(
    contrast: Contrast,
    subjects: Subjects,
    associated: dict[str, float],
    adjust: Sequence[str],
    count: Array,
) -> list[str]:
    """Warnings about a comparison: few subjects, correlated attributes and extrapolation."""
    flags = _few_subjects(contrast, count)
    if not contrast.is_paired:
        flags += _confounders(associated, adjust)
        for name in adjust:
            flags += _extrapolations(contrast, subjects, name)
        flags += _collinearity(contrast, adjust)
    return [f"{contrast.name}: {flag}" for flag in flags]


def _confounders(associated: dict[str, float], adjust: Sequence[str]) -> list[str]:
    """Warnings about attributes that are correlated with the compared one."""
    return [
        f"is correlated with {name} (adjusted multiple correlation {value:.2f}); "
        f"adjust for {name} if it may cause the effect"
        for name, value in associated.items()
        if value >= ASSOCIATED and name not in adjust
    ]


def _collinearity(contrast: Contrast, adjust: Sequence[str]) -> list[str]:
    """A warning if the compared attribute follows from the adjusted ones."""
    spread = np.column_stack([contrast.regressor, contrast.covariates])
    spread = (spread - spread.mean(axis=0)) / np.maximum(spread.std(axis=0), 1e-300)
    number = float(np.linalg.cond(spread))
    if number <= MAX_CONDITION_NUMBER:
        return []
    names = ", ".join(adjust)
    return [f"can hardly be separated from {names} (condition number {number:.0f})"]


def _few_subjects(contrast: Contrast, count: Array) -> list[str]:
    """A warning if few subjects are compared."""
    counts = [int(side) for side in count.max(axis=0)]
    text = f"{counts[0]} subjects"
    if not (contrast.is_number or contrast.is_paired):
        text += f" with and {counts[1]} without"
    else:
        counts = counts[:1]
    if min(counts) >= FEW:
        return []
    return [f"{text}; with fewer than {FEW} the intervals assume normal values"]


def _extrapolations(contrast: Contrast, subjects: Subjects, name: str) -> list[str]:
    """Warnings about values of an adjusted attribute that only one side has."""
    other = subjects.by_subject(name, contrast.quantities.subject)
    if other.is_numeric or contrast.is_number:
        return []
    words = np.array([word_of(value) for value in other.values])
    flags = []
    for word in sorted(set(words.tolist())):
        for value, side in ((1, "with"), (0, "without")):
            if word not in words[contrast.regressor == value]:
                flags.append(
                    f"no subject {side} the compared value has {name} {word}; the "
                    "adjustment extrapolates there"
                )
    return flags
