"""Small array helpers for the fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

# also for the modules that import it from here
from skindb.types import Array as Array

# surfels that a kernel processes at once: 15 MB of single-precision samples of a full
# dome
BATCH = 512


def in_batches(
    kernel: Callable[..., tuple[NDArray[Any], ...]], surfel_arrays: Sequence[Array]
) -> tuple[Any, ...]:
    """Run `kernel` on slices along the shared first axis of arrays, and concatenate the
    results; bounds the memory.
    """
    n = len(surfel_arrays[0])
    parts = [
        kernel(*(a[i : i + BATCH] for a in surfel_arrays))
        for i in range(0, max(n, 1), BATCH)
    ]
    return tuple(np.concatenate(outputs) for outputs in zip(*parts, strict=True))


def unit(vectors: Array) -> Array:
    """Vectors (..., 3) of length 1; zero and NaN vectors become NaN."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, np.nan))


def directions(points: Array, targets: Array) -> Array:
    """(n, t, 3) unit directions from points (n, 3) to targets (t, 3)."""
    return unit(targets.astype(np.float64)[None] - points.astype(np.float64)[:, None])


def cosines(normal: Array, towards: Array) -> Array:
    """(n, t) cosines between normals (n, 3) and directions (n, t, 3)."""
    return np.asarray(np.einsum("nk,ntk->nt", normal, towards))


def quantile_finite(values: Array, level: float, axis: int) -> Array:
    """Quantile at `level` of the finite values along an axis, without interpolation;
    NaN where there is none.
    """
    ordered = np.sort(np.where(np.isfinite(values), values, np.nan), axis=axis)
    count = np.isfinite(ordered).sum(axis, keepdims=True)
    place = np.clip(
        np.rint(level * (count - 1)).astype(np.int64), 0, values.shape[axis] - 1
    )
    return np.asarray(np.take_along_axis(ordered, place, axis).squeeze(axis))
