"""Statistics of populations: moments, intervals, false discoveries, power, and
correlations within subjects; the unit of observation is a subject.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from skindb.types import AnyArray, Array, float64

CONFIDENCE = 0.95  # of intervals
SUMMARY = ("count", "mean", "mean_low", "mean_high", "standard_deviation")
POWER = 0.8  # of tests, for the smallest effect that they detect
# standard deviation over the median absolute deviation of normal noise
NORMAL_PER_MEDIAN = 1.4826
ROUNDING = 1e-13  # relative to the largest value


def correlation(a: Array, b: Array) -> float:
    """Pearson's correlation of two vectors; 0 if one of them is constant."""
    x = float64(a) - float64(a).mean()
    y = float64(b) - float64(b).mean()
    product = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / product if product > 0 else 0.0


def robust_deviation(
    deviation: Array, axis: int | tuple[int, ...] | None = None
) -> Any:
    """Standard deviation of normal noise, from the median of its absolute deviations;
    outliers hardly change it.
    """
    return NORMAL_PER_MEDIAN * np.median(np.abs(deviation), axis=axis)


@dataclass(frozen=True)
class Moments:
    """Count, mean and centred second moment along the first axis."""

    count: Array
    mean: Array
    second: Array  # sum of squared deviations from the mean

    @classmethod
    def of(cls, values: Array) -> Moments:
        """Moments over the first axis; NaN counts as missing."""
        values = float64(values)
        finite = np.isfinite(values)
        count = finite.sum(axis=0).astype(float)
        mean = np.where(finite, values, 0.0).sum(axis=0) / np.maximum(count, 1.0)
        second = (np.where(finite, values - mean, 0.0) ** 2).sum(axis=0)
        return cls(count, mean, second)

    @classmethod
    def stacked(cls, parts: Iterable[Moments]) -> Moments:
        """Moments of several sets, along a new first axis."""
        columns = ((part.count, part.mean, part.second) for part in parts)
        return cls(*map(np.stack, zip(*columns, strict=True)))

    @property
    def variance(self) -> Array:
        """Unbiased variance; NaN for fewer than two values."""
        return np.where(
            self.count > 1, self.second / np.maximum(self.count - 1.0, 1.0), np.nan
        )

    @property
    def standard_deviation(self) -> Array:
        """Square root of the unbiased variance."""
        return np.sqrt(self.variance)

    def summary(self, prefix: str) -> dict[str, Array]:
        """Name of each statistic in `SUMMARY` after a prefix -> its values; NaN where
        there are too few.
        """
        mean = np.where(self.count > 0, self.mean, np.nan)
        values = (self.count, mean, *self.mean_interval(), self.standard_deviation)
        names = [f"{prefix}_{name}" for name in SUMMARY]
        return dict(zip(names, values, strict=True))

    def mean_interval(self) -> tuple[Array, Array]:
        """Student's interval of the mean; NaN for fewer than two values."""
        half = special.stdtrit(np.maximum(self.count - 1.0, 1.0), (1 + CONFIDENCE) / 2)
        half = half * self.standard_deviation / np.sqrt(np.maximum(self.count, 1.0))
        return self.mean - half, self.mean + half


def bootstrap_interval(
    values: Array,
    statistic: Callable[[Array], Array],
    *,
    rng: np.random.Generator,
    draws: int = 1000,
) -> tuple[Array, Array]:
    """Percentile interval of `statistic(values[drawn rows])`, rows drawn with
    replacement (Efron 1979).
    """
    n = len(values)
    if n == 0:
        raise ValueError("values must have at least one row for a bootstrap")
    results = [statistic(values[rng.integers(n, size=n)]) for _ in range(draws)]
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(results, [tail, (1 + CONFIDENCE) / 2], axis=0)
    return low, high


def known_mean(values: Array) -> Array:
    """Mean of the finite values over the first axis; NaN where there are none."""
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    total = np.where(finite, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def detectable_difference(error: Array, free: Array | float) -> Array:
    """Smallest effect that a test at the level of 5 % detects with a power of 80 %, from
    the standard error of its estimate and its degrees of freedom.
    """
    quantiles = special.stdtrit(free, (1 + CONFIDENCE) / 2) + special.stdtrit(
        free, POWER
    )
    return error * quantiles


class OneWay(NamedTuple):
    """Intraclass correlation of a one-way design with its 95 % interval, and the
    standard deviation within subjects.
    """

    correlation: float
    low: float
    high: float
    within: float


def intraclass_correlation(values: Array, subject: AnyArray) -> OneWay:
    """ICC(1) of values (n,) of subjects (n,), at least two of them and one with two
    values; exact for equal numbers of values (Shrout and Fleiss 1979), and with their
    mean number otherwise.
    """
    _, member, count = np.unique(subject, return_inverse=True, return_counts=True)
    n, people = len(values), len(count)
    mean = np.bincount(member, values) / count
    between = float(count @ (mean - values.mean()) ** 2) / (people - 1)
    within = float(((values - mean[member]) ** 2).sum()) / (n - people)
    size = (n - float(count @ count) / n) / (people - 1)
    upper = special.fdtri(people - 1, n - people, (1 + CONFIDENCE) / 2)
    lower = special.fdtri(n - people, people - 1, (1 + CONFIDENCE) / 2)
    # ratios of the mean squares between and within subjects, times the latter
    squares = (between, between / upper, between * lower)
    with np.errstate(invalid="ignore", divide="ignore"):
        bounds = [np.divide(b - within, b + (size - 1) * within) for b in squares]
    return OneWay(*map(float, (*bounds, np.sqrt(within))))


def agreement_correlation(values: Array) -> tuple[float, float, float]:
    """ICC(2,1) of values (subject, occasion) with its 95 % interval (McGraw and Wong
    1996, ICC(A,1)); NaN for fewer than three subjects or two occasions.
    """
    n, k = values.shape
    if n < 3 or k < 2:
        return np.nan, np.nan, np.nan
    people, occasions = values.mean(axis=1), values.mean(axis=0)
    rest = values - people[:, None] - occasions + values.mean()
    between = k * people.var(ddof=1)
    occasion = n * occasions.var(ddof=1)
    error = (rest**2).sum() / ((n - 1) * (k - 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = between + (k - 1) * error
        icc = (between - error) / (spread + k * (occasion - error) / n)
        a = k * icc / (n * (1 - icc))
        b = 1 + k * icc * (n - 1) / (n * (1 - icc))
        free = (a * occasion + b * error) ** 2 / (
            (a * occasion) ** 2 / (k - 1) + (b * error) ** 2 / ((n - 1) * (k - 1))
        )
        upper = special.fdtri(n - 1, free, (1 + CONFIDENCE) / 2)
        lower = special.fdtri(free, n - 1, (1 + CONFIDENCE) / 2)
        others = k * occasion + (k * n - k - n) * error
        low = n * (between - upper * error) / (upper * others + n * between)
        high = n * (lower * between - error) / (others + n * lower * between)
    return float(icc), float(low), float(high)
