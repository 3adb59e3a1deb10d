"""Correlations of albedo, surface reflectance and translucency between subjects."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import scipy  # scipy.stats takes longer to load, at its first use, than commands run
from numpy.random import Generator
from xarray import Dataset

from skindb import plots
from skindb.analysis.quantities import SURFACE, Quantities, quantities_of
from skindb.analysis.study import Study, of_cohort, skipped_takes, table_of
from skindb.analysis.subjects import compared_conditions, takes_to_compare
from skindb.errors import require
from skindb.numerics.statistics import known_mean
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS, FACE
from skindb.study_parameters import DECLARED
from skindb.types import Array, finite_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MIN_SUBJECTS = 5  # subjects needed for a correlation
# subjects, below which the bootstrap has too few distinct samples for an interval
FEW = 10
RESAMPLES = 2000
COMPONENTS = (
    *(f"R_d {channel}" for channel in CHANNELS),
    SURFACE,
    *(f"log sigma_tr {c}" for c in CHANNELS),
)

COLUMNS = (
    variables.CORRELATION_COUNT,
    variables.COMPONENT_CORRELATION,
    variables.COMPONENT_CORRELATION_LOW,
    variables.COMPONENT_CORRELATION_HIGH,
    variables.CORRELATION_P,
    variables.CORRELATION_P_FALSE_DISCOVERY,
)


def component_correlations(
    cohort: Dataset,
    *,
    permutations: int = 10_000,
    rng: Generator,
) -> Dataset:
    """Correlations between subjects of the three components of skin: albedo, surface
    reflectance and translucency.

    Each subject counts once, in the condition normal. The values are the mean albedo
    and surface reflectance of the face, and the mean over probe sites of log sigma_tr
    after the mean of each site is subtracted.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    permutations
        Maximum number of permutations for p values.
    rng
        Random generator of the bootstrap and the permutations.

    Returns
    -------
    Dataset
        (pair,) `component_correlation` with its 95 % interval by bootstrap over
        subjects (BCa, Efron 1987; NaN with fewer than ten), `correlation_p` by
        permutation of subjects (statistic: the absolute correlation; exact if the
        components are independent), `correlation_p_false_discovery` controlled over the
        pairs of different components, NaN for channels of one, and `correlation_count`,
        the number of subjects. Attribute "flags".

    Raises
    ------
    InputError
        If fewer than five subjects have two components.
    """
    require_comparable(cohort, "tables")
    takes, _ = takes_to_compare(cohort, None)
    values = _components(quantities_of(takes))
    pairs = [
        pair
        for pair in combinations(range(len(COMPONENTS)), 2)
        if _can_correlate(values[:, pair])
    ]
    require(
        pairs,
        "correlations",
        f"at least {MIN_SUBJECTS} subjects must have two components that vary",
        f"{len(values)} subjects",
        "fit more subjects",
    )
    rows = [_pair(values[:, [i, j]], permutations, rng) for i, j in pairs]
    values_of_pairs, low, high, p, count = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    kinds = [name.rpartition(" ")[0] for name in COMPONENTS]
    differ = np.array([kinds[i] != kinds[j] for i, j in pairs])
    discovered = np.full(len(pairs), np.nan)
    discovered[differ] = scipy.stats.false_discovery_control(p[differ])
    flags = []
    if count.min() < FEW:
        flags.append(f"fewer than {FEW} subjects: there are no intervals")
    return dataset(
        {
            variables.COMPONENT_CORRELATION: values_of_pairs,
            variables.COMPONENT_CORRELATION_LOW: low,
            variables.COMPONENT_CORRELATION_HIGH: high,
            variables.CORRELATION_P: p,
            variables.CORRELATION_P_FALSE_DISCOVERY: discovered,
            variables.CORRELATION_COUNT: count,
        },
        coords={"pair": [f"{COMPONENTS[i]} with {COMPONENTS[j]}" for i, j in pairs]},
        attrs={"flags": flags, "skipped": skipped_takes(cohort)},
    )


def _components(quantities: Quantities) -> Array:
    """Values (subject, component); NaN where a subject lacks a component."""
    of_subjects = quantities.of_subjects()
    columns = dict(zip(of_subjects.names, of_subjects.values.T, strict=True))
    nothing = np.full(len(of_subjects.subject), np.nan)
    out = [columns.get(f"R_d {FACE} {channel}", nothing) for channel in CHANNELS]
    out.append(columns.get(f"{SURFACE} {FACE}", nothing))
    for channel in CHANNELS:
        sites = [
            x
            for name, x in columns.items()
            if name.startswith("sigma_tr ") and name.endswith(f" {channel}")
        ]
        # subtract the mean of each site: subjects who were measured at other sites must
        # not appear to differ
        out.append(
            known_mean(np.stack([x - known_mean(x) for x in sites]))
            if sites
            else nothing
        )
    return np.stack(out, axis=1)


def _can_correlate(columns: Array) -> bool:
    """Whether enough subjects have both columns (n, 2), and both vary between them."""
    complete = columns[finite_rows(columns)]
    return len(complete) >= MIN_SUBJECTS and bool((np.ptp(complete, axis=0) > 0).all())


def _pair(
    two: Array, permutations: int, rng: Generator
) -> tuple[float, float, float, float, int]:
    """Correlation, ends of its interval, p value and number of subjects of two columns."""
    x, y = two[finite_rows(two)].T
    # pairs of subjects are drawn anew; all of them are used if there are at most `permutations`
    p = scipy.stats.permutation_test(
        (x,),
        lambda permuted, axis: np.abs(_pearson(permuted, y, axis)),
        permutation_type="pairings",
        vectorized=True,
        n_resamples=permutations,
        alternative="greater",
        rng=rng,
    ).pvalue
    low = high = float("nan")
    if len(x) >= FEW:
        interval = scipy.stats.bootstrap(
            (x, y),
            _pearson,
            paired=True,
            vectorized=True,
            n_resamples=RESAMPLES,
            method="BCa",
            rng=rng,
        ).confidence_interval
        low = float(interval.low)
        high = float(interval.high)
    return float(_pearson(x, y)), low, high, float(p), len(x)


def _pearson(x: Array, y: Array, axis: int = -1) -> Array:
    """Correlation along an axis; 0 where a resample does not vary."""
    x, y = (variable - variable.mean(axis=axis, keepdims=True) for variable in (x, y))
    size = np.sqrt((x**2).sum(axis=axis) * (y**2).sum(axis=axis))
    return np.asarray(
        np.divide((x * y).sum(axis=axis), size, out=np.zeros_like(size), where=size > 0)
    )


def describe_correlations(table: Dataset) -> list[str]:
    """Notes on the table, one line each."""
    p = table[variables.CORRELATION_P_FALSE_DISCOVERY]
    counts = f"{int((p < 0.05).sum())} of {int(p.notnull().sum())}"
    line = f"{counts} pairs of different components are correlated (false discovery rate 5 %)"
    return [line, *table.attrs["flags"]]


def plot_correlations(table: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the correlations with their 95 % intervals, one row per pair."""
    names = table["pair"].values.tolist()
    ax, place = plots.axes_of_rows(names, ax)
    ax.axvline(0, color="0.6", linewidth=1)
    name = variables.COMPONENT_CORRELATION
    significant = table[variables.CORRELATION_P_FALSE_DISCOVERY].values < 0.05
    colour = plots.CYCLE[0]
    plots.significant_intervals(ax, table, name, place, significant, colour=colour)
    ax.set_xlim(-1.03, 1.03)
    count = int(table[variables.CORRELATION_COUNT].max())
    has_intervals = table[variables.COMPONENT_CORRELATION_LOW].notnull().any()
    interval = ", 95 % CI" if has_intervals else ""
    ax.set_xlabel(
        f"correlation between subjects{interval} (n = {count})\nfilled: p < 0.05 "
        "at a false discovery rate of 5 %; channels of one component are not tested"
    )
    return ax


STUDY = Study(
    *DECLARED["correlations"],
    layout="tables",
    compute=of_cohort("correlations", component_correlations),
    shown=("correlations",),
    tabulate=lambda table: table_of(table, COLUMNS),
    plot=plot_correlations,
    describe=describe_correlations,
    conditions=compared_conditions,
)
