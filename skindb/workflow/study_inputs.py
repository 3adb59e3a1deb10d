"""What studies are made from: cohorts, registrations and tables of BRDFs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from dask.delayed import Delayed, delayed
from numpy.typing import NDArray

from skindb.analysis.regions import common_landmarks
from skindb.analysis.registration import describe_registration
from skindb.analysis.study import Population, Study
from skindb.errors import Fault, InputError
from skindb.reflectance.dictionary import convolve_disc, embedded_dictionary
from skindb.reflectance.kinds import require_mixture
from skindb.reflectance.table_file import read_dictionary
from skindb.schema.cohort import require_same_fit
from skindb.schema.notes import Note, note, unique_notes
from skindb.store import Database, Lookup, Record, Staleness
from skindb.workflow.registration import (
    current_registrations,
    register_takes,
    registered_datasets,
    takes_with_landmarks,
)
from skindb.workflow.summaries import summarise


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


def open_population(
    db: Database,
    study: Study,
    *,
    takes: Sequence[str] = (),
    release: str | None = None,
    dictionary: Path | None = None,
) -> tuple[Population, list[Record]]:
    """What a study reads, and the records of the versions that it is made from.

    Parameters
    ----------
    db
        Database with models.
    study
        The study.
    takes
        Default all whose consent covers statistics.
    release
        Name of a release to study; default the newest versions.
    dictionary
        Path of the dictionary of the fits; default the embedded one.
    """
    if study.registers:
        require_covered(db, release)
    _require_models(db, takes, release)
    open_models = partial(db.cohort, takes=takes or None, release=release)
    if study.layout != "maps":
        cohort = open_models(study.layout, **study.cohort_options)
    else:
        cohort = open_models("tables")
    registrations: Mapping[str, Record] = {}
    notes: list[Note] = []
    if study.registers:
        if not takes:  # before anything is registered
            require_same_fit(cohort)
        registrations, notes = _registrations(db, cohort, release)
    registered = [*registrations]
    open_registered = partial(db.cohort, takes=registered, release=release)

    def open_cohort(layout: Any, **options: Any) -> xr.Dataset:
        if layout != "maps" and "kind" not in options:
            return open_models(layout, **options)
        size = {"size": options["size"]} if "size" in options else {}
        summarise(db, registered, release=release, **size)
        return open_registered(layout, **options)

    if study.layout == "maps":
        open_maps = partial(open_cohort, "maps", **study.cohort_options)
        cohort = _open_maps(db, cohort, registered, open_maps)
    population = Population(
        cohort,
        open_cohort,
        partial(_brdf_tables, open_models, cohort, dictionary),
        landmarks=common_landmarks(registered_datasets(db, registrations)),
        registered=registered,
        mixed_fits=bool(takes),
        notes=notes,
    )
    return population, [*_models(db, cohort), *registrations.values()]


def _require_models(db: Database, takes: Sequence[str], release: str | None) -> None:
    """Refuse a database without models, and summarise those that cohorts cannot read."""
    models = db.takes("model", release=release)
    if not models:
        rule = "a study needs fitted takes"
        raise InputError(Fault(db.url, rule, "no model", "run skindb fit first"))
    summarise(db, [take for take in takes or models if take in models], release=release)


def _open_maps(
    db: Database,
    models: xr.Dataset,
    registered: Sequence[str],
    open_maps: Callable[[], xr.Dataset],
) -> xr.Dataset:
    """Maps of the registered takes; without a probe there is no map of sigma_tr."""
    if not registered:
        rule = "maps need registered takes"
        found = f"none of {models.sizes['take']} takes has landmarks"
        cure = "add landmarks to the captures, then ingest and fit them"
        raise InputError(Fault(db.url, rule, found, cure))
    maps = open_maps()
    skipped = [*models.attrs["skipped"], *maps.attrs["skipped"]]
    return maps.assign_attrs(skipped=unique_notes(skipped))


def _models(db: Database, cohort: xr.Dataset) -> list[Record]:
    """Records of the models of a cohort."""
    takes = cohort["take"].values
    generations = cohort["model_generation"].values
    markers = db.markers()
    return [
        db.record("model", str(take), int(generation), markers=markers)
        for take, generation in zip(takes, generations, strict=True)
    ]


def _brdf_tables(
    open_models: Callable[..., xr.Dataset], cohort: xr.Dataset, dictionary: Path | None
) -> Delayed:
    """The tables of the fits, computed once, where the study is: they travel to no
    other process by themselves.
    """
    take = str(cohort["take"].values[0])
    opened = open_models("tables", takes=[take], variables=["disc_angular_radius"])
    disc = float(opened["disc_angular_radius"][0])
    require_mixture(cohort.coords, "cohort")
    names = [str(name) for name in cohort["dictionary"].values]
    tables: Delayed = delayed(dictionary_tables, pure=False)(
        names, disc, dictionary
    ).persist()
    return tables


def require_covered(db: Database, release: str | None) -> None:
    """Refuse a release whose registrations contain data of a subject who no longer
    consents to statistics.
    """
    if release is None:
        return
    known = Lookup(db, release)
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
    db: Database, cohort: xr.Dataset, release: str | None
) -> tuple[dict[str, Record], list[Note]]:
    """Registrations of the takes of a cohort that can have one, and notes on them; a
    release is never registered again.
    """
    takes = [str(take) for take in cohort["take"].values]
    if release is not None:
        known = Lookup(db, release)
        names = [take for take in takes if known.has("registration", take)]
        records = {take: known.record("registration", take) for take in names}
        origin = "that of the release"
    else:
        able = takes_with_landmarks(db, takes)
        records = current_registrations(db, able)
        origin = "the stored one"
        if able and not records:
            # all takes, so that the next study need not register others again
            everyone = register_takes(db)
            records = {take: everyone[take] for take in everyone if take in able}
            origin = "made for this study"
    notes = describe_registration(registered_datasets(db, records), takes)
    return records, [*notes, note("", origin)] if records else notes
