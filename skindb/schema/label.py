"""Labelled variables with the dims, dtype and attributes of the schema: made from arrays, and
checked where they are passed between packages; all faults are reported together.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from xarray import Dataset, DataTree, Variable

from skindb.errors import Fault, require, require_none
from skindb.schema.declaration import flag_attrs
from skindb.schema.variables import VARIABLES

BLOCK_SURFELS = 4096  # of a task of a fit; objects hold multiples of it
CHANNELS = ("R", "G", "B")
FACE = "face"  # every surfel of a take
# attributes of a capture that its models and their edits have too
TAKE_ATTRS = ("subject", "condition", "session", "traits", "consent_scope", "take")


def take_attrs(attrs: Mapping[Any, Any]) -> dict[Any, Any]:
    """The attributes of a version that describe its take."""
    return {name: attrs[name] for name in TAKE_ATTRS if name in attrs}


def label(name: str, data: Any) -> Variable:
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
    return Variable(spec.dims, array.astype(spec.dtype, copy=False), attrs)


def dataset(
    variables: Mapping[str, Any],
    *,
    coords: Mapping[str, Any] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> Dataset:
    """A Dataset of schema variables; `coords` maps a dim to its labels (strings become
    variable-length text).
    """
    index = {dim: text_labels(values) for dim, values in (coords or {}).items()}
    return Dataset(
        {name: label(name, data) for name, data in variables.items()},
        index,
        dict(attrs or {}),
    )


def text_labels(values: Any) -> np.ndarray[Any, Any]:
    """Labels as an array; strings as variable-length text, which zarr v3 can store."""
    array = np.asarray(values)
    return array.astype(np.dtypes.StringDType()) if array.dtype.kind in "UO" else array


def fitted_of(model: DataTree) -> Dataset:
    """The group "fitted" of a model; `InputError` if it is another version, such as a capture."""
    require(
        "fitted" in model.children,
        str(model.attrs.get("take", "version")),
        "must be a model, which has the group fitted",
        f"the groups {', '.join(model.children) or 'none'}",
        "fit the capture first, and read the model: db.read('model', take)",
    )
    return model["fitted"].to_dataset()


def check(ds: Dataset, names: Iterable[str], *, where: str = "dataset") -> None:
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
    require_none(faults)


def _faults(ds: Dataset, name: str, where: str) -> list[Fault]:
    spec = VARIABLES[name]
    place = f"{where}[{name}]"
    if name not in ds.variables:
        available = sorted(map(str, ds.variables)) or "nothing"
        rule = "variable is required"
        return [Fault(place, rule, f"only {available}", f"it is {spec.doc}")]
    variable = ds[name]
    units = variable.attrs.get("units")
    return [
        Fault(place, rule, str(finding), cure)
        for is_right, rule, finding, cure in (
            (
                variable.dims == spec.dims,
                f"dims must be {spec.dims}",
                variable.dims,
                "transpose or rename them",
            ),
            (
                np.can_cast(variable.dtype, spec.dtype, "same_kind"),
                f"dtype must be {spec.dtype}",
                variable.dtype,
                "convert it before the call",
            ),
            (
                units == spec.units,
                f"units must be {spec.units!r}",
                repr(units),
                "convert the values, then set attrs['units']",
            ),
        )
        if not is_right
    ]
