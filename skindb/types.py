"""Types that many modules share, and arrays of vectors."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

AnyArray = NDArray[Any]
Array = NDArray[np.floating[Any]]
Half = NDArray[np.float16]
Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]  # numbers of vertices, surfels, ...
Index32 = NDArray[np.int32]
Values16 = NDArray[np.uint16]  # of frames of 16 bits
Faces = NDArray[np.integer[Any]]  # (f, 3) vertices of triangles

# Arrays of compiled kernels by rank and dtype; docstrings name the lengths, such as
# "rows (n, m)". Float64 unless the name ends with the bits.
Scalar = TypeVar("Scalar", bound=np.generic)
Rank1 = np.ndarray[tuple[int], np.dtype[Scalar]]
Rank2 = np.ndarray[tuple[int, int], np.dtype[Scalar]]
Rank3 = np.ndarray[tuple[int, int, int], np.dtype[Scalar]]
Rank4 = np.ndarray[tuple[int, int, int, int], np.dtype[Scalar]]
Vector = Rank1[np.float64]
Matrix = Rank2[np.float64]
Cube = Rank3[np.float64]
Tensor = Rank4[np.float64]  # four axes
Vector32 = Rank1[np.float32]
Matrix32 = Rank2[np.float32]
Cube32 = Rank3[np.float32]
Tensor32 = Rank4[np.float32]
IntVector = Rank1[np.int64]
IntMatrix = Rank2[np.int64]
IntCube = Rank3[np.int64]
IntVector32 = Rank1[np.int32]
IntMatrix32 = Rank2[np.int32]
BoolVector = Rank1[np.bool_]
BoolMatrix = Rank2[np.bool_]
BoolCube = Rank3[np.bool_]
ByteVector = Rank1[np.uint8]
ByteMatrix = Rank2[np.uint8]

Real = float | np.floating[Any]

MIN_LENGTH = 1e-12  # of a vector that has a direction; shorter ones are rounding

# called with the stage, the steps done and the steps in all
Progress = Callable[[str, int, int], None]


def float64(values: ArrayLike) -> Float64:
    """An array in double precision; a copy only if it has another type."""
    return np.asarray(values, np.float64)


def contiguous(values: ArrayLike) -> Float64:
    """An array in double precision and C order, for which kernels are compiled."""
    return np.ascontiguousarray(values, np.float64)


def finite_rows(values: AnyArray) -> Mask:
    """Mask (...) of the rows of an array (..., d) whose values are all finite."""
    return np.asarray(np.isfinite(values).all(axis=-1))


def dots(a: AnyArray, b: AnyArray) -> AnyArray:
    """Products (n,) of the vectors of arrays (n, d)."""
    return np.asarray(np.einsum("nc,nc->n", a, b))


def lengths(vectors: ArrayLike) -> AnyArray:
    """Lengths (...) of vectors (..., d)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def unit(vectors: AnyArray) -> AnyArray:
    """Vectors (..., d) over their lengths; those below MIN_LENGTH, such as 0, stay short."""
    return np.asarray(vectors / np.maximum(lengths(vectors)[..., None], MIN_LENGTH))


def silent(stage: str, done: int, total: int) -> None:
    """Progress callback that does nothing."""
