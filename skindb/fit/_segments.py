"""Sums over the samples of each surfel when surfels have different numbers of samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skindb.types import Array


class Segments:
    """Consecutive samples of n surfels; surfels without samples have no segment."""

    def __init__(self, offsets: NDArray[np.int64]) -> None:
        """Start from (n + 1,) offsets where each surfel's samples begin."""
        sizes = np.diff(offsets)
        self._total = len(sizes)
        self._filled = np.flatnonzero(sizes)
        self._begin = offsets[:-1][self._filled]
        self._sizes = sizes[self._filled]
        self.count = len(self._filled)
        # (total,) surfel of each sample
        self.owner = np.repeat(self._filled, self._sizes)

    def sum(self, values: Array) -> Array:
        """(count,) sums over each segment of (total,) values, in float64."""
        if not self.count:
            return np.zeros(0)
        return np.asarray(np.add.reduceat(values, self._begin, dtype=np.float64))

    def spread(self, values: Array) -> Array:
        """(total,) the value of each sample's segment."""
        return np.repeat(values, self._sizes)

    def scatter(self, values: Array) -> Array:
        """(n, ...) values of the segments at their surfels, NaN elsewhere."""
        out = np.full((self._total, *values.shape[1:]), np.nan)
        out[self._filled] = values
        return out
