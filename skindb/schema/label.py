"""From arrays to labelled variables with the dims, dtype and attributes of the schema."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from skindb.schema.status import flag_attrs
from skindb.schema.variables import VARIABLES

# attributes of a capture that its models and their edits have too
TAKE_ATTRS = ("subject", "condition", "session", "traits", "consent_scope", "take")


def take_attrs(attrs: Mapping[Any, Any]) -> dict[Any, Any]:
    """The attributes of a version that describe its take."""
    return {name: attrs[name] for name in TAKE_ATTRS if name in attrs}


def label(name: str, data: Any) -> xr.Variable:
    """The variable `name` around `data` (numpy or dask); dims, dtype, units and
    description are the schema's.

    Raises
    ------
    ValueError
        If the schema does not declare it.
    """
    if name not in VARIABLES:
        raise ValueError(f"variable {name!r} is not declared in skindb/schema")
    spec = VARIABLES[name]
    attrs: dict[str, object] = {
        "units": spec.units,
        "long_name": spec.doc,
        "source": spec.source,
    }
    if spec.statuses is not None:
        attrs |= flag_attrs(spec.statuses)
    array = data if hasattr(data, "dask") else np.asarray(data)
    return xr.Variable(spec.dims, array.astype(spec.dtype, copy=False), attrs)


def dataset(
    variables: Mapping[str, Any],
    *,
    coords: Mapping[str, Any] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """A Dataset of schema variables; `coords` maps a dim to its labels (strings become
    variable-length text).
    """
    index = {dim: text_labels(values) for dim, values in (coords or {}).items()}
    return xr.Dataset(
        {name: label(name, data) for name, data in variables.items()},
        index,
        dict(attrs or {}),
    )


def text_labels(values: Any) -> np.ndarray[Any, Any]:
    """Labels as an array; strings as variable-length text, which zarr v3 can store."""
    array = np.asarray(values)
    return array.astype(np.dtypes.StringDType()) if array.dtype.kind in "UO" else array
