"""Checks of Datasets that are passed between packages; all faults are reported together."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema.variables import VARIABLES


def check(ds: xr.Dataset, names: Iterable[str], *, where: str = "dataset") -> None:
    """Raise `InputError` with every fault of the variables `names` in `ds` (absent,
    dims, dtype, units).

    Parameters
    ----------
    ds
        Dataset to look at; variables that are not named are ignored.
    names
        Variables that must be there, each declared in the schema.
    where
        What the user knows this Dataset by.
    """
    faults = [fault for name in names for fault in _faults(ds, name, where)]
    if faults:
        raise InputError(faults)


def _faults(ds: xr.Dataset, name: str, where: str) -> list[Fault]:
    spec = VARIABLES[name]
    place = f"{where}[{name}]"
    if name not in ds.variables:
        return [
            Fault(
                place,
                "variable is required",
                f"only {sorted(map(str, ds.variables)) or 'nothing'}",
                f"it is {spec.doc}",
            )
        ]
    var = ds[name]
    faults = []
    if var.dims != spec.dims:
        faults.append(
            Fault(
                place,
                f"dims must be {spec.dims}",
                str(var.dims),
                "transpose or rename them",
            )
        )
    if not np.can_cast(var.dtype, spec.dtype, "same_kind"):
        faults.append(
            Fault(
                place,
                f"dtype must be {spec.dtype}",
                str(var.dtype),
                "convert it before the call",
            )
        )
    if var.attrs.get("units") != spec.units:
        faults.append(
            Fault(
                place,
                f"units must be {spec.units!r}",
                repr(var.attrs.get("units")),
                "convert the values, then set attrs['units']",
            )
        )
    return faults
