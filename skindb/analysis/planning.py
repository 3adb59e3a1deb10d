"""Numbers of subjects that a study needs, from the variances of a database."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Literal

import numpy as np
import pandas as pd
import scipy  # scipy.stats takes longer to load, at its first use, than commands run
from xarray import Dataset

from skindb import plots
from skindb.analysis.contrasts import MIN_RELIABILITY
from skindb.analysis.formula_models import (
    ALONE,
    RESIDUAL,
    information_of,
    is_constant_within,
    linear_model,
)
from skindb.analysis.formulas import (
    SUBJECT,
    MixedModel,
    design_of,
    names_of,
    sum_of,
    with_levels,
)
from skindb.analysis.long_form import INTERCEPT, tidy
from skindb.analysis.study import Study, of_cohort, table_of
from skindb.analysis.subjects import CONDITION, NORMAL
from skindb.errors import require
from skindb.parameters import require_limits
from skindb.schema import dataset, variables
from skindb.schema.cohort import visit_of
from skindb.study_parameters import DECLARED, PlanParameters
from skindb.types import Array, Index

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIGNIFICANT = 0.05
MAX_SUBJECTS = 10_000
CERTAIN = (
    1e4  # errors from 0 at which every power is reached; SciPy has none beyond 1e10
)
PARALLEL = "parallel"
Design = Literal["parallel", "crossover"]
COLUMNS = (
    variables.PLAN_SUBJECTS,
    variables.PLAN_ERROR,
    variables.BETWEEN_SUBJECT_DEVIATION,
    variables.RESIDUAL_DEVIATION,
    variables.KNOWN_SUBJECTS,
)


def sample_sizes(
    cohort: Dataset,
    *,
    formula: str,
    term: str,
    effect: float,
    power: float = 0.8,
    visits: int = 1,
    design: Design = "parallel",
    doses: int = 1,
    drop_out: float = 0.0,
) -> Dataset:
    """Numbers of subjects with which a model finds an effect.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")`` with several visits of subjects in the condition normal,
        from whose first takes the variances between and within subjects come.
    formula
        As in `linear_model`, of `treatment` (0, 1, ... `doses`) and `visit` (1, 2, ...),
        with ``(1 | subject)``.
    term
        Term of the formula, or a sum of multiples of terms.
    effect
        Its value, in the unit of the quantity or of its logarithm.
    power
        Probability that its p value is below 5 %.
    visits
        Visits of each subject.
    design
        "parallel": each subject has one dose; "crossover": each subject is measured
        with all doses, of which 0 is no treatment, at every visit.
    doses
        Largest dose.
    drop_out
        Fraction of the subjects who leave the study before any visit.

    Returns
    -------
    Dataset
        (quantity,), see the variables of the group "plan": subjects of both arms
        together, rounded up to equal arms in parallel designs, NaN for more than 10,000; and
        the standard error of the term with those who stay. Attribute "flags" of the variances.

    Raises
    ------
    InputError
        If the formula has other parts, if the design does not determine it, or if the
        cohort determines no variances.

    References
    ----------
    Noncentral t with the degrees of freedom and errors of `linear_model`; Fitzmaurice,
    Laird and Ware 2011, chapter 20.
    """
    chosen = PlanParameters(
        formula, term, effect, power, visits, design, doses, drop_out
    )
    require_limits(chosen)
    model = MixedModel.of(formula)
    names_of(model, [SUBJECT, "treatment", "visit"])
    require(effect != 0, "effect", "must differ from 0", "0", "give another value")
    require(
        model.is_mixed and not model.slopes and not model.nested,
        f"formula {formula}",
        "must have (1 | subject), without slopes or nesting",
        "another random part",
    )
    rows = with_levels(model, _design(visits, design, doses))
    people = rows[SUBJECT].nunique()
    x, terms, _ = design_of(model, rows)
    require(
        np.linalg.matrix_rank(x) == len(terms),
        f"formula {formula}",
        "its terms must be determined by the design",
        f"{', '.join(terms)}, {visits} visits, {design}",
        "use fewer terms or more visits",
    )
    quantity = formula.partition("~")[0].strip()
    first = [visit_of(str(take))[1] == 1 for take in cohort["take"].values]
    known = linear_model(
        cohort.isel(take=first), formula=f"{quantity} ~ 1 + (1 | subject)"
    )
    deviations = known[variables.MODEL_DEVIATION].sel(effect=[INTERCEPT, RESIDUAL])
    factors = sum_of(term, terms)
    step = people if design == PARALLEL else 1
    counts = np.arange(step, MAX_SUBJECTS + 1, step)
    free = _degrees_of_freedom(x, rows, factors, counts)
    is_repeated = len(rows) > people
    excess = np.ones(len(counts)) if is_repeated else _hc3(x, factors, counts)
    noise = _noise(cohort.isel(take=first), model)
    takes = len(rows) // people
    is_between = is_constant_within(x, rows[SUBJECT].to_numpy())[factors != 0]
    needed, errors = [], []
    flags = list(known.attrs["flags"])
    for name, (between, within) in zip(
        known["quantity"].values.tolist(), deviations.values, strict=True
    ):
        variance = np.where(is_between, between**2 + within**2 / takes, within**2)
        error = noise.get(name, np.nan) / np.where(is_between, takes, 1)
        if (error > (1 - MIN_RELIABILITY) * variance).any():
            flags.append(
                f"{name}: errors explain the variance: the model has no p value"
            )
        subjects = rows[SUBJECT].to_numpy()
        variances = (np.full((1, 1), between**2), [within**2])
        information = information_of(x, np.ones((len(rows), 1)), [subjects], *variances)
        variance = factors @ np.linalg.solve(information, factors)
        error = np.sqrt(variance * people / counts)
        enough = np.flatnonzero(_power(effect / error, free, excess) >= power)
        arms = counts[enough[0]] / step if len(enough) else np.nan
        needed.append(step * np.ceil(np.round(arms / (1 - drop_out), 6)))
        errors.append((error * excess)[enough[0]] if len(enough) else np.nan)
    sources = known[variables.MODEL_SUBJECTS].values
    values = (needed, errors, *deviations.values.T, sources)
    return dataset(
        dict(zip(COLUMNS, values, strict=True)),
        coords={"quantity": known["quantity"].values},
        attrs=vars(chosen) | {"flags": flags, "skipped": known.attrs["skipped"]},
    )


def _noise(cohort: Dataset, model: MixedModel) -> dict[str, float]:
    """Quantity, region and channel -> mean square of the errors that the fits state."""
    rows = tidy(cohort)
    rows = rows[(rows["quantity"] == model.quantity) & (rows[CONDITION] == NORMAL)]
    square = (rows["error"] / (rows["value"] if model.is_log else 1.0)) ** 2
    channel = (" " + rows["channel"]).fillna("")
    mean = square.groupby(model.quantity + " " + rows["region"] + channel).mean()
    return dict(zip(mean.index.tolist(), mean.tolist(), strict=True))


def _design(visits: int, design: Design, doses: int) -> pd.DataFrame:
    """Subject, treatment and visit of each take of the subjects who stand for all."""
    pairs = itertools.product(range(doses + 1), repeat=2)
    arms = [pair for pair in pairs if design != PARALLEL or pair[0] == pair[1]]
    return pd.DataFrame(
        [(*pair, visit + 1) for pair in arms for visit in range(visits)],
        columns=[SUBJECT, "treatment", "visit"],
    )


def _degrees_of_freedom(
    x: Array, rows: pd.DataFrame, factors: Array, counts: Index
) -> Array:
    """Degrees of freedom, as in `linear_model`, with each number of subjects; 0 with too few
    for any term.
    """
    is_between = is_constant_within(x, rows[SUBJECT].to_numpy())
    between = counts - is_between.sum()
    takes = len(rows) // rows[SUBJECT].nunique()
    within = counts * (takes - 1) - (~is_between).sum()
    free = np.where(is_between[:, None], between, within)
    is_determined = (free > 0).all(axis=0)
    return np.where(is_determined, free[factors != 0].min(axis=0), 0).astype(float)


def _hc3(x: Array, factors: Array, counts: Index) -> Array:
    """Errors HC3, which `linear_model` has without repeats, over those of least squares,
    with each number of subjects.
    """
    inverse = np.linalg.inv(x.T @ x)
    leverage = np.einsum("ij,jk,ik->i", x, inverse, x) * len(x) / counts[:, None]
    weights = (x @ inverse @ factors) ** 2
    square = (1 / np.maximum(1 - leverage, ALONE)) @ weights / weights.sum()
    return np.asarray(np.sqrt(square))


def _power(distance: Array, free: Array, excess: Array) -> Array:
    """Power of two-sided t tests at 5 % of effects that are `distance` errors from 0, if
    errors are stated too large by a factor.
    """
    is_possible = free > 0
    distance = np.clip(distance, -CERTAIN, CERTAIN)
    limit = scipy.stats.t.ppf(1 - SIGNIFICANT / 2, np.where(is_possible, free, 1))
    limit = limit * excess
    of_sides = [
        scipy.stats.nct.sf(limit, np.where(is_possible, free, 1), side * distance)
        for side in (1, -1)
    ]
    return np.where(is_possible, np.sum(of_sides, axis=0), 0.0)


def describe_plan(table: Dataset) -> list[str]:
    """The design and notes on the variances, one line each."""
    about = table.attrs
    return [
        f"{about['formula']}: subjects in total that show {about['term']} = "
        f"{about['effect']:g} at 5 % with a power of {100 * about['power']:g} %, "
        f"{about['design']}, {about['visits']} visits; empty for more than {MAX_SUBJECTS:,}",
        "variances come from the visits of the subjects of the database; "
        f"{about['drop_out']:.0%} of the subjects leave before any visit",
        *about["flags"],
    ]


def plot_plan(table: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the number of subjects for each quantity."""
    names = table["quantity"].values.tolist()
    ax, places = plots.axes_of_rows(names, ax)
    subjects = table[variables.PLAN_SUBJECTS].values
    ax.plot(subjects, places, "o", color=plots.BLUE)
    ax.set_xlim(0, 1.05 * np.nanmax(subjects, initial=1.0))
    for place in places[np.isnan(subjects)]:
        ax.annotate(
            f"more than {MAX_SUBJECTS:,}",
            (0.02, place),
            xycoords=("axes fraction", "data"),
            fontsize=7,
            va="center",
        )
    ax.set_xlabel(
        f"subjects for a power of {100 * table.attrs['power']:g} %\n"
        f"{table.attrs['term']} = {table.attrs['effect']:g}"
    )
    return ax


STUDY = Study(
    *DECLARED["plan"],
    layout="tables",
    compute=of_cohort("plan", sample_sizes),
    shown=("plan",),
    tabulate=lambda table: table_of(table, COLUMNS, ("quantity",)),
    plot=plot_plan,
    describe=describe_plan,
    counts_takes=True,
    conditions=lambda *_: [NORMAL],
)
