"""From the capture of a take to a version of its model."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from skindb.analysis.summary import SAMPLED
from skindb.errors import Fault, InputError
from skindb.fit import FitParameters, FitPlan, first_pass, plan_fit, second_pass
from skindb.reflectance.dictionary import EMBEDDED, Dictionary, embedded_dictionary
from skindb.reflectance.table_file import read_dictionary
from skindb.schema.consent import require_consent
from skindb.store import Database, Record
from skindb.threads import one_blas_thread
from skindb.types import Progress
from skindb.workflow.audit import logged
from skindb.workflow.first import (
    FIRST,
    inputs_of_first_pass,
    keep_first_pass,
    kept_first_pass,
)
from skindb.workflow.provenance import as_input, groups_of, method_digest, provenance
from skindb.workflow.summaries import sample_groups, summary_digest, tables_of

# modules and subpackages that decide the numbers of a fit
METHOD = (
    "fit",
    "numerics",
    "optics",
    "reflectance",
    "elementwise",
    "schema/status",
    "jit",
    "threads",
    "geometry/rays",
    "geometry/_ray_kernels",
)


@logged("fit")
def fit_take(
    db: Database,
    take: str,
    parameters: FitParameters | None = None,
    *,
    dictionary: Dictionary | None = None,
    generation: int | None = None,
    wait: float = 0.0,
    progress: Progress | None = None,
) -> Record:
    """Fit one take and commit its model; killed after its first pass, the same call
    continues there.

    Parameters
    ----------
    db
        Database with a version of kind "capture" of the take.
    take
        Name of the take.
    parameters, dictionary
        See `skindb.fit.fit_model`.
    generation
        Version of the capture; default the newest.
    wait
        Seconds to wait for another run of the same take.
    progress
        Called with the stage, the number of finished steps and the total number of steps.

    Returns
    -------
    Record
        Of the commit; its provenance holds the report of the fit: seconds per stage,
        fraction of surfels per status, medians of the residuals and of the errors at
        held-out samples, suspicious lights and cameras, and what was skipped.

    Raises
    ------
    InputError
        Without a capture, without the consent "fit", if another run fits or ingests the
        take, or if the capture cannot be fitted. Nothing is committed then.
    """
    # before anything is written for a take that there is not
    db.record("capture", take, generation)
    asked = parameters or FitParameters()
    method = method_digest(METHOD)
    with (
        db.lease(take, "model", wait=wait, command="skindb fit") as lease,
        one_blas_thread(),
    ):
        capture = db.read("capture", take, generation=generation)
        # the newest record decides
        require_consent({"consent_scope": db.consent(take), "take": take}, "fit")
        made_from = as_input(db, "capture", take, capture)
        inputs = inputs_of_first_pass(asked, dictionary, made_from, method)
        first = kept_first_pass(db, take, inputs)
        if first is None:
            first = first_pass(capture, asked, dictionary=dictionary, progress=progress)
            keep_first_pass(db, take, first, inputs, lease)
        elif progress is not None:
            progress("first pass of the run before", 1, 1)
        model = second_pass(capture, first, dictionary=dictionary, progress=progress)
        used = model.attrs["parameters"]
        about = provenance(
            "fit", [made_from], parameters=used, seeds={"fit": used["seed"]}
        )
        about |= {"requested": asked.as_dict(), "method_digest": method}
        about |= {
            "summary_parameters": {
                "surfels": SAMPLED,
                "seed": 0,
                "digest": summary_digest(),
            }
        }
        with db.stage("model", take, lease) as stage:
            stage.write(
                groups_of(model) | sample_groups(model), tables=tables_of(model)
            )
            record = stage.commit(
                {str(name): value for name, value in model.attrs.items()}
                | {"take": take}
                | about
            )
        db.forget(FIRST, take)
        return record


@logged("fit")
def fit_with(
    db: Database,
    take: str,
    *,
    given: Mapping[str, Any],
    refit: bool = False,
    dictionary: Path | None = None,
    explain: bool = False,
    wait: float = 0.0,
    progress: Progress | None = None,
) -> Record | tuple[str, list[str]]:
    """Fit a take as a command asks for it, also in another process.

    Parameters
    ----------
    db, take, wait, progress
        See `fit_take`.
    given, refit, dictionary
        See `parameters_of`.
    explain
        Only return the take and what its fit would skip.
    """
    parameters = parameters_of(db, take, given, refit=refit, dictionary=dictionary)
    brdfs = dictionary_at(dictionary)
    if explain:
        return take, plan_take(db, take, parameters, dictionary=brdfs).explain()
    return fit_take(
        db, take, parameters, dictionary=brdfs, wait=wait, progress=progress
    )


@logged("fit", explain=True)
def plan_take(
    db: Database,
    take: str,
    parameters: FitParameters | None = None,
    *,
    dictionary: Dictionary | None = None,
    generation: int | None = None,
) -> FitPlan:
    """What `fit_take` would skip, and the bound on the error this costs."""
    return plan_fit(
        db.read("capture", take, generation=generation),
        parameters,
        dictionary=dictionary,
    )


def takes_to_fit(
    db: Database,
    *,
    refit: bool = False,
    given: Mapping[str, Any] | None = None,
    dictionary: Path | None = None,
) -> list[str]:
    """The takes whose model is missing or out of date.

    Parameters
    ----------
    db
        Database with captures.
    refit
        Without it: takes without a model of their newest capture. With it also takes
        whose model would change: it was made by other code, with other parameters than
        its own with `given` put in, or with another dictionary. An interrupted refit
        therefore continues with the takes that are not done. Takes whose consent does
        not cover fits are skipped, see `takes_without_consent`.
    given, dictionary
        As in `parameters_of`.
    """
    takes = []
    for take in db.takes("capture"):
        try:
            if "fit" not in db.consent(take):
                continue
            record = current_model(db, take)
            if record is None or (
                refit and not _up_to_date(db, record, given or {}, dictionary)
            ):
                takes.append(take)
        except InputError:  # its fit reports the reason, and other takes continue
            takes.append(take)
    return takes


def takes_without_consent(db: Database, scope: str) -> list[str]:
    """Takes with a capture whose subject does not agree to a scope; damaged ones are
    not looked at.
    """
    found = []
    for take in db.takes("capture"):
        with suppress(InputError):
            found += [take] if scope not in db.consent(take) else []
    return found


def parameters_of(
    db: Database,
    take: str,
    given: Mapping[str, Any],
    *,
    refit: bool,
    dictionary: Path | None = None,
) -> FitParameters:
    """The parameters to fit a take with.

    Parameters
    ----------
    db, take
        Which take.
    given
        Parameters of `FitParameters` that the user gave.
    refit
        The others are those of the take's newest model if it has one, and the default otherwise.
    dictionary
        Path of the dictionary of the fit; None for the embedded one.

    Raises
    ------
    InputError
        In a refit of a model that was made with a dictionary from files, if none is given.
    """
    if not refit or not db.has("model", take):
        return FitParameters(**given)
    own = db.record("model", take).provenance
    if dictionary is None and own.get("dictionary", EMBEDDED) != EMBEDDED:
        rule = "a refit uses the dictionary of the model"
        cure = "name it with --dictionary, or fit without --refit"
        raise InputError(
            Fault(
                take,
                rule,
                f"no dictionary for a model made with {own['dictionary']!r}",
                cure,
            )
        )
    return replace(_requested(own), **given)


def current_model(db: Database, take: str) -> Record | None:
    """The newest model of a take if it was made from the newest capture."""
    if not db.has("model", take):
        return None
    record = db.record("model", take)
    newest = db.record("capture", take).generation
    made_from = record.provenance.get("inputs", [])
    return (
        record
        if any(
            one["kind"] == "capture" and one["generation"] == newest
            for one in made_from
        )
        else None
    )


def dictionary_at(path: Path | None) -> Dictionary | None:
    """The dictionary of a path, read once in each process as long as its files stay the same."""
    if path is None:
        return None
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return _read(
        path,
        tuple((file.name, file.stat().st_mtime_ns) for file in files if file.exists()),
    )


@lru_cache(maxsize=1)
def _read(path: Path, _: tuple[tuple[str, int], ...]) -> Dictionary:
    return read_dictionary(path)


def _up_to_date(
    db: Database, record: Record, given: Mapping[str, Any], dictionary: Path | None
) -> bool:
    """Whether a fit with these parameters and this code would give the model that is there."""
    about = record.provenance
    brdfs = dictionary_at(dictionary) or embedded_dictionary()
    wanted = parameters_of(db, record.take, given, refit=True, dictionary=dictionary)
    alike = (
        wanted == _requested(about) and about.get("dictionary_digest") == brdfs.digest
    )
    return alike and about.get("method_digest") == method_digest(METHOD)


def _requested(about: Mapping[str, Any]) -> FitParameters:
    """What a fit was asked for: where a take has fewer components, or a dictionary
    fewer BRDFs, it used less.
    """
    return FitParameters.of({"parameters": about.get("requested", about["parameters"])})
