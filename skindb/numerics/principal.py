"""Principal components of few long vectors, such as one for each take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb._types import Array

BLOCK = 1 << 16  # entries of all vectors at a time in double precision: 90 MB of 174


@dataclass(frozen=True)
class Components:
    """Mean and axes of vectors, and each vector's place along them."""

    mean: Array  # (d,)
    axes: Array  # (c, d) of unit norm, by falling variance; the largest entry of each is positive
    score: Array  # (n, c)
    variance: Array  # (c,) of the score, unbiased
    total: float  # sum of the variances of all entries
    residual: Array  # (n,) root mean square of what the components leave


def principal_axes(vectors: NDArray[np.floating], most: int) -> Components:
    """Components of vectors (n, d), n at least 2, by the eigenvectors of their inner products.

    Nothing as large as the vectors is made in double precision: they are read block by block. Components whose
    variance is below 1e-12 of the largest are rounding, and omitted.

    Parameters
    ----------
    vectors
        (n, d) finite, of any precision.
    most
        Components, at most; never more than n - 1.
    """
    n, d = vectors.shape
    blocks = [slice(start, start + BLOCK) for start in range(0, d, BLOCK)]
    mean, inner = np.empty(d), np.zeros((n, n))
    for block in blocks:
        x = vectors[:, block].astype(np.float64)
        mean[block] = x.mean(axis=0)
        x -= mean[block]
        inner += x @ x.T
    values, places = np.linalg.eigh(inner)
    values, places = values[::-1][: min(most, n - 1)], places[:, ::-1][:, : min(most, n - 1)]
    there = int((values > max(float(values[0]), 0.0) * 1e-12).sum())
    length = np.sqrt(values[:there])
    axes, residual = np.empty((there, d)), np.zeros(n)
    for block in blocks:
        x = vectors[:, block] - mean[block]
        axes[:, block] = (places[:, :there] / length).T @ x
        residual += ((x - (places[:, :there] * length) @ axes[:, block]) ** 2).sum(axis=1)
    largest = np.abs(axes).argmax(axis=1)
    sign = np.where(axes[np.arange(there), largest] < 0, -1.0, 1.0)
    score = places[:, :there] * (length * sign)
    variance, total = values[:there] / (n - 1), float(np.trace(inner)) / (n - 1)
    return Components(mean, axes * sign[:, None], score, variance, total, np.sqrt(residual / d))
