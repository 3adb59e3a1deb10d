"""Repeatability of quantities: what differs between takes of one subject in one condition."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from xarray import Dataset

from skindb import plots
from skindb.analysis.quantities import NORMAL_95, Quantities, quantities_of
from skindb.analysis.study import Study, Table, of_cohort, skipped_takes, table_of
from skindb.analysis.subjects import CONDITION, NORMAL, subjects_of
from skindb.errors import require
from skindb.numerics.statistics import (
    ROUNDING,
    agreement_correlation,
    intraclass_correlation,
)
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable, visit_of
from skindb.study_parameters import DECLARED
from skindb.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MIN_SUBJECTS = 3  # with a repeated value
FEW = 10  # subjects, below which intervals are wide
COLUMNS = (
    variables.REPEAT_SUBJECTS,
    variables.REPEAT_TAKES,
    variables.ICC,
    variables.ICC_LOW,
    variables.ICC_HIGH,
    variables.ICC_AGREEMENT,
    variables.ICC_AGREEMENT_LOW,
    variables.ICC_AGREEMENT_HIGH,
    variables.WITHIN_SUBJECT_DEVIATION,
    variables.REPEATABILITY_COEFFICIENT,
    variables.DETECTABLE_CHANGE_OF_MEAN,
    variables.REPEAT_BIAS,
    variables.AGREEMENT_LOW,
    variables.AGREEMENT_HIGH,
)


def repeatability(
    cohort: Dataset, *, condition: str = NORMAL, quantities: Sequence[str] = ()
) -> Dataset:
    """Reliability and repeatability of quantities, from repeats and visits of subjects.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    condition
        Condition of the takes.
    quantities
        Names of quantities; default albedo, surface reflectance and sigma_tr.

    Returns
    -------
    Dataset
        (quantity,), see the variables of the group "repeatability". sigma_tr is
        compared by its natural logarithm. `icc` is ICC(1), the fraction of the variance
        that is between subjects, from all takes; `icc_agreement` is ICC(2,1), from the
        visits and repeats of at least half of the repeated subjects, and the subjects
        with a value at each of them; common changes count as variance. Both have a 95 %
        interval. The repeatability coefficient,
        1.96 sqrt(2) times the standard deviation within subjects, is also the smallest
        detectable change of one subject. The limits of agreement are those of the
        second take less the first. NaN where fewer than three subjects have two values.

    Raises
    ------
    InputError
        If fewer than three subjects have two takes in the condition.

    References
    ----------
    Shrout and Fleiss 1979; McGraw and Wong 1996; Bland and Altman 1986, 1999; de Vet et
    al. 2006.
    """
    require_comparable(cohort, "tables")
    subjects = subjects_of(cohort)
    conditions = subjects.attribute(CONDITION).values
    rows = [i for i, name in enumerate(conditions) if name == condition]
    names = [subjects.subject[i] for i in rows]
    repeated = {name for name in names if names.count(name) > 1}
    require(
        len(repeated) >= MIN_SUBJECTS,
        f"condition {condition}",
        f"at least {MIN_SUBJECTS} subjects must have two takes",
        f"{len(repeated)} of {len(set(names))} subjects",
        "ingest and fit further visits or repeats",
    )
    chosen = cohort.isel(take=sorted(rows, key=lambda i: visit_of(subjects.take[i])))
    measured = quantities_of(chosen, quantities)
    occasions = [visit_of(str(take)) for take in chosen["take"].values]
    columns = [_statistics(values, measured, occasions) for values in measured.values.T]
    flags = []
    if len(repeated) < FEW:
        flags.append(f"fewer than {FEW} subjects with repeated takes")
    return dataset(
        {name: [column[name] for column in columns] for name in COLUMNS},
        coords={"quantity": list(measured.names)},
        attrs={
            "condition": condition,
            "logarithmic": list(itertools.compress(measured.names, measured.is_log)),
            "flags": flags,
            "skipped": skipped_takes(cohort),
        },
    )


def _statistics(
    values: Array, measured: Quantities, occasions: Sequence[tuple[int, int]]
) -> dict[str, float]:
    """Variables of one quantity of takes, which are in the order of their occasions."""
    known = np.isfinite(values)
    subjects = np.array(measured.subject)
    of_subject = {
        name: values[known & (subjects == name)]
        for name in dict.fromkeys(measured.subject)
    }
    repeated = [x for x in of_subject.values() if len(x) > 1]
    statistics = dict.fromkeys(COLUMNS, np.nan)
    statistics[variables.REPEAT_SUBJECTS] = len(repeated)
    statistics[variables.REPEAT_TAKES] = int(known.sum())
    spread = np.ptp(values[known]) if known.any() else 0.0
    if len(repeated) < MIN_SUBJECTS or spread <= ROUNDING * np.abs(values[known]).max(
        initial=0
    ):
        return statistics
    one_way = intraclass_correlation(values[known], subjects[known])
    columns = [measured.subject, *zip(*occasions, strict=True)]
    keys = pd.MultiIndex.from_arrays(columns)
    table = pd.Series(values, keys).unstack([1, 2])
    table = table[table.count(axis=1) > 1]
    table = table.loc[:, table.count() >= len(table) / 2].dropna()
    agreement = agreement_correlation(table.to_numpy())
    coefficient = NORMAL_95 * np.sqrt(2) * one_way.within
    change = np.array([x[1] - x[0] for x in repeated])
    half = NORMAL_95 * change.std(ddof=1)
    results = (
        *one_way[:3],
        *agreement,
        one_way.within,
        coefficient,
        coefficient / np.sqrt(len(repeated)),
        change.mean(),
        change.mean() - half,
        change.mean() + half,
    )
    return statistics | dict(zip(COLUMNS[2:], map(float, results), strict=True))


def tabulate_repeatability(table: Dataset) -> Table:
    """Header and one row per quantity."""
    return table_of(table, COLUMNS, ("quantity",))


def describe_repeatability(table: Dataset) -> list[str]:
    """Notes on the table, one line each."""
    lines = [
        f"takes in the condition {table.attrs['condition']}; low and high are the ends of "
        "95 % intervals",
        "the repeatability coefficient is the smallest detectable change of one subject",
    ]
    if table.attrs["logarithmic"]:
        lines.append("sigma_tr is compared by its natural logarithm")
    return [*lines, *table.attrs["flags"]]


def plot_repeatability(table: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the ICC of each quantity with its 95 % interval."""
    names = table["quantity"].values.tolist()
    ax, places = plots.axes_of_rows(names, ax)
    plots.intervals(ax, table, variables.ICC, places, fmt="o", color=plots.BLUE)
    count = int(table[variables.REPEAT_SUBJECTS].max())
    ax.set_xlim(min(0.0, *ax.get_xlim()), 1.02)
    ax.set_xlabel(f"ICC(1), 95 % CI (n = {count} subjects with repeated takes)")
    return ax


STUDY = Study(
    *DECLARED["repeatability"],
    layout="tables",
    compute=of_cohort("repeatability", repeatability),
    shown=("repeatability",),
    tabulate=tabulate_repeatability,
    plot=plot_repeatability,
    describe=describe_repeatability,
    columns_of_files=(
        variables.ICC_AGREEMENT_LOW,
        variables.ICC_AGREEMENT_HIGH,
        variables.DETECTABLE_CHANGE_OF_MEAN,
    ),
    counts_takes=True,
    conditions=lambda _, parameters: [parameters.condition],
)
