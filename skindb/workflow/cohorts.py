"""What cohorts need of models: registrations, which give all takes one (u, v), and summaries,
which are kept as versions of kind summary if a version lacks them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from xarray import Dataset, DataTree, merge

from skindb.analysis.regions import take_masks
from skindb.analysis.registration import (
    Frame,
    Outline,
    common_frame,
    has_landmarks,
    outline,
    register_one,
)
from skindb.analysis.summary import (
    SAMPLED,
    SIZE,
    common_maps,
    region_tables,
    sample_surfels,
    summary_tables,
)
from skindb.errors import require
from skindb.files import Json
from skindb.fit import prediction_table
from skindb.schema import FitStatus, dataset, variables
from skindb.schema.label import FACE
from skindb.store import SUMMARY, CohortRequest, Database, Lookup, Record, lacking
from skindb.types import Progress, silent
from skindb.workflow.audit import logged
from skindb.workflow.derive import TABLES, Derivation, code_digest, groups_of
from skindb.workflow.takes import map_takes, results_of

if TYPE_CHECKING:
    from distributed import Client

Landmarks = tuple[str, ...]  # names
SURFACE = ("fitted", "mesh")  # groups of a model that maps and registrations need


@logged("summarise")
def summarise(
    db: Database,
    takes: Sequence[str] | None = None,
    *,
    size: int = SIZE,
    maps: Sequence[str] | None = None,
    workers: int | None = None,
    release: str | None = None,
) -> list[str]:
    """Store what cohorts with these options need, for takes that lack it.

    New models and registrations keep their tables, a sample of 5,000 surfels, and maps
    of 512 texels; this is for other sizes of maps, and for models that were summarised
    by other code.

    Parameters
    ----------
    db
        Database with models.
    takes
        Default all.
    size
        Texels along each side of the maps, for takes that are registered.
    maps
        Variables of the maps, by default all.
    workers
        See `map_takes`.
    release
        Name of a release: for its versions in place of the newest ones.

    Returns
    -------
    list of str
        The takes for which something was stored.

    Raises
    ------
    InputError
        With the faults of every take that could not be summarised; the others are stored.
    """
    names = db.takes("model", release=release) if takes is None else list(takes)
    code = summary_digest()
    tables = CohortRequest("tables", digest=code)
    sample = CohortRequest("surfels", surfels=SAMPLED, digest=code)
    chosen = None if maps is None else tuple(maps)
    map_request = CohortRequest("maps", size=size, digest=code, variables=chosen)
    lookup = Lookup(db, release)
    registered = [take for take in names if lookup.has("registration", take)]
    steps = [
        ("model", names, [tables, sample], partial(_summarise_model, db)),
        (
            "registration",
            registered,
            [sample],
            partial(_summarise_registration, db, size),
        ),
        ("registration", registered, [map_request], partial(_map, db, map_request)),
    ]
    records: list[Record] = []
    for kind, candidates, requests, summary in steps:
        lack = lacking(db, kind, requests, candidates, release=release)
        versions = [lookup.record(kind, take) for take in lack]
        records += results_of(map_takes(summary, versions, workers=workers))
    return sorted({record.take for record in records})


def summary_digest() -> str:
    """Digest of the code that computes tables, samples and maps; results of other code
    are computed again.
    """
    return code_digest(*SUMMARY_METHOD)


def summary_parameters(*, size: int | None = None) -> Json:
    """How the parts for cohorts are computed, as versions record it."""
    parameters = {"surfels": SAMPLED, "digest": summary_digest()}
    return parameters if size is None else parameters | {"size": size}


def model_with_summary(model: DataTree) -> DataTree:
    """A model with what cohorts need of it: a sample of its surfels, and tables."""
    groups = groups_of(model) | sample_groups(model) | {TABLES: tables_of(model)}
    version = DataTree.from_dict(groups)
    version.attrs = model.attrs
    return version


def tables_of(model: DataTree) -> Dataset:
    """What is kept beside a model: its summary for cohorts, and how well it predicts."""
    tables = summary_tables(model)
    prediction = prediction_table(model["fitted"].dataset.load())
    # a region without any surfel has no row there
    rows = prediction.reindex(
        region=tables["region"].values, fill_value={variables.PREDICTION_SURFELS: 0}
    )
    return merge(
        [tables, rows], combine_attrs="override", join="outer", compat="no_conflicts"
    )


def sample_groups(model: DataTree) -> dict[str, Dataset]:
    """The group "sample" of a model; none if no surfel was fitted."""
    if not bool(
        (model["fitted"].dataset[variables.FIT_STATUS] == FitStatus.FITTED).any()
    ):
        return {}
    return {"sample": sample_surfels(model)}


def registered_parts(
    model: DataTree,
    registered: Dataset,
    *,
    size: int = SIZE,
) -> dict[str, Dataset]:
    """Groups and tables that cohorts need of a registered take: maps, and the regions
    that its landmarks give.
    """
    fitted = model["fitted"].dataset.load()
    masks = take_masks(model, registered)
    groups = {"maps": common_maps(model, registered, size=size)}
    if sampled := sample_groups(model):
        index = sampled["sample"][variables.SURFEL_INDEX].values
        mask = np.array([mask[index] for mask in masks.values()]).reshape(
            len(masks), len(index)
        )
        groups["sample"] = dataset(
            {variables.SURFEL_INDEX: index, variables.REGION_MASK: mask.T},
            coords={"region": list(masks)},
        )
    face = {FACE: np.ones(fitted.sizes["surfel"], bool)}
    groups[TABLES] = region_tables(fitted, face | masks)
    return groups


def _summarise_model(db: Database, record: Record) -> Record:
    model = db.version(record)
    groups = sample_groups(model) | {TABLES: tables_of(model)}
    return _commit_summary(db, record, groups, summary_parameters())


def _summarise_registration(db: Database, size: int, record: Record) -> Record:
    groups = registered_parts(*_registered_model(db, record), size=size)
    return _commit_summary(db, record, groups, summary_parameters(size=size))


def _map(db: Database, request: CohortRequest, record: Record) -> Record:
    model, registered = _registered_model(db, record)
    maps = common_maps(model, registered, size=request.size, maps=request.variables)
    return _commit_summary(
        db, record, {"maps": maps}, summary_parameters(size=request.size)
    )


def _registered_model(db: Database, record: Record) -> tuple[DataTree, Dataset]:
    """The model of a registration, and the group "registration"."""
    version = db.version(record, ["registration"])
    model = db.source(version, "model", record.take, SURFACE)
    return model, version["registration"].dataset


def _commit_summary(
    db: Database,
    record: Record,
    groups: dict[str, Dataset],
    parameters: Json,
) -> Record:
    derivation = Derivation.of(
        db,
        SUMMARY,
        record.take,
        inputs=[record],
        code=SUMMARY_METHOD,
        names=record.names,
        parameters=parameters,
        summary_parameters=parameters,
    )
    summary = DataTree.from_dict(groups)
    summary.attrs["consent_scope"] = record.provenance.get("consent_scope", [])
    return derivation.commit(summary)


@logged("register")
def register_takes(
    db: Database,
    *,
    takes: Sequence[str] | None = None,
    reference: str | None = None,
    workers: int | None = None,
    client: Client | None = None,
    progress: Progress = silent,
) -> dict[str, Record]:
    """Register takes by their landmarks, and commit the common (u, v), regions and maps of each.

    Parameters
    ----------
    db
        Database with models.
    takes
        Default all that have landmarks and whose consent covers statistics; the others are skipped.
    reference
        See `skindb.analysis.register`.
    workers, client
        See `map_takes`.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    dict
        Take -> record of its version of kind "registration", which may exist already.

    Raises
    ------
    InputError
        If no take can be registered, or if a take that was named does not consent to statistics.
    """
    for take in takes or ():
        db.require_consent(take, "statistics")
    names = sorted(takes_with_landmarks(db, takes))
    require(
        names,
        db.url,
        "a registration needs landmarks",
        "no take has any",
        "name the 20 points in the capture's landmarks.json",
    )
    models = {take: db.record("model", take) for take in names}
    derivation = _derivation(db, models.values(), reference or "")
    stored = {take: replace(derivation, key=take).current() for take in names}
    current = {take: record for take, record in stored.items() if record is not None}
    if len(current) == len(names):
        return current
    # small: every task gets all of them
    generations = {take: record.generation for take, record in models.items()}
    map_all = partial(map_takes, workers=workers, client=client)
    outlines = {}
    progress("outlines", 0, len(names))
    for take, shape in results_of(map_all(partial(_outline, db, generations), names)):
        outlines[take] = shape
        progress("outlines", len(outlines), len(names))
    frame = common_frame({take: outlines[take] for take in names}, reference=reference)
    assert frame is not None
    call = partial(_register, derivation, generations, frame)
    progress("register", len(current), len(names))
    pending = [take for take in names if take not in current]
    for record in results_of(map_all(call, pending)):
        current[record.take] = record
        progress("register", len(current), len(names))
    return {take: current[take] for take in names}


def takes_with_landmarks(db: Database, takes: Sequence[str] | None = None) -> list[str]:
    """Takes with a model and landmarks whose newest capture consents to statistics."""
    fitted = db.takes("model")
    names = fitted if not takes else list(dict.fromkeys(takes))
    require_fitted(db, names)
    return [
        take
        for take in names
        if "statistics" in db.consent(take)
        and _has_landmarks(db, db.record("model", take))
    ]


def require_fitted(db: Database, takes: Sequence[str]) -> None:
    """Refuse a study without takes."""
    require(
        takes, db.url, "a study needs fitted takes", "no model", "run skindb fit first"
    )


def current_registrations(db: Database, takes: Sequence[str]) -> dict[str, Record]:
    """The registrations of takes; none if any is missing or out of date, or if they
    were not registered together.

    The common coordinates depend on every take that was registered along: all of these
    must still have the models that were used, and consent to statistics. More takes
    than are asked for do no harm.
    """
    if not takes or not all(db.has("registration", take) for take in takes):
        return {}
    records = {take: db.record("registration", take) for take in takes}
    provenance = records[takes[0]].provenance
    along = [str(model["take"]) for model in provenance["inputs"]]
    usable = all(
        db.has("model", take) and "statistics" in db.consent(take) for take in along
    )
    if not usable or not set(takes) <= set(along):
        return {}
    models = [db.record("model", take) for take in along]
    derivation = _derivation(db, models, provenance["parameters"]["reference"])
    is_current = all(
        replace(derivation, key=take).describes(record)
        for take, record in records.items()
    )
    return records if is_current else {}


def _derivation(db: Database, models: Iterable[Record], reference: str) -> Derivation:
    """What decides the registrations of takes that are registered together."""
    inputs = list(models)
    return Derivation.of(
        db,
        "registration",
        "",
        inputs=inputs,
        code=REGISTRATION_METHOD,
        names=[record.take for record in inputs],
        parameters={"reference": reference},
        summary_parameters=summary_parameters(),
    )


def registered_datasets(
    db: Database, records: Mapping[str, Record]
) -> dict[str, Dataset]:
    """The group "registration" of versions; what belongs to no surfel is in memory."""
    out = {}
    for take, record in records.items():
        version = db.version(record, ["registration"])
        ds = version["registration"].dataset
        small = {name: ds[name].load() for name in ds if "surfel" not in ds[name].dims}
        out[take] = ds.assign(small)
    return out


def _outline(
    db: Database, generations: Mapping[str, int], take: str
) -> tuple[str, Outline]:
    return take, outline(
        db.read("model", take, generation=generations[take], groups=SURFACE)
    )


def _register(
    derivation: Derivation, generations: Mapping[str, int], frame: Frame, take: str
) -> Record:
    model, template = (
        derivation.db.read("model", name, generation=generations[name], groups=SURFACE)
        for name in (take, frame.template)
    )
    registered = register_one(take, model, template, frame)
    groups = registered_parts(model, registered)
    version = DataTree.from_dict({"registration": registered} | groups)
    version.attrs["consent_scope"] = model.attrs.get("consent_scope", [])
    return replace(derivation, key=take).commit(version)


def _has_landmarks(db: Database, record: Record) -> bool:
    mesh = record.contents.get("mesh", {"variables": []})
    if variables.LANDMARK_POSITION not in mesh["variables"]:
        return False
    return has_landmarks(db.version(record, ["mesh"]))


# functions that compute what cohorts need
SUMMARY_METHOD = (tables_of, sample_groups, registered_parts)
# functions that compute a registration
REGISTRATION_METHOD = (outline, common_frame, register_one, registered_parts)
