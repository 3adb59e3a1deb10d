"""Linear algebra on one thread, so that results do not depend on the number of cores."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np

# SciPy has its own BLAS, and only loaded libraries can be limited
import scipy.linalg  # noqa: F401
from threadpoolctl import threadpool_limits

from skindb.types import AnyArray

P = ParamSpec("P")
Result = TypeVar("Result")


def one_blas_thread() -> threadpool_limits:
    """Context in which matrix products and decompositions do not depend on the number of threads.

    The order of sums in BLAS depends on its threads, and fits amplify the last digit to
    1e-3 of a weight.
    """
    return threadpool_limits(1)


def on_one_blas_thread(function: Callable[P, Result]) -> Callable[P, Result]:
    """Decorator that runs a function, and any threads it starts, in `one_blas_thread`."""

    @wraps(function)
    def limited(*args: P.args, **options: P.kwargs) -> Result:
        with one_blas_thread():
            return function(*args, **options)

    return limited


def c_contiguous(array: AnyArray) -> AnyArray:
    """The array in C order and aligned; an array that was received over a network may
    be neither.
    """
    return np.require(array, requirements=["C", "A"])
