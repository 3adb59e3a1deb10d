"""Coverage of groups in a cohort: numbers of subjects, and cells with none or few of them."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from xarray import Dataset

from skindb import plots
from skindb.analysis.contrasts import FEW
from skindb.analysis.study import Study, of_cohort, skipped_takes, table_of
from skindb.analysis.subjects import (
    AGE,
    CONDITION,
    MAX_AGE,
    Attribute,
    Subjects,
    subjects_of,
)
from skindb.errors import counted, few_names, require
from skindb.schema import IDENTIFIED, dataset, variables
from skindb.schema.cohort import require_takes
from skindb.study_parameters import DECLARED
from skindb.types import Array, Mask

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GENDER = "gender"
ANCESTRY = "ancestry"
AGE_BAND = "age band"
SITE = "site"
# factors of which pairs and the triple are counted
CROSSED = (GENDER, ANCESTRY, AGE_BAND)
DECADE = 10  # years in an age band
AND = " x "
DARK = 0.6  # fraction of the colour scale above which numbers are white
MAX_LISTED = 12  # cells named in a line
# different values of an attribute; one with more is treated as a name, not as groups
MAX_VALUES = 12
Factor = dict[str, Mask]  # value -> mask of the subjects that have it
Words = tuple[str, ...]  # names of factors, or a value of each


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
        and crossing ("gender: female x ancestry: african"), including empty ones.
        Attribute "flags": empty cells, cells with fewer than 10 subjects, and unknown
        attributes. Values that no subject has cannot be listed, except for age bands
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
    stated = {
        name: takes.by_subject(name, takes.names) for name in sorted(takes.described)
    }
    factors = _factors(cohort, takes, stated)
    counts = _counts(factors)
    flags = [
        flag
        for factors_of, cells in counts.items()
        for flag in _flags(factors_of, cells, counts)
    ]
    flags += _unknown(factors, stated, len(takes.names))
    return dataset(
        {
            variables.COVERAGE_COUNT: [
                n for cells in counts.values() for n in cells.values()
            ]
        },
        coords={
            "cell": [
                AND.join(map(": ".join, zip(names, cell, strict=True)))
                for names, cells in counts.items()
                for cell in cells
            ]
        },
        attrs={
            "subjects": len(takes.names),
            "takes": sorted(takes.take),
            "flags": flags
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
    names = np.array(takes.names)
    who = np.array(takes.subject)
    factors = {}
    for name in [*stated, CONDITION]:
        attribute = takes.attribute(name)
        if name == AGE:
            factors[AGE_BAND] = _age_bands(stated[name].numbers)
        elif name == CONDITION or (
            not attribute.is_numeric and 1 <= len(attribute.words) <= MAX_VALUES
        ):
            factor = f"attribute {name}" if name in (AGE_BAND, SITE) else name
            # values may differ between takes of a subject
            factors[factor] = {
                value: np.isin(names, who[rows])
                for value, rows in _indicators(attribute.values).items()
            }
    if variables.SITE_STATUS in cohort:
        good = cohort[variables.SITE_STATUS].isin(IDENTIFIED).any("channel")
        factors[SITE] = {
            str(site): np.isin(names, who[good.sel(site=site).values & takes.is_normal])
            for site in cohort["site"].values.tolist()
        }
    order = dict.fromkeys([*CROSSED, CONDITION, SITE, *factors])
    return {name: factors[name] for name in order if name in factors}


def _indicators(values: Iterable[object]) -> Factor:
    """Mask of each value, sorted."""
    words = [None if value is None else str(value) for value in values]
    return {
        word: np.array([other == word for other in words])
        for word in sorted({*filter(None, words)})
    }


def _age_bands(ages: Array) -> Factor:
    """Decades from the youngest to the oldest subject."""
    decades = ages[(ages >= 0) & (ages <= MAX_AGE)] // DECADE
    span = range(int(decades.min()), int(decades.max()) + 1) if decades.size else []
    return {
        f"{i * DECADE}-{i * DECADE + DECADE - 1}": ages // DECADE == i for i in span
    }


def _counts(factors: Mapping[str, Factor]) -> dict[Words, dict[Words, int]]:
    """Numbers of subjects by factors and a value of each: of single factors, pairs, and
    the triple of gender, ancestry and age.
    """
    crossed = [name for name in CROSSED if name in factors]
    combined: list[Words] = [(name,) for name in factors]
    combined += itertools.combinations(crossed, 2)
    combined += itertools.product(
        crossed, [n for n in (CONDITION, SITE) if n in factors]
    )
    combined += itertools.combinations(crossed, 3)
    counts: dict[Words, dict[Words, int]] = {}
    for chosen in combined:
        counts[chosen] = {}
        for cell in itertools.product(*(factors[name].items() for name in chosen)):
            values, masks = zip(*cell, strict=True)
            counts[chosen][values] = int(np.all(masks, axis=0).sum())
    return counts


def _flags(
    names: Words,
    cells: Mapping[Words, int],
    counts: Mapping[Words, Mapping[Words, int]],
) -> list[str]:
    """Lines about empty and small cells of one crossing."""
    name = AND.join(names)
    small = [cell for cell, count in cells.items() if 0 < count < FEW]
    empty = [cell for cell, count in cells.items() if count == 0]
    if len(names) == 3:  # too many cells to list; they are in the table
        few = len(empty) + len(small)
        return [
            f"{name}: {len(empty)} of {len(cells)} cells are empty, {few} "
            f"have fewer than {FEW}"
        ]
    flags = []
    if len(names) > 1:
        # crossings of a value without subjects are not listed again
        empty = [
            cell
            for cell in empty
            if all(counts[n,][value,] for n, value in zip(names, cell, strict=True))
        ]
    if empty:
        flags.append(
            f"{name}: no subjects in {few_names([*map(AND.join, empty)], MAX_LISTED)}"
        )
    if len(names) > 1 and small and len(small) == sum(map(bool, cells.values())):
        flags.append(
            f"{name}: all {len(small)} cells with subjects have fewer than {FEW}"
        )
    elif small:
        listed = [f"{AND.join(cell)} ({cells[cell]})" for cell in small]
        flags.append(
            f"{name}: fewer than {FEW} subjects: {few_names(listed, MAX_LISTED)}"
        )
    return flags


def _unknown(
    factors: Mapping[str, Factor], stated: Mapping[str, Attribute], subjects: int
) -> list[str]:
    """Lines about attributes that some subjects or all lack."""
    flags = []
    for name, factor in factors.items():
        known = np.any([np.zeros(subjects, bool), *factor.values()], axis=0)
        if name not in (CONDITION, SITE) and not known.all():
            flags.append(f"{name}: unknown for {(~known).sum()} of {subjects} subjects")
    return flags + [
        f"{name}: no subject has this attribute"
        for name in (GENDER, ANCESTRY, AGE)
        if name not in stated or not stated[name].words
    ]


def describe_coverage(report: Dataset) -> list[str]:
    """Numbers of subjects and takes, and the flags of a coverage report, one line each."""
    return [
        f"{counted(report.attrs['subjects'], 'subject')}, "
        f"{counted(len(report.attrs['takes']), 'take')}",
        *report.attrs["flags"],
    ]


def plot_coverage(report: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot numbers of subjects by gender and ancestry, and by other factors that are crossed
    with age, against age as a table; empty cells are white.
    """
    from matplotlib.colors import LogNorm

    # values may contain AND
    factors = "|".join([*CROSSED, CONDITION, SITE])
    between = re.compile(f"{AND}(?=(?:{factors}): )")
    cells = [tuple(between.split(name)) for name in report["cell"].values]
    numbers = report[variables.COVERAGE_COUNT].values.tolist()
    count_of = dict(zip(map(frozenset, cells), numbers, strict=True))
    bands: list[Words] = [
        c for c in cells if len(c) == 1 and c[0].startswith(f"{AGE_BAND}: ")
    ]
    columns: list[Words] = bands or [()]
    rows = [
        cell
        for cell in cells
        if not any(part.startswith(f"{AGE_BAND}: ") for part in cell)
        and all(frozenset(cell + column) in count_of for column in columns)
    ]
    counts = np.array(
        [[count_of[frozenset(row + column)] for column in columns] for row in rows]
    )
    ax = ax or plots.new_axes(2.6 + 0.75 * len(columns), 1.1 + 0.4 * len(rows))
    norm = LogNorm(0.5, 2 * max(int(counts.max()), FEW))
    ax.imshow(np.ma.masked_equal(counts, 0), cmap="Blues", norm=norm, aspect="auto")
    for (i, j), count in np.ndenumerate(counts):
        colour = "white" if norm(max(count, 1)) > DARK else "black"
        ax.text(j, i, str(count), ha="center", va="center", fontsize=8, color=colour)
    labels = [row[0] if len(row) == 1 else _values(row) for row in rows]
    ages = [_values(column) or "all" for column in columns]
    ax.set_xticks(range(len(columns)), ages, fontsize=8)
    ax.set_yticks(range(len(rows)), labels, fontsize=8)
    ax.set_xlabel("age [years]" if bands else "subjects")
    ax.set_title(f"number of subjects (n = {report.attrs['subjects']})", fontsize=9)
    return ax


def _values(cell: Words) -> str:
    """The values of a cell without the names of their factors."""
    return AND.join(part.partition(": ")[2] for part in cell)


STUDY = Study(
    *DECLARED["coverage"],
    layout="tables",
    compute=of_cohort("coverage", coverage_report),
    shown=("coverage",),
    tabulate=lambda report: table_of(report, [variables.COVERAGE_COUNT]),
    plot=plot_coverage,
    describe=describe_coverage,
)
