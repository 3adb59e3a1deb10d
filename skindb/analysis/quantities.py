"""The quantities that studies compare: one record each, and their values for takes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from xarray import DataArray, Dataset

from skindb.analysis.subjects import level_error
from skindb.errors import require
from skindb.numerics.statistics import known_mean
from skindb.schema import IDENTIFIED, variables
from skindb.schema.label import CHANNELS
from skindb.types import Array, Index, float64

NORMAL_95 = 1.96


@dataclass(frozen=True)
class Quantity:
    """A quantity of skin: the variables of tables and of maps that hold it."""

    name: str
    tabulated: str
    mapped: str
    dims: tuple[str, ...]  # of the table, after the take
    is_log: bool = (
        False  # whether logarithms are compared, so that intervals stay positive
    )
    has_common_error: bool = (
        False  # whether all takes have the error of the level in common
    )

    def compared(self, values: Array) -> Array:
        """The values as they are compared; logarithms of positive ones."""
        return np.log(np.where(values > 0, values, np.nan)) if self.is_log else values


SURFACE = "surface reflectance"
QUANTITIES = (
    Quantity(
        "R_d",
        variables.REGION_DIFFUSE_REFLECTANCE,
        variables.TEXEL_DIFFUSE_REFLECTANCE,
        ("region", "channel"),
        has_common_error=True,
    ),
    Quantity(
        SURFACE,
        variables.REGION_SURFACE_REFLECTANCE,
        variables.TEXEL_SURFACE_REFLECTANCE,
        ("region",),
    ),
    Quantity(
        "sigma_tr",
        variables.SITE_SIGMA_TR,
        variables.TEXEL_SIGMA_TR,
        ("site", "channel"),
        is_log=True,
    ),
)


@dataclass(frozen=True)
class Quantities:
    """Measured values of takes or of subjects."""

    values: Array  # (n, q) as they are compared; NaN where there is no value
    subject: tuple[str, ...]  # (n,) names of the subjects
    names: tuple[str, ...] = ()  # (q,) for example "R_d face G"; none of texels
    is_log: tuple[bool, ...] = ()  # (q,)
    # (q,) half-width of the 95 % interval of an error that all takes have in common
    common: tuple[float, ...] = ()

    def of_subjects(self, names: Iterable[str] = ()) -> Quantities:
        """Means over the takes of every subject, by default of all."""
        names = tuple(names) or tuple(dict.fromkeys(self.subject))
        takes = [
            np.array([name == subject for subject in self.subject]) for name in names
        ]
        values = np.stack([known_mean(self.values[rows]) for rows in takes])
        return replace(self, values=values, subject=names)

    def select(self, rows: Sequence[int] | Index) -> Quantities:
        """The quantities of the takes or subjects with these indices."""
        subject = tuple(self.subject[i] for i in rows)
        return replace(self, values=self.values[rows], subject=subject)


def trusted(takes: Dataset, variable: str) -> DataArray:
    """A variable of probe sites; NaN where the profile does not determine sigma_tr."""
    return takes[variable].where(takes[variables.SITE_STATUS].isin(IDENTIFIED))


def quantities_of(cohort: Dataset) -> Quantities:
    """Albedo and surface reflectance of regions and log sigma_tr of probe sites, for every take.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.

    Raises
    ------
    InputError
        If no take has any of these quantities.
    """
    prefixes = ("region_", "site_")
    tables = cohort[[name for name in cohort if str(name).startswith(prefixes)]].load()
    half_width = NORMAL_95 * float(np.nan_to_num(level_error(cohort)))
    columns: list[Array] = []
    described: list[tuple[str, bool, float]] = []
    for quantity in QUANTITIES:
        if quantity.tabulated not in tables:
            continue
        is_site = "site" in quantity.dims
        select = trusted if is_site else Dataset.__getitem__
        table = select(tables, quantity.tabulated).transpose("take", *quantity.dims)
        values = quantity.compared(float64(table.values)).reshape(len(table), -1)
        labels = [
            CHANNELS if dim == "channel" else tables[dim].values
            for dim in quantity.dims
        ]
        common = half_width if quantity.has_common_error else 0.0
        for words, column in zip(itertools.product(*labels), values.T, strict=True):
            if np.isfinite(column).any():
                columns.append(column)
                name = " ".join([quantity.name, *map(str, words)])
                described.append((name, quantity.is_log, common))
    require(
        columns,
        "population",
        "some take must have albedo, surface reflectance or sigma_tr",
        "none of them",
        "fit the takes again",
    )
    subject = tuple(map(str, cohort["subject"].values))
    names, is_log, commons = zip(*described, strict=True)
    return Quantities(np.stack(columns, axis=1), subject, names, is_log, commons)
