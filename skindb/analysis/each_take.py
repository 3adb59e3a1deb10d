"""Work on the takes of a cohort one by one, wherever Dask computes: in threads, or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from dask.base import compute
from dask.delayed import Delayed, delayed

from skindb._blas import c_contiguous

Result = TypeVar("Result")


def each_take(
    function: Callable[..., Result], cohort: xr.Dataset, variables: Iterable[str], *shared: Any
) -> list[Result]:
    """What a function returns for every take of a cohort, in their order.

    Parameters
    ----------
    function
        Called with the loaded Dataset of one take and with what is shared; it should return something small.
    cohort
        With the dimension ``take``.
    variables
        Names of the variables and coordinates that the function gets; those that the cohort lacks are omitted.
    shared
        Arrays, or Dask collections, that every call gets; each is in the graph once.
    """
    names = [name for name in variables if name in cohort.variables]
    asked = cohort[names]
    asked = asked.drop_vars([name for name in asked.coords if name not in names])  # they would be in every task
    takes = [asked.isel(take=i) for i in range(cohort.sizes["take"])]
    call, once = delayed(_InOrder(function), pure=False, traverse=False), [shared_once(one) for one in shared]
    return list(compute(*(call(one, *once) for one in takes)))  # type: ignore[no-untyped-call]


def each_item(function: Callable[[Any], Result], items: Iterable[Any]) -> list[Result]:
    """What a function returns for every item; `function` is in the graph once."""
    call = delayed(_InOrder(function), pure=False, traverse=False)
    return list(compute(*(call(one) for one in items)))  # type: ignore[no-untyped-call]


@dataclass(frozen=True)
class _InOrder:
    """Call a function with arrays in C order and aligned in memory, whatever came from the store or over the network.

    NumPy and BLAS add up in another order otherwise, so that last digits would depend on the engine.
    """

    function: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        """Call it."""
        return self.function(*map(_in_order, arguments))


def _in_order(value: Any) -> Any:
    if isinstance(value, xr.Dataset):
        return value.map(lambda one: one.copy(data=c_contiguous(one.values)), keep_attrs=True)
    return c_contiguous(value) if isinstance(value, np.ndarray) else value


def shared_once(value: Any) -> Delayed:
    """A value of which a Dask graph holds one copy for all tasks; Dask collections are returned unchanged."""
    return value if isinstance(value, Delayed) else delayed(value, pure=False, traverse=False)
