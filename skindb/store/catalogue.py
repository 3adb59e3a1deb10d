"""The catalogue with one row per take, and queries on it."""

from __future__ import annotations

from typing import Any

import pandas as pd

from skindb.errors import Fault, InputError
from skindb.schema.cohort import column, take_coords
from skindb.store.known import Known
from skindb.store.record import Record

CATALOGUE_KINDS = ("capture", "model", "registration")  # kinds whose generation and date the catalogue shows


def table(known: Known) -> pd.DataFrame:
    """See `Database.table`."""
    takes = sorted(take for take in known.takes("capture") | known.takes("model") if not known.is_withdrawn(take))
    rows = {take: _row(known, take) for take in takes}
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    columns = {name: column([row.get(name) for row in rows.values()]) for name in names}
    frame = pd.DataFrame(columns, index=pd.Index(list(rows), name="take"))
    for kind in CATALOGUE_KINDS:
        if (name := f"{kind}_created") in frame:
            dates = pd.to_datetime([row.get(name) for row in rows.values()], utc=True, errors="coerce")
            frame[name] = dates.tz_localize(None)  # UTC without a time zone, so that queries can compare dates
    return frame


def matching(frame: pd.DataFrame, where: str) -> list[str]:
    """Takes whose rows fulfil a condition.

    Parameters
    ----------
    frame
        From `table`.
    where
        Condition in the syntax of `pandas.DataFrame.eval`, for example ``condition == 'lotion' and age > 40``.

    Raises
    ------
    InputError
        If the condition cannot be evaluated, or is not true or false for every take.
    """
    rule = "a condition must compare columns of the catalogue"
    cure = f"columns: {', '.join(map(str, ['take', *frame]))}"
    if "@" in where or "__" in where:
        raise InputError(Fault("where", rule, repr(where), cure))
    try:
        found = frame.eval(where)
    except Exception as error:  # noqa: BLE001  a condition can raise any error of pandas
        raise InputError(Fault("where", rule, f"{where!r}: {error}", cure)) from None
    if not isinstance(found, pd.Series) or found.dtype != bool or len(found) != len(frame):
        raise InputError(Fault("where", rule, f"{where!r}, whose result is not true or false for every take", cure))
    return [str(take) for take in frame.index[found.to_numpy()]]


def _row(known: Known, take: str) -> dict[str, Any]:
    records = {kind: known.record(kind, take) for kind in CATALOGUE_KINDS if known.has(kind, take)}
    model = records.get("model")
    row = take_coords(take, known.about(take), None if model is None else model.about)
    row |= {f"{kind}_generation": records[kind].generation if kind in records else None for kind in CATALOGUE_KINDS}
    row |= {f"{kind}_created": record.created for kind, record in records.items()}
    row["consent"] = ", ".join(known.scope(take))
    if model is not None:
        row |= {f"status_{name}": part for name, part in model.provenance.get("status", {}).items()}
        row["outdated"] = _is_outdated(model, records.get("capture"))
    return row


def _is_outdated(model: Record, capture: Record | None) -> bool:
    """Whether there is a newer capture than that from which a model was made."""
    made_from = [one["generation"] for one in model.made_from if one["kind"] == "capture"]
    return capture is not None and bool(made_from) and capture.generation not in made_from
