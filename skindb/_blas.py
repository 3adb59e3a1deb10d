"""Linear algebra on one thread, so that the last digits do not depend on the number of cores."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
import scipy.linalg  # noqa: F401  its BLAS is another one than NumPy's, and only what is loaded can be limited
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

P = ParamSpec("P")
Result = TypeVar("Result")


def one_blas_thread() -> threadpool_limits:
    """Context in which matrix products and decompositions give the same bits whatever the number of threads.

    BLAS adds up in an order that depends on its threads; fits amplify the last digit to 1e-3 of a weight.
    """
    return threadpool_limits(1)


def on_one_blas_thread(function: Callable[P, Result]) -> Callable[P, Result]:
    """Decorator: a function that runs in `one_blas_thread`, with whatever threads it starts."""

    @wraps(function)
    def limited(*args: P.args, **options: P.kwargs) -> Result:
        with one_blas_thread():
            return function(*args, **options)

    return limited


def in_order(array: NDArray[Any]) -> NDArray[Any]:
    """The array in C order and aligned, as `numpy` makes them; one that came over a network may be neither."""
    return np.require(array, requirements=["C", "A"])
