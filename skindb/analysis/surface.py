"""Space of the surface BRDFs of a population: means and distances of groups, and a map
of the takes.

Weyrich et al. 2005, section 10.1 and figures 7, 14 and 15.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from dask.delayed import Delayed
from numpy.random import Generator
from xarray import Dataset

from skindb.analysis.brdf import population_basis
from skindb.analysis.brdf_plots import plot_space
from skindb.analysis.contrasts import unreliable_surfaces
from skindb.analysis.quantities import Quantities
from skindb.analysis.study import (
    Population,
    Results,
    Study,
    Table,
    each_item,
    skipped_takes,
    table_of,
)
from skindb.analysis.subjects import (
    AGE,
    NORMAL,
    OLDER,
    OTHER,
    UNKNOWN,
    Subjects,
    compared_conditions,
    groups_by,
    numeric_attributes,
    subjects_of,
    takes_to_compare,
)
from skindb.analysis.summary import SAMPLED
from skindb.errors import Fault, InputError, require
from skindb.numerics.inference import (
    between_groups_p,
    classical_scaling,
    within_subjects_p,
)
from skindb.numerics.statistics import known_mean
from skindb.reflectance.tables import TableGrid, brdf_coords, stored_brdf
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.study_parameters import DECLARED, SurfaceParameters
from skindb.threads import c_contiguous
from skindb.types import AnyArray, Array, Mask, finite_rows, unit

# subjects of a group, below which p values are approximate if the groups have different
# variances
FEW = 10
SIGNIFICANT = 0.05  # of adjusted p values
# relative distance due to rounding: coefficients are stored in single precision
IDENTICAL = 1e-6
# minimum ratio of the smallest to the largest singular value of the normalised mixtures
INDEPENDENT = 1e-5
ONE_PAIR = "one pair"
SIDES = ("first", "second")
COLUMNS = (
    variables.GROUP_DISTANCE,
    variables.GROUP_DISTANCE_NOISE,
    variables.GROUP_DISTANCE_P,
    variables.GROUP_DISTANCE_P_ADJUSTED,
)


@dataclass(frozen=True)
class _Subjects:
    """Means over the takes of each subject in each group; NaN where a subject has no
    take in a group.
    """

    groups: tuple[str, ...]
    coefficient: Array  # (subject, group, component)
    # (subject, group, component) in coordinates in which Euclidean distance is the
    # distance of BRDFs
    place: Array

    @property
    def measured(self) -> Mask:
        """Mask (subject, group) of the groups in which a subject was measured."""
        return np.asarray(np.isfinite(self.place).all(axis=2))


def brdf_space(
    cohort: Dataset,
    *,
    basis: Dataset,
    tables: Array | Delayed,
    group_by: str,
    pairs: Sequence[str] = (),
    permutations: int = 10_000,
    rng: Generator,
) -> Dataset:
    """Mean surface BRDFs of groups, distances between groups and between takes, and a
    map of the takes.

    The distance of two BRDFs is that of `skindb.reflectance.tables.brdf_metric`, divided
    by the length of the mean BRDF. The unit is the subject: the takes of a subject in a
    group are averaged first. Groups with different subjects are compared by permutation
    of the subjects. Groups with subjects in common, such as conditions, are compared
    within these subjects. The statistic is the squared distance of the means divided by
    its squared standard error (`skindb.numerics.inference`), so that groups that
    differ only in variance are not reported as different.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    basis
        From `population_basis` of the same takes.
    tables
        (nh, nd, np, m) tables of the dictionary of the fits [sr^-1], or a Dask object
        that computes them.
    group_by
        Attribute or trait; see `skindb.analysis.groups_by`. Takes without it are
        excluded, and so are takes in other conditions than normal unless conditions are
        compared.
    pairs
        Names of the pairs of interest, such as "normal to lotion"; default all.
    permutations
        Maximum number of permutations for p values; if there are fewer, all of them are used.
    rng
        Random generator of the permutations.

    Returns
    -------
    Dataset
        See the variables of the group "brdf_space". p values are NaN where fewer than
        two subjects can be compared. Attributes: `groups_of_takes` (group of each
        take), `flags` (limitations and warnings), `adjusted_by`.

    Raises
    ------
    InputError
        If there are fewer than two groups or subjects, if the attribute is numeric, if
        a take has no fitted surfels, if components are linearly dependent (k above the
        rank), or if all takes have the same BRDF.

    References
    ----------
    Anderson and Walsh 2013; Chung and Romano 2016; Westfall and Young 1993; Gower 1966 (the map).
    """
    require_comparable(cohort, "tables")
    takes, named, flags = grouped_takes(cohort, group_by)
    coefficient = _coefficients(takes.take, basis)
    mixture = basis[variables.POPULATION_MIXTURE].values.astype(float)
    [brdf] = each_item(partial(_mixed, c_contiguous(mixture)), [tables])
    place = coefficient @ basis[variables.COMPONENT_VECTOR].values
    subjects = _by_subject(takes, named, coefficient, place)
    centre = known_mean(known_mean(np.moveaxis(subjects.place, 1, 0)))
    length = float(np.linalg.norm(centre)) or 1.0
    distance = np.linalg.norm(place[:, None] - place[None], axis=-1) / length
    require(
        distance.max() > IDENTICAL,
        f"group by {group_by}",
        "the BRDFs of takes must differ",
        "the same BRDF in all takes",
        "check the fits",
    )
    mapped, explained, error = classical_scaling(distance)
    possible = {
        " to ".join(subjects.groups[i] for i in pair): pair
        for pair in itertools.combinations(range(len(subjects.groups)), 2)
    }
    require(
        possible.keys() >= {*pairs},
        "pairs",
        "must be of two groups",
        ", ".join(pairs),
        f"choose from: {', '.join(possible)}",
    )
    compared = [
        _compared_pair(subjects, name, possible[name], permutations, rng)
        for name in possible
        if not pairs or name in pairs
    ]
    is_joint = len(compared) == len(possible)
    adjusted, method = _adjusted(subjects, compared, permutations, rng, is_joint)
    means = known_mean(subjects.coefficient)
    averaged = brdf @ means.T
    labels = list(takes.take)
    return dataset(
        {
            variables.GROUP_SUBJECT_COUNT: subjects.measured.sum(axis=0),
            variables.GROUP_COEFFICIENT: means,
            variables.GROUP_BRDF: stored_brdf(averaged),
            variables.TAKE_DISTANCE: distance,
            variables.TAKE_PLACE: mapped,
            variables.EXPLAINED_FRACTION: explained,
            variables.MAP_ERROR: error,
            variables.GROUP_DISTANCE: [pair.distance / length for pair in compared],
            variables.GROUP_DISTANCE_NOISE: [pair.noise / length for pair in compared],
            variables.GROUP_DISTANCE_P: [pair.p for pair in compared],
            variables.GROUP_DISTANCE_P_ADJUSTED: adjusted,
            variables.PAIR_SUBJECT_COUNT: [pair.count for pair in compared],
            variables.PAIR_PERMUTATIONS: [pair.permutations for pair in compared],
        },
        coords={
            "group": list(subjects.groups),
            "pair": [pair.name for pair in compared],
            "side": list(SIDES),
            "take": labels,
            "take_2": labels,
            **brdf_coords(TableGrid(*averaged.shape[:3])),
        },
        attrs={
            "group_by": group_by,
            "groups_of_takes": named,
            "adjusted_by": method,
            "flags": flags
            + [flag for pair in compared for flag in pair.flags]
            + unreliable_surfaces(cohort, group_by),
            "skipped": skipped_takes(cohort),
        },
    )


def grouped_takes(
    cohort: Dataset, group_by: str
) -> tuple[Subjects, list[str], list[str]]:
    """Takes that belong to a group, the names of their groups, and a flag about excluded takes.

    Raises
    ------
    InputError
        If there are fewer than two groups or subjects, or if the attribute is numeric.
    """
    where = f"group by {group_by}"
    is_age = group_by == AGE
    require(
        group_by not in numeric_attributes(subjects_of(cohort)),
        where,
        "must not be numeric",
        "a numeric attribute",
        f"group by {f'a trait, such as {OLDER}' if is_age else 'another attribute'}",
    )
    _, counted = takes_to_compare(cohort, group_by)
    named = groups_by(counted, group_by)
    rows = [i for i, name in enumerate(named) if name not in (UNKNOWN, OTHER)]
    groups = sorted({named[i] for i in rows})
    require(
        len(groups) >= 2,
        where,
        "there must be subjects of two groups",
        f"only {groups[0]}" if groups else "no take with this attribute",
        "group by another attribute",
    )
    subjects = counted.select(rows)
    require(
        len(subjects.names) >= 2,
        where,
        "there must be at least two subjects",
        "one",
        "add the takes of other subjects",
    )
    flags = []
    if excluded := len(named) - len(rows):
        flags.append(
            f"{excluded} of {len(named)} takes are excluded because they belong to none "
            "of the groups"
        )
    return subjects, [named[i] for i in rows], flags


def _coefficients(names: Sequence[str], basis: Dataset) -> Array:
    """Coefficients (take, component) of the takes; raises `InputError` for missing ones
    and for a dependent basis.
    """
    mixture = basis[variables.POPULATION_MIXTURE].values.astype(float)
    rank = np.linalg.matrix_rank(unit(mixture), rtol=INDEPENDENT)
    require(
        rank == len(mixture),
        "basis",
        "the components must be linearly independent",
        f"{len(mixture)} components of rank {rank}",
        "choose a smaller k",
    )
    stored = basis[variables.TAKE_COEFFICIENT].reindex(take=list(names)).values
    if not (is_known := finite_rows(stored)).all():
        rule = "a take must have fitted surfels"
        cure = "fit it again, or exclude it"
        raise InputError(
            Fault(f"take {name}", rule, "none in the basis", cure)
            for name in itertools.compress(names, ~is_known)
        )
    return stored.astype(float)


def _mixed(mixture: Array, tables: AnyArray) -> AnyArray:
    """Tables (nh, nd, np, k) of the components."""
    return tables @ mixture.T


def _by_subject(
    takes: Subjects, named: Sequence[str], coefficient: Array, place: Array
) -> _Subjects:
    """Average the takes of every subject within each group; the group "normal" is the first."""
    groups = sorted(set(named), key=lambda name: (name != NORMAL, name))
    members = [[i for i, name in enumerate(named) if name == g] for g in groups]
    means = []
    for values in (coefficient, place):
        of_takes = Quantities(values, takes.subject)
        of_groups = [of_takes.select(rows).of_subjects(takes.names) for rows in members]
        means.append(np.stack([group.values for group in of_groups], axis=1))
    return _Subjects(tuple(groups), *means)


@dataclass(frozen=True)
class _Pair:
    """Comparison of two groups; distances are lengths of BRDFs."""

    name: str
    within: bool  # whether subjects were measured in both groups
    count: tuple[int, int]  # subjects of each group
    distance: float
    noise: float  # distance that the scatter of subjects alone would give
    p: float
    permutations: int

    @property
    def flags(self) -> list[str]:
        """Warnings about few subjects."""
        if min(self.count) < 2:
            side = "in both groups" if self.within else "per group"
            return [f"{self.name}: no p value with fewer than two subjects {side}"]
        if min(self.count) < FEW:
            subjects = f"{self.count[0]} and {self.count[1]} subjects"
            warning = f"p values are approximate with fewer than {FEW}"
            return [f"{self.name}: {subjects}; {warning}"]
        return []


def _compared_pair(
    subjects: _Subjects,
    name: str,
    pair: tuple[int, int],
    max_draws: int,
    rng: Generator,
) -> _Pair:
    """Compare two groups: within the subjects measured in both, if there are any."""
    values = subjects.place[:, pair]
    measured = subjects.measured[:, pair]
    both = measured.all(axis=1)
    within = bool(both.any())
    if within:
        values = values[both]
        measured = measured[both]
    first, second = measured.sum(axis=0).tolist()
    statistic = np.nan
    p = np.nan
    drawn = 0
    if min(first, second) >= 2:
        draws: dict[str, Any] = {"max_draws": max_draws, "rng": rng}
        if within:
            result = within_subjects_p(values, **draws)
        else:
            places = values.swapaxes(0, 1)[measured.T]
            group = np.repeat([0, 1], (first, second))
            result = between_groups_p(places, group, **draws)
        (statistic,), (p,), drawn = result
    step = known_mean(values[:, 0]) - known_mean(values[:, 1])
    length = float(np.linalg.norm(step))
    noise = length / np.sqrt(statistic) if statistic > 0 else np.nan
    return _Pair(name, within, (first, second), length, noise, p, drawn)


def _adjusted(
    subjects: _Subjects,
    pairs: Sequence[_Pair],
    max_draws: int,
    rng: Generator,
    is_joint: bool,
) -> tuple[Array, str]:
    """P values adjusted for all pairs, and the method: joint permutations of all groups
    if these are valid.
    """
    p = np.array([pair.p for pair in pairs])
    finite = np.isfinite(p)
    if finite.sum() < 2:
        return p, ONE_PAIR
    # no single permutation scheme is valid for all pairs, or it has others than these
    if not is_joint or not finite.all() or len({pair.within for pair in pairs}) > 1:
        return np.minimum(p * finite.sum(), 1.0), "Bonferroni"
    if pairs[0].within:
        _, largest, _ = within_subjects_p(subjects.place, max_draws=max_draws, rng=rng)
    else:
        group = np.argmax(subjects.measured, axis=1)
        places = subjects.place[np.arange(len(group)), group]
        _, largest, _ = between_groups_p(places, group, max_draws=max_draws, rng=rng)
    return np.maximum(largest, p), "largest statistic"


def tabulate_brdf_space(space: Dataset) -> Table:
    """Header and rows of the table of `brdf_space`, one row per pair of groups."""
    counts = {
        f"subjects_{side}": space[variables.PAIR_SUBJECT_COUNT].sel(
            side=side, drop=True
        )
        for side in SIDES
    }
    return table_of(space.assign(counts), [*counts, *COLUMNS])


def describe_brdf_space(space: Dataset) -> list[str]:
    """Results of a study of the space of BRDFs and its flags, one line each."""
    p = space[variables.GROUP_DISTANCE_P_ADJUSTED].values
    compared = int(np.isfinite(p).sum())
    differ = int((p < SIGNIFICANT).sum())
    how = space.attrs["adjusted_by"]
    how = how if how == ONE_PAIR else f"adjusted for all pairs: {how}"
    fractions = ", ".join(
        f"{fraction:.0%}" for fraction in space[variables.EXPLAINED_FRACTION].values
    )
    return [
        f"{differ} of {compared} pairs of groups differ (p < {SIGNIFICANT:g}; {how})",
        "distances are relative to the length of the mean BRDF; "
        "group_distance_noise is the distance expected from the "
        "scatter of subjects alone",
        f"map of {space.sizes['take']} takes: its axes explain {fractions} of the scatter; "
        f"the RMS error of its distances is {float(space[variables.MAP_ERROR]):.1%}",
        *space.attrs["flags"],
    ]


def compute(population: Population, parameters: SurfaceParameters) -> Results:
    """The results of the study."""
    cohort = population.open_cohort("tables")
    grouped_takes(cohort, parameters.group_by)  # before anything is computed
    rng = np.random.default_rng(parameters.seed)
    tables = population.brdf_tables()
    k = parameters.k
    basis = population_basis(population.cohort, tables=tables, k=k, rng=rng)
    rank = basis.sizes["component"]
    require(
        rank == k,
        "k",
        "must not be above the number of BRDFs of the dictionary or of surfels",
        f"{k}, and {rank} of them",
        "choose a smaller k",
    )
    space = brdf_space(
        cohort,
        basis=basis,
        tables=tables,
        group_by=parameters.group_by,
        pairs=parameters.pairs,
        permutations=parameters.permutations,
        rng=rng,
    )
    return {"population_basis": basis, "brdf_space": space}


STUDY = Study(
    *DECLARED["surface"],
    layout="surfels",
    compute=compute,
    shown=("brdf_space",),
    tabulate=tabulate_brdf_space,
    plot=plot_space,
    describe=describe_brdf_space,
    cohort_options={"surfels": SAMPLED},
    conditions=compared_conditions,
)
