"""Registration of the takes of a database: one (u, v) for all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import xarray as xr

from skindb import __version__
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
from skindb.analysis.summary import SAMPLED
from skindb.errors import Fault, InputError
from skindb.schema.consent import require_consent
from skindb.store import Database, Record, frame_of
from skindb.types import Progress, silent
from skindb.workflow.audit import logged
from skindb.workflow.provenance import provenance
from skindb.workflow.summaries import registered_parts, summary_digest
from skindb.workflow.takes import map_takes, results_of

if TYPE_CHECKING:
    from distributed import Client


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
        Take -> record of its version of kind "registration". Where these takes, with
        these models and this reference, are registered already, that of the version
        there is.

    Raises
    ------
    InputError
        If no take can be registered, or if a take that was named does not consent to statistics.
    """
    for take in takes or ():
        require_consent({"consent_scope": db.consent(take), "take": take}, "statistics")
    names = takes_with_landmarks(db, takes)
    if not names:
        found = "no take has any"
        cure = "name the 20 points in the capture's landmarks.json"
        raise InputError(Fault(db.url, "a registration needs landmarks", found, cure))
    if done := _registered_alike(db, names, reference or ""):
        return done
    models = {take: db.record("model", take) for take in names}
    # small: every task gets all of them
    generations = {take: record.generation for take, record in models.items()}
    tell = progress or silent
    where: dict[str, Any] = {"workers": workers, "client": client}
    found_outlines: dict[str, tuple[tuple[str, ...], Outline]] = {}
    tell("outlines", 0, len(names))
    for take, own, one in results_of(
        map_takes(partial(_outline, db, generations), names, **where)
    ):
        found_outlines[take] = (own, one)
        tell("outlines", len(found_outlines), len(names))
    points = tuple(
        dict.fromkeys(name for take in names for name in found_outlines[take][0])
    )
    outlines = {
        take: with_names(found_outlines[take][1], found_outlines[take][0], points)
        for take in names
    }
    frame = common_frame(outlines, points, reference=reference)
    assert frame is not None
    inputs = [record.as_input() for record in models.values()]
    call = partial(_register, db, generations, frame, inputs, reference or "")
    committed: dict[str, Record] = {}
    tell("register", 0, len(names))
    for record in results_of(map_takes(call, names, **where)):
        committed[record.take] = record
        tell("register", len(committed), len(names))
    return {take: committed[take] for take in names}


def takes_with_landmarks(db: Database, takes: Sequence[str] | None = None) -> list[str]:
    """Takes with a model and landmarks whose newest capture consents to statistics."""
    known = db.takes("model")
    names = known if not takes else list(dict.fromkeys(takes))
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
    frames = {frame_of(record) for record in records.values()}
    one = next(iter(records.values()))
    along = {str(made["take"]): made for made in one.made_from}
    same = (
        len(frames) == 1
        and one.provenance["software_version"] == __version__
        and set(takes) <= set(along)
    )
    return (
        records
        if same and all(_is_current(db, take, made) for take, made in along.items())
        else {}
    )


def _registered_alike(
    db: Database, names: Sequence[str], reference: str
) -> dict[str, Record]:
    """The registrations of exactly these takes, if another run would find the same ones."""
    records = current_registrations(db, names)
    for record in records.values():
        about = record.provenance
        same = about["parameters"].get("reference", "") == reference and len(
            record.made_from
        ) == len(names)
        if not same or about["summary_parameters"]["digest"] != summary_digest():
            return {}
    return records


def _is_current(db: Database, take: str, made: Mapping[str, Any]) -> bool:
    """Whether the newest model of a take is the one that was used, and the take may still be."""
    current = db.has("model", take) and db.record("model", take).as_input() == made
    return current and "statistics" in db.consent(take)


def registered_datasets(
    db: Database, records: Mapping[str, Record]
) -> dict[str, xr.Dataset]:
    """The group "registration" of versions; what belongs to no surfel is in memory."""
    out = {}
    for take, record in records.items():
        one = db.read("registration", take, generation=record.generation)[
            "registration"
        ].to_dataset()
        out[take] = one.assign(
            {name: one[name].load() for name in one if "surfel" not in one[name].dims}
        )
    return out


def _outline(
    db: Database, generations: Mapping[str, int], take: str
) -> tuple[str, tuple[str, ...], Outline]:
    model = db.read("model", take, generation=generations[take])
    own = landmark_names([model])
    return take, own, outline(model, own)


def _register(
    db: Database,
    generations: Mapping[str, int],
    frame: Frame,
    inputs: Iterable[Mapping[str, Any]],
    reference: str,
    take: str,
) -> Record:
    model, other = (
        db.read("model", name, generation=generations[name])
        for name in (take, frame.template)
    )
    registered = register_one(take, model, other, frame)
    groups, tables = registered_parts(model, registered)
    about = provenance("register", inputs, parameters={"reference": reference})
    about |= {"take": take, "consent_scope": model.attrs.get("consent_scope", [])}
    about |= {
        "summary_parameters": {
            "surfels": SAMPLED,
            "seed": 0,
            "digest": summary_digest(),
        }
    }
    with db.stage("registration", take, names=generations) as stage:
        stage.write({"registration": registered} | groups, tables=tables)
        return stage.commit(about)


def _has_landmarks(db: Database, record: Record) -> bool:
    if record.contents and "landmark_position" not in record.contents.get(
        "mesh", {}
    ).get("variables", []):
        return False
    return has_landmarks(db.read("model", record.take, generation=record.generation))
