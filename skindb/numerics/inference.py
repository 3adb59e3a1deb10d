"""Effects, permutation tests and distances of groups; the unit of observation is a subject.

Effects are estimated by regression with standard errors that are valid for unequal
variances (HC3, MacKinnon and White 1985). Permutations respect covariates (Freedman and
Lane 1983) and correct for many quantities by the largest statistic (Westfall and Young
1993). They compare statistics that contain the standard errors (DiCiccio and Romano
2017; Chung and Romano 2016); otherwise groups of different sizes and spreads would
appear to differ (Anderson and Walsh 2013). The statistic of two groups of vectors is
the squared distance of their means divided by the sum of their mean squared scatters,
each over its number of subjects; in one dimension it is the square of Welch's t.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, islice, permutations, product
from math import factorial, prod
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy import special

from skindb.numerics.statistics import CONFIDENCE, ROUNDING, Moments
from skindb.types import AnyArray, Array, Index, Mask, finite_rows, float64, lengths

Draw = AnyArray  # an order, signs or labels of the subjects, or many of them
SUMS = 8  # values in memory per draw and quantity, or subject
TILE = 1 << 14  # quantities of which double-precision copies are in memory at a time
# relative to the sum of weighted squares; smaller differences are dominated by rounding
CANCELLED = 1e-6
BATCH = 1 << 22  # number of permuted values in memory at a time: 32 MB
REACHED = 1 - 1e-9  # tolerance for the same statistic summed in another order


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
class _Regression:
    """Quantities of the same subjects, the adjusted regressor, and the covariates."""

    rows: Mask  # (n,) mask of these subjects
    columns: Index  # indices of the quantities
    regressor: Array  # (rows,) its residual after projection on the basis
    basis: Array  # (rows, .) orthonormal basis of 1 and the covariates
    values: Array  # (rows, columns)

    @property
    def leverage(self) -> Array:
        square = float(self.regressor @ self.regressor)
        return (self.basis**2).sum(axis=1) + self.regressor**2 / square

    @property
    def error_weight(self) -> Array:
        """Weights (rows,) of the squared residuals in the squared HC3 error of the slope."""
        square = float(self.regressor @ self.regressor)
        scale = np.maximum(1 - self.leverage, 1e-12)
        return (self.regressor / square / scale) ** 2

    def residual(self) -> Array:
        """Values after projection on the basis; 0 where only rounding remains."""
        y = self.values - self.basis @ (self.basis.T @ self.values)
        exact = np.abs(y).max(axis=0) > ROUNDING * np.abs(self.values).max(axis=0)
        return np.where(exact, y, 0.0)

    def statistics(self, values: Array) -> Array:
        """Slope over its HC3 error (b, q) of values (b, n, q), after projection on the basis."""
        y = values - self.basis @ (self.basis.T @ values)
        slope = self.regressor @ y / float(self.regressor @ self.regressor)
        residual = y - self.regressor[:, None] * slope[:, None]
        square = np.einsum("i,biq,biq->bq", self.error_weight, residual, residual)
        return _ratio(slope, np.sqrt(square))

    def permuted_statistics(self, order: Index, sign: Array) -> Array:
        """Statistics (b, q) of values in another order (b, rows), multiplied by signs (b, rows).

        Sums over subjects are products of matrices, whose factors are permuted instead
        of the values. Statistics whose residuals are mostly rounding are computed again
        from the permuted values.
        """
        weight = self.error_weight
        # orthogonal columns, all but the last of unit length
        design = np.column_stack([self.basis, self.regressor])
        weighted_design = weight[:, None] * design
        inverse = np.argsort(order, axis=1)
        factors = np.concatenate([design, weighted_design], axis=1)[inverse]
        factors = factors * np.take_along_axis(sign, inverse, axis=1)[..., None]
        b, n, c = factors.shape
        rows = np.moveaxis(factors, 2, 1).reshape(b * c, n)
        sums = (rows @ self.values).reshape(b, c, -1)
        along = sums[:, : c // 2]
        along[:, -1] /= float(self.regressor @ self.regressor)
        total = weight[inverse] @ self.values**2
        cross = np.einsum("bcq,bcq->bq", along, sums[:, c // 2 :])
        gram = design.T @ weighted_design
        explained = np.einsum("bcq,cd,bdq->bq", along, gram, along, optimize=True)
        squares = total - 2 * cross + explained
        statistics = _ratio(along[:, -1], np.sqrt(np.maximum(squares, 0.0)))
        cancelled = squares <= CANCELLED * total
        for draw in np.flatnonzero(cancelled.any(axis=1)):
            columns = np.flatnonzero(cancelled[draw])
            values = self.values[np.ix_(order[draw], columns)] * sign[draw][:, None]
            statistics[draw, columns] = self.statistics(values[None])[0]
        return statistics


# order (b, rows) and signs (b, rows) of the subjects of a regression in b draws
Redraw = Callable[[_Regression, Draw], tuple[Index, Array]]


def effects(
    values: Array,
    regressor: Array,
    covariates: Array | None = None,
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
    slope, error, spread, freedom = np.full((4, values.shape[1]), np.nan)
    tiles = _regressions(values, regressor, covariates)
    for fit in chain.from_iterable(tiles):
        y = fit.residual()
        columns = fit.columns
        slope[columns] = fit.regressor @ y / float(fit.regressor @ fit.regressor)
        residual = y - fit.regressor[:, None] * slope[columns]
        error[columns] = np.sqrt(fit.error_weight @ residual**2)
        freedom[columns] = len(y) - fit.basis.shape[1] - 1
        spread[columns] = np.sqrt((residual**2).sum(axis=0) / freedom[columns])
    return _effects(slope, error, spread, freedom)


def paired_effects(differences: Array) -> Effects:
    """Mean of differences (n, q) within subjects, NaN where a subject lacks one; see `effects`.

    The error is the standard error of the mean, and `spread` the standard deviation of
    the differences.
    """
    moments = Moments.of(differences)
    is_known = moments.count >= 2
    mean = np.where(is_known, moments.mean, np.nan)
    spread = moments.standard_deviation
    error = spread / np.sqrt(np.maximum(moments.count, 1))
    freedom = np.where(is_known, moments.count - 1.0, np.nan)
    return _effects(mean, error, spread, freedom)


def known_effects(slope: Array, error: Array) -> Effects:
    """Effects (q,) with known standard errors, such as differences within one subject;
    `spread` is NaN.
    """
    slope = np.where(np.isfinite(error), slope, np.nan)
    return _effects(
        slope, error, np.full_like(error, np.nan), np.full_like(error, np.inf)
    )


def _effects(slope: Array, error: Array, spread: Array, freedom: Array) -> Effects:
    half = special.stdtrit(freedom, (1 + CONFIDENCE) / 2) * error
    statistic = np.where(np.isnan(slope), np.nan, _ratio(slope, error))
    return Effects(slope, error, slope - half, slope + half, statistic, spread, freedom)


def _ratio(slope: Array, error: Array) -> Array:
    return np.divide(slope, error, out=np.zeros_like(slope), where=error > 0)


def permutation_p(
    values: Array,
    regressor: Array,
    covariates: Array | None = None,
    *,
    max_draws: int = 10_000,
    rng: Generator,
) -> tuple[Array, Array, int]:
    """P values of `effects` by permutation of the residuals after regression on the covariates.

    Parameters
    ----------
    values, regressor, covariates
        See `effects`. Subjects who lack a quantity are excluded from it in every permutation.
    max_draws
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
    orders = _draws(
        factorial(n),
        lambda: permutations(range(n)),
        lambda: rng.permutation(n),
        max_draws,
        rng,
    )

    def redraw(fit: _Regression, order: Draw) -> tuple[Index, Array]:
        # subjects who lack a quantity are excluded, and all orders remain equally likely
        places = np.argsort(order[:, fit.rows], axis=1)
        return places, np.ones(places.shape)

    tiles = (
        [replace(fit, values=fit.residual()) for fit in fits]
        for fits in _regressions(values, regressor, covariates)
    )
    return _max_t_p(tiles, values.shape, *orders, redraw)


