"""Effects, permutation tests and variance components; the unit of observation is a subject.

The methods are regression with standard errors that are valid for unequal variances
(HC3, MacKinnon and White 1985), permutation with covariates (Freedman and Lane 1983),
and correction for many quantities (Westfall and Young 1993; Benjamini and Hochberg
1995). Permutations compare statistics that contain the standard errors (DiCiccio and
Romano 2017); otherwise groups of different sizes and spreads would appear to differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, permutations, product
from math import factorial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from skindb.types import Array, Mask

ROUNDING = 1e-13  # relative to the largest value
SUMS = 2  # entries per draw and quantity when products of matrices are used
MANY = 1000  # number of quantities from which products of matrices are faster
# relative to the sum of weighted squares; smaller differences are dominated by rounding
CANCELLED = 1e-6
BATCH = 1 << 22  # number of permuted values in memory at a time: 32 MB


@dataclass(frozen=True)
class Effects:
    """Effect of a regressor on each of q quantities, adjusted for the covariates."""

    slope: Array  # (q,) per unit of the regressor
    error: Array  # (q,) HC3 standard error
    low: Array  # (q,) lower end of the interval, by Student's distribution
    high: Array  # (q,) upper end
    statistic: Array  # (q,) slope over its error, which permutations compare
    # (q,) standard deviation of the residuals: variation between subjects with equal
    # regressors
    spread: Array
    free: Array  # (q,) degrees of freedom


@dataclass(frozen=True)
class _Part:
    """Quantities that are known for the same subjects."""

    rows: Mask  # (n,) mask of these subjects
    columns: NDArray[np.intp]  # indices of the quantities
    own: Array  # residual of the regressor after projection on the basis
    basis: Array  # orthonormal basis of 1 and the covariates
    values: Array  # (rows, columns)


def effects(
    values: Array,
    regressor: Array,
    covariates: Array | None = None,
    *,
    level: float = 0.95,
) -> Effects:
    """Least squares of every quantity on [1, regressor, covariates].

    Parameters
    ----------
    values
        (n, q) one row per subject; NaN where a subject lacks a quantity, which is then
        estimated from the others.
    regressor
        (n,) 0 and 1 for two groups, or a number such as an age.
    covariates
        (n, c) variables to adjust for; none by default.
    level
        Confidence level of the intervals.

    Returns
    -------
    Effects
        NaN for quantities that too few subjects have, or only subjects who do not
        differ in the regressor.

    Raises
    ------
    ValueError
        If no quantity can be estimated: fewer than two degrees of freedom are left, or
        the covariates determine the regressor.
    """
    found = np.full((5, values.shape[1]), np.nan)
    for part in _parts(values, regressor, covariates):
        own = part.own
        y = _residual(part.values, part.basis)
        square = float(own @ own)
        slope = own @ y / square
        residual = y - own[:, None] * slope
        free = len(own) - part.basis.shape[1] - 1
        error = np.sqrt(_error_weight(own, part.basis) @ residual**2)
        spread = np.sqrt((residual**2).sum(axis=0) / free)
        found[:, part.columns] = (
            slope,
            error,
            _ratio(slope, error),
            spread,
            np.full_like(slope, free),
        )
    return _effects(found, level)


def paired_effects(differences: Array, *, level: float = 0.95) -> Effects:
    """Mean of differences (n, q) within subjects, NaN where a subject lacks one; see `effects`.

    The error is the standard error of the mean, and `spread` the standard deviation of
    the differences.
    """
    known = np.isfinite(differences)
    count = known.sum(axis=0)
    told = count >= 2
    clean = np.where(known, differences, 0.0)
    mean = np.where(told, clean.sum(axis=0) / np.maximum(count, 1), np.nan)
    square = (np.where(known, differences - mean, 0.0) ** 2).sum(axis=0)
    spread = np.sqrt(square / np.maximum(count - 1, 1))
    error = spread / np.sqrt(np.maximum(count, 1))
    found = np.stack([mean, error, _ratio(mean, error), spread, count - 1.0])
    found[:, ~told] = np.nan
    return _effects(found, level)


def _effects(found: Array, level: float) -> Effects:
    slope, error, statistic, spread, free = found
    half = stats.t.ppf((1 + level) / 2, free) * error
    return Effects(slope, error, slope - half, slope + half, statistic, spread, free)


def _ratio(above: Array, below: Array) -> Array:
    return np.divide(above, below, out=np.zeros_like(above), where=below > 0)


def permutation_p(
    values: Array,
    regressor: Array,
    covariates: Array | None = None,
    *,
    most: int = 10_000,
    rng: np.random.Generator,
) -> tuple[Array, Array, int]:
    """P values of `effects` by permutation of the residuals after regression on the covariates.

    Parameters
    ----------
    values, regressor, covariates
        See `effects`. Subjects who lack a quantity are excluded from it in every permutation.
    most
        Maximum number of permutations; all of them are used if there are fewer.
    rng
        Random generator for the permutations.

    Returns
    -------
    p, adjusted, count
        P values (q,) of each quantity alone; p values (q,) adjusted by the largest
        statistic of all quantities (max-T, which controls the probability of any false
        positive); the number of permutations. The smallest p is 1 / (count + 1).
    """
    n = len(regressor)
    if factorial(min(n, 12)) <= most:
        orders = (np.array(order) for order in islice(permutations(range(n)), 1, None))
        count = factorial(n) - 1
    else:
        orders = (rng.permutation(n) for _ in range(most))
        count = most

    def drawn(part: _Part, order: Array) -> tuple[NDArray[np.intp], Array]:
        """Permuted residuals; subjects who lack a quantity are excluded, and all orders
        remain equally likely.
        """
        places = np.argsort(order[:, part.rows], axis=1)
        return places, np.ones(places.shape)

    parts = [
        replace(part, values=_residual(part.values, part.basis))
        for part in _parts(values, regressor, covariates)
    ]
    return _compared(parts, values.shape, orders, count, drawn)


def sign_flip_p(
    differences: Array, *, most: int = 10_000, rng: np.random.Generator
) -> tuple[Array, Array, int]:
    """P values of means of paired differences (n, q), by changing the signs of
    subjects; see `permutation_p`.
    """
    n = len(differences)
    parts = [
        _Part(
            rows,
            columns,
            np.ones(rows.sum()),
            np.empty((rows.sum(), 0)),
            differences[np.ix_(rows, columns)],
        )
        for rows, columns in missing_patterns(differences)
        if rows.sum() >= 2
    ]
    if not parts:
        raise ValueError("paired differences need at least two subjects")
    if 2.0**n <= most:
        signs = (
            np.array(one) for one in islice(product((1.0, -1.0), repeat=n), 1, None)
        )
        count = 2**n - 1
    else:
        signs = (rng.choice((1.0, -1.0), n) for _ in range(most))
        count = most

    def drawn(part: _Part, sign: Array) -> tuple[NDArray[np.intp], Array]:
        own = sign[:, part.rows]
        return np.tile(np.arange(own.shape[1]), (len(own), 1)), own

    return _compared(parts, differences.shape, signs, count, drawn)


def benjamini_hochberg(p: Array) -> Array:
    """P values adjusted to control the false discovery rate (Benjamini and Hochberg 1995)."""
    p = np.asarray(p, np.float64)
    order = np.argsort(p)
    raised = p[order] * len(p) / np.arange(1, len(p) + 1)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.minimum.accumulate(raised[::-1])[::-1], 1.0)
    return adjusted


def detectable_difference(
    error: Array, free: Array | float, *, level: float = 0.05, power: float = 0.8
) -> Array:
    """Smallest effect that a test at this level detects with this power, given the
    standard error of its estimate.
    """
    return np.asarray(
        error * (stats.t.ppf(1 - level / 2, free) + stats.t.ppf(power, free))
    )


def variance_components(
    values: Array, subject: NDArray[Any]
) -> tuple[float, float, float]:
    """Mean, variance between subjects and variance of repeats of one subject, by
    restricted maximum likelihood.

    Parameters
    ----------
    values
        (n,) finite.
    subject
        (n,) subject of each value; at least two subjects, one of them with two values.
    """
    _, which, count = np.unique(subject, return_inverse=True, return_counts=True)
    n = len(values)
    people = len(count)
    if people < 2 or n == people:
        raise ValueError(
            "variance components must come from two subjects or more, one of them with two values"
        )
    if np.ptp(values) <= ROUNDING * np.abs(values).max():
        return float(values.mean()), 0.0, 0.0
    mean = np.bincount(which, values) / count
    within = float(((values - mean[which]) ** 2).sum())

    def profile(log_ratio: float) -> tuple[float, float, float]:
        """-2 log restricted likelihood, mean, and variance of repeats, for a ratio of
        the two variances.
        """
        share = count / (1 + count * np.exp(log_ratio))
        centre = float(share @ mean / share.sum())
        square = within + float(share @ (mean - centre) ** 2)
        repeat = square / (n - 1)
        if repeat <= 0:
            return -np.inf, centre, 0.0
        logs = float(np.log1p(count * np.exp(log_ratio)).sum() + np.log(share.sum()))
        return (n - 1) * float(np.log(repeat)) + logs, centre, repeat

    grid = np.linspace(-12, 12, 49)  # the likelihood may have two maxima
    start = grid[int(np.argmin([profile(one)[0] for one in grid]))]
    best = optimize.minimize_scalar(
        lambda one: profile(one)[0], bounds=(start - 0.5, start + 0.5), method="bounded"
    )
    at = (
        float(best.x)
        if start > grid[0] and profile(float(best.x))[0] < profile(-40.0)[0]
        else -np.inf
    )
    _, centre, repeat = profile(at)
    return centre, float(np.exp(at)) * repeat, repeat


def _split(regressor: Array, covariates: Array | None) -> tuple[Array, Array]:
    """Residual of the regressor after regression on the covariates, and an orthonormal
    basis of 1 and covariates.
    """
    x = np.asarray(regressor, np.float64)
    columns = (
        [np.ones(len(x))]
        if covariates is None
        else [np.ones(len(x)), *np.asarray(covariates, np.float64).T]
    )
    u, s, _ = np.linalg.svd(
        np.stack([one / (np.linalg.norm(one) or 1.0) for one in columns], axis=1),
        full_matrices=False,
    )
    basis = u[:, s > 1e-10 * s[0]]
    own = x - basis @ (basis.T @ x)
    if len(x) - basis.shape[1] < 3:
        raise ValueError(
            f"{len(x)} subjects are too few to estimate {basis.shape[1] + 1} "
            "coefficients and their errors"
        )
    if own @ own <= 1e-12 * max(float(x @ x), np.finfo(np.float64).tiny):
        raise ValueError(
            "the regressor is the same for all subjects, or a combination of the covariates"
        )
    return own, basis


def _residual(values: Array, basis: Array) -> Array:
    """Residuals of values (n, q) after projection on the basis; 0 where only rounding remains."""
    y = values - basis @ (basis.T @ values)
    return np.where(
        np.abs(y).max(axis=0) > ROUNDING * np.abs(values).max(axis=0), y, 0.0
    )


def _statistics(values: Array, own: Array, basis: Array) -> Array:
    """Slope over its HC3 error (b, q) of values (b, n, q), after removal of their
    projection on the basis.
    """
    y = values - basis @ (basis.T @ values)
    slope = own @ y / float(own @ own)
    residual = y - own[:, None] * slope[:, None]
    error = np.sqrt(
        np.einsum("i,biq,biq->bq", _error_weight(own, basis), residual, residual)
    )
    return _ratio(slope, error)


def _redrawn(part: _Part, places: NDArray[np.intp], signs: Array) -> Array:
    """Result (b, q) of `_statistics` for values that are permuted and multiplied by signs.

    Sums over subjects are products of matrices. For many quantities, the factors are
    permuted b times instead of the values. Statistics whose residuals are mostly
    rounding are computed again from the permuted values.
    """
    if len(part.columns) < MANY:
        return _statistics(part.values[places] * signs[..., None], part.own, part.basis)
    weight = _error_weight(part.own, part.basis)
    # orthogonal columns, all but the last of unit length
    design = np.column_stack([part.basis, part.own])
    square = float(part.own @ part.own)
    factors = np.concatenate([design, weight[:, None] * design], axis=1)
    back = np.argsort(places, axis=1)
    moved = factors[back] * np.take_along_axis(signs, back, axis=1)[..., None]
    b, n, c = moved.shape
    sums = (np.moveaxis(moved, 2, 1).reshape(b * c, n) @ part.values).reshape(b, c, -1)
    along = sums[:, : c // 2]
    weighted = sums[:, c // 2 :]
    along[:, -1] /= square
    whole = weight[back] @ part.values**2
    cross = np.einsum("bcq,bcq->bq", along, weighted)
    again = np.einsum(
        "bcq,cd,bdq->bq",
        along,
        design.T @ (weight[:, None] * design),
        along,
        optimize=True,
    )
    squares = whole - 2 * cross + again
    found = _ratio(along[:, -1], np.sqrt(np.maximum(squares, 0.0)))
    for draw, column in np.argwhere(squares <= CANCELLED * whole):
        values = (part.values[places[draw], column] * signs[draw])[None, :, None]
        found[draw, column] = _statistics(values, part.own, part.basis)[0, 0]
    return found


def _error_weight(own: Array, basis: Array) -> Array:
    """Weights (n,) of the squared residuals in the squared HC3 error of the slope."""
    square = float(own @ own)
    leverage = (basis**2).sum(axis=1) + own**2 / square
    return np.asarray((own / square / np.maximum(1 - leverage, 1e-12)) ** 2)


def _require_several(own: Array, basis: Array) -> None:
    """Refuse a slope that one subject determines alone: its error is unknown, and
    permutations are not comparable.
    """
    leverage = (basis**2).sum(axis=1) + own**2 / float(own @ own)
    decides = np.abs(own) > 1e-6 * np.linalg.norm(own)
    if (decides & (leverage > 1 - 1e-9)).any():
        raise ValueError(
            "each group must have two subjects: the effect depends on one subject and has no error"
        )


def _parts(values: Array, regressor: Array, covariates: Array | None) -> list[_Part]:
    """Quantities grouped by the subjects who have them, if their effect can be estimated."""
    parts = []
    why = ValueError("no subject has any of the quantities")
    x = np.asarray(regressor, np.float64)
    for rows, columns in missing_patterns(values):
        try:
            own, basis = _split(
                x[rows], None if covariates is None else np.asarray(covariates)[rows]
            )
            _require_several(own, basis)
        except ValueError as error:
            why = error
            continue
        parts.append(_Part(rows, columns, own, basis, values[np.ix_(rows, columns)]))
    if not parts:
        raise why
    return parts


def missing_patterns(values: Array) -> Iterator[tuple[Mask, NDArray[np.intp]]]:
    """Masks of subjects (n,), each with the indices of the quantities that exactly
    these subjects have.
    """
    known = np.isfinite(values)
    kinds, which = np.unique(np.packbits(known, axis=0), axis=1, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    for columns in np.split(
        order, np.cumsum(np.bincount(which.ravel(), minlength=kinds.shape[1]))[:-1]
    ):
        rows = known[:, columns[0]]
        if rows.any():
            yield rows, columns


def _compared(
    parts: Sequence[_Part],
    shape: tuple[int, ...],
    draws: Iterator[Array],
    count: int,
    drawn: Callable[[_Part, Array], tuple[NDArray[np.intp], Array]],
) -> tuple[Array, Array, int]:
    """P values of the observed statistics, each alone and against the largest statistic
    of all parts.

    For b draws, which are common to all parts, `drawn` returns the indices (b, rows) of
    the permuted values of a part and their signs (b, rows).
    """
    observed = np.full(shape[1], np.nan)
    for part in parts:
        observed[part.columns] = np.abs(
            _statistics(_residual(part.values, part.basis)[None], part.own, part.basis)[
                0
            ]
        )
    # tolerance for the same value summed in another order
    reached = observed * (1 - 1e-9)
    alone = np.zeros(shape[1])
    largest = np.zeros(shape[1])
    entries = shape[1] * (shape[0] if shape[1] < MANY else SUMS)
    while batch := list(islice(draws, max(1, BATCH // max(entries, 1)))):
        most = np.zeros(len(batch))
        for part in parts:
            found = np.abs(_redrawn(part, *drawn(part, np.stack(batch))))
            alone[part.columns] += (found >= reached[part.columns]).sum(axis=0)
            most = np.maximum(most, found.max(axis=1))
        largest += (most[:, None] >= reached).sum(axis=0)
    told = np.isfinite(observed)
    p, adjusted = (
        np.where(told, (one + 1) / (count + 1), np.nan) for one in (alone, largest)
    )
    return p, adjusted, count
