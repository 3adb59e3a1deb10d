"""A cohort as a table with one row for each value, for pandas, seaborn, statsmodels and R."""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd
from xarray import Dataset

from skindb.analysis.colour import colour_difference, propagated, typology_class
from skindb.analysis.quantities import (
    COLOUR_DIFFERENCE,
    REFLECTANCE,
    TYPOLOGY_ANGLE,
    Measurement,
    measurements,
)
from skindb.analysis.subjects import CONDITION, NORMAL, subjects_of
from skindb.errors import require
from skindb.schema.cohort import require_takes, visit_of
from skindb.types import Array, Index

KEYS = ("take", "subject", CONDITION, "visit", "repeat")
INTERCEPT = "Intercept"  # a term of every model
COLUMNS = (
    "quantity",
    "region",
    "channel",
    "value",
    "error",
    "common_error",
    "baseline",
    "unit",
    "status",
    "label",
)


def tidy(cohort: Dataset) -> pd.DataFrame:
    """One row for each take, region or probe site, channel and quantity.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.

    Returns
    -------
    DataFrame
        Columns take, subject, condition, visit and repeat; quantity; region, also for
        sites of the probe; channel (R, G, B, or missing); value, NaN where there is
        none to be trusted, in `unit`; `error`, its standard error without
        `common_error`, the errors of level and model, which are taken to be the same
        for all takes; `baseline`, the value of the subject's first take in the condition
        normal, NaN for the takes of that visit; status; label (the class of an individual
        typology angle); and each attribute of the captures, as ``attribute_<name>`` if
        it has the name of another column, or is called Intercept. Takes without a white
        target have R_d with the status "relative" and no colours.

        Quantities: those of `skindb.analysis.quantities.QUANTITIES`, of which colours are
        derived from R_d, see `skindb.analysis.colour`; and delta E, the CIEDE2000
        difference to the first take of the subject in the condition normal, which noise
        makes larger.

    Raises
    ------
    InputError
        If the cohort has another layout.

    Examples
    --------
    >>> frame = tidy(db.cohort("tables"))  # doctest: +SKIP
    >>> cheek = frame[(frame.quantity == "ITA") & (frame.region == "cheek")]  # doctest: +SKIP
    """
    require_takes(cohort, "tables")
    subjects = subjects_of(cohort)
    attributes = {
        f"attribute_{name}"
        if name in (*KEYS, *COLUMNS, INTERCEPT)
        else name: attribute.values
        for name, attribute in subjects.attributes.items()
        if name != CONDITION
    }
    visit, repeat = zip(*map(visit_of, subjects.take), strict=True)
    conditions = subjects.attribute(CONDITION).values
    keys = (subjects.take, subjects.subject, conditions, visit, repeat)
    takes = pd.DataFrame(dict(zip(KEYS, keys, strict=True)) | attributes)
    measured = measurements(cohort)
    require(
        measured,
        "cohort",
        "must have regions or probe sites",
        "neither",
        "add landmarks or a probe to the captures",
    )
    baseline = _baseline(takes)
    compared = [*measured, *_differences(measured, baseline)]
    visits = takes["visit"].to_numpy()
    is_first = (takes[CONDITION] == NORMAL) & (visits == visits[baseline])
    before = np.where(is_first, -1, baseline)
    rows = [_rows(one, before) for one in compared]
    table = takes.merge(pd.concat(rows), left_index=True, right_index=True)
    return table[[*KEYS, *COLUMNS, *attributes]].reset_index(drop=True)


def _baseline(takes: pd.DataFrame) -> Index:
    """Number (take,) of the first take of each subject in the condition normal, or -1."""
    normal = takes[takes[CONDITION] == NORMAL].sort_values(["visit", "repeat"])
    first = dict(zip(normal["subject"][::-1], normal.index[::-1], strict=True))
    return np.array([first.get(subject, -1) for subject in takes["subject"]])


def _rows(measured: Measurement, baseline: Index) -> pd.DataFrame:
    """Rows of a quantity, whose index is the number of the take; `baseline` is -1 for
    takes without.
    """
    quantity = measured.quantity
    labels = [*itertools.product(*measured.labels)]
    count = len(measured.values)
    values = measured.values.ravel()
    before = measured.values[baseline]
    before[baseline < 0] = np.nan
    is_angle = quantity.name == TYPOLOGY_ANGLE
    columns = (
        quantity.name,
        [label[0] for label in labels] * count,
        [label[1] if len(label) > 1 else None for label in labels] * count,
        values,
        measured.errors.ravel(),
        np.nan_to_num(measured.common.ravel()),
        before.ravel(),
        quantity.unit,
        measured.status.ravel(),
        [typology_class(value) if is_angle else "" for value in values.tolist()],
    )
    index = np.repeat(np.arange(count), len(labels))
    return pd.DataFrame(dict(zip(COLUMNS, columns, strict=True)), index)


def _differences(measured: list[Measurement], baseline: Index) -> Iterator[Measurement]:
    """Differences of colour to the first take of each subject in the condition normal."""
    reflectance = next((one for one in measured if one.quantity == REFLECTANCE), None)
    if reflectance is None:
        return
    is_own = baseline == np.arange(len(baseline))
    is_compared = (baseline >= 0) & ~is_own
    is_absolute = (reflectance.status != "relative").all(axis=(1, 2))
    is_compared &= is_absolute & is_absolute[baseline]
    before = reflectance.values[baseline]

    def change(now: Array) -> Array:
        return colour_difference(now, before)

    def change_of_baseline(then: Array) -> Array:
        return colour_difference(reflectance.values, then)

    nothing = np.zeros(before.shape[:-1])
    values = change(reflectance.values)
    errors = np.hypot(
        propagated(change, reflectance.values, reflectance.errors, nothing)[0],
        propagated(change_of_baseline, before, reflectance.errors[baseline], nothing)[
            0
        ],
    )
    values[~is_compared] = np.nan
    errors[~is_compared] = np.nan
    absent = np.where(is_compared, "missing", "no baseline")[:, None]
    absent = np.where(is_own[:, None], "baseline", absent)
    words = np.where(np.isfinite(values), "fitted", absent)
    yield Measurement(
        replace(REFLECTANCE, name=COLOUR_DIFFERENCE),
        reflectance.labels[:1],
        values,
        errors,
        nothing,
        nothing,
        words,
    )