def sign_flip_p(
    differences: Array, *, max_draws: int = 10_000, rng: Generator
) -> tuple[Array, Array, int]:
    """P values of means of paired differences (n, q), by changing the signs of
    subjects; see `permutation_p`.
    """
    n = len(differences)
    if (np.isfinite(differences).sum(axis=0) < 2).all():
        raise ValueError("paired differences need at least two subjects")
    tiles = (
        [
            _Regression(rows, columns, np.ones(size), np.empty((size, 0)), block)
            for rows, columns, block in patterns
            if (size := len(block)) >= 2
        ]
        for patterns in _tiles(differences)
    )
    signs = _draws(
        2**n,
        lambda: product((1.0, -1.0), repeat=n),
        lambda: rng.choice((1.0, -1.0), n),
        max_draws,
        rng,
    )

    def redraw(fit: _Regression, sign: Draw) -> tuple[Index, Array]:
        sign = sign[:, fit.rows]
        return np.tile(np.arange(sign.shape[1]), (len(sign), 1)), sign

    return _max_t_p(tiles, differences.shape, *signs, redraw)


def missing_patterns(values: Array) -> Iterator[tuple[Mask, Index]]:
    """Masks of subjects (n,), each with the indices of the quantities that exactly
    these subjects have.
    """
    finite = np.isfinite(values)
    patterns, pattern = np.unique(
        np.packbits(finite, axis=0), axis=1, return_inverse=True
    )
    order = np.argsort(pattern.ravel(), kind="stable")
    count = np.bincount(pattern.ravel(), minlength=patterns.shape[1])
    for columns in np.split(order, np.cumsum(count)[:-1]):
        rows = finite[:, columns[0]]
        if rows.any():
            yield rows, columns


