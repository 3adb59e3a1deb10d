"""The quantities that studies compare: one record each, and their values for takes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from xarray import DataArray, Dataset

from skindb.analysis.colour import (
    cielab,
    erythema_index,
    melanin_index,
    propagated,
    typology_angle,
)
from skindb.analysis.roughness import MAX_SPACING
from skindb.analysis.subjects import LEVEL, level_error
from skindb.errors import Fault, InputError, require
from skindb.geometry.mesh import lattice_spacing
from skindb.numerics.statistics import Moments, known_mean
from skindb.schema import IDENTIFIED, VARIABLES, ProbeStatus, variables
from skindb.schema.label import CHANNELS
from skindb.schema.notes import Note, note
from skindb.types import AnyArray, Array, Index, Mask, float64

NORMAL_95 = 1.96
RELATIVE = "fit_relative_reflectance"  # coordinate, 1 without a white target
MIN_SUBJECTS = 3  # for a variance between or within subjects
# Coarsest over finest spacing of surfels of takes that are studied without a note. Ingest
# reaches the requested spacing within 2 %, unless a scan is finer.
MAX_SPACING_RATIO = 1.3
SPACING = (variables.REGION_AREA, variables.REGION_SURFELS)
# ends of the names of standard errors, without what takes have in common and with it
ERRORS = ("_error", "_total_error")
SURFACE = "surface reflectance"
TYPOLOGY_ANGLE = "ITA"
COLOUR_DIFFERENCE = "delta E"


@dataclass(frozen=True)
class Quantity:
    """A quantity of skin: the variables of tables and of maps that hold it."""

    name: str
    tabulated: str
    mapped: str = ""  # empty for quantities of regions alone
    unit: str = "1"
    is_log: bool = (
        False  # whether logarithms are compared, so that intervals stay positive
    )
    has_common_error: bool = (
        False  # whether all takes have the error of the level in common
    )
    # function of R_d (..., channel), for quantities that are derived from it
    derive: Callable[[Array], Array] | None = None

    @property
    def dims(self) -> tuple[str, ...]:
        """Dims of the table, after the take."""
        dims = VARIABLES[self.tabulated].dims
        return dims if self.derive is None else dims[:-1]

    def compared(self, values: Array) -> Array:
        """The variable's values (..., channel) as they are compared: derived, or
        logarithms of positive ones.
        """
        if self.derive is not None:
            return self.derive(values)
        if self.is_log:
            values = np.log(np.where(values > 0, values, np.nan))
        return values


REFLECTANCE = Quantity(
    "R_d",
    variables.REGION_DIFFUSE_REFLECTANCE,
    variables.TEXEL_DIFFUSE_REFLECTANCE,
    has_common_error=True,
)
MEASURED = (
    REFLECTANCE,
    Quantity(
        SURFACE,
        variables.REGION_SURFACE_REFLECTANCE,
        variables.TEXEL_SURFACE_REFLECTANCE,
    ),
    Quantity(
        "sigma_tr",
        variables.SITE_SIGMA_TR,
        variables.TEXEL_SIGMA_TR,
        unit="mm-1",
        is_log=True,
    ),
)
GLOSSINESS = Quantity(
    "glossiness", variables.REGION_GLOSSINESS, variables.TEXEL_GLOSSINESS
)
ROUGHNESS = (
    Quantity("albedo contrast", variables.REGION_ALBEDO_CONTRAST),
    Quantity("RMS slope", variables.REGION_NORMAL_SLOPE),
)


def _of_lab(index: int, reflectance: Array) -> Array:
    return cielab(reflectance)[..., index]


DERIVED: dict[str, tuple[str, Callable[[Array], Array]]] = {
    "L*": ("1", partial(_of_lab, 0)),
    "a*": ("1", partial(_of_lab, 1)),
    "b*": ("1", partial(_of_lab, 2)),
    TYPOLOGY_ANGLE: ("degree", typology_angle),
    "melanin index": ("1", melanin_index),
    "erythema index": ("1", erythema_index),
}
QUANTITIES = {
    quantity.name: quantity
    for quantity in (
        *MEASURED,
        GLOSSINESS,
        *ROUGHNESS,
        *(
            replace(REFLECTANCE, name=name, unit=unit, derive=derive)
            for name, (unit, derive) in DERIVED.items()
        ),
    )
}
DEFAULT = tuple(quantity.name for quantity in MEASURED)  # quantities of comparisons


class Measurement(NamedTuple):
    """A quantity of the takes of a cohort."""

    quantity: Quantity
    labels: list[list[str]]  # of each dim after the take
    values: Array  # (take, ...) NaN where there is no value, or none to be trusted
    errors: Array  # (take, ...) standard errors, without `common`
    common: Array  # (take, ...) standard errors that the takes have in common
    level: Array  # (take, ...) the part of `common` that is due to the level of R_d
    status: AnyArray  # (take, ...) words


@dataclass(frozen=True)
class Quantities:
    """Measured values of takes or of subjects."""

    values: Array  # (n, q) as they are compared; NaN where there is no value
    subject: tuple[str, ...]  # (n,) names of the subjects
    # (q,) for example "R_d face G"; of texels one for all
    names: tuple[str, ...] = ("",)
    is_log: tuple[bool, ...] = ()  # (q,)
    # (q,) half-width of the 95 % interval of an error that all takes have in common
    common: tuple[float, ...] = (0.0,)
    # (n, q) standard errors of the values, without what all takes have in common
    errors: Array | None = None

    def of_subjects(self, names: Iterable[str] = ()) -> Quantities:
        """Means over the takes of every subject, by default of all."""
        names = tuple(names) or tuple(dict.fromkeys(self.subject))
        takes = [
            np.array([name == subject for subject in self.subject]) for name in names
        ]
        values = np.stack([known_mean(self.values[rows]) for rows in takes])
        repeated = within_deviation(self.values, self.subject)
        errors = self.errors
        if errors is not None or np.isfinite(repeated).any():
            count = np.stack(
                [np.isfinite(self.values[rows]).sum(axis=0) for rows in takes]
            )
            repeated = repeated / np.sqrt(np.maximum(count, 1))
            stated: Array | float = np.nan
            if errors is not None:
                stated = np.stack([mean_error(errors[rows]) for rows in takes])
            errors = np.fmax(stated, repeated)
        return replace(self, values=values, subject=names, errors=errors)

    def reliability(self, of_changes: bool) -> Array:
        """Fraction (q,) of the variance between these subjects, or of the mean square of
        changes within them, that their errors leave; NaN without errors or for fewer
        than three subjects.
        """
        if self.errors is None:
            return np.full(self.values.shape[1], np.nan)
        moments = Moments.of(self.values)
        # a change of all subjects by the same amount is not an error; the mean square does
        # not depend on signs, so that those that permutations change decide no p value
        total = known_mean(self.values**2) if of_changes else moments.variance
        error = known_mean(np.where(np.isfinite(self.values), self.errors, np.nan) ** 2)
        is_known = (moments.count >= MIN_SUBJECTS) & (total > 0)
        return np.maximum(1 - error / np.where(is_known, total, np.nan), 0.0)

    def select(self, rows: Sequence[int] | Index) -> Quantities:
        """The quantities of the takes or subjects with these indices."""
        subject = tuple(self.subject[i] for i in rows)
        errors = None if self.errors is None else self.errors[rows]
        return replace(self, values=self.values[rows], subject=subject, errors=errors)


def mean_error(errors: Array) -> Array:
    """Standard error of the mean of values with independent errors (n, ...)."""
    count = np.isfinite(errors).sum(axis=0)
    return np.asarray(np.sqrt(known_mean(errors**2) / np.maximum(count, 1)))


def within_deviation(values: Array, subject: Sequence[str]) -> Array:
    """Standard deviation (...) of the takes of one subject, from values (n, ...); NaN where
    fewer than three subjects have two.
    """
    second, free, repeated = np.zeros((3, *values.shape[1:]))
    names = np.array(subject)
    for name in dict.fromkeys(subject):
        if (names == name).sum() > 1:
            moments = Moments.of(values[names == name])
            second += moments.second
            free += np.maximum(moments.count - 1, 0)
            repeated += moments.count > 1
    variance = second / np.maximum(free, 1)
    return np.where(repeated >= MIN_SUBJECTS, np.sqrt(variance), np.nan)


def take_spacing(tables: Dataset) -> Array:
    """Distance (take,) of neighbouring trusted surfels [mm]; NaN for takes without."""
    area, count = (tables[name].sum("region").values for name in SPACING)
    return lattice_spacing(area / np.where(count > 0, count, np.nan))


def spacing_notes(tables: Dataset) -> list[Note]:
    """A note if the spacings of the surfels differ between the takes of a cohort."""
    spacing = take_spacing(tables)
    if np.isnan(spacing).all():
        return []
    finest, coarsest = np.nanargmin(spacing), np.nanargmax(spacing)
    if spacing[coarsest] <= MAX_SPACING_RATIO * spacing[finest]:
        return []
    low, high = (f"{spacing[i]:.2g} mm" for i in (finest, coarsest))
    takes = tables["take"].values
    named = f"{low} apart in {takes[finest]} and {high} in {takes[coarsest]}"
    cure = f"ingest the takes again with --spacing {spacing[finest]:.2g}"
    return [note("", f"surfels are {named}: {cure}")]


def trusted(takes: Dataset, variable: str) -> DataArray:
    """A variable of probe sites; NaN where the profile does not determine sigma_tr."""
    return takes[variable].where(takes[variables.SITE_STATUS].isin(IDENTIFIED))


def chosen_quantities(names: Sequence[str]) -> tuple[Quantity, ...]:
    """The quantities of these names, by default the measured ones.

    Raises
    ------
    InputError
        For an unknown name.
    """
    if unknown := [name for name in names if name not in QUANTITIES]:
        cure = f"choose from: {', '.join(QUANTITIES)}"
        rule = "must be known"
        raise InputError(
            Fault(f"quantity {name}", rule, "another name", cure) for name in unknown
        )
    return tuple(QUANTITIES[name] for name in names or DEFAULT)


def measurements(
    cohort: Dataset, names: Sequence[str] = tuple(QUANTITIES)
) -> list[Measurement]:
    """The quantities that a cohort has, with their errors.

    Errors of derived quantities are propagated to first order from those of R_d, which
    are independent between channels, and from the error of its level, which they share.
    Takes without a white target have no colours, and R_d has the status "relative".

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    names
        Of the quantities.
    """
    level = np.zeros(cohort.sizes["take"])
    if LEVEL in cohort.coords:
        level = np.nan_to_num(cohort[LEVEL].values.astype(float))
    quantities = chosen_quantities(names)
    needed = {variables.SITE_STATUS, *SPACING}
    needed |= {f"{x.tabulated}{end}" for x in quantities for end in ("", *ERRORS)}
    tables = cohort[[name for name in cohort if name in needed]].load()
    relative = is_relative(cohort)
    return [
        _measured(tables, quantity, level, relative)
        for quantity in quantities
        if quantity.tabulated in tables
    ]


def is_relative(cohort: Dataset) -> Mask:
    """Whether each take (take,) has no white target, so that R_d has an unknown scale."""
    if RELATIVE not in cohort.coords:
        return np.zeros(cohort.sizes["take"], bool)
    return np.array([value == 1 for value in cohort[RELATIVE].values.tolist()], bool)


def _measured(
    tables: Dataset, quantity: Quantity, level: Array, relative: Mask
) -> Measurement:
    """A quantity of the takes whose levels have the errors `level` (take,)."""
    is_site = "site" in quantity.dims
    dims = ["take", *quantity.dims]
    if quantity.derive is not None:
        dims.append("channel")
    select = trusted if is_site else Dataset.__getitem__
    values: Array = float64(select(tables, quantity.tabulated).transpose(*dims).values)
    names = [f"{quantity.tabulated}{end}" for end in ERRORS]
    errors: list[Array] = [
        float64(tables[name].transpose(*dims).values)
        for name in names
        if name in tables
    ] or [np.full_like(values, np.nan)]
    error = errors[0]
    total = errors[-1]
    of_level: Array = np.zeros_like(values)
    if quantity.has_common_error:
        of_level = of_level + level.reshape(-1, *[1] * (values.ndim - 1))
    # what averaging over surfels does not remove: the level and the model of the fit
    model = np.nan_to_num(np.sqrt(np.maximum(total**2 - error**2 - of_level**2, 0)))
    if quantity.derive is not None:
        reflectance = values.copy()
        reflectance[relative] = np.nan
        values = quantity.derive(reflectance)
        propagate = partial(propagated, quantity.derive, reflectance)
        error, of_level = propagate(error, of_level[..., 0])
        model, _ = propagate(model, np.zeros_like(values))
    common = np.hypot(of_level, model)
    status = np.where(np.isfinite(values), "fitted", "missing").astype(object)
    if quantity.tabulated == REFLECTANCE.tabulated:
        status[relative] = "relative"
    if quantity in ROUGHNESS:
        status[take_spacing(tables) > MAX_SPACING] = "surfels too far apart"
    if is_site:
        words = {int(one): one.name.lower() for one in ProbeStatus}
        codes = tables[variables.SITE_STATUS].transpose(*dims).values
        status = np.vectorize(words.get, otypes=[object])(codes)
    labels = [
        list(CHANNELS) if dim == "channel" else tables[dim].values.tolist()
        for dim in quantity.dims
    ]
    return Measurement(quantity, labels, values, error, common, of_level, status)


def quantities_of(cohort: Dataset, names: Sequence[str] = ()) -> Quantities:
    """Quantities of regions and probe sites as they are compared, for every take.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    names
        Of the quantities; default albedo, surface reflectance and sigma_tr.

    Raises
    ------
    InputError
        If a name is unknown, or no take has any of these quantities.
    """
    half_width = NORMAL_95 * float(np.nan_to_num(level_error(cohort)))
    columns = []
    errors = []
    described = []
    for measured in measurements(cohort, names or DEFAULT):
        quantity = measured.quantity
        count = len(measured.values)
        values = measured.values
        error = measured.errors
        if quantity.is_log:
            error = error / values
            values = quantity.compared(values)
        level = np.nan_to_num(measured.level).reshape(count, -1)
        half_widths = (
            NORMAL_95 * level.max(axis=0, initial=0.0)
            if quantity.derive is not None
            else np.full(level.shape[1], half_width * quantity.has_common_error)
        )
        for words, column, deviation, width in zip(
            itertools.product(*measured.labels),
            values.reshape(count, -1).T,
            error.reshape(count, -1).T,
            half_widths,
            strict=True,
        ):
            if np.isfinite(column).any():
                columns.append(column)
                errors.append(deviation)
                name = " ".join([quantity.name, *map(str, words)])
                described.append((name, quantity.is_log, float(width)))
    require(
        columns,
        "population",
        f"some take must have {' or '.join(names or DEFAULT)}",
        "none of them",
        f"ingest the takes with a --spacing below {MAX_SPACING:g}"
        if {quantity.name for quantity in ROUGHNESS} & {*names}
        else "fit the takes again",
    )
    subject = tuple(map(str, cohort["subject"].values))
    labels, is_log, commons = zip(*described, strict=True)
    return Quantities(
        np.stack(columns, axis=1),
        subject,
        labels,
        is_log,
        commons,
        np.stack(errors, axis=1),
    )
