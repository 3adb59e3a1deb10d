"""Computing stale results again, in order of dependence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from skindb.analysis.studies import STUDIES
from skindb.errors import InputError, input_error, require
from skindb.files import Attributes
from skindb.store import (
    RELEASE,
    STUDY,
    Database,
    Record,
    Request,
    UnavailableError,
)
from skindb.types import Progress, silent
from skindb.workflow.administration import (
    KINDS,
    Refreshed,
    requested_result,
    stale_results,
)
from skindb.workflow.audit import logged
from skindb.workflow.cohorts import register_takes
from skindb.workflow.edits import edit
from skindb.workflow.fit import fit_with
from skindb.workflow.studies import study
from skindb.workflow.takes import computing_on, map_takes

if TYPE_CHECKING:
    from distributed import Client


@logged("refresh")
def refresh(
    db: Database,
    *,
    dictionary: Path | None = None,
    workers: int | None = None,
    client: Client | None = None,
    wait: float = 0.0,
    progress: Progress = silent,
) -> list[Refreshed]:
    """Make stale models, registrations, studies and edits again, each with its own parameters.

    Withdrawals that were interrupted are completed first, and results that withdrawals
    removed are computed again.

    Parameters
    ----------
    db
        Database.
    dictionary
        Path of the dictionary of the fits; default the embedded one.
    workers, client
        See `map_takes`. With `client` its workers do the studies as well, see `computing_on`.
    wait
        Seconds to wait for another run that fits one of the takes.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    list of Refreshed
        One for each stale or removed version, in the order in which they were made.
        What cannot be computed again, such as a registration of a take whose consent
        does not cover statistics any more, stays as it is and is refused by every step
        that would read it.
    """
    resources = {"workers": workers, "client": client}
    makers = {
        "model": partial(_fit_again, db, dictionary, wait, resources),
        "registration": partial(_register_again, db, resources),
        STUDY: partial(_repeat_again, db, dictionary),
        "edit": partial(_repeat_again, db, dictionary),
    }
    db.complete_erasures()
    results = []
    for number, kind in enumerate(KINDS):
        progress("refresh", number, len(KINDS))
        with computing_on(client if kind == STUDY else None, db.folder):
            results += repeat_requests(db, dictionary=dictionary, kinds=(kind,))
            # what was made before made others stale
            made = [one for one in stale_results(db) if one.generation]
            if stale := [result for result in made if result.kind == kind]:
                results += makers[kind](stale)
    progress("refresh", len(KINDS), len(KINDS))
    return results


@logged("refresh")
def repeat_requests(
    db: Database, *, dictionary: Path | None = None, kinds: Sequence[str] = KINDS
) -> list[Refreshed]:
    """Compute the results again that withdrawals removed, each with its own parameters.

    Parameters
    ----------
    db, dictionary
        As in `refresh`.
    kinds
        Kinds of the results.

    Returns
    -------
    list of Refreshed
        One for each request, in order of dependence. What fails for any reason is named
        there, and stays requested.
    """
    requests = [request for request in db.requests() if request.kind in kinds]
    results = []
    for request in sorted(requests, key=lambda one: (KINDS.index(one.kind), one.take)):
        make = partial(_repeat, db, dictionary, request)
        outcome = _again(requested_result(request), make)
        if outcome.record is not None:
            db.fulfil(request)
        results.append(outcome)
    return results


def _repeat(db: Database, dictionary: Path | None, request: Request) -> Record:
    """Compute a result again."""
    if request.kind == "registration":
        # all takes together: the common (u, v) depends on each of them
        reference = request.parameters.get("reference", "")
        is_fitted = reference in db.takes("model")
        usable = is_fitted and "statistics" in db.consent(reference)
        return next(
            iter(register_takes(db, reference=reference if usable else None).values())
        )
    if request.kind == RELEASE:
        return _repeat_release(db, request)
    if request.kind == STUDY:
        return repeat_study(db, request.take, request.parameters, dictionary=dictionary)
    # by the same amounts, with the newest study of that name
    amounts = request.parameters["amounts"]
    study = request.parameters.get("study", "traits")
    tree = edit(db, request.take, amounts, study=study, dictionary=dictionary)
    return db.record("edit", request.take, tree.attrs["generation"])


def repeat_study(
    db: Database,
    key: str,
    parameters: Attributes,
    *,
    dictionary: Path | None = None,
) -> Record:
    """Run a study again with its own parameters, stored as before; takes that no longer
    exist are skipped.

    Raises
    ------
    InputError
        If this version of skindb does not know the study or one of its parameters, or as the study.
    """
    options = dict(parameters)
    study_name = str(options.pop("what", ""))
    rule = "a study must be one that this version of skindb can compute"
    cure = "run skindb analyze"
    require(study_name in STUDIES, key, rule, f"the study {study_name!r}", cure)
    accepted = {spec.name for spec in fields(STUDIES[study_name].parameters)}
    if unknown := sorted(options.keys() - {*accepted, "takes", "as_normal", "release"}):
        raise input_error(key, rule, f"the parameters {', '.join(unknown)}", cure)
    release = options.pop("release", "") or None
    takes = options.pop("takes", [])
    stored = set(db.takes("model", release=release))
    if takes and not stored & set(takes):
        raise input_error(
            key, "a study needs fitted takes", "no version of it is left", cure
        )
    if "group_by" in options:
        options["group_by"] = options["group_by"] or None
    if "dictionary" in accepted:
        options["dictionary"] = dictionary
    results = study(
        db,
        study_name,
        takes=[take for take in takes if take in stored],
        release=release,
        name=key.partition(".")[2] or None,
        **options,
    )
    return db.record(STUDY, key, results.attrs["generation"])


def _repeat_release(db: Database, request: Request) -> Record:
    """The next revision of a release, with the registrations that were made again of
    the models that it names.
    """
    pins = request.parameters.get("pins") or db.record(RELEASE, request.take).made_from
    models = {pin["take"]: pin["seal"] for pin in pins if pin["kind"] == "model"}
    require(
        not any(waiting.kind == "registration" for waiting in db.requests()),
        str(request),
        "the registrations of a release must be computed before its next revision",
        "that they could not be computed yet",
        "run skindb refresh",
    )
    takes = request.parameters.get("takes", [])
    records = [
        db.record("registration", take)
        for take in takes
        if db.has("registration", take)
    ]
    registrations = [
        record.as_input()
        for record in records
        if models.get(record.take) in {pin["seal"] for pin in record.made_from}
    ]
    if not registrations and "pins" not in request.parameters:
        return db.record(RELEASE, request.take)
    return db.commit_release(request.take, [*pins, *registrations])


def _fit_again(
    db: Database,
    dictionary: Path | None,
    wait: float,
    resources: Attributes,
    stale: Sequence[Refreshed],
) -> list[Refreshed]:
    models = {result.take: result for result in stale}
    call = partial(fit_with, db, changes={}, dictionary=dictionary, wait=wait)
    return [
        replace(
            models[outcome.take],
            record=outcome.value if isinstance(outcome.value, Record) else None,
            fault=str(outcome.error or ""),
        )
        for outcome in map_takes(call, list(models), **resources, shared=db.folder)
    ]


def _register_again(
    db: Database, resources: Attributes, stale: Sequence[Refreshed]
) -> list[Refreshed]:
    """All takes together: the common (u, v) depends on each of them."""
    registration = db.record("registration", stale[0].take)
    reference = registration.provenance.get("parameters", {}).get("reference") or None
    fault = "its consent does not cover statistics, or its model has no landmarks"
    records = {}
    try:
        records = register_takes(db, reference=reference, **resources)
    except UnavailableError:
        raise
    except InputError as error:
        fault = str(error)
    made = [replace(result, record=records.get(result.take)) for result in stale]
    return [one if one.record else replace(one, fault=fault) for one in made]


def _repeat_again(
    db: Database, dictionary: Path | None, stale: Sequence[Refreshed]
) -> list[Refreshed]:
    def repeat(result: Refreshed) -> Record:
        parameters = db.record(result.kind, result.take).provenance["parameters"]
        return _repeat(db, dictionary, Request(result.kind, result.take, parameters))

    return [_again(result, partial(repeat, result)) for result in stale]


def _again(result: Refreshed, make: Callable[[], Record]) -> Refreshed:
    """The outcome of a computation; whatever it raises does not stop the others."""
    try:
        return replace(result, record=make())
    except InputError as error:
        return replace(result, fault=str(error))
    # for example parameters of another version of skindb, or too little memory
    except Exception as error:  # noqa: BLE001
        text = f"{type(error).__name__}: {error}"
        return replace(result, fault=f"cannot be computed by this version: {text}")
