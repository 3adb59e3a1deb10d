"""Comparisons of groups of subjects in the measured quantities: what the studies of groups
and of maps have in common. The unit of inference is the subject.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.special import gammaln
from xarray import Dataset

from skindb.analysis.quantities import (
    GLOSSINESS,
    NORMAL_95,
    SURFACE,
    Quantities,
    quantities_of,
)
from skindb.analysis.subjects import (
    CONDITION,
    EVEN,
    LEVEL,
    NORMAL,
    Attribute,
    Subjects,
    attribute_of,
    comparable_takes,
    has_trait,
    multiple_correlation,
    require_adjustable,
    subjects_of,
    takes_to_compare,
    trait_of,
    word_of,
)
from skindb.errors import Fault, InputError, require
from skindb.numerics.inference import (
    Effects,
    effects,
    known_effects,
    paired_effects,
    permutation_p,
    sign_flip_p,
)
from skindb.numerics.statistics import ROUNDING
from skindb.schema.label import FACE
from skindb.types import Array, finite_rows

# below which a quantity shows errors more than subjects or their changes ("poor" in Koo
# and Li 2016), and has no p values
MIN_RELIABILITY = 0.5
# change of quantities of the surface by light that highlights lack, a fraction of all light:
# its glossiness may differ by 0.4 from that of the 0.04 which skin reflects
LACKING = {SURFACE: 1.0, GLOSSINESS.name: 10.0}
# subjects of a group, below which intervals depend on the assumption of normal values
FEW = 10
# multiple correlation from which an attribute counts as confounder: a quarter of the
# variance
ASSOCIATED = 0.5


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
    # (q,) half-width of the 95 % interval of what even reflection may add to differences
    even: Array | float = 0.0

    @property
    def reliability(self) -> Array:
        """Reliability (q,) of the subjects, or of changes; see `Quantities.reliability`."""
        return self.quantities.reliability(self.is_paired)

    @property
    def is_paired(self) -> bool:
        """Whether the contrast is of differences within subjects."""
        return self.before is not None

    def complete(self) -> Contrast:
        """The contrast of the subjects with known regressor and covariates."""
        rows = np.isfinite(self.regressor) & finite_rows(self.covariates)
        return replace(
            self,
            quantities=self.quantities.select(np.flatnonzero(rows)),
            regressor=self.regressor[rows],
            covariates=self.covariates[rows],
        )


def contrasts(
    cohort: Dataset,
    group_by: str,
    adjust: Sequence[str],
    measure: Callable[[Dataset], Quantities],
) -> list[Contrast]:
    """Comparisons by an attribute of the quantities that `measure` computes from takes;
    see `group_effects`.
    """
    everyone = subjects_of(cohort)
    compared = attribute_of(everyone, group_by)
    if compared == CONDITION:
        require(
            not adjust,
            "adjust",
            "conditions are compared within subjects, which holds everything else fixed",
            ", ".join(adjust),
            "omit this option",
        )
        return _paired(cohort, group_by, measure)
    require_adjustable(everyone, adjust, compared)
    takes, subjects = takes_to_compare(cohort, group_by)
    for name in (compared, *adjust):
        subjects.require_constant(name)
    quantities = measure(takes).of_subjects()
    names = quantities.subject
    attribute = subjects.by_subject(compared, names)
    covariates = _covariates(subjects, names, adjust, attribute)
    is_number = group_by in everyone.attributes and attribute.is_numeric
    if group_by in everyone.attributes:
        regressors = _regressors(attribute, group_by)
    else:
        trait = trait_of(everyone, group_by)
        carries = _carriers(everyone, subjects, trait)
        values = np.array([carries.get(name, np.nan) for name in names])
        regressors = {f"{trait} less others": values}
    return [
        Contrast(name, quantities, regressor, covariates, is_number).complete()
        for name, regressor in regressors.items()
    ]


def unreliable_surfaces(cohort: Dataset, group_by: str) -> list[str]:
    """Warnings about comparisons of surface BRDFs, whose errors are not known: the surface
    reflectance of the face has a low reliability.
    """
    of_face = cohort.sel(region=[FACE]) if "region" in cohort.dims else cohort
    measure = partial(quantities_of, names=(SURFACE,))
    with suppress(InputError):  # of what the tables of the cohort cannot compare
        return [
            f"{contrast.name}: errors explain the differences of BRDFs: the reliability of "
            f"the {SURFACE} of the {FACE} is {value:.2f}"
            for contrast in contrasts(of_face, group_by, (), measure)
            for value in contrast.reliability
            if value < MIN_RELIABILITY
        ]
    return []


def _covariates(
    subjects: Subjects, names: Sequence[str], adjust: Sequence[str], compared: Attribute
) -> Array:
    """Regression columns (n, c) of the adjusted attributes of the named subjects.

    Raises
    ------
    InputError
        If one of them or the compared attribute mixes numbers and words.
    """
    attributes = [subjects.by_subject(name, names) for name in adjust]
    for attribute in (compared, *attributes):
        attribute.require_one_kind()
    nothing = np.empty((len(names), 0))
    return np.concatenate([nothing, *(a.columns for a in attributes)], axis=1)


def _regressors(attribute: Attribute, group_by: str) -> dict[str, Array]:
    """Name of each comparison by an attribute -> regressor (n,), NaN where unknown."""
    words = sorted({word_of(value) for value in attribute.known})
    require(
        len(words) >= 2,
        f"group by {group_by}",
        "there must be subjects of two groups",
        f"only {words[0]}" if words else "no subject with this attribute",
        "group by another attribute",
    )
    if attribute.is_numeric:
        return {f"{group_by}, per unit": attribute.numbers}
    is_known = np.array([value is not None for value in attribute.values])
    indicators = {}
    for word in words:
        is_word = np.array([word_of(value) == word for value in attribute.values])
        indicators[word] = np.where(is_known, is_word.astype(float), np.nan)
    if len(words) == 2:
        return {f"{words[1]} less {words[0]}": indicators[words[1]]}
    return {f"{word} less others": indicators[word] for word in words}


def _carriers(everyone: Subjects, subjects: Subjects, trait: str) -> dict[str, float]:
    """Subject -> 1 with and 0 without a trait, from its first take that is compared."""
    # of all takes, because the median age is that of all subjects
    of_take = dict(zip(everyone.take, has_trait(everyone, trait).tolist(), strict=True))
    carries: dict[str, float] = {}
    for i in np.flatnonzero(comparable_takes(subjects, trait)):
        carries.setdefault(subjects.subject[i], float(of_take[subjects.take[i]]))
    return carries


@dataclass(frozen=True)
class Comparison:
    """A contrast with its test, associated attributes and warnings."""

    contrast: Contrast
    test: ContrastTest
    associated: dict[str, float]  # attribute -> multiple correlation
    flags: list[str]

    @property
    def smallest_p(self) -> float:
        """The smallest p value that is possible with its number of permutations and subjects."""
        contrast = self.contrast
        smallest = 1 / (self.test.permutations + 1)
        if contrast.is_paired:
            # with all signs changed, the statistic has the same magnitude
            return max(smallest, 2.0 ** (1 - len(contrast.regressor)))
        if contrast.covariates.shape[1]:
            return smallest
        # permutations within a group change nothing
        sizes = np.unique(contrast.regressor, return_counts=True)[1]
        # exchanging both groups only changes the sign
        mirrored = 2.0 if len(sizes) == 2 and sizes[0] == sizes[1] else 1.0
        logarithm = gammaln(len(contrast.regressor) + 1)
        logarithm -= sum(gammaln(size + 1) for size in sizes)
        return max(smallest, mirrored / float(np.exp(logarithm)))


def compare_groups(
    cohort: Dataset,
    group_by: str,
    adjust: Sequence[str],
    measure: Callable[[Dataset], Quantities],
    *,
    permutations: int,
    min_fraction: float = 0.0,
    rng: Generator,
) -> tuple[list[Comparison], list[Fault]]:
    """Comparisons with their tests, and a fault for each contrast that the subjects do
    not determine; arguments as of `contrasts` and `contrast_test`.
    """
    subjects = subjects_of(cohort)
    compared_attribute = attribute_of(subjects, group_by)
    compared = []
    faults = []
    for contrast in contrasts(cohort, group_by, adjust, measure):
        try:
            test = contrast_test(contrast, permutations, min_fraction, rng)
            associated = {
                name: _association(contrast, subjects, name)
                for name in subjects.described
                if name != compared_attribute
            }
            flags = contrast_flags(contrast, subjects, associated, adjust)
        except ValueError as error:
            faults.append(
                Fault(
                    contrast.name,
                    "the subjects must determine the effect",
                    str(error),
                    "adjust for fewer attributes, compare other groups, or add subjects",
                )
            )
        else:
            compared.append(Comparison(contrast, test, associated, flags))
    return compared, faults


def _paired(
    cohort: Dataset, group_by: str, measure: Callable[[Dataset], Quantities]
) -> list[Contrast]:
    """Differences of each condition to normal, within the subjects who were measured in both."""
    subjects = subjects_of(cohort)
    conditions = np.array(list(map(str, subjects.attributes[CONDITION].values)))
    names = sorted(set(conditions) - {NORMAL})
    if group_by != CONDITION:
        names = [trait_of(subjects, group_by).partition(":")[2]]
    quantities = measure(cohort)
    plain = quantities.select(np.flatnonzero(conditions == NORMAL))
    pairs = []
    for name in names:
        changed = quantities.select(np.flatnonzero(conditions == name))
        both = [s for s in dict.fromkeys(changed.subject) if s in plain.subject]
        if not both:
            continue
        after = changed.of_subjects(both)
        normal = plain.of_subjects(both)
        errors = after.errors
        if errors is not None and normal.errors is not None:
            errors = np.hypot(errors, normal.errors)
        changes = replace(after, values=after.values - normal.values, errors=errors)
        pairs.append(
            Contrast(
                f"{name} less {NORMAL}",
                changes,
                np.ones(len(both)),
                np.empty((len(both), 0)),
                before=normal.values,
                even=even_errors(cohort, quantities, name),
            )
        )
    require(
        pairs,
        f"group by {group_by}",
        "some subjects must be measured in both conditions",
        "none",
        "measure subjects in two conditions",
    )
    return pairs


def even_errors(cohort: Dataset, quantities: Quantities, condition: str) -> Array:
    """Half-widths (q,) of the 95 % intervals of what even reflection may add to the mean
    difference of a condition from normal, of the subjects who were measured in both, if
    there are any.

    Where both have the same prior, its error cancels, and what was subtracted differs by
    a fraction of the change of the highlights, which is known to about itself; highlights
    may lack as much. Errors of different priors are taken as independent.
    """
    conditions = cohort[CONDITION].values
    levels = np.zeros((len(conditions), 2))
    for column, name in zip(levels.T, (LEVEL, EVEN), strict=True):
        if name in cohort.coords:
            column[:] = np.nan_to_num(cohort[name].values.astype(float))
    largest = levels[:, 0].max()
    sides = [
        Quantities(levels, quantities.subject).select(
            np.flatnonzero(conditions == name)
        )
        for name in (NORMAL, condition)
    ]
    paired = [name for name in sides[0].subject if name in sides[1].subject]
    first, second = (
        side.of_subjects([*dict.fromkeys(paired)]).values
        if paired
        else side.values.mean(axis=0, keepdims=True)
        for side in sides
    )
    both = np.stack([first[:, 0], second[:, 0]])
    is_same = np.isclose(*both)
    change = float((second - first)[:, 1].mean())
    error = np.hypot(np.where(is_same, 0.0, np.hypot(*both)).mean(), change)
    lacking = (
        NORMAL_95
        * abs(change)
        * sum(
            factor * np.char.startswith(quantities.names, name)
            for name, factor in LACKING.items()
        )
    )
    common = np.multiply(quantities.common, error / max(largest, ROUNDING))
    return np.asarray(np.hypot(common, lacking))


@dataclass(frozen=True)
class ContrastTest:
    """Effects on quantities (q,) with their p values by permutation, NaN where errors
    may cause the effect.
    """

    effects: Effects
    p: Array
    p_adjusted: Array  # for all quantities, by the largest statistic
    permutations: int


def contrast_test(
    contrast: Contrast, permutations: int, min_fraction: float, rng: Generator
) -> ContrastTest:
    """Effects on the quantities that at least a fraction of the subjects has, NaN for
    others; raises `ValueError` where the subjects do not determine any.
    """
    values = contrast.quantities.values
    able = np.isfinite(values).sum(axis=0) >= max(min_fraction * len(values), 1)
    if min_fraction and not able.any():
        raise ValueError(
            f"no texel with values of {min_fraction:.0%} of the {len(values)} subjects"
        )
    values = np.where(able, values, np.float32(np.nan))
    draws: dict[str, Any] = {"max_draws": permutations, "rng": rng}
    if contrast.is_paired:
        errors = contrast.quantities.errors
        if len(values) == 1 and errors is not None:
            fit = known_effects(values[0], errors[0])
            found, count = [np.full_like(fit.slope, np.nan)] * 2, 0
        else:
            fit = paired_effects(values)
            *found, count = sign_flip_p(values, **draws)
        low, high = (
            fit.slope + np.copysign(np.hypot(end - fit.slope, contrast.even), side)
            for end, side in ((fit.low, -1), (fit.high, 1))
        )
        fit = replace(fit, low=low, high=high)
    else:
        design = (contrast.regressor, contrast.covariates)
        fit = effects(values, *design)
        *found, count = permutation_p(values, *design, **draws)
    is_error = contrast.reliability < MIN_RELIABILITY
    is_error |= np.abs(fit.slope) < contrast.even
    p, adjusted = (np.where(is_error, np.nan, x) for x in found)
    return ContrastTest(fit, p, adjusted, count)


def contrast_counts(contrast: Contrast) -> Array:
    """Numbers (quantity, side) of subjects with and without; for numeric attributes and
    pairs, all count as "with".
    """
    is_known = np.isfinite(contrast.quantities.values)
    is_with = (
        np.ones(len(is_known), bool)
        if contrast.is_number or contrast.is_paired
        else contrast.regressor > 0
    )
    return np.stack(
        [is_known[is_with].sum(axis=0), is_known[~is_with].sum(axis=0)], axis=1
    )


def _association(contrast: Contrast, subjects: Subjects, name: str) -> float:
    if contrast.is_paired:
        return 0.0
    attribute = subjects.by_subject(name, contrast.quantities.subject)
    if attribute.odd_words:
        return float("nan")
    columns = attribute.columns
    is_known = finite_rows(columns)
    if not is_known.any():
        return float("nan")
    return multiple_correlation(contrast.regressor[is_known], columns[is_known])


def contrast_flags(
    contrast: Contrast,
    subjects: Subjects,
    associated: dict[str, float],
    adjust: Sequence[str],
) -> list[str]:
    """Warnings about a comparison: few subjects, correlated attributes and extrapolation."""
    flags = _few_subjects(contrast)
    if not contrast.is_paired:
        flags += [
            f"is correlated with {name} (adjusted multiple correlation {value:.2f}); "
            f"adjust for {name} if it may cause the effect"
            for name, value in associated.items()
            if value >= ASSOCIATED and name not in adjust
        ]
        for name in adjust:
            flags += _extrapolations(contrast, subjects, name)
    return [f"{contrast.name}: {flag}" for flag in flags]


def _few_subjects(contrast: Contrast) -> list[str]:
    """A warning if few subjects are compared."""
    counts = [int(side) for side in contrast_counts(contrast).max(axis=0)]
    text = f"{counts[0]} subjects"
    if not (contrast.is_number or contrast.is_paired):
        text += f" with and {counts[1]} without"
    else:
        counts = counts[:1]
    if min(counts) >= FEW or len(contrast.regressor) == 1:
        return []
    return [f"{text}; with fewer than {FEW} the intervals assume normal values"]


def _extrapolations(contrast: Contrast, subjects: Subjects, name: str) -> list[str]:
    """Warnings about values of an adjusted attribute that only one side has."""
    attribute = subjects.by_subject(name, contrast.quantities.subject)
    if attribute.is_numeric or contrast.is_number:
        return []
    words = np.array([word_of(value) for value in attribute.values])
    flags = []
    for word in sorted(set(words.tolist())):
        for value, side in ((1, "with"), (0, "without")):
            if word not in words[contrast.regressor == value]:
                flags.append(
                    f"no subject {side} the compared value has {name} {word}; the "
                    "adjustment extrapolates there"
                )
    return flags
