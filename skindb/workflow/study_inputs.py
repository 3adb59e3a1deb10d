"""What studies are made from: cohorts, registrations and tables of BRDFs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from dask.delayed import Delayed, delayed
from numpy.typing import NDArray

from skindb.analysis.registration import describe_registration
from skindb.errors import Fault, InputError
from skindb.reflectance.dictionary import convolve_disc, embedded_dictionary
from skindb.reflectance.table_file import read_dictionary
from skindb.schema.cohort import require_same_fit
from skindb.schema.notes import Note, note, unique_notes
from skindb.store import Database, Known, Record, Staleness
from skindb.workflow.registration import (
    current_registrations,
    register_takes,
    registered_datasets,
    takes_with_landmarks,
)
from skindb.workflow.summaries import summarise


@dataclass(frozen=True)
class Frame:
    """Registrations of takes, and notes on them."""

    records: Mapping[str, Record]
    datasets: Mapping[str, xr.Dataset]
    notes: list[Note]


def dictionary_tables(
    names: Sequence[str], disc: float, dictionary: Path | None = None
) -> NDArray[np.float32]:
    """Tables (nh, nd, np, m) that takes were fitted with, averaged over the discs of the lights.

    Parameters
    ----------
    names
        Of the BRDFs the takes were fitted with.
    disc
        Angular radius of the lights [rad].
    dictionary
        Path of the dictionary; default the embedded one.
    """
    own = embedded_dictionary() if dictionary is None else read_dictionary(dictionary)
    if list(own.names) != list(names):
        where = "dictionary"
        rule = "must be the one the takes were fitted with"
        found = f"{len(names)} BRDFs, {names[0]} first"
        cure = "name its folder with --dictionary"
        raise InputError(Fault(where, rule, found, cure))
    return convolve_disc(own, disc).table


def study_cohort(
    db: Database, layout: Any, takes: Sequence[str], release: str | None, **options: Any
) -> xr.Dataset:
    """A cohort of the takes of a study; models of earlier versions of skindb are
    summarised for it.
    """
    _summarise(db, takes, release)
    return db.cohort(layout, takes=takes or None, release=release, **options)


def _summarise(db: Database, takes: Sequence[str], release: str | None) -> None:
    """Models of earlier versions of skindb keep nothing for cohorts."""
    known = set(db.takes("model", release=release))
    if not known:
        raise InputError(
            Fault(
                db.url, "a study needs fitted takes", "no model", "run skindb fit first"
            )
        )
    summarise(
        db,
        [take for take in (takes or sorted(known)) if take in known],
        release=release,
    )


def brdf_tables(
    db: Database, cohort: xr.Dataset, dictionary: Path | None, release: str | None
) -> Delayed:
    """The tables of the fits, computed once, where the study is: they travel to no
    other process by themselves.
    """
    first = str(cohort["take"].values[0])
    opened = db.cohort(
        "tables", takes=[first], variables=["disc_angular_radius"], release=release
    )
    disc = float(opened["disc_angular_radius"][0])
    names = [str(name) for name in cohort["dictionary"].values]
    tables: Delayed = delayed(dictionary_tables, pure=False)(
        names, disc, dictionary
    ).persist()
    return tables


def frame_of(db: Database, cohort: xr.Dataset, release: str | None) -> Frame:
    """The registrations of the takes of a cohort that have landmarks."""
    takes = [str(take) for take in cohort["take"].values]
    records, origin = _registrations(db, takes, release)
    datasets = registered_datasets(db, records)
    notes = describe_registration(datasets, takes)
    return Frame(records, datasets, [*notes, note("", origin)] if records else notes)


def registered_maps(
    db: Database, takes: Sequence[str], release: str | None
) -> tuple[xr.Dataset, Frame]:
    """Maps of takes on the common (u, v), and their registrations."""
    require_covered(db, release)
    models = study_cohort(db, "tables", takes, release)
    if not takes:  # before anything is registered
        require_same_fit(models)
    frame = frame_of(db, models, release)
    if not frame.records:
        rule = "maps need registered takes"
        cure = "add landmarks to the captures, then ingest and fit them"
        raise InputError(
            Fault(
                db.url,
                rule,
                f"none of {models.sizes['take']} takes has landmarks",
                cure,
            )
        )
    names = list(frame.records)
    summarise(db, names, release=release)
    # without a probe there is no map of sigma_tr
    cohort = db.cohort("maps", takes=names, release=release)
    cohort.attrs["skipped"] = unique_notes(
        [*models.attrs["skipped"], *cohort.attrs["skipped"]]
    )
    return cohort, frame


def require_covered(db: Database, release: str | None) -> None:
    """Refuse a release whose registrations contain data of a subject who no longer
    consents to statistics.
    """
    if release is None:
        return
    known = Known(db, release)
    staleness = Staleness(db)
    records = [
        known.record("registration", take) for take in known.takes("registration")
    ]
    reasons = [
        reason
        for record in records
        for reason in staleness.reasons(record)
        if reason.why != "superseded"
    ]
    if found := list(dict.fromkeys(map(str, reasons))):
        rule = "the registrations of a release must be covered by consent"
        cure = "run skindb refresh, and make another release"
        raise InputError(Fault(f"release {release}", rule, "; ".join(found), cure))


def _registrations(
    db: Database, takes: Sequence[str], release: str | None
) -> tuple[dict[str, Record], str]:
    """Registrations of the takes that can have one, and their source: a release is
    never registered again.
    """
    if release is not None:
        known = Known(db, release)
        return {
            t: known.record("registration", t)
            for t in takes
            if known.has("registration", t)
        }, "that of the release"
    able = takes_with_landmarks(db, takes)
    records = current_registrations(db, able)
    if records or not able:
        return records, "the stored one"
    # all takes, so that the next study need not register others again
    made = {take: record for take, record in register_takes(db).items() if take in able}
    return made, "made for this study"
