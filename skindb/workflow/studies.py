"""Studies of the population of a database: computed if what is stored is not current, and
committed with the cohorts, registrations and tables of BRDFs that they were made from.
"""

import hashlib
import inspect
import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, asdict, fields
from functools import partial, wraps
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from dask.delayed import Delayed, delayed
from xarray import Dataset, DataTree

from skindb.analysis.long_form import tidy
from skindb.analysis.quantities import SPACING, spacing_notes
from skindb.analysis.regions import common_landmarks
from skindb.analysis.registration import describe_registration
from skindb.analysis.studies import STUDIES
from skindb.analysis.study import Population, Study, of_cohort
from skindb.analysis.subjects import (
    CONDITION,
    describe_visits,
    subjects_of,
    subjects_without,
)
from skindb.errors import InputError, require
from skindb.files import Attributes
from skindb.format.dome import EXPOSURE_RATIO
from skindb.parameters import option_of, require_limits
from skindb.reflectance.brdf_files import read_dictionary
from skindb.reflectance.dictionary import convolve_disc, embedded_dictionary
from skindb.reflectance.kinds import require_mixture
from skindb.schema import variables
from skindb.schema.cohort import NORMAL, require_same_fit
from skindb.schema.notes import Note, note, unique_notes
from skindb.store import STUDY, Database, Lookup, Record, Staleness, require_text
from skindb.threads import on_one_blas_thread
from skindb.types import Float32
from skindb.workflow.audit import logged_action
from skindb.workflow.cohorts import (
    current_registrations,
    register_takes,
    registered_datasets,
    require_fitted,
    summarise,
    takes_with_landmarks,
)
from skindb.workflow.derive import Derivation

STUDY_NAME = r"[A-Za-z0-9_-]{1,64}"


def dictionary_tables(
    names: Sequence[str], disc: float, dictionary: Path | None = None
) -> Float32:
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
    stored = (
        embedded_dictionary() if dictionary is None else read_dictionary(dictionary)
    )
    require(
        list(stored.names) == list(names),
        "dictionary",
        "must be the one the takes were fitted with",
        f"{len(names)} BRDFs, {names[0]} first",
        "name its folder with --dictionary",
    )
    return convolve_disc(stored, disc).table


