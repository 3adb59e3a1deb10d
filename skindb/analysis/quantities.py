"""Tables of the measured quantities of takes and subjects; the unit of inference is the subject."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from skindb.analysis.members import AGE, CONDITION, attributes, texts
from skindb.errors import Fault, InputError
from skindb.numerics.statistics import known_mean
from skindb.schema import IDENTIFIED
from skindb.types import Array, Mask

CHANNELS = ("R", "G", "B")
SURFACE = "surface reflectance"
MAX_AGE = 130  # years


@dataclass(frozen=True)
class Quantities:
    """Measured values of takes or of subjects."""

    names: tuple[str, ...]  # for example "R_d face G"
    values: Array  # (n, q) NaN where there is no value; logarithms where `is_log`
    # (n, q) standard errors that are independent between takes; NaN where none is
    # stated
    errors: Array
    # (q,) whether logarithms are compared, so that intervals stay positive
    is_log: Mask
    # (q,) limit of a bias to higher values that all takes have in common; 0 where there
    # is none
    common: Array
    subject: tuple[str, ...]  # (n,) names of the subjects

    def of_subjects(self) -> Quantities:
        """Means over the takes of every subject."""
        names = list(dict.fromkeys(self.subject))
        rows = [np.array([one == name for one in self.subject]) for name in names]
        values = np.stack([known_mean(self.values[own]) for own in rows])
        squares = np.stack(
            [known_mean(self.errors[own] ** 2) / max(own.sum(), 1) for own in rows]
        )
        return replace(
            self, values=values, errors=np.sqrt(squares), subject=tuple(names)
        )

    def of_takes(self, rows: Mask) -> Quantities:
        """The quantities of the selected takes."""
        subject = tuple(
            one for one, kept in zip(self.subject, rows.tolist(), strict=True) if kept
        )
        return replace(
            self, values=self.values[rows], errors=self.errors[rows], subject=subject
        )


def quantities_of(cohort: xr.Dataset) -> Quantities:
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
    limit = 0.0
    if (
        "fit_even_reflection" in cohort.coords
        and np.isfinite(cohort["fit_even_reflection"].values.astype(float)).any()
    ):
        limit = float(np.nanmax(cohort["fit_even_reflection"].values.astype(float)))
    names: list[str] = []
    columns: list[tuple[Array, Array, bool, float]] = []

    def add(
        prefix: str,
        variable: str,
        dims: tuple[str, ...],
        *,
        is_log: bool = False,
        common: float = 0.0,
    ) -> None:
        if variable not in cohort:
            return
        values = np.asarray(
            cohort[variable].transpose("take", *dims).values, np.float64
        )
        known = f"{variable}_error" in cohort
        errors = (
            np.asarray(cohort[f"{variable}_error"].transpose("take", *dims).values)
            if known
            else values * np.nan
        )
        if is_log:
            good = cohort["site_status"].isin(IDENTIFIED).transpose(
                "take", *dims[:-1], "channel"
            ).values & (values > 0)
            errors = np.where(good, errors / np.where(good, values, 1.0), np.nan)
            values = np.where(good, np.log(np.where(good, values, 1.0)), np.nan)
        for index in np.ndindex(values.shape[1:]):
            there = [
                CHANNELS if dim == "channel" else cohort[dim].values for dim in dims
            ]
            names.append(
                " ".join(
                    [
                        prefix,
                        *(str(one[i]) for one, i in zip(there, index, strict=True)),
                    ]
                )
            )
            columns.append((values[:, *index], errors[:, *index], is_log, common))

    cohort = cohort[
        [name for name in cohort if str(name).startswith(("region_", "site_"))]
    ].load()
    add("R_d", "region_diffuse_reflectance", ("region", "channel"), common=limit)
    add(SURFACE, "region_surface_reflectance", ("region",))
    add("sigma_tr", "site_sigma_tr", ("site", "channel"), is_log=True)
    kept = [i for i, column in enumerate(columns) if np.isfinite(column[0]).any()]
    if not kept:
        rule = "some take must have albedo, surface reflectance or sigma_tr"
        raise InputError(
            Fault("population", rule, "none of them", "fit the takes again")
        )
    values, errors, is_log, common = zip(*(columns[i] for i in kept), strict=True)
    subject = tuple(str(one) for one in texts(cohort["subject"]))
    stacked = np.stack(values, axis=1), np.stack(errors, axis=1)
    return Quantities(
        tuple(names[i] for i in kept),
        *stacked,
        np.array(is_log),
        np.array(common),
        subject,
    )


def attribute_of_subjects(
    cohort: xr.Dataset, name: str, subjects: tuple[str, ...]
) -> list[object]:
    """Value of an attribute for each subject, from the first take that has it; None
    where no take has it.
    """
    coord = attributes(cohort)[name]
    found: dict[str | None, object] = {}
    for subject, one, text in zip(
        texts(cohort["subject"]), coord.values.tolist(), texts(coord), strict=True
    ):
        if text is not None:
            found.setdefault(subject, one)
    return [found.get(subject) for subject in subjects]


def require_adjustable(
    cohort: xr.Dataset, adjust: Sequence[str], own: str = ""
) -> None:
    """Raise `InputError` if a name in `adjust` is not an attribute, or is the compared
    attribute `own`.
    """
    able = set(attributes(cohort)) - {CONDITION, own}
    if unknown := [name for name in adjust if name not in able]:
        rule = "must be an attribute other than the compared one"
        found = "an unknown name"
        cure = f"choose from: {', '.join(sorted(able)) or 'none'}"
        raise InputError(Fault(f"adjust {name}", rule, found, cure) for name in unknown)


def require_one_kind(name: str, values: list[object]) -> None:
    """Raise `InputError` if some values of an attribute are numbers and others are words."""
    if words := _odd_words(values):
        found = f"numbers and {', '.join(map(repr, words[:3]))}"
        cure = "correct the traits in capture.json and ingest again"
        raise InputError(
            Fault(
                f"attribute {name}",
                "must be a number for all subjects or a word for all",
                found,
                cure,
            )
        )


def attribute_notes(name: str, values: list[object]) -> list[str]:
    """Lines about values of an attribute that are likely to be mistakes."""
    notes = []
    if words := _odd_words(values):
        notes.append(
            f"{name}: numbers and {', '.join(map(repr, words[:3]))}; it is not compared"
        )
    spellings: dict[str, set[str]] = {}
    for one in values:
        if isinstance(one, str):
            spellings.setdefault(one.strip().casefold(), set()).add(one)
    alike = [
        " and ".join(map(repr, sorted(same)))
        for same in spellings.values()
        if len(same) > 1
    ]
    notes += [f"{name}: {words} count as different values" for words in alike]
    if name == AGE and (
        odd := sorted(
            {str(one) for one in values if _is_finite(one) and not is_age(one)}
        )
    ):
        notes.append(
            f"{name}: must be in years, from 0 to {MAX_AGE}; found {', '.join(odd[:3])}"
        )
    return notes


def is_age(value: object) -> bool:
    """Whether a value is an age in years."""
    return _is_finite(value) and 0 <= float(str(value)) <= MAX_AGE


def _is_finite(value: object) -> bool:
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and bool(np.isfinite(value))
    )


def attribute_has_two_kinds(values: list[object]) -> bool:
    """Whether some values of an attribute are numbers and others are words."""
    return bool(_odd_words(values))


def _odd_words(values: list[object]) -> list[str]:
    """Sorted values that are not numbers, if others are."""
    words = {str(one) for one in values if one is not None}
    others = {one for one in words if not _reads_as_number(one)}
    return sorted(others) if others != words else []


def _reads_as_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def is_number(values: list[object]) -> bool:
    """Whether an attribute is numeric: its values are numbers, of which more than two differ."""
    known = [one for one in values if one is not None]
    numbers = all(
        isinstance(one, int | float) and not isinstance(one, bool) for one in known
    )
    return numbers and len(set(known)) > 2


def columns_of(values: list[object]) -> Array:
    """Regression columns (n, c) of an attribute: a centred number, or indicators of all
    values except the first.

    NaN where the attribute is unknown.
    """
    known = np.array([one is not None for one in values])
    if is_number(values):
        numbers = np.array(
            [np.nan if one is None else float(str(one)) for one in values]
        )
        return np.asarray(numbers - np.nanmean(numbers))[:, None]
    words = sorted({str(one) for one in values if one is not None})
    columns = np.array(
        [[float(str(one) == word) for word in words[1:]] for one in values]
    ).reshape(len(values), -1)
    return np.where(known[:, None], columns, np.nan)