def _tiles(values: Array) -> Iterator[list[tuple[Mask, Index, Array]]]:
    """Missing patterns of some quantities at a time, with the values (rows, columns) in
    double precision.
    """
    for start in range(0, values.shape[1], TILE):
        tile = float64(values[:, start : start + TILE])
        yield [
            (rows, start + columns, tile[np.ix_(rows, columns)])
            for rows, columns in missing_patterns(tile)
        ]


def _regressions(
    values: Array, regressor: Array, covariates: Array | None
) -> Iterator[list[_Regression]]:
    """Quantities grouped by the subjects who have them, if their effect can be
    estimated, some at a time.
    """
    found = False
    fault = ValueError("no subject has any of the quantities")
    x = float64(regressor)
    design = np.ones((len(x), 1))
    if covariates is not None:
        design = np.column_stack([design, float64(covariates)])
    for patterns in _tiles(values):
        fits = []
        for rows, columns, block in patterns:
            try:
                adjusted, basis = _adjusted(x[rows], design[rows])
                fit = _Regression(rows, columns, adjusted, basis, block)
                length = np.linalg.norm(fit.regressor)
                decides = np.abs(fit.regressor) > 1e-6 * length
                if (decides & (fit.leverage > 1 - 1e-9)).any():
                    # permutations of such a slope are not comparable either
                    raise ValueError(
                        "each group must have two subjects: the effect depends on one "
                        "subject and has no error"
                    )
            except ValueError as error:
                fault = error
                continue
            fits.append(fit)
        found = found or bool(fits)
        yield fits
    if not found:
        raise fault


def _adjusted(x: Array, design: Array) -> tuple[Array, Array]:
    """Residual (n,) of a regressor after regression on the design (n, c), and an
    orthonormal basis of the design.
    """
    columns = [column / (np.linalg.norm(column) or 1.0) for column in design.T]
    u, s, _ = np.linalg.svd(np.stack(columns, axis=1), full_matrices=False)
    basis = u[:, s > 1e-10 * s[0]]
    residual = x - basis @ (basis.T @ x)
    if len(x) - basis.shape[1] < 3:
        raise ValueError(
            f"{len(x)} subjects are too few to estimate {basis.shape[1] + 1} "
            "coefficients and their errors"
        )
    if residual @ residual <= 1e-12 * max(float(x @ x), np.finfo(np.float64).tiny):
        raise ValueError(
            "the regressor is the same for all subjects, or a combination of the covariates"
        )
    return residual, basis


def _draws(
    total: int,
    enumeration: Callable[[], Iterable[Any]],
    draw: Callable[[], Draw],
    max_draws: int,
    rng: Generator,
) -> tuple[Callable[[], Iterator[Draw]], int]:
    """Function that returns the same draws whenever it is called, and their number: all
    of `total` but the first, which is the identity, or random ones if there are more
    than `max_draws`.
    """
    if total - 1 <= max_draws:
        return lambda: map(np.array, islice(enumeration(), 1, None)), total - 1
    state = rng.bit_generator.state

    def drawn() -> Iterator[Draw]:
        rng.bit_generator.state = state
        return (draw() for _ in range(max_draws))

    return drawn, max_draws