def open_population(
    db: Database,
    study: Study,
    *,
    takes: Sequence[str] = (),
    as_normal: Sequence[str] = (),
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
    as_normal
        See `study`.
    release
        Name of a release to study; default the newest versions.
    dictionary
        Path of the dictionary of the fits; default the embedded one.
    """
    if study.registers:
        require_covered(db, release)
    _require_models(db, takes, release)
    opened = partial(
        _opened, db, release=release, mixed_fits=bool(takes), as_normal=as_normal
    )
    open_models = partial(opened, takes=takes or None)
    cohort = (
        open_models("tables")
        if study.layout == "maps"
        else open_models(study.layout, **study.cohort_options)
    )
    registrations: Mapping[str, Record] = {}
    frames = {}
    notes = []
    if study.registers:
        if not takes:  # before anything is registered
            require_same_fit(cohort)
        registrations, origin = _registrations(db, cohort, release)
        frames = registered_datasets(db, registrations)
        notes = describe_registration(frames, cohort["take"].values.tolist())
        notes += [note("", origin)] if frames else []
    registered = [*registrations]
    open_registered = partial(opened, takes=registered)

    def open_cohort(layout: Any, **options: Any) -> Dataset:
        if layout != "maps" and "kind" not in options:
            return open_models(layout, **options)
        size = {"size": options["size"]} if "size" in options else {}
        maps = options.get("variables") if layout == "maps" else None
        summarise(db, registered, release=release, maps=maps, **size)
        return open_registered(layout, **options)

    if study.layout == "maps":
        require(
            registered,
            db.url,
            "maps need registered takes",
            f"none of {cohort.sizes['take']} takes has landmarks",
            "add landmarks to the captures, then ingest and fit them",
        )
        # without a probe there is no map of sigma_tr
        maps = open_cohort("maps", **study.cohort_options)
        skipped = [*cohort.attrs["skipped"], *maps.attrs["skipped"]]
        cohort = maps.assign_attrs(skipped=unique_notes(skipped))
    population = Population(
        cohort,
        open_cohort,
        partial(_brdf_tables, open_models, cohort, dictionary),
        landmarks=common_landmarks(frames),
        registered=registered,
        notes=notes,
    )
    generations = zip(
        cohort["take"].values.tolist(),
        cohort["model_generation"].values.astype(int).tolist(),
        strict=True,
    )
    lookup = Lookup(db)
    models = [lookup.generation("model", *key) for key in generations]
    return population, [*models, *registrations.values()]


def _opened(
    db: Database,
    layout: Any,
    *,
    mixed_fits: bool,
    as_normal: Sequence[str],
    **options: Any,
) -> Dataset:
    """A cohort that states whether its takes may be fitted with different parameters, and
    in which some conditions count as normal for subjects without a normal take.
    """
    cohort = db.cohort(layout, **options).assign_attrs(mixed_fits=mixed_fits)
    if not as_normal:
        return cohort
    condition, subject = (cohort[name].values for name in (CONDITION, "subject"))
    has_normal = np.isin(subject, subject[condition == NORMAL])
    counts = np.isin(condition, list(as_normal)) & ~has_normal
    counted = [note(take, "counts") for take in cohort["take"].values[counts].tolist()]
    return cohort.assign_coords(
        {CONDITION: ("take", np.where(counts, NORMAL, condition))}
    ).assign_attrs(as_normal=counted)


def _require_models(db: Database, takes: Sequence[str], release: str | None) -> None:
    """Refuse a database without models, and summarise those that cohorts cannot read."""
    models = db.takes("model", release=release)
    require_fitted(db, models)
    summarise(db, [take for take in takes or models if take in models], release=release)


def _require_one_scale(db: Database, study: Study, inputs: Sequence[Record]) -> None:
    """Refuse models whose reflectance cannot be compared: with and without a white target,
    or without one where absolute values are needed or photographs had other exposures.
    """
    models = [record for record in inputs if record.kind == "model"]
    relative = [x for x in models if x.provenance.get("relative_reflectance")]
    if not relative:
        return
    rule = "all takes of a study must have absolute reflectance, or all relative"
    if study.absolute:
        rule = f"the study {study.name} needs absolute reflectance"
    names = [record.take for record in relative]
    require(
        len(relative) == len(models) and not study.absolute,
        ", ".join(names[:3]) + (", ..." if names[3:] else ""),
        rule,
        f"{len(relative)} of {len(models)} takes without a white target",
        "name takes of one kind with --take",
    )
    exposures = {}
    for record in relative:
        for key in record.input_keys:
            with suppress(InputError):  # the capture was removed since
                about = db.record(*key).provenance
                exposures[about.get("relative_exposure", 0.0)] = record.take
    exposures.pop(0.0, None)  # unknown
    low = min(exposures, default=0.0)
    high = max(exposures, default=0.0)
    require(
        high <= EXPOSURE_RATIO * low,
        ", ".join(exposures[x] for x in (low, high) if x in exposures),
        "takes without a white target are comparable if their pictures have one exposure",
        f"{low:.3g} and {high:.3g}, which the imports recorded",
        "name takes of one exposure with --take",
    )


def _brdf_tables(
    open_models: Callable[..., Dataset], cohort: Dataset, dictionary: Path | None
) -> Delayed:
    """The tables of the fits, computed once, where the study is: they travel to no
    other process by themselves.
    """
    take = str(cohort["take"].values[0])
    opened = open_models(
        "tables", takes=[take], variables=[variables.DISC_ANGULAR_RADIUS]
    )
    disc = float(opened[variables.DISC_ANGULAR_RADIUS][0])
    require_mixture(cohort.coords, "cohort")
    names = cohort["dictionary"].values.tolist()
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
    lookup = Lookup(db, release)
    staleness = Staleness(db)
    causes = dict.fromkeys(
        str(reason)
        for take in lookup.takes("registration")
        for reason in staleness.reasons(lookup.record("registration", take))
        if reason.why != "superseded"
    )
    require(
        not causes,
        f"release {release}",
        "the registrations of a release must be covered by consent",
        "; ".join(causes),
        "run skindb refresh, and make another release",
    )


def _registrations(
    db: Database, cohort: Dataset, release: str | None
) -> tuple[dict[str, Record], str]:
    """Registrations of the takes of a cohort that can have one, and where they are
    from; a release is never registered again.
    """
    takes = cohort["take"].values.tolist()
    if release is not None:
        lookup = Lookup(db, release)
        names = [take for take in takes if lookup.has("registration", take)]
        records = {take: lookup.record("registration", take) for take in names}
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
    return records, origin


@on_one_blas_thread
def study(
    db: Database,
    what: str,
    *,
    takes: Sequence[str] = (),
    as_normal: Sequence[str] = (),
    release: str | None = None,
    name: str | None = None,
    **parameters: Any,
) -> DataTree:
    """The stored study if it is current, or a new one, which is computed and committed.

    Parameters
    ----------
    db
        Database with models.
    what
        Name of the study, see `skindb.analysis.STUDIES`.
    takes
        Default all whose consent covers statistics. Takes that are named may be fitted
        with different parameters.
    as_normal
        Conditions, such as makeup, that count as normal for subjects who have no take in
        the condition normal.
    release
        Name of a release to study; default the newest versions.
    name
        The study is stored as ``<what>.<name>``; default as in `study_key`.
    **parameters
        Parameters of the study, see the record ``STUDIES[what].parameters``.

    Returns
    -------
    DataTree
        Version of kind "population"; its attribute "study" is what it is stored as.

    Raises
    ------
    InputError
        For another study or other parameters, without takes that consent to statistics,
        or if they were fitted with different parameters and none is named.
    """
    cure = f"choose from {', '.join(STUDIES)}"
    known = "must be a known study"
    require(what in STUDIES, f"study {what}", known, "another name", cure)
    record = STUDIES[what]
    chosen = _parameters(record, parameters)
    # what another run needs to repeat the study
    requested = {name: _plain(value) for name, value in asdict(chosen).items()}
    requested.pop("dictionary", None)
    requested |= {"takes": [*takes], "release": release or ""}
    if as_normal:
        requested["as_normal"] = [*as_normal]
    key = study_key(record, requested, name)
    dictionary = parameters.get("dictionary")
    studied = takes or db.takes("model", release=release)
    conditions = sorted({[*take.split("."), NORMAL][1] for take in studied})
    require(
        {*as_normal} <= {*conditions},
        f"conditions {', '.join(as_normal)} as normal",
        f"must be among {', '.join(conditions)}",
        "another word",
        "correct it",
    )
    with logged_action(db, "study", studied, what=record.name):
        population, inputs = open_population(
            db,
            record,
            takes=takes,
            as_normal=as_normal,
            release=release,
            dictionary=dictionary,
        )
        _require_one_scale(db, record, inputs)
        derivation = _derivation(db, key, record, requested, chosen, population, inputs)
        # the file of a dictionary may change: a study with one is always computed
        if dictionary is not None or derivation.current() is None:
            studied = population.cohort["take"].values.tolist()
            # before the study, during which a subject may be withdrawn
            tables = db.cohort(
                "tables", takes=studied, release=release, variables=SPACING
            )
            spacing = spacing_notes(tables)
            version = DataTree.from_dict(record.compute(population, chosen))
            if population.notes:
                version.attrs["registration"] = population.notes
            version.attrs["spacing"] = spacing
            version.attrs["as_normal"] = population.cohort.attrs.get("as_normal", [])
            derivation.commit(version)
    return db.read(STUDY, key)


def tidy_table(
    db: Database, *, takes: Sequence[str] = (), release: str | None = None
) -> tuple[pd.DataFrame, list[Note], list[Note]]:
    """The table `skindb.analysis.tidy` of the takes of a database, one note for each
    skipped take, and one if the spacings of their surfels differ.

    Parameters
    ----------
    db
        Database with models.
    takes
        Default all whose consent covers statistics.
    release
        Name of a release; default the newest versions.
    """
    with logged_action(db, "tidy", takes or db.takes("model", release=release)):
        _require_models(db, takes, release)
        cohort = db.cohort("tables", takes=takes or None, release=release)
        return tidy(cohort), cohort.attrs["skipped"], spacing_notes(cohort)


def study_key(record: Study, requested: Attributes, name: str | None) -> str:
    """What a study is stored as.

    The study of everything with default parameters is stored under its own word,
    "traits"; with other parameters it is "traits.k-8", and with a name "traits.<name>".
    No study replaces one that was asked for differently; one with another random seed
    is the next generation of the same.
    """
    if name is not None:
        return f"{record.name}.{require_text(name, STUDY_NAME, 'name of a study')}"
    defaults = {spec.name: _plain(spec.default) for spec in fields(record.parameters)}
    defaults |= {"takes": [], "as_normal": [], "release": ""}
    chosen = {
        key: value
        for key, value in requested.items()
        if key != "seed" and value != defaults[key]
    }
    if not chosen:
        return record.name
    words = dict(chosen)
    if "adjust" in chosen and "-" not in "".join(chosen["adjust"]):
        words["adjust"] = "-".join(chosen["adjust"])
    text = "_".join(f"{key}-{value}" for key, value in words.items())
    if not re.fullmatch(STUDY_NAME, text):
        encoded = json.dumps(chosen, sort_keys=True).encode()
        text = hashlib.sha256(encoded).hexdigest()[:16]
    return f"{record.name}.{text}"


def study_function(record: Study) -> Callable[..., DataTree]:
    """Function of a database that makes one study, with its parameters in signature and
    docstring, for notebooks.
    """

    @wraps(study)
    def function(db: Database, **options: Any) -> DataTree:
        return study(db, record.name, **options)

    general = inspect.signature(study).parameters
    keywords = [
        parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for parameter in inspect.signature(record.parameters).parameters.values()
    ]
    shared = ("takes", "as_normal", "release", "name")
    keywords += [general[name] for name in shared]
    function.__signature__ = inspect.Signature([general["db"], *keywords])  # type: ignore[attr-defined]
    function.__name__ = function.__qualname__ = record.name
    helps = "".join(
        f"    {spec.name}\n        {option_of(record.parameters, spec.name).help}\n"
        for spec in fields(record.parameters)
    )
    function.__doc__ = (
        f"Study of the population: {record.description}; see `skindb.workflow.study`.\n\n"
        "    Parameters\n    ----------\n    db\n        Database with models.\n"
        f"{helps}    {', '.join(shared)}\n        As in `skindb.workflow.study`.\n    "
    )
    return function


STUDY_FUNCTIONS = {name: study_function(record) for name, record in STUDIES.items()}


def _parameters(record: Study, options: Attributes) -> Any:
    """The parameters of a study as its record, checked."""
    specs = {spec.name: spec for spec in fields(record.parameters)}
    place = f"study {record.name}"
    unknown = ", ".join(sorted(options.keys() - specs.keys()))
    rule = f"its parameters are {', '.join(specs) or 'none'}"
    require(not unknown, place, rule, unknown, "omit the others")
    names = " and ".join(
        name
        for name, spec in specs.items()
        if spec.default is MISSING and options.get(name) is None
    )
    cure = f"give {names}, such as 'gender'"
    require(not names, place, f"needs {names}", "none", cure)
    chosen = dict(options)
    if isinstance(chosen.get("adjust"), str):
        chosen["adjust"] = (chosen["adjust"],)
    parameters = record.parameters(**chosen)
    require_limits(parameters)
    return parameters


def _plain(value: Any) -> Any:
    """A value of a parameter as it is stored."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return list(value)
    return "" if value is None else value


def _derivation(
    db: Database,
    key: str,
    record: Study,
    requested: Attributes,
    chosen: Any,
    population: Population,
    inputs: Sequence[Record],
) -> Derivation:
    """Everything that decides the content of a study."""
    cohort = population.cohort
    skipped = list(cohort.attrs["skipped"])
    subjects = subjects_of(cohort)
    skipped += subjects_without(subjects, record.conditions(subjects, chosen))
    outdated = list(cohort.attrs["outdated"])
    notes = [*skipped, *outdated, *population.notes]
    names = {note["take"] for note in notes if note["take"]}
    names.update(
        requested["takes"], *({source.take, *source.names} for source in inputs)
    )
    return Derivation.of(
        db,
        STUDY,
        key,
        inputs=inputs,
        code=[record.compute, of_cohort, open_population],
        names=names,
        parameters={"what": record.name, **requested},
        seeds={"analyze": requested["seed"]} if "seed" in requested else {},
        skipped=skipped,
        outdated=outdated,
        visits="" if record.counts_takes else describe_visits(cohort),
        attributes_digest=_attributes_digest(cohort),
    )


def _attributes_digest(cohort: Dataset) -> str:
    """Digest of the coordinates that describe the takes: age, gender, condition,
    parameters of the fit.
    """
    values = {
        str(name): [str(value) for value in coordinate.values]
        for name, coordinate in cohort.coords.items()
        if coordinate.dims == ("take",)
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
