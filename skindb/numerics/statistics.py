"""Mergeable moments and intervals for population statistics (Chan et al. 1979)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats

from skindb.types import Array


@dataclass(frozen=True)
class Moments:
    """Count, mean and centred second moment along the first axis; moments of parts of a
    population can be added.
    """

    count: Array
    mean: Array
    second: Array  # sum of squared deviations from the mean

    @classmethod
    def zero(cls, shape: tuple[int, ...] = ()) -> Moments:
        """Moments of an empty set."""
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape))

    @classmethod
    def of(cls, values: Array) -> Moments:
        """Moments over the first axis; NaN counts as missing."""
        values = np.asarray(values, np.float64)
        known = np.isfinite(values)
        count = known.sum(axis=0).astype(np.float64)
        mean = np.where(known, values, 0.0).sum(axis=0) / np.maximum(count, 1.0)
        second = (np.where(known, values - mean, 0.0) ** 2).sum(axis=0)
        return cls(count, mean, second)

    def __add__(self, other: Moments) -> Moments:
        count = self.count + other.count
        share = other.count / np.maximum(count, 1.0)
        step = other.mean - self.mean
        second = self.second + other.second + step**2 * self.count * share
        return Moments(count, self.mean + step * share, second)

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

    def mean_interval(self, *, level: float = 0.95) -> tuple[Array, Array]:
        """Student's interval of the mean; NaN for fewer than two values."""
        half = stats.t.ppf((1 + level) / 2, np.maximum(self.count - 1.0, 1.0))
        half = half * self.standard_deviation / np.sqrt(np.maximum(self.count, 1.0))
        return self.mean - half, self.mean + half

    def deviation_interval(self, *, level: float = 0.95) -> tuple[Array, Array]:
        """Chi-square interval of the standard deviation of normal values; NaN for fewer
        than two values.
        """
        free = np.maximum(self.count - 1.0, 1.0)
        low = stats.chi2.ppf((1 + level) / 2, free)
        high = stats.chi2.ppf((1 - level) / 2, free)
        second = np.where(self.count > 1, self.second, np.nan)
        return np.sqrt(second / low), np.sqrt(second / high)


def bootstrap_interval(
    values: Array,
    statistic: Callable[[Array], Array],
    *,
    rng: np.random.Generator,
    draws: int = 1000,
    level: float = 0.95,
) -> tuple[Array, Array]:
    """Percentile interval of `statistic(values[drawn rows])`, rows drawn with
    replacement (Efron 1979).
    """
    n = len(values)
    if n == 0:
        raise ValueError("values must have at least one row for a bootstrap")
    results = np.stack(
        [statistic(values[rng.integers(n, size=n)]) for _ in range(draws)]
    )
    low, high = np.quantile(results, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


def known_mean(values: Array) -> Array:
    """Mean of the finite values over the first axis; NaN where there are none."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
