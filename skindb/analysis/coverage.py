"""Coverage of groups in a cohort, and attributes that are confounded in it."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats.contingency import association
from xarray import Dataset

from skindb import plots
from skindb.analysis.contrasts import ASSOCIATED, FEW
from skindb.analysis.study import Population, Results, Study, skipped_takes, table_of
from skindb.analysis.subjects import (
    AGE,
    CONDITION,
    NORMAL,
    Attribute,
    Subjects,
    is_age,
    multiple_correlation,
    subjects_of,
)
from skindb.errors import few_names, require
from skindb.schema import IDENTIFIED, dataset, variables
from skindb.schema.cohort import require_takes
from skindb.types import Array, Mask

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GENDER = "gender"
ANCESTRY = "ancestry"
AGE_BAND = "age band"
SITE = "site"
# factors of which pairs and the triple are counted
CROSSED = (GENDER, ANCESTRY, AGE_BAND)
WITH_AGE = (GENDER, ANCESTRY, CONDITION, SITE)  # factors that are crossed with age
DECADE = 10  # years in an age band
AND = " x "
DARK = 0.6  # fraction of the colour scale above which numbers are white
MAX_LISTED = 12  # cells named in a line
# different values of an attribute; one with more is treated as a name, not as groups
MAX_VALUES = 12
# values of each subject: one value, several conditions or sites, or none
Factor = list[frozenset[str]]


def coverage_report(cohort: Dataset) -> Dataset:
    """Numbers of subjects by gender, ancestry and age and their crossings, and by
    condition and probe site.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``, with takes in all conditions.

    Returns
    -------
    Dataset
        `coverage_count` (cell,): number of subjects for every value ("gender: female")
        and crossing ("gender: female x ancestry: african"), including empty ones;
        `coverage_unknown` (attribute,): number of subjects without the attribute;
        `coverage_association` (attribute, attribute_2) between subjects: Cramer's V of
        two categorical attributes (corrected for its bias, Bergsma 2013), the multiple
        correlation of a numeric with a categorical attribute (adjusted for the number
        of values), the absolute correlation of two numeric attributes. Attribute
        "flags": empty cells, cells with fewer than 10 subjects, and attributes that are
        confounded. Values that no subject has cannot be listed, except for age bands
        between the youngest and the oldest.

    Raises
    ------
    InputError
        If the cohort has no take.
    """
    require_takes(cohort, "tables")
    require(
        cohort.sizes["take"],
        "coverage",
        "the cohort must have a take",
        "none",
        "fit a take first",
    )
    takes = subjects_of(cohort)
    subjects = takes.names
    stated = {
        name: takes.by_subject(name, subjects) for name in sorted(takes.described)
    }
    factors = _factors(cohort, takes, stated)
    levels = {name: _values(name, factor) for name, factor in factors.items()}
    if SITE in factors:  # including sites without measurements
        levels[SITE] = cohort["site"].values.tolist()
    counts = dict(_cells(factors, levels))
    names = [
        name
        for name, attribute in stated.items()
        if attribute.is_numeric or 1 < len(attribute.words) <= MAX_VALUES
    ]
    between = np.array(
        [[_association(stated[a], stated[b]) for b in names] for a in names]
    ).reshape(len(names), len(names))
    unknown = {
        name: sum(not value for value in factor)
        for name, factor in factors.items()
        if name not in (CONDITION, SITE)
    }
    return dataset(
        {
            variables.COVERAGE_COUNT: list(counts.values()),
            variables.COVERAGE_ASSOCIATION: between,
            variables.COVERAGE_UNKNOWN: [
                stated[name].values.count(None) for name in names
            ],
        },
        coords={
            "cell": [AND.join(key) for key in counts],
            "attribute": names,
            "attribute_2": names,
        },
        attrs={
            "subjects": len(subjects),
            "takes": sorted(map(str, cohort["take"].values)),
            "flags": _flags(counts, unknown, names, stated, between, len(subjects))
            + [line for attribute in stated.values() for line in attribute.notes()],
            "skipped": skipped_takes(cohort),
        },
    )


def _factors(
    cohort: Dataset, takes: Subjects, stated: Mapping[str, Attribute]
) -> dict[str, Factor]:
    """Factors by which subjects are counted: categorical attributes, age in decades,
    conditions and sites.
    """
    factors: dict[str, Factor] = {}
    for name, attribute in stated.items():
        if name == AGE:
            bands = [_band(age) if is_age(age) else None for age in attribute.values]
            factors[AGE_BAND] = _single(bands)
        elif not attribute.is_numeric and 1 <= len(attribute.words) <= MAX_VALUES:
            factors[name] = _single(attribute.values)
    conditions = np.full(len(takes.take), NORMAL, object)
    if CONDITION in takes.attributes:
        conditions[:] = takes.attributes[CONDITION].values
    rows = [np.flatnonzero(takes.rows_of(name)) for name in takes.names]
    factors[CONDITION] = [
        frozenset(str(v) for v in conditions[of_subject] if v is not None)
        for of_subject in rows
    ]
    if variables.SITE_STATUS in cohort:
        good = cohort[variables.SITE_STATUS].isin(IDENTIFIED).any("channel")
        measured: Mask = (
            good.transpose("take", "site").values & takes.is_normal[:, None]
        )
        sites = cohort["site"].values.tolist()
        factors[SITE] = [
            frozenset(itertools.compress(sites, np.any(measured[of_subject], axis=0)))
            for of_subject in rows
        ]
    order = [*CROSSED, CONDITION, SITE]
    return {
        name: factors[name]
        for name in [*order, *sorted(set(factors) - set(order))]
        if name in factors
    }


def _single(values: Iterable[object]) -> Factor:
    """A factor of which each subject has at most one value."""
    return [frozenset() if v is None else frozenset([str(v)]) for v in values]


def _cells(
    factors: Mapping[str, Factor], levels: Mapping[str, Sequence[str]]
) -> Iterator[tuple[tuple[str, ...], int]]:
    """Cells with their numbers of subjects: single factors, pairs, and the triple of
    gender, ancestry and age.
    """
    crossed = [name for name in CROSSED if name in factors]
    combined: list[tuple[str, ...]] = [(name,) for name in factors]
    combined += list(itertools.combinations(crossed, 2))
    combined += [
        (name, factor)
        for name in crossed
        for factor in (CONDITION, SITE)
        if factor in factors
    ]
    combined += [tuple(crossed)] if len(crossed) == 3 else []
    for chosen in combined:
        for cell in itertools.product(*(levels[name] for name in chosen)):
            subjects = zip(*(factors[name] for name in chosen), strict=True)
            count = sum(
                all(value in has for value, has in zip(cell, values, strict=True))
                for values in subjects
            )
            yield (
                tuple(
                    f"{name}: {value}" for name, value in zip(chosen, cell, strict=True)
                ),
                count,
            )


def _values(name: str, factor: Factor) -> list[str]:
    """Sorted values of a factor; for age, all decades from the youngest to the oldest subject."""
    values = sorted(set().union(*factor))
    if name != AGE_BAND or not values:
        return values
    decades = [int(value.partition("-")[0]) for value in values]
    return [_band(decade) for decade in range(min(decades), max(decades) + 1, DECADE)]


def _flags(
    counts: Mapping[tuple[str, ...], int],
    unknown: Mapping[str, int],
    names: Sequence[str],
    stated: Mapping[str, Attribute],
    between: Array,
    subjects: int,
) -> list[str]:
    """Lines about empty and small cells of every crossing, unknown attributes, and
    associated attributes.
    """
    crossings: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for cell in counts:
        factors = tuple(part.partition(": ")[0] for part in cell)
        crossings.setdefault(factors, []).append(cell)
    flags = []
    for factors, cells in crossings.items():
        flags += _crossing_flags(AND.join(factors), cells, counts)
    flags += [
        f"{name}: unknown for {n} of {subjects} subjects"
        for name, n in unknown.items()
        if n
    ]
    flags += [
        f"{name}: no subject has this attribute"
        for name in (GENDER, ANCESTRY, AGE)
        if name not in stated or not stated[name].words
    ]
    for i, j in itertools.combinations(range(len(names)), 2):
        if between[i, j] >= ASSOCIATED:
            measure = _measure_name(stated[names[i]], stated[names[j]])
            flags.append(
                f"{names[i]} and {names[j]} are associated ({measure} "
                f"{between[i, j]:.2f}): their effects can "
                "hardly be separated"
            )
    return flags


def _crossing_flags(
    name: str,
    cells: Sequence[tuple[str, ...]],
    counts: Mapping[tuple[str, ...], int],
) -> list[str]:
    """Lines about empty and small cells of one crossing."""
    factors = len(cells[0])
    small = [cell for cell in cells if 0 < counts[cell] < FEW]
    empty = [cell for cell in cells if counts[cell] == 0]
    if factors == 3:  # too many cells to list; they are in the table
        few = len(empty) + len(small)
        return [
            f"{name}: {len(empty)} of {len(cells)} cells are empty, {few} "
            f"have fewer than {FEW}"
        ]
    flags = []
    if factors > 1:
        # crossings of a value without subjects are not listed again
        empty = [cell for cell in empty if all(counts[part,] for part in cell)]
    if empty:
        listed = few_names([_cell_values(cell) for cell in empty], MAX_LISTED)
        flags.append(f"{name}: no subjects in {listed}")
    if factors > 1 and small and len(small) == sum(counts[cell] > 0 for cell in cells):
        flags.append(
            f"{name}: all {len(small)} cells with subjects have fewer than {FEW}"
        )
    elif small:
        listed = few_names(
            [f"{_cell_values(cell)} ({counts[cell]})" for cell in small], MAX_LISTED
        )
        flags.append(f"{name}: fewer than {FEW} subjects: {listed}")
    return flags


def _association(a: Attribute, b: Attribute) -> float:
    """Strength of association of two attributes, from 0 to 1; NaN if too few subjects have both."""
    pairs = zip(a.values, b.values, strict=True)
    both = [(x, y) for x, y in pairs if x is not None and y is not None]
    if len(both) < 3:
        return float("nan")
    a_values, second = (
        Attribute(attribute.name, values)
        for attribute, values in zip((a, b), zip(*both, strict=True), strict=True)
    )
    if len(a_values.words) < 2 or len(second.words) < 2:
        return float("nan")
    if a.is_numeric and b.is_numeric:
        return float(np.abs(np.corrcoef(a_values.numbers, second.numbers)[0, 1]))
    if b.is_numeric:
        a_values, second = second, a_values
    if a.is_numeric or b.is_numeric:
        words = tuple(map(str, second.values))
        return multiple_correlation(
            a_values.numbers, Attribute(second.name, words).columns
        )
    counts = Counter((str(x), str(y)) for x, y in both)
    table = [[counts[x, y] for y in second.words] for x in a_values.words]
    return _cramer(np.array(table))


def _cramer(table: Array) -> float:
    """Cramer's V of a table of counts, corrected for its bias (Bergsma 2013); NaN for a
    single row or column.
    """
    n, (rows, columns) = table.sum(), table.shape
    square = float(association(table, method="cramer")) ** 2 * (min(rows, columns) - 1)
    corrected = max(0.0, square - (rows - 1) * (columns - 1) / (n - 1))
    largest = (
        min(rows - (rows - 1) ** 2 / (n - 1), columns - (columns - 1) ** 2 / (n - 1))
        - 1
    )
    return (
        float(min(1.0, np.sqrt(corrected / largest))) if largest > 0 else float("nan")
    )


def _measure_name(a: Attribute, b: Attribute) -> str:
    """Name of the measure of association of two attributes."""
    numeric = a.is_numeric + b.is_numeric
    return ("Cramer's V", "multiple correlation", "correlation")[numeric]


def _band(age: object) -> str:
    start = int(float(str(age)) // DECADE * DECADE)
    return f"{start}-{start + DECADE - 1}"


def _cell_values(cell: tuple[str, ...]) -> str:
    return AND.join(part.partition(": ")[2] for part in cell)


def describe_coverage(report: Dataset) -> list[str]:
    """Numbers of subjects and takes, and the flags of a coverage report, one line each."""
    return [
        f"{report.attrs['subjects']} subjects, {len(report.attrs['takes'])} takes",
        *report.attrs["flags"],
    ]


def plot_coverage(report: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot numbers of subjects by gender and ancestry against age as a table; empty
    cells are white.
    """
    from matplotlib.colors import LogNorm

    names: list[tuple[str, ...]] = [
        tuple(str(name).split(AND)) for name in report["cell"].values
    ]
    count_of = dict(
        zip(map(frozenset, names), report[variables.COVERAGE_COUNT].values, strict=True)
    )
    bands = [name for name in names if _factors_of(name) == {AGE_BAND}]
    rows = [name for name in names if _is_row(name, has_ages=bool(bands))]
    columns: list[tuple[str, ...]] = bands or [()]
    counts = np.array(
        [[count_of[frozenset(row + column)] for column in columns] for row in rows]
    )
    ax = ax or plots.new_axes(2.6 + 0.75 * len(columns), 1.1 + 0.4 * len(rows))
    norm = LogNorm(0.5, 2 * max(int(counts.max()), FEW))
    ax.imshow(np.ma.masked_equal(counts, 0), cmap="Blues", norm=norm, aspect="auto")
    for (i, j), count in np.ndenumerate(counts):
        colour = "white" if norm(max(count, 1)) > DARK else "black"
        ax.text(j, i, str(count), ha="center", va="center", fontsize=8, color=colour)
    labels = [row[0] if len(row) == 1 else _cell_values(row) for row in rows]
    ages = [_cell_values(column) or "all" for column in columns]
    ax.set_xticks(range(len(columns)), ages, fontsize=8)
    ax.set_yticks(range(len(rows)), labels, fontsize=8)
    ax.set_xlabel("age [years]" if bands else "subjects")
    ax.set_title(f"number of subjects (n = {report.attrs['subjects']})", fontsize=9)
    return ax


def _factors_of(cell: tuple[str, ...]) -> set[str]:
    return {part.partition(": ")[0] for part in cell}


def _is_row(cell: tuple[str, ...], *, has_ages: bool) -> bool:
    """Whether a cell is a row of the plot: pairs of gender and ancestry, and values of
    other factors than age, with ages only of those that are crossed with it.
    """
    factors = _factors_of(cell)
    if len(cell) > 1:
        return factors == {GENDER, ANCESTRY}
    return AGE_BAND not in factors and (not has_ages or factors <= {*WITH_AGE})


@dataclass(frozen=True)
class Parameters:
    """The study of coverage has no parameters."""


def compute(population: Population, _: Parameters) -> Results:
    """The results of the study."""
    return {"coverage": coverage_report(population.cohort)}


STUDY = Study(
    name="coverage",
    description="number of subjects by skin type, gender and age",
    layout="tables",
    parameters=Parameters,
    compute=compute,
    shown=("coverage",),
    tabulate=lambda report: table_of(report, [variables.COVERAGE_COUNT], ["cell"]),
    plot=plot_coverage,
    describe=describe_coverage,
)
