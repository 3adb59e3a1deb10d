"""Principal components of a few long vectors, such as one per take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.types import Array

# entries per vector that are held in double precision at a time: 90 MB for 174 vectors
BLOCK = 1 << 16


@dataclass(frozen=True)
class Components:
    """Mean and principal axes of vectors, and the scores of each vector."""

    mean: Array  # (d,)
    # (c, d) of unit norm, by decreasing variance; the largest entry of each is positive
    axes: Array
    score: Array  # (n, c)
    variance: Array  # (c,) unbiased variance of the scores
    total: float  # sum of the variances of all entries
    residual: Array  # (n,) root mean square of the residual of each vector


def principal_axes(vectors: NDArray[np.floating], most: int) -> Components:
    """Principal components of vectors (n, d), n at least 2, from the eigenvectors of
    their inner products.

    Vectors are read block by block, so that no full copy in double precision is needed.
    Components whose variance is below 1e-12 of the largest are rounding and are
    dropped.

    Parameters
    ----------
    vectors
        (n, d) finite, of any precision.
    most
        Maximum number of components; never more than n - 1.
    """
    n, d = vectors.shape
    blocks = [slice(start, start + BLOCK) for start in range(0, d, BLOCK)]
    mean = np.empty(d)
    inner = np.zeros((n, n))
    for block in blocks:
        x = vectors[:, block].astype(np.float64)
        mean[block] = x.mean(axis=0)
        x -= mean[block]
        inner += x @ x.T
    values, places = np.linalg.eigh(inner)
    values = values[::-1][: min(most, n - 1)]
    places = places[:, ::-1][:, : min(most, n - 1)]
    there = int((values > max(float(values[0]), 0.0) * 1e-12).sum())
    length = np.sqrt(values[:there])
    axes = np.empty((there, d))
    residual = np.zeros(n)
    for block in blocks:
        x = vectors[:, block] - mean[block]
        axes[:, block] = (places[:, :there] / length).T @ x
        residual += ((x - (places[:, :there] * length) @ axes[:, block]) ** 2).sum(
            axis=1
        )
    largest = np.abs(axes).argmax(axis=1)
    sign = np.where(axes[np.arange(there), largest] < 0, -1.0, 1.0)
    score = places[:, :there] * (length * sign)
    variance = values[:there] / (n - 1)
    total = float(np.trace(inner)) / (n - 1)
    return Components(
        mean, axes * sign[:, None], score, variance, total, np.sqrt(residual / d)
    )
