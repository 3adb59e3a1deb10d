"""Conversion of samples from half to single precision, scaled so that their squares
neither vanish nor overflow.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from skindb._compiled import fast_kernel, kernel
from skindb._vectors import half


def single(value: Any) -> Any:
    """A sample in single precision; half floats are passed as their bits, see `sample_bits`."""
    return value


@overload(single, inline="always", strict=False)
def _single(value: Any) -> Any:
    if value == types.uint16:
        return lambda value: half(value)
    return lambda value: value


def sample_bits(sample: NDArray[Any]) -> NDArray[Any]:
    """Half floats as uint16 bits, because Numba has no half type; other samples in
    single precision.
    """
    is_half = sample.dtype == np.float16
    return (
        np.ascontiguousarray(sample).view(np.uint16)
        if is_half
        else np.ascontiguousarray(sample, np.float32)
    )


@kernel
def unpack(sample: Any, out: Any) -> None:
    """Write the samples (lights, cameras, 3) of a surfel to `out` (lights cameras 3,)
    in single precision.
    """
    flat = sample.reshape(-1)
    for i in range(flat.shape[0]):
        out[i] = single(flat[i])


@fast_kernel
def largest_finite(values: Any) -> Any:
    """Largest finite absolute value of (n,) values in single precision; 0 if there is none."""
    largest = np.float32(0)
    for i in range(values.shape[0]):
        size = abs(values[i])
        largest = max(largest, size if size < np.inf else np.float32(0))
    return largest


@kernel
def scale_to_one(values: Any) -> float:
    """Multiply values by the power of two that brings the largest to [0.5, 1), which is
    exact; returns the power.
    """
    largest = np.float64(largest_finite(values))
    if largest <= 0.0:
        return 1.0
    factor = np.float32(min(math.ldexp(1.0, -math.frexp(largest)[1]), 1e38))
    for i in range(values.shape[0]):
        values[i] *= factor
    return float(factor)
