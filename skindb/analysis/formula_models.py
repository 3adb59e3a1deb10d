"""Linear and mixed models of quantities by a formula, such as
``ITA ~ treatment * visit + age + (1 | subject)``.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import scipy  # scipy.stats takes longer to load, at its first use, than commands run
from xarray import Dataset

from skindb import plots
from skindb.analysis.contrasts import MIN_RELIABILITY, even_errors
from skindb.analysis.formulas import (
    SUBJECT,
    MixedModel,
    design_of,
    names_of,
    sum_of,
    with_levels,
)
from skindb.analysis.long_form import COLUMNS as VALUES
from skindb.analysis.long_form import INTERCEPT, KEYS, tidy
from skindb.analysis.quantities import QUANTITIES, quantities_of
from skindb.analysis.study import Study, Table, of_cohort, skipped_takes, table_of
from skindb.analysis.subjects import CONDITION, NORMAL, Subjects
from skindb.errors import InputError, input_error, require
from skindb.numerics.statistics import ROUNDING, known_mean
from skindb.parameters import require_limits
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.study_parameters import DECLARED, ModelParameters
from skindb.types import Array, Mask

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BASELINE = "baseline"
WITHOUT = "without (1 | subject)"  # the reason of a model that needs it
RESIDUAL = "residual"
# variance of a random effect over that of the residual, below which it is at its bound
BOUND = 1e-6
ALONE = 1e-9  # one less the leverage of a take, below which it determines a term alone
COLUMNS = (
    variables.MODEL_ESTIMATE,
    variables.MODEL_ERROR,
    variables.MODEL_ESTIMATE_LOW,
    variables.MODEL_ESTIMATE_HIGH,
    variables.MODEL_RELIABILITY,
    variables.MODEL_P,
    variables.MODEL_P_FALSE_DISCOVERY,
    variables.MODEL_P_EQUIVALENCE,
    variables.MODEL_DEGREES_OF_FREEDOM,
)


def linear_model(
    cohort: Dataset,
    *,
    formula: str,
    contrasts: Sequence[str] = (),
    margin: float | None = None,
) -> Dataset:
    """Fit a linear or mixed model to a quantity, for each region or site and channel.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    formula
        Quantity, or its logarithm ``log(NAME)``, ``~`` and terms of attributes, condition
        and visit, as of formulaic; perhaps with ``(1 | subject)``, with ``(1 + NAME |
        subject)`` for slopes that differ between subjects, or with ``(1 | subject/NAME)``
        for values of NAME that differ within them. Takes in other conditions
        than normal are used if the formula names ``condition``, or the condition
        itself: ``lotion`` is then its dose, an attribute that is a number, and 0 in
        the condition normal where it is not stated. `baseline` is the value
        of the subject's first take in the condition normal; the takes of that visit are
        no rows then. It is the logarithm if that of the quantity is explained.
    contrasts
        Sums of multiples of terms, such as ``treatment[T.b]:visit - treatment[T.c]:visit``,
        which are estimated like terms.
    margin
        Largest magnitude of an effect that does not matter, in the unit of the quantity
        or of its logarithm: p values are added of the hypothesis that it is larger.

    Returns
    -------
    Dataset
        (quantity, term), see the variables of the group "linear_model": estimates by restricted
        maximum likelihood (statsmodels' MixedLM; without a random part least squares,
        with HC3 errors, which hold for unequal variances),
        Student's intervals and p values with the degrees of freedom between subjects
        for terms that are constant within subjects or have random slopes, within
        subjects for others, and between nested values for those constant within them.
        Where the errors of the fits leave less than half of the variance between or
        within subjects, there are no p values, except of equivalence.
        Terms of one number are per unit of it, those of words less the first word,
        where week 2 is before week 10, those of conditions less normal; contrasts
        follow them. Attribute "flags".

    Raises
    ------
    InputError
        If the formula has other parts, if formula or contrasts have unknown names, if no
        region has enough takes, or if subjects have several takes and there is no random
        part.

    References
    ----------
    Laird and Ware 1982; MacKinnon and White 1985 (HC3); Schluchter and Elashoff 1990
    (degrees of freedom); Schuirmann 1987 (equivalence).
    """
    require_comparable(cohort, "tables")
    contrasts = (contrasts,) if isinstance(contrasts, str) else tuple(contrasts)
    require_limits(ModelParameters(formula, contrasts, margin))
    model = MixedModel.of(formula)
    frame = tidy(cohort)
    unused = {*VALUES, "take"} - {BASELINE}
    known = [name for name in frame.columns if name not in unused]
    used = names_of(model, known)
    frame = frame[frame["quantity"] == model.quantity]
    doses = _doses(used, frame[CONDITION])
    is_normal = frame[CONDITION] == NORMAL
    for name in doses:
        frame[name] = frame[name].where(frame[name].notna() | ~is_normal, 0.0)
    if CONDITION not in used:
        frame = frame[is_normal | frame[CONDITION].isin(doses)]
    measured = frame.dropna(subset=["value"])
    if model.is_log:
        numbers = frame[["value", BASELINE]]
        frame[["value", BASELINE]] = np.log(numbers.where(numbers > 0))
    frame = with_levels(model, frame.dropna(subset=["value", *used]))
    fits = {}
    flags = _flags(model, measured, frame)
    if late := sorted(_late_baselines(measured)) if BASELINE in used else []:
        flags.append(
            f"the baseline of {', '.join(late)} is of a later visit than others"
        )
    reasons = []  # of regions without a model
    for (region, channel), part in frame.groupby(
        ["region", "channel"], sort=False, dropna=False
    ):
        words = [model.quantity, region, channel]
        name = " ".join(str(word) for word in words if isinstance(word, str))
        try:
            fits[name] = _fit(model, part, contrasts, margin)
        except InputError as error:
            reasons.append(error.faults[0].found)
            flags.append(f"{name}: excluded, {reasons[-1]}")
        else:
            flags += [f"{name}: {flag}" for flag in fits[name].flags]
    require(
        fits,
        f"formula {formula}",
        "some region must determine it",
        "; ".join(dict.fromkeys(reasons)) or "no take with all its variables",
        "add (1 | subject)"
        if any(WITHOUT in reason for reason in reasons)
        else "use fewer terms, or add takes",
    )
    flags += _even_reflection(cohort, model, fits, margin)
    compared = "" if CONDITION in used else ", ".join([NORMAL, *doses])
    stated = {"formula": formula, "margin": margin, "condition": compared}
    return _labelled(fits, flags, cohort, stated)


def _even_reflection(
    cohort: Dataset, model: MixedModel, fits: dict[str, _Fit], margin: float | None
) -> list[str]:
    """Widen intervals by what errors of even reflection in the conditions add to terms
    and contrasts, which also narrows margins of equivalence, and withhold p values of
    effects within it, which are named.
    """
    flags = []
    # a unit for each condition, independent of the others
    squares = {name: np.zeros(len(fit.table)) for name, fit in fits.items()}
    conditions = sorted({name for fit in fits.values() for name in fit.shifts})
    is_normal = cohort[CONDITION].values == NORMAL
    if conditions and model.quantity in QUANTITIES and is_normal.any():
        quantities = quantities_of(cohort, (model.quantity,))
        normal = quantities.values[is_normal]
        level = np.abs(known_mean(normal)) if model.is_log else np.ones(normal.shape[1])
        for condition in conditions:
            errors = even_errors(cohort, quantities, condition) / level
            # not known where no normal take has a value
            known = np.nan_to_num(errors)
            for name, error in zip(quantities.names, known, strict=True):
                if name in fits and condition in fits[name].shifts:
                    squares[name] += (fits[name].shifts[condition] * error) ** 2
    for name, fit in fits.items():
        for row, error in zip(fit.table.index, np.sqrt(squares[name]), strict=True):
            if error and _widen(fit.table, row, error, margin):
                flags.append(f"{name}: even reflection may cause the effect of {row}")
    return flags


def _widen(table: pd.DataFrame, row: str, error: float, margin: float | None) -> bool:
    """Add an error that takes have in common to a row; whether it may cause the effect,
    which then has no p value.
    """
    estimate, deviation, *ends = table.loc[row, list(COLUMNS[:4])]
    for name, end in zip(COLUMNS[2:4], ends, strict=True):
        half = end - estimate
        table.loc[row, name] = estimate + np.copysign(np.hypot(half, error), half)
    if margin is not None:
        inside = (margin - abs(estimate) - error) / deviation
        free = table.loc[row, variables.MODEL_DEGREES_OF_FREEDOM]
        table.loc[row, variables.MODEL_P_EQUIVALENCE] = scipy.stats.t.sf(inside, free)
    is_within = bool(abs(estimate) < error)
    if is_within:
        table.loc[row, variables.MODEL_P] = np.nan
    return is_within


def _flags(model: MixedModel, measured: pd.DataFrame, used: pd.DataFrame) -> list[str]:
    """Warnings about subjects that are excluded, and about repeats."""
    flags = []
    places = ["region", "channel"]
    for (region, channel), part in measured.groupby(places, sort=False, dropna=False):
        is_here = used["region"] == region
        if isinstance(channel, str):
            is_here &= used["channel"] == channel
        absent = {*part[SUBJECT]} - {*used[SUBJECT][is_here]}
        if absent:
            words = [word for word in (region, channel) if isinstance(word, str)]
            flags.append(
                f"{' '.join(words)}: {len(absent)} of {part[SUBJECT].nunique()} subjects "
                "lack a variable of the formula"
                + (", or a positive value" if model.is_log else "")
            )
    repeated = used.duplicated([*places, SUBJECT, CONDITION, "visit"]).any()
    if model.is_mixed and not model.nested and repeated:
        flags.append(
            "visits have repeats, whose differences count like those of visits; "
            "(1 | subject/visit) tells them apart"
        )
    return flags


def _late_baselines(rows: pd.DataFrame) -> set[str]:
    """Subjects whose first take in the condition normal is of a later visit than those
    of others.
    """
    normal = rows[rows[CONDITION] == NORMAL]
    first = normal.groupby(SUBJECT)["visit"].min()
    return {*first.index[first > first.min()]}


@dataclass(frozen=True)
class _Fit:
    """A model of one region and channel."""

    # term or contrast -> variables of COLUMNS except the false discovery rate
    table: pd.DataFrame
    # of the same rows: what values that rise by 1 in a condition add
    shifts: pd.DataFrame
    deviation: dict[str, float]  # random effect, or the residual -> standard deviation
    takes: int
    subjects: int
    flags: tuple[str, ...]


def _fit(
    model: MixedModel,
    rows: pd.DataFrame,
    contrasts: Sequence[str] = (),
    margin: float | None = None,
) -> _Fit:
    """Fit a model to the rows of one region and channel, which lack no value."""
    subjects = rows[SUBJECT].to_numpy(str)
    people = len(set(subjects))
    x, terms, of_slopes = design_of(model, rows)
    groups = [subjects] if model.is_mixed else []
    if model.nested:
        cells = rows.groupby([SUBJECT, model.nested], observed=True).ngroup()
        groups.append(cells.to_numpy())
    random = np.column_stack(
        [np.ones(len(rows)), *(_numbers(rows, name) for name in model.slopes)]
    )
    free = _degrees_of_freedom(x, groups, np.isin(terms, of_slopes))
    if model.slopes:
        # subjects in whom the number of a slope does not differ say nothing about it
        levels = pd.DataFrame(random[:, 1:]).groupby(subjects).nunique()
        free[np.isin(terms, of_slopes)] -= people - (levels > 1).sum().min()
    require(
        free.min() > 0 and np.linalg.matrix_rank(x) == len(terms),
        "formula",
        "must be determined",
        f"{len(rows)} takes of {people} subjects do not determine {len(terms)} terms",
    )
    require(
        model.is_mixed or people == len(rows),
        "formula",
        "must have (1 | subject) if subjects have several takes",
        f"{len(rows)} takes of {people} subjects {WITHOUT}",
    )
    require(
        not model.is_mixed or people < len(rows),
        "formula",
        "must have (1 | subject) only if subjects have several takes",
        f"one take of each of {people} subjects",
    )
    require(
        all(people < len(set(cells)) < len(rows) for cells in groups[1:]),
        "formula",
        "must have (1 | subject/NAME) only if values of NAME have several takes",
        f"one {model.nested} of each subject, or one take of each {model.nested}",
    )
    require(
        len(rows) > people * random.shape[1] or not model.slopes,
        "formula",
        "must have fewer random effects than takes",
        f"{random.shape[1]} of each of {people} subjects, {len(rows)} takes",
    )
    y = rows["value"].to_numpy(float)
    require(
        np.ptp(y) > ROUNDING * np.abs(y).max(),
        "formula",
        "must explain values that differ",
        f"the same in {len(rows)} takes",
    )
    scale = float(np.std(y))  # so that the solver converges
    try:
        conditions = sorted({*rows[CONDITION]} - {NORMAL})
        condition = rows[CONDITION].to_numpy(str)
        rises = 1.0 * np.equal.outer(condition, np.array(conditions, str))
        estimate, covariance, spread, shifts = _solve(
            y / scale, x, groups, random, rises
        )
    except np.linalg.LinAlgError:
        raise input_error(
            "formula", "must be determined", "no maximum of the likelihood was found"
        ) from None
    reliability = _reliability(rows, is_constant_within(x, subjects), model.is_log)
    reliability[np.array(terms) == INTERCEPT] = np.nan
    fitted = (scale * estimate, scale**2 * covariance, free, reliability)
    contrasts = [name for name in dict.fromkeys(contrasts) if name not in terms]
    sums = np.vstack([np.eye(len(terms)), *(sum_of(name, terms) for name in contrasts)])
    table = _inference(fitted, sums, margin).set_axis([*terms, *contrasts])
    effects = [INTERCEPT, *model.slopes] if model.is_mixed else []
    size = np.sqrt((random**2).mean(axis=0))  # whatever the units of the slopes are
    if model.nested:
        effects.append(f"{SUBJECT}/{model.nested}")
        size = np.append(size, 1.0)
    at_bound = [
        effect
        for effect, value in zip(effects, spread[:-1] * size, strict=True)
        if value**2 < BOUND * spread[-1] ** 2
    ]
    return _Fit(
        table,
        pd.DataFrame(sums @ shifts, columns=conditions),
        dict(zip([*effects, RESIDUAL], scale * spread, strict=True)),
        len(rows),
        people,
        tuple(f"no variance of {effect} was found" for effect in at_bound),
    )


def _degrees_of_freedom(x: Array, groups: Sequence[Array], of_slopes: Mask) -> Array:
    """Degrees of freedom (p,) of columns x (n, p): those between the outermost groups in
    which a column is constant, or between rows.
    """
    counts = [0, *(len(set(labels)) for labels in groups), len(x)]
    varies = [~is_constant_within(x, labels) for labels in groups]
    level = np.sum(varies, axis=0, dtype=int) * np.ones(x.shape[1], int)
    level[of_slopes] = 0
    terms = np.bincount(level, minlength=len(counts) - 1)
    return np.asarray((np.diff(counts) - terms)[level], float)


def is_constant_within(x: Array, subjects: Array) -> Mask:
    """Whether each column (n, p) is constant within subjects (n,)."""
    people = len(set(subjects))
    return np.array(
        [len({*zip(subjects, column, strict=True)}) == people for column in x.T]
    )


def information_of(
    x: Array,
    random: Array,
    groups: Sequence[Array],
    between: Array,
    variances: Sequence[float],
) -> Array:
    """Inverse covariance (p, p) of the fixed effects of columns x (n, p) for columns
    random (n, q), their covariance between subjects (q, q), which are the first of the
    groups, and the variances of the other groups and of the residual.
    """
    information = np.zeros((x.shape[1],) * 2)
    for subject in dict.fromkeys(groups[0].tolist()):
        rows = groups[0] == subject
        covariance = random[rows] @ between @ random[rows].T
        labels = [*(cells[rows] for cells in groups[1:]), np.arange(rows.sum())]
        for cells, variance in zip(labels, variances, strict=True):
            covariance += variance * (cells[:, None] == cells)
        information += x[rows].T @ np.linalg.solve(covariance, x[rows])
    return information


def _reliability(rows: pd.DataFrame, is_between: Mask, is_log: bool) -> Array:
    """Fraction (p,) of the variance between subjects that the errors of the fits leave,
    for terms that are constant within them, and of that within subjects for others.
    """
    square = (rows["error"] / (np.exp(rows["value"]) if is_log else 1.0)) ** 2
    values = rows["value"].groupby(rows[SUBJECT])
    means = values.mean()
    noise = (square.groupby(rows[SUBJECT]).mean() / values.count()).mean()
    rest = ((rows["value"] - values.transform("mean")) ** 2).sum()
    free = len(rows) - len(means)
    with np.errstate(divide="ignore", invalid="ignore"):
        within = 1 - np.float64(square.mean()) * free / rest
        between = 1 - np.float64(noise) / means.var()
    return np.asarray(np.maximum(np.where(is_between, between, within), 0.0))


def _inference(
    fitted: tuple[Array, Array, Array, Array],
    sums: Array,
    margin: float | None,
) -> pd.DataFrame:
    """Variables of sums (row, p) of terms, from estimates, covariance, degrees of freedom
    and reliability.
    """
    estimate, covariance, free, reliability = fitted
    estimate = sums @ estimate
    error = np.sqrt(np.einsum("ij,jk,ik->i", sums, covariance, sums))
    free = np.where(sums != 0, free, np.inf).min(axis=1)
    # of the term that is known worst; NaN, where it is unknown, is ignored
    reliability = np.fmin.reduce(np.where(sums != 0, reliability, np.nan), axis=1)
    p = 2 * scipy.stats.t.sf(np.abs(estimate / error), free)
    half = scipy.stats.t.ppf(0.975, free) * error
    columns = {
        variables.MODEL_ESTIMATE: estimate,
        variables.MODEL_ERROR: error,
        variables.MODEL_ESTIMATE_LOW: estimate - half,
        variables.MODEL_ESTIMATE_HIGH: estimate + half,
        variables.MODEL_RELIABILITY: reliability,
        variables.MODEL_P: np.where(reliability < MIN_RELIABILITY, np.nan, p),
        variables.MODEL_DEGREES_OF_FREEDOM: free,
    }
    if margin is not None:
        # two one-sided tests: the p value of the end of the margin that is nearer
        inside = (margin - np.abs(estimate)) / error
        columns[variables.MODEL_P_EQUIVALENCE] = scipy.stats.t.sf(inside, free)
    return pd.DataFrame(columns)


def _numbers(rows: pd.DataFrame, name: str) -> Array:
    """A column as numbers."""
    try:
        return np.asarray(rows[name], float)
    except (TypeError, ValueError):
        raise input_error(
            "formula", "random slopes are of numbers", f"{name} is not a number"
        ) from None


def _solve(
    y: Array, x: Array, groups: Sequence[Array], random: Array, rises: Array
) -> tuple[Array, Array, Array, Array]:
    """Estimates (p,), their covariance (p, p), standard deviations of the random effects
    of the first groups, of the other ones, and of the residual, and what `rises` (n, c)
    of the values add to the estimates (p, c).
    """
    if not groups:
        estimate = np.linalg.lstsq(x, y)[0]
        shifts = np.linalg.lstsq(x, rises)[0]
        rest = y - x @ estimate
        variance = float((rest**2).sum()) / (len(y) - x.shape[1])
        inverse = np.linalg.inv(x.T @ x)
        free = 1 - np.einsum("ij,jk,ik->i", x, inverse, x)
        is_alone = free < ALONE  # has a level of its own: HC3 does not know its error
        square = np.where(is_alone, variance, (rest / np.maximum(free, ALONE)) ** 2)
        covariance = inverse @ (x.T * square) @ x @ inverse
        return estimate, covariance, np.sqrt([variance]), shifts
    # takes a second to import
    from statsmodels.regression.mixed_linear_model import MixedLM, VCSpec

    # solvers with gradients stop early at bounds, and others for columns of unlike size
    x, of_x = np.linalg.qr(x)
    random, of_random = np.linalg.qr(random)
    scale = np.sqrt(len(y))
    x, random = scale * x, scale * random
    back, back_random = (scale * np.linalg.inv(part) for part in (of_x, of_random))
    subjects, *others = groups
    nested = None
    if others:
        labels = [others[0][subjects == subject] for subject in np.unique(subjects)]
        indicators = [np.equal.outer(cells, np.unique(cells)) for cells in labels]
        names = [[*map(str, range(columns.shape[1]))] for columns in indicators]
        nested = VCSpec(["nested"], [names], [[1.0 * one for one in indicators]])
    with warnings.catch_warnings():
        # a variance at its bound 0, which is reported
        warnings.simplefilter("ignore")
        model = MixedLM(y, x, groups=subjects, exog_re=random, exog_vc=nested)
        fitted = model.fit(method="powell")
    variances = [*map(float, fitted.vcomp), float(fitted.scale)]
    between = np.atleast_2d(np.asarray(fitted.cov_re, float))
    columns = np.column_stack([x, rises])
    information = information_of(columns, random, groups, between, variances)
    between = back_random @ between @ back_random.T
    spread = np.sqrt([*np.maximum(np.diag(between), 0), *variances])
    estimate = back @ np.asarray(fitted.fe_params, float)
    of_terms, of_rises = np.split(information[: x.shape[1]], [x.shape[1]], axis=1)
    covariance = back @ np.linalg.inv(of_terms)
    return estimate, covariance @ back.T, spread, covariance @ of_rises


def _labelled(
    fits: dict[str, _Fit],
    flags: list[str],
    cohort: Dataset,
    stated: dict[str, str | float | None],
) -> Dataset:
    """The Dataset of all models."""
    terms = list(
        dict.fromkeys(term for fit in fits.values() for term in fit.table.index)
    )
    tables = [fit.table.reindex(terms) for fit in fits.values()]
    values = {name: np.stack([table[name] for table in tables]) for name in tables[0]}
    p = values[variables.MODEL_P]
    discovered = np.full(p.shape, np.nan)
    for column in range(len(terms)):
        is_known = np.isfinite(p[:, column])
        discovered[is_known, column] = scipy.stats.false_discovery_control(
            p[is_known, column]
        )
    if (values[variables.MODEL_RELIABILITY] < MIN_RELIABILITY).any():
        flags.append(f"no p values where the reliability is below {MIN_RELIABILITY}")
    effects = list(next(iter(fits.values())).deviation)
    return dataset(
        values
        | {
            variables.MODEL_P_FALSE_DISCOVERY: discovered,
            variables.MODEL_DEVIATION: [
                [*fit.deviation.values()] for fit in fits.values()
            ],
            variables.MODEL_TAKES: [fit.takes for fit in fits.values()],
            variables.MODEL_SUBJECTS: [fit.subjects for fit in fits.values()],
        },
        coords={"quantity": list(fits), "term": terms, "effect": effects},
        attrs={
            **stated,
            "flags": flags,
            "skipped": skipped_takes(cohort),
        },
    )


def tabulate_model(table: Dataset) -> Table:
    """Header and one row per quantity and term."""
    counts = {
        name: table[name].broadcast_like(table[variables.MODEL_ESTIMATE])
        for name in (variables.MODEL_TAKES, variables.MODEL_SUBJECTS)
    }
    known = [name for name in COLUMNS if name in table]
    return table_of(table.assign(counts), [*known, *counts], ("quantity", "term"))


def describe_model(table: Dataset) -> list[str]:
    """The formula, deviations of the random effects, and flags, one line each."""
    lines = [f"{table.attrs['formula']}; every visit and repeat counts"]
    if table.attrs["condition"]:
        lines[0] += f", in the condition {table.attrs['condition']}"
    deviations = table[variables.MODEL_DEVIATION]
    for quantity in table["quantity"].values.tolist():
        values = deviations.sel(quantity=quantity)
        words = [f"{float(x):.3g} ({x['effect'].item()})" for x in values]
        lines.append(f"{quantity}: standard deviations {', '.join(words)}")
    interval = (
        "low and high are the ends of 95 % intervals, p values are of one region alone"
    )
    if table.attrs["margin"] is not None:
        interval += (
            "; p of equivalence is that of the hypothesis that an effect is not within "
            f"+-{table.attrs['margin']:g}"
        )
    return [*lines, interval, *table.attrs["flags"]]


def plot_model(table: Dataset, *, ax: Axes | None = None) -> Axes:
    """Plot the estimates over their errors, with 95 % intervals, one row per quantity;
    colours are terms.
    """
    terms = [term for term in table["term"].values.tolist() if term != INTERCEPT]
    names = table["quantity"].values.tolist()
    ax, places = plots.axes_of_rows(names, ax, lines=len(terms))
    ax.axvline(0, color="0.6", linewidth=1)
    error = table[variables.MODEL_ERROR]
    shown = table[list(COLUMNS[:4])] / error
    for i, term in enumerate(terms):
        colour = plots.CYCLE[i % len(plots.CYCLE)]
        marker = plots.MARKERS[i // len(plots.CYCLE) % len(plots.MARKERS)]
        label = plots.legend_entry(term)
        ax.plot([], [], marker, color=colour, markersize=4, label=label)
        plots.significant_intervals(
            ax,
            shown.sel(term=term, drop=True),
            variables.MODEL_ESTIMATE,
            places - 0.6 * ((i + 0.5) / len(terms) - 0.5),
            table[variables.MODEL_P].sel(term=term).values < 0.05,
            colour=colour,
            marker=marker,
        )
    counts = sorted({*table[variables.MODEL_SUBJECTS].values.tolist()})
    n = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    ax.set_xlabel(
        f"estimate over its standard error, 95 % CI (n = {n})\nfilled: p < 0.05"
    )
    plots.legend_above(ax)
    return ax


def _doses(used: Iterable[str], conditions: Iterable[str]) -> list[str]:
    """Names of a formula that are conditions and no columns of every take."""
    return sorted({*used} & {*conditions} - {*KEYS, BASELINE})


def _conditions(subjects: Subjects, parameters: ModelParameters) -> list[str]:
    """Conditions whose takes a model uses, unless it is of conditions."""
    model = MixedModel.of(parameters.formula)
    used = {*model.names, *model.slopes}
    doses = _doses(used, map(str, subjects.attribute(CONDITION).values))
    return [] if CONDITION in used else [NORMAL, *doses]


STUDY = Study(
    *DECLARED["model"],
    layout="tables",
    compute=of_cohort("linear_model", linear_model),
    shown=("linear_model",),
    tabulate=tabulate_model,
    plot=plot_model,
    describe=describe_model,
    columns_of_files=(variables.MODEL_P_FALSE_DISCOVERY,),
    counts_takes=True,
    conditions=_conditions,
)
