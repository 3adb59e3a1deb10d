"""Which groups a cohort represents, and which attributes cannot be separated in it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from scipy.stats.contingency import association

from skindb._types import Array
from skindb.analysis.group_effects import ASSOCIATED, FEW
from skindb.analysis.members import AGE, CONDITION, NORMAL, attributes, is_normal, texts
from skindb.analysis.quantities import attribute_of_subjects, columns_of, is_number
from skindb.errors import Fault, InputError
from skindb.schema import IDENTIFIED, dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GENDER, ANCESTRY, AGE_BAND, SITE = "gender", "ancestry", "age band", "site"
CROSSED = (GENDER, ANCESTRY, AGE_BAND)  # also all three of them
DECADE = 10  # years of an age band
AND = " x "
DARK = 0.6  # of the colour scale, from which numbers are white
MOST_NAMED = 12  # cells in a line
MOST_WORDS = 12  # values of an attribute that is counted; one of more is a name, not a group
Factor = list[frozenset[str]]  # of each subject: one value, several conditions or sites, or none


def coverage_report(cohort: xr.Dataset) -> xr.Dataset:
    """Counts of subjects by gender, ancestry, age and their crossings, by condition and probe site.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``; with the conditions, of which a subject may have several.

    Returns
    -------
    Dataset
        `coverage_count` (cell,): subjects of every value ("gender: female") and crossing ("gender: female x ancestry:
        african"), also of those without subjects; `coverage_unknown` (attribute,): subjects without it;
        `coverage_association` (attribute, attribute_2) between subjects: Cramer's V of two attributes with few values
        (corrected for its bias, Bergsma 2013), the multiple correlation of a number with such a one (adjusted for the
        number of values), the absolute correlation of two numbers. Attribute "flags": empty cells, cells below 10
        subjects, and attributes whose differences can hardly be separated. A value that no subject has is not known
        here, except for ages in between.

    Raises
    ------
    InputError
        If there is no take.
    """
    if not cohort.sizes.get("take"):
        raise InputError(Fault("coverage", "there must be a take", "none", "fit a take first"))
    subjects = tuple(dict.fromkeys(str(one) for one in texts(cohort["subject"])))
    said = {
        name: attribute_of_subjects(cohort, name, subjects) for name in sorted(attributes(cohort)) if name != CONDITION
    }
    factors = _factors(cohort, subjects, said)
    levels = {name: _values(name, factor) for name, factor in factors.items()}
    if SITE in factors:  # including sites without measurements
        levels[SITE] = [str(site) for site in cohort["site"].values]
    counts = dict(_cells(factors, levels))
    names = [name for name in said if is_number(said[name]) or 1 < len(_words(said[name])) <= MOST_WORDS]
    between = np.array([[_association(said[a], said[b]) for b in names] for a in names]).reshape(len(names), len(names))
    unknown = {
        name: sum(not one for one in factor) for name, factor in factors.items() if name not in (CONDITION, SITE)
    }
    return dataset(
        {
            "coverage_count": np.array(list(counts.values()), np.int32),
            "coverage_association": between,
            "coverage_unknown": np.array([_unknown(said[name]) for name in names], np.int32),
        },
        coords={"cell": [AND.join(key) for key in counts], "attribute": names, "attribute_2": names},
        attrs={
            "subjects": len(subjects),
            "takes": sorted(map(str, cohort["take"].values)),
            "flags": _flags(counts, unknown, names, said, between, len(subjects)),
            "skipped": list(cohort.attrs.get("skipped", [])),
        },
    )


def _factors(cohort: xr.Dataset, subjects: Sequence[str], said: Mapping[str, list[object]]) -> dict[str, Factor]:
    """What subjects are counted by: attributes with few values, age in decades, conditions and sites."""
    factors: dict[str, Factor] = {}
    for name, values in said.items():
        if name == AGE:
            factors[AGE_BAND] = [frozenset([_band(one)]) if _is_age(one) else frozenset() for one in values]
        elif not is_number(values) and 1 <= len(_words(values)) <= MOST_WORDS:
            factors[name] = [frozenset() if one is None else frozenset([str(one)]) for one in values]
    owner = [str(one) for one in texts(cohort["subject"])]
    known = texts(cohort[CONDITION]) if CONDITION in cohort.coords else [NORMAL] * len(owner)
    factors[CONDITION] = [
        frozenset(str(one) for one, own in zip(known, owner, strict=True) if own == subject and one is not None)
        for subject in subjects
    ]
    if "site_status" in cohort:
        good = cohort["site_status"].isin(IDENTIFIED).transpose("take", "site", ...).values
        good = good.reshape(*good.shape[:2], -1).any(axis=-1) & is_normal(cohort)[:, None]
        rows = [np.array([one == subject for one in owner]) for subject in subjects]
        sites = [str(site) for site in cohort["site"].values]
        factors[SITE] = [frozenset(itertools.compress(sites, good[own].any(axis=0).tolist())) for own in rows]
    order = [*CROSSED, CONDITION, SITE]
    return {name: factors[name] for name in [*order, *sorted(set(factors) - set(order))] if name in factors}


def _cells(factors: Mapping[str, Factor], levels: Mapping[str, Sequence[str]]) -> Iterator[tuple[tuple[str, ...], int]]:
    """Cell -> subjects: each factor alone, pairs of the main ones, and all three of gender, ancestry and age."""
    crossed = [name for name in CROSSED if name in factors]
    combined: list[tuple[str, ...]] = [(name,) for name in factors]
    combined += list(itertools.combinations(crossed, 2))
    combined += [(name, other) for name in crossed for other in (CONDITION, SITE) if other in factors]
    combined += [tuple(crossed)] if len(crossed) == 3 else []
    for chosen in combined:
        for cell in itertools.product(*(levels[name] for name in chosen)):
            subjects = zip(*(factors[name] for name in chosen), strict=True)
            count = sum(all(value in has for value, has in zip(cell, one, strict=True)) for one in subjects)
            yield tuple(f"{name}: {value}" for name, value in zip(chosen, cell, strict=True)), count


def _values(name: str, factor: Factor) -> list[str]:
    """Values in order; decades between the youngest and the oldest also if they are empty."""
    found = sorted(set().union(*factor))
    if name != AGE_BAND or not found:
        return found
    first = [int(one.partition("-")[0]) for one in found]
    return [_band(decade) for decade in range(min(first), max(first) + 1, DECADE)]


def _flags(
    counts: Mapping[tuple[str, ...], int],
    unknown: Mapping[str, int],
    names: Sequence[str],
    said: Mapping[str, list[object]],
    between: Array,
    subjects: int,
) -> list[str]:
    """Empty and small cells by what is crossed, and attributes that are associated."""
    flags = []
    kinds: dict[tuple[str, ...], dict[tuple[str, ...], int]] = {}
    for cell, count in counts.items():
        kinds.setdefault(tuple(one.partition(": ")[0] for one in cell), {})[cell] = count
    for kind, cells in kinds.items():
        if len(kind) == 3:  # too many to name: the table has them
            few = sum(count < FEW for count in cells.values())
            empty = sum(count == 0 for count in cells.values())
            flags.append(f"{AND.join(kind)}: {empty} of {len(cells)} cells are empty, {few} have fewer than {FEW}")
            continue
        reported = {
            cell: count for cell, count in cells.items() if all(counts[one,] for one in cell)
        }  # named alone else
        empty_ones = [_short(cell) for cell, count in (reported if len(kind) > 1 else cells).items() if count == 0]
        small = [f"{_short(cell)} ({count})" for cell, count in cells.items() if 0 < count < FEW]
        if empty_ones:
            flags.append(f"{AND.join(kind)}: no subject is {_listed(empty_ones)}")
        if small and len(small) == sum(map(bool, cells.values())) and len(kind) > 1:
            flags.append(f"{AND.join(kind)}: all {len(small)} cells with subjects have fewer than {FEW}")
        elif small:
            flags.append(f"{AND.join(kind)}: fewer than {FEW} subjects: {_listed(small)}")
    flags += [f"{name}: not known of {n} of {subjects} subjects" for name, n in unknown.items() if n]
    flags += [f"{name}: no subject says it" for name in (GENDER, ANCESTRY, AGE) if not any(_words(said.get(name, [])))]
    for i, j in itertools.combinations(range(len(names)), 2):
        if between[i, j] >= ASSOCIATED:
            measure = _kind(said[names[i]], said[names[j]])
            flags.append(
                f"{names[i]} and {names[j]} go together ({measure} {between[i, j]:.2f}): differences of one can "
                "hardly be separated from those of the other"
            )
    return flags


def _association(a: list[object], b: list[object]) -> float:
    """How well one attribute predicts another, from 0 to 1; NaN if too few subjects have both."""
    both = [(x, y) for x, y in zip(a, b, strict=True) if x is not None and y is not None]
    if len(both) < 3:
        return float("nan")
    first, second = ([pair[i] for pair in both] for i in (0, 1))
    if len(_words(first)) < 2 or len(_words(second)) < 2:
        return float("nan")
    if is_number(a) and is_number(b):
        return float(np.abs(np.corrcoef(_numbers(first), _numbers(second))[0, 1]))
    if is_number(a) or is_number(b):
        return _multiple(first, second) if is_number(a) else _multiple(second, first)
    table = np.array([[sum(pair == (x, y) for pair in _as_words(both)) for y in _words(second)] for x in _words(first)])
    return _cramer(table)


def _cramer(table: Array) -> float:
    """Cramer's V of counts, corrected for its bias (Bergsma 2013); of a single value NaN."""
    n, (rows, columns) = table.sum(), table.shape
    square = float(association(table, method="cramer")) ** 2 * (min(rows, columns) - 1)
    corrected = max(0.0, square - (rows - 1) * (columns - 1) / (n - 1))
    most = min(rows - (rows - 1) ** 2 / (n - 1), columns - (columns - 1) ** 2 / (n - 1)) - 1
    return float(min(1.0, np.sqrt(corrected / most))) if most > 0 else float("nan")


def _multiple(numbers: list[object], words: list[object]) -> float:
    """Multiple correlation of a number with groups, adjusted for their number."""
    y = _numbers(numbers)
    x = np.column_stack([np.ones(len(y)), columns_of([str(one) for one in words])])
    free = len(y) - np.linalg.matrix_rank(x)
    if free < 1 or np.ptp(y) == 0:
        return float("nan")
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(np.sqrt(max(0.0, 1.0 - (left @ left / free) / np.var(y, ddof=1))))


def _kind(a: list[object], b: list[object]) -> str:
    numbers = is_number(a) + is_number(b)
    return ("Cramer's V", "multiple correlation", "correlation")[numbers]


def _numbers(values: list[object]) -> Array:
    return np.array([float(str(one)) for one in values])


def _as_words(pairs: list[tuple[object, object]]) -> list[tuple[str, str]]:
    return [(str(x), str(y)) for x, y in pairs]


def _words(values: Sequence[object]) -> list[str]:
    return sorted({str(one) for one in values if one is not None})


def _unknown(values: Sequence[object]) -> int:
    return sum(one is None for one in values)


def _is_age(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _band(age: object) -> str:
    first = int(float(str(age)) // DECADE * DECADE)
    return f"{first}-{first + DECADE - 1}"


def _short(cell: tuple[str, ...]) -> str:
    return AND.join(one.partition(": ")[2] for one in cell)


def _listed(names: Sequence[str]) -> str:
    rest = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {rest} more" if rest > 0 else "")


def describe_coverage(report: xr.Dataset) -> list[str]:
    """Number of subjects and groups that are not represented, one line each."""
    return [f"{report.attrs['subjects']} subjects, {len(report.attrs['takes'])} takes", *report.attrs["flags"]]


def plot_coverage(report: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Subjects by gender and ancestry against age, as a table of numbers; empty cells are white."""
    from matplotlib import pyplot
    from matplotlib.colors import LogNorm

    cells = {
        tuple(str(name).split(AND)): int(count)
        for name, count in zip(report["cell"].values, report["coverage_count"].values, strict=True)
    }
    rows, columns, counts = _plotted(cells)
    if ax is None:
        _, ax = pyplot.subplots(figsize=(2.6 + 0.75 * len(columns), 1.1 + 0.4 * len(rows)))
    most = max(int(counts.max()), FEW)
    norm = LogNorm(0.5, 2 * most)
    ax.imshow(np.ma.masked_equal(counts, 0), cmap="Blues", norm=norm, aspect="auto")
    for i, j in np.ndindex(counts.shape):
        dark = norm(max(int(counts[i, j]), 1)) > DARK
        ax.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=8, color="white" if dark else "black")
    ax.set_xticks(range(len(columns)), columns, fontsize=8)
    ax.set_yticks(range(len(rows)), rows, fontsize=8)
    has_ages = any(name[0].startswith(AGE_BAND) for name in cells)
    ax.set_xlabel("age [years]" if has_ages else "subjects")
    ax.set_title(f"number of subjects (n = {report.attrs['subjects']})", fontsize=9)
    return ax


def _plotted(cells: Mapping[tuple[str, ...], int]) -> tuple[list[str], list[str], Array]:
    """Rows, columns and counts: values of everything that is crossed with age, or all values alone."""
    bands = [name[0] for name in cells if len(name) == 1 and name[0].startswith(f"{AGE_BAND}: ")]
    others = [name for name in cells if len(name) < 3 and not any(one.startswith(AGE_BAND) for one in name)]
    kinds = (GENDER, ANCESTRY, CONDITION, SITE)
    single = [name[0] for name in others if len(name) == 1 and (not bands or name[0].partition(":")[0] in kinds)]
    pairs = [
        name for name in others if len(name) == 2 and {one.partition(":")[0] for one in name} == {GENDER, ANCESTRY}
    ]
    if not bands:
        keys: list[tuple[str, ...]] = [*((name,) for name in single), *pairs]
        return [_short(key) for key in keys], ["all"], np.array([[cells[key]] for key in keys])
    rows = [*((name,) for name in single), *pairs]
    table = np.array([[_crossed(cells, (*row, band)) for band in bands] for row in rows])
    labels = [row[0] if len(row) == 1 else _short(row) for row in rows]
    return labels, [band.partition(": ")[2] for band in bands], table


def _crossed(cells: Mapping[tuple[str, ...], int], wanted: tuple[str, ...]) -> int:
    """Count of a crossing, in whatever order it is named."""
    return next((count for name, count in cells.items() if set(name) == set(wanted)), 0)
