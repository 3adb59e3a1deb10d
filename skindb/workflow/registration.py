"""Registration of the takes of a database: one (u, v) for all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import xarray as xr

from skindb.analysis.registration import (
    Frame,
    Outline,
    common_frame,
    has_landmarks,
    landmark_names,
    outline,
    register_one,
    with_names,
)
from skindb.errors import Fault, InputError
from skindb.schema.consent import require_consent
from skindb.store import Database, Record
from skindb.types import Progress, silent
from skindb.workflow.audit import logged
from skindb.workflow.derive import Derivation
from skindb.workflow.summaries import registered_parts, summary_parameters
from skindb.workflow.takes import map_takes, results_of

if TYPE_CHECKING:
    from distributed import Client

# functions that compute a registration
METHOD = (
    landmark_names,
    outline,
    with_names,
    common_frame,
    register_one,
    registered_parts,
)


@logged("register")
def register_takes(
    db: Database,
    *,
    takes: Sequence[str] | None = None,
    reference: str | None = None,
    workers: int | None = None,
    client: Client | None = None,
    progress: Progress | None = None,
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
        require_consent({"consent_scope": db.consent(take), "take": take}, "statistics")
    names = sorted(takes_with_landmarks(db, takes))
    if not names:
        finding = "no take has any"
        cure = "name the 20 points in the capture's landmarks.json"
        raise InputError(Fault(db.url, "a registration needs landmarks", finding, cure))
    models = {take: db.record("model", take) for take in names}
    derivation = _derivation(db, models.values(), reference or "")
    stored = {take: replace(derivation, key=take).current() for take in names}
    current = {take: record for take, record in stored.items() if record is not None}
    if len(current) == len(names):
        return current
    # small: every task gets all of them
    generations = {take: record.generation for take, record in models.items()}
    report = progress or silent
    resources: dict[str, Any] = {"workers": workers, "client": client}
    outlines: dict[str, Outline] = {}
    landmarks: dict[str, tuple[str, ...]] = {}
    report("outlines", 0, len(names))
    for take, points, shape in results_of(
        map_takes(partial(_outline, db, generations), names, **resources)
    ):
        landmarks[take] = points
        outlines[take] = shape
        report("outlines", len(outlines), len(names))
    every_point = tuple(
        dict.fromkeys(name for take in names for name in landmarks[take])
    )
    aligned = {
        take: with_names(outlines[take], landmarks[take], every_point) for take in names
    }
    frame = common_frame(aligned, every_point, reference=reference)
    assert frame is not None
    call = partial(_register, derivation, generations, frame)
    report("register", len(current), len(names))
    pending = [take for take in names if take not in current]
    for record in results_of(map_takes(call, pending, **resources)):
        current[record.take] = record
        report("register", len(current), len(names))
    return {take: current[take] for take in names}


def takes_with_landmarks(db: Database, takes: Sequence[str] | None = None) -> list[str]:
    """Takes with a model and landmarks whose newest capture consents to statistics."""
    fitted = db.takes("model")
    names = fitted if not takes else list(dict.fromkeys(takes))
    if not names:
        rule = "a study needs fitted takes"
        cure = "run skindb fit first"
        raise InputError(Fault(db.url, rule, "no model", cure))
    return [
        take
        for take in names
        if "statistics" in db.consent(take)
        and _has_landmarks(db, db.record("model", take))
    ]


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
        code=METHOD,
        names=[record.take for record in inputs],
        parameters={"reference": reference},
        summary_parameters=summary_parameters(),
    )


def registered_datasets(
    db: Database, records: Mapping[str, Record]
) -> dict[str, xr.Dataset]:
    """The group "registration" of versions; what belongs to no surfel is in memory."""
    out = {}
    for take, record in records.items():
        version = db.read("registration", take, generation=record.generation)
        ds = version["registration"].to_dataset()
        small = {name: ds[name].load() for name in ds if "surfel" not in ds[name].dims}
        out[take] = ds.assign(small)
    return out


def _outline(
    db: Database, generations: Mapping[str, int], take: str
) -> tuple[str, tuple[str, ...], Outline]:
    model = db.read("model", take, generation=generations[take])
    points = landmark_names([model])
    return take, points, outline(model, points)


def _register(
    derivation: Derivation, generations: Mapping[str, int], frame: Frame, take: str
) -> Record:
    model, template = (
        derivation.db.read("model", name, generation=generations[name])
        for name in (take, frame.template)
    )
    registered = register_one(take, model, template, frame)
    groups = registered_parts(model, registered)
    version = xr.DataTree.from_dict({"registration": registered} | groups)
    version.attrs["consent_scope"] = model.attrs.get("consent_scope", [])
    return replace(derivation, key=take).commit(version)


def _has_landmarks(db: Database, record: Record) -> bool:
    if record.contents and "landmark_position" not in record.contents.get(
        "mesh", {}
    ).get("variables", []):
        return False
    return has_landmarks(db.read("model", record.take, generation=record.generation))
