"""The catalogue with one row per take, and queries on it."""

import warnings
from collections.abc import Iterable

import pandas as pd

from skindb.errors import InputError, SkindbWarning, few_names
from skindb.files import Json
from skindb.schema.cohort import column, imitates_column, take_coords
from skindb.schema.consent import CONSENT, consent_scope
from skindb.store.condition import evaluate, is_missing
from skindb.store.entries import CACHED_KINDS
from skindb.store.place import CALIBRATION, RELEASE, STUDY, Located
from skindb.store.snapshot import Lookup, RecordCache
from skindb.store.stale import DERIVED, Staleness

# kinds whose generation and date the catalogue shows
CATALOGUE_KINDS = ("capture", "model", "registration")
# kinds without takes -> section of `Database.info` that lists them
INFO_SECTIONS = {
    STUDY: "studies",
    RELEASE: "releases",
    CALIBRATION: "calibrations",
    CONSENT: "consents",
}


class MissingWarning(SkindbWarning):
    """Takes are not selected because they lack an attribute that a condition compares."""


def table(lookup: Lookup) -> pd.DataFrame:
    """See `Database.table`."""
    takes = sorted(lookup.takes("capture") | lookup.takes("model"))
    rows = {take: _row(lookup, take) for take in takes}
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    columns = {name: column([row.get(name) for row in rows.values()]) for name in names}
    frame = pd.DataFrame(columns, index=pd.Index(list(rows), name="take"))
    for kind in CATALOGUE_KINDS:
        if (name := f"{kind}_created") in frame:
            dates = pd.to_datetime(
                [row.get(name) for row in rows.values()], utc=True, errors="coerce"
            )
            # UTC without a time zone, so that queries can compare dates
            frame[name] = dates.tz_localize(None)
    return frame


def matching(frame: pd.DataFrame, where: str) -> list[str]:
    """Takes whose rows fulfil a condition.

    Parameters
    ----------
    frame
        From `table`.
    where
        Condition, see `skindb.store.condition`, for example ``condition == 'lotion' and age > 40``.

    Raises
    ------
    InputError
        If the condition is not of this language, or does not fit the columns.

    Warns
    -----
    MissingWarning
        If takes are not selected because they lack an attribute that the condition compares.
    """
    columns = {
        str(name): values.tolist() for name, values in frame.reset_index().items()
    }
    truth, operands = evaluate(where, columns)
    takes = columns["take"]
    undecided = [row for row, is_true in enumerate(truth) if is_true is None]
    attributes = [name for name in operands if not imitates_column(name)]
    lacking = [
        name
        for name in attributes
        if any(is_missing(columns[name][row]) for row in undecided)
    ]
    if lacking:
        finding = (
            f"{len(undecided)} of {len(takes)} takes "
            f"({few_names([takes[row] for row in undecided])})"
        )
        name = lacking[0] if lacking[0].isidentifier() else f"`{lacking[0]}`"
        cure = f"add 'or {name} is missing' to select them"
        text = f"{finding} lack {' or '.join(lacking)} and are not selected by {where!r}; {cure}"
        warnings.warn(text, MissingWarning, stacklevel=3)
    return [take for take, is_true in zip(takes, truth, strict=True) if is_true]


def _row(lookup: Lookup, take: str) -> Json:
    records = {
        kind: lookup.record(kind, take)
        for kind in CATALOGUE_KINDS
        if lookup.has(kind, take)
    }
    model = records.get("model")
    row = take_coords(
        take, lookup.about(take), None if model is None else model.provenance
    )
    row |= {
        f"{kind}_generation": records[kind].generation if kind in records else None
        for kind in CATALOGUE_KINDS
    }
    row |= {f"{kind}_created": record.created for kind, record in records.items()}
    row["consent"] = ", ".join(lookup.scope(take))
    if model is not None:
        row |= {
            f"status_{name}": part
            for name, part in model.provenance.get("status", {}).items()
        }
        # whether there is a newer capture than that from which a model was made
        capture = records.get("capture")
        row["outdated"] = capture is not None and model.is_outdated(capture)
    return row


def cached_table(lookup: Lookup) -> pd.DataFrame:
    """The catalogue, for which records are read in parallel and kept in the cache."""
    lookup.read_ahead((*CATALOGUE_KINDS, CONSENT))
    rows = table(lookup)
    lookup.save()
    return rows


def describe_versions(
    db: Located, *, takes: Iterable[str] | None, where: str | None, release: str | None
) -> Json:
    """See `Database.info`."""
    sections: dict[str, Json] = {
        name: {} for name in ("takes", *INFO_SECTIONS.values())
    }
    cache = RecordCache(db.place)
    cached = Lookup(db, release, cache)
    lookup = Lookup(db, release)
    stale = Staleness(db, cache)
    chosen = None if takes is None else {*takes}
    if where is not None:
        fulfilling = {*matching(cached_table(cached), where)}
        chosen = fulfilling if chosen is None else chosen & fulfilling
    else:
        cached.read_ahead(CACHED_KINDS)
    for kind in cache.kinds():
        if chosen is not None and kind in INFO_SECTIONS:
            continue
        section = sections[INFO_SECTIONS.get(kind, "takes")]
        source = cached if kind in CACHED_KINDS else lookup
        names = cached.takes(kind)
        for take in sorted(names if chosen is None else names & chosen):
            section.setdefault(take, {})[kind] = _describe(source, stale, kind, take)
    cache.save()
    return {
        name: dict(sorted(section.items()))
        for name, section in sections.items()
        if section or name == "takes"
    }


def _describe(lookup: Lookup, stale: Staleness, kind: str, take: str) -> Json:
    try:
        record = lookup.record(kind, take)
        reasons = stale.reasons(record) if kind in DERIVED else ()
    except InputError as error:
        return {"fault": str(error)}
    summary = {
        "generation": record.generation,
        "path": lookup.place.url(record.path),
        "created": record.created,
        "bytes": record.bytes,
    }
    if kind == CONSENT:
        return summary | {"scope": list(consent_scope(record.provenance))}
    if reasons:
        summary["stale"] = list(map(str, reasons))
    known = ("calibration", "calibrated_by") if kind == "capture" else ()
    summary |= {x: record.provenance[x] for x in known if x in record.provenance}
    return summary | {"status": record.provenance.get("status", {})}
