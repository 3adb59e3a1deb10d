"""From arrays to labelled variables with the schema's dims, dtype and attributes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from skindb.schema.status import FitStatus, ProbeStatus, flag_attrs
from skindb.schema.variables import VARIABLES


def label(name: str, data: Any) -> xr.Variable:
    """The variable `name` around `data` (numpy or dask; dims, dtype, units and description from the schema)."""
    spec = VARIABLES[name]
    attrs: dict[str, object] = {"units": spec.units, "long_name": spec.doc, "source": spec.source}
    if name == "fit_status":
        attrs |= flag_attrs(FitStatus)
    if name == "site_status":
        attrs |= flag_attrs(ProbeStatus)
    array = data if hasattr(data, "dask") else np.asarray(data)
    return xr.Variable(spec.dims, array.astype(spec.dtype, copy=False), attrs)


def dataset(
    variables: Mapping[str, Any], *, coords: Mapping[str, Any] | None = None, attrs: Mapping[str, Any] | None = None
) -> xr.Dataset:
    """A Dataset of schema variables; `coords` maps a dim to its labels (strings are stored as variable-length text)."""
    index = {dim: np.asarray(values) for dim, values in (coords or {}).items()}
    text = np.dtypes.StringDType()
    index = {dim: values.astype(text) if values.dtype.kind in "UO" else values for dim, values in index.items()}
    return xr.Dataset({name: label(name, data) for name, data in variables.items()}, index, dict(attrs or {}))