def _batches(draws: Iterator[Draw], entries: int) -> Iterator[Draw]:
    """Draws of `entries` values, stacked along a first axis in batches of about BATCH values."""
    while batch := list(islice(draws, max(1, BATCH // max(entries, 1)))):
        yield np.stack(batch)


def _max_t_p(
    tiles: Iterable[list[_Regression]],
    shape: tuple[int, ...],
    draws: Callable[[], Iterator[Draw]],
    count: int,
    redraw: Redraw,
) -> tuple[Array, Array, int]:
    """P values of the observed statistics, each alone and against the largest statistic
    of all quantities; the draws are common to all fits.
    """
    observed = np.full(shape[1], np.nan)
    alone = np.zeros(shape[1])
    largest = np.zeros(count)
    entries = SUMS * (shape[0] + min(shape[1], TILE))
    for fits in tiles:
        for fit in fits:
            observed[fit.columns] = np.abs(fit.statistics(fit.residual()[None])[0])
        done = 0
        for batch in _batches(draws(), entries):
            highest = largest[done : done + len(batch)]
            for fit in fits:
                statistics = np.abs(fit.permuted_statistics(*redraw(fit, batch)))
                reached = statistics >= REACHED * observed[fit.columns]
                alone[fit.columns] += reached.sum(axis=0)
                np.maximum(highest, statistics.max(axis=1), out=highest)
            done += len(batch)
    family = count - np.searchsorted(np.sort(largest), observed * REACHED)
    exceeding = np.where(np.isfinite(observed), [alone, family], np.nan)
    p, adjusted = (exceeding + 1) / (count + 1)
    return p, adjusted, count


def between_groups_p(
    values: Array, group: Index, *, max_draws: int, rng: Generator
) -> tuple[Array, Array, int]:
    """Statistics and p values of all pairs of groups of different subjects, by
    permutation of the subjects.

    Parameters
    ----------
    values
        (n, k) one vector per subject, in coordinates in which distances are Euclidean.
    group
        (n,) group of each subject, counted from 0; each group must have at least two subjects.
    max_draws
        Maximum number of permutations; all distinct ones are used if there are fewer.
    rng
        Random generator for the permutations.

    Returns
    -------
    statistic, p, count
        Statistics (pairs,) in the order of ``itertools.combinations``; p values
        (pairs,) adjusted by the largest statistic of all pairs; the number of
        permutations. The smallest p is 1 / (count + 1).
    """
    sizes = np.bincount(group)
    # all draws label the values in this order, in which the groups follow each other
    observed = np.repeat(np.arange(len(sizes)), sizes)
    draws, count = _draws(
        factorial(len(group)) // prod(map(factorial, sizes.tolist())),
        lambda: _arrangements(sizes.tolist()),
        lambda: rng.permutation(observed),
        max_draws,
        rng,
    )
    # sorted by group, so that the order of the subjects does not change the bits of the result
    y = values[np.argsort(group, kind="stable")]
    y = y - y.mean(axis=0)
    y = np.where(np.abs(y) > ROUNDING * np.abs(values).max(), y, 0.0)
    statistic = _between(y, observed[None], sizes)[0]
    batches = _batches(draws(), len(y) * len(sizes))
    drawn = (_between(y, labels, sizes) for labels in batches)
    return statistic, _largest_p(statistic, drawn, count), count


def within_subjects_p(
    values: Array, *, max_draws: int, rng: Generator
) -> tuple[Array, Array, int]:
    """Statistics and p values of all pairs of conditions of the same subjects, by
    permutation within subjects.

    Parameters
    ----------
    values
        (n, groups, k), NaN where a subject lacks a condition; each pair must have at
        least two subjects with both.
    max_draws, rng
        See `between_groups_p`. With two conditions, a permutation changes the signs of
        the subjects' differences.

    Returns
    -------
    statistic, p, count
        See `between_groups_p`.
    """
    orders = [_orders(row) for row in finite_rows(values)]
    lengths = [len(order) for order in orders]
    choices, count = _draws(
        prod(lengths),
        lambda: product(*map(range, lengths)),
        lambda: rng.integers(lengths),
        max_draws,
        rng,
    )
    rows = np.arange(len(values))[:, None]

    def permuted(choice: Index) -> Array:
        order = [orders[i][choice[:, i]] for i in range(len(orders))]
        return _within(values[rows, np.stack(order, axis=1)])

    statistic = _within(values[None])[0]
    drawn = map(permuted, _batches(choices(), values.size))
    return statistic, _largest_p(statistic, drawn, count), count


def _largest_p(statistic: Array, drawn: Iterator[Array], count: int) -> Array:
    """P values (pairs,) against the largest statistic of each of `count` draws (b, pairs)."""
    exceeding = np.zeros(len(statistic))
    for statistics in drawn:
        largest = statistics.max(axis=1)
        exceeding += (largest[:, None] >= REACHED * statistic).sum(axis=0)
    return (exceeding + 1) / (count + 1)


def classical_scaling(distance: Array) -> tuple[Array, Array, float]:
    """Points in a plane whose distances approximate those of a matrix: principal coordinates
    (Torgerson 1952, Gower 1966).

    Parameters
    ----------
    distance
        (n, n) symmetric, of two points or more.

    Returns
    -------
    place, explained, error
        Centred points (n, 2), with the largest entry of each axis positive; fraction
        of the scatter along each axis (2,); RMS difference between distances in the
        map and those of the matrix, over the RMS distance.
    """
    n = len(distance)
    centre = np.eye(n) - 1 / n
    gram = -0.5 * centre @ distance**2 @ centre
    variance, vectors = np.linalg.eigh((gram + gram.T) / 2)
    variance = np.maximum(variance[::-1], 0.0)
    total = variance.sum() or 1.0
    variance = variance[:2]
    scale = np.sqrt(np.where(variance > ROUNDING * total, variance, 0.0))
    place = vectors[:, ::-1][:, :2] * scale
    largest = place[np.abs(place).argmax(axis=0), np.arange(place.shape[1])]
    place = place * np.where(largest < 0, -1.0, 1.0)
    mapped = lengths(place[:, None] - place[None])
    square = ((mapped - distance) ** 2).sum() / ((distance**2).sum() or 1.0)
    return place, variance / total, float(np.sqrt(square))


def _between(values: Array, group: Index, sizes: Index) -> Array:
    """Statistics (b, pairs) of centred values (n, k) for labels (b, n)."""
    square = (values**2).sum(axis=1)
    means = []
    errors = []
    for g, size in enumerate(sizes.tolist()):
        member = (group == g).astype(float)
        mean = member @ values / size
        scatter = member @ square - size * (mean**2).sum(axis=1)
        scatter = np.maximum(scatter, 0.0) / (size - 1)
        means.append(mean)
        errors.append(np.where(scatter > ROUNDING * square.max(), scatter, 0.0) / size)
    pairs = combinations(range(len(sizes)), 2)
    statistics = [
        _distance_ratio(means[a] - means[b], errors[a] + errors[b]) for a, b in pairs
    ]
    return np.stack(statistics, axis=1)


def _within(values: Array) -> Array:
    """Statistics (b, pairs) of values (b, n, groups, k), from the subjects who have
    both conditions of a pair.
    """
    statistics = []
    for a, b in combinations(range(values.shape[2]), 2):
        difference = values[:, :, a] - values[:, :, b]
        # the same subjects in all permutations
        difference = difference[:, finite_rows(difference[0])]
        n = difference.shape[1]
        mean = difference.mean(axis=1)
        scatter = ((difference - mean[:, None]) ** 2).sum(axis=(1, 2)) / (n - 1)
        largest = (difference**2).sum(axis=2).max(axis=1)
        scatter = np.where(scatter > ROUNDING * largest, scatter, 0.0)
        statistics.append(_distance_ratio(mean, scatter / n))
    return np.stack(statistics, axis=1)


def _distance_ratio(step: Array, error: Array) -> Array:
    """Squared lengths of steps (b, k) over squared errors (b,); infinite if the error
    is zero, 0 for a zero step.
    """
    square = (step**2).sum(axis=1)
    exact = np.where(square > 0, np.inf, 0.0)
    return np.divide(square, error, out=exact, where=error > 0)


def _arrangements(sizes: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """Every distinct order of labels, by the number of labels of each group; the first
    is sorted.
    """
    if not any(sizes):
        yield ()
    for g, size in enumerate(sizes):
        if size > 0:
            rest = [*sizes[:g], size - 1, *sizes[g + 1 :]]
            yield from ((g, *labels) for labels in _arrangements(rest))


def _orders(present: Mask) -> Index:
    """Permutations (orders, groups) of the conditions that a subject has; the first is
    the identity.
    """
    columns = np.flatnonzero(present)
    orders = list(permutations(columns.tolist()))
    out = np.tile(np.arange(len(present)), (len(orders), 1))
    out[:, columns] = orders
    return out
