"""Apply a function to every take of a cohort with Dask, in threads or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from dask.base import compute
from dask.delayed import Delayed, delayed

from skindb.threads import c_contiguous

Result = TypeVar("Result")


def each_take(
    function: Callable[..., Result],
    cohort: xr.Dataset,
    variables: Iterable[str],
    *shared: Any,
) -> list[Result]:
    """Apply a function to every take of a cohort and return the results in the order of the takes.

    Parameters
    ----------
    function
        Called with the loaded Dataset of one take and with the shared values; its
        result should be small.
    cohort
        Dataset with the dimension ``take``.
    variables
        Names of the variables and coordinates that the function receives; names that
        the cohort lacks are ignored.
    shared
        Arrays, or Dask collections, that every call receives; the graph holds one copy of each.
    """
    names = [name for name in variables if name in cohort.variables]
    chosen = cohort[names]
    chosen = chosen.drop_vars(
        [name for name in chosen.coords if name not in names]
    )  # otherwise every task would hold them
    takes = [chosen.isel(take=i) for i in range(cohort.sizes["take"])]
    call = delayed(_InOrder(function), pure=False, traverse=False)
    once = [shared_once(value) for value in shared]
    return list(compute(*(call(value, *once) for value in takes)))  # type: ignore[no-untyped-call]


def each_item(function: Callable[[Any], Result], items: Iterable[Any]) -> list[Result]:
    """Apply a function to every item; the graph holds one copy of `function`."""
    call = delayed(_InOrder(function), pure=False, traverse=False)
    return list(compute(*(call(item) for item in items)))  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class _InOrder:
    """Call a function with arrays that are in C order and aligned in memory.

    Arrays from the store or the network may have another layout. NumPy and BLAS would
    then add in another order, and the last digits of results would depend on the
    scheduler.
    """

    function: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return self.function(*map(_in_order, arguments))


def _in_order(value: Any) -> Any:
    if isinstance(value, xr.Dataset):
        return value.map(
            lambda array: array.copy(data=c_contiguous(array.values)), keep_attrs=True
        )
    return c_contiguous(value) if isinstance(value, np.ndarray) else value


def shared_once(value: Any) -> Delayed:
    """Wrap a value so that a Dask graph holds one copy for all tasks; Dask collections
    are returned unchanged.
    """
    return (
        value
        if isinstance(value, Delayed)
        else delayed(value, pure=False, traverse=False)
    )
