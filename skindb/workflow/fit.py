"""From the capture of a take to a version of its model."""

import shutil
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from xarray import DataTree

from skindb.errors import InputError, input_error
from skindb.files import Attributes
from skindb.fit import FitParameters, FitPlan, first_pass, plan_fit, second_pass
from skindb.reflectance.brdf_files import read_dictionary
from skindb.reflectance.dictionary import EMBEDDED, Dictionary, embedded_dictionary
from skindb.store import Database, Record, seal_of, subject_of
from skindb.threads import one_blas_thread
from skindb.types import Progress, silent
from skindb.workflow.audit import logged
from skindb.workflow.cohorts import model_with_summary, summary_parameters
from skindb.workflow.derive import Derivation, groups_of

EMBEDDED_NAME = "embedded"  # in place of a path
METHOD = (first_pass, second_pass)  # functions that compute a model


@logged("fit")
def fit_take(
    db: Database,
    take: str,
    parameters: FitParameters | None = None,
    *,
    dictionary: Dictionary | None = None,
    generation: int | None = None,
    wait: float = 0.0,
    progress: Progress = silent,
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
    requested = parameters or FitParameters()
    with (
        db.lease(take, "model", wait=wait, command="skindb fit") as lease,
        one_blas_thread(),
    ):
        record = db.record("capture", take, generation)
        capture = db.version(record)
        # the newest record decides
        db.require_consent(take, "fit")
        derivation = fit_derivation(db, record, requested, dictionary)
        name = f"{take}-{seal_of(derivation.provenance)[:16]}"
        scratch = db.scratch() / name
        _remove_first_passes(db, take, besides=name)
        try:
            first_tree = _stored_first_pass(scratch, take)
            if first_tree is None:
                first_tree = first_pass(
                    capture, requested, dictionary=dictionary, progress=progress
                )
                _store_first_pass(db, scratch, take, first_tree)
            else:
                progress("first pass of the run before", 1, 1)
            model = second_pass(
                capture, first_tree, dictionary=dictionary, progress=progress
            )
            model = model_with_summary(model)
            model.attrs |= {
                "seeds": {"fit": model.attrs["parameters"]["seed"]},
                "summary_parameters": summary_parameters(),
            }
            record = derivation.commit(model, lease)
        except (OSError, InputError):
            if db.withdrawal(subject_of(take)) is not None:
                _remove_first_passes(db, take)
            raise
        _remove_first_passes(db, take)
        return record


def fit_derivation(
    db: Database,
    capture: Record,
    parameters: FitParameters,
    dictionary: Dictionary | None = None,
) -> Derivation:
    """What decides the model of a capture.

    The requested parameters do: where a take has fewer components, or a dictionary
    fewer BRDFs, the fit uses less.
    """
    return Derivation.of(
        db,
        "model",
        capture.take,
        inputs=[capture],
        code=METHOD,
        requested=parameters.as_dict(),
        dictionary_digest=(dictionary or embedded_dictionary()).digest,
    )


def _stored_first_pass(scratch: Path, take: str) -> DataTree | None:
    """The first pass of a killed fit that would give the same model, in memory."""
    db = Database(scratch)
    try:
        if not db.has("model", take):
            return None
        stored = db.read("model", take)
        groups = {name: ds.compute() for name, ds in groups_of(stored).items()}
    except InputError:  # damaged: it is repeated
        return None
    first_pass_tree = DataTree.from_dict(groups)
    first_pass_tree.attrs = stored.attrs
    return first_pass_tree


def _store_first_pass(
    db: Database, scratch: Path, take: str, first_tree: DataTree
) -> None:
    """Keep a first pass for the case that the fit is killed, in a database of its own,
    whose name contains a digest of all that decides the model.
    """
    shutil.rmtree(scratch, ignore_errors=True)  # a damaged one
    db.make_scratch(scratch / "data")
    with Database(scratch).stage("model", take) as stage:
        stage.write(groups_of(first_tree))
        stage.commit({str(name): value for name, value in first_tree.attrs.items()})


def _remove_first_passes(db: Database, take: str, besides: str = "") -> None:
    """Remove the first passes of a take, except for that of this name."""
    for log in db.scratch().glob(f"{take}-*/log/model/{take}"):
        folder = log.parents[2]
        if folder.name != besides:
            shutil.rmtree(folder, ignore_errors=True)


@logged("fit")
def fit_with(
    db: Database,
    take: str,
    *,
    changes: Attributes,
    dictionary: Path | None = None,
    explain: bool = False,
    wait: float = 0.0,
    progress: Progress = silent,
) -> Record | tuple[str, list[str]]:
    """Fit a take as a command asks for it, also in another process.

    Parameters
    ----------
    db, take, wait, progress
        See `fit_take`.
    changes, dictionary
        See `parameters_of`.
    explain
        Only return the take and what its fit would skip.
    """
    parameters = parameters_of(db, take, changes, dictionary=dictionary)
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
) -> FitPlan:
    """What `fit_take` would skip, and the bound on the error this costs."""
    return plan_fit(db.read("capture", take), parameters, dictionary=dictionary)


def takes_to_fit(
    db: Database,
    *,
    refit: bool = False,
    changes: Attributes | None = None,
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
        its own with `changes` put in, or with another dictionary. An interrupted refit
        therefore continues with the takes that are not done. Takes whose consent does
        not cover fits are skipped, see `takes_without_consent`.
    changes, dictionary
        As in `parameters_of`.
    """
    takes = []
    for take in db.takes("capture"):
        try:
            if "fit" not in db.consent(take):
                continue
            record = current_model(db, take)
            if record is None or (
                refit and not _up_to_date(db, record, changes or {}, dictionary)
            ):
                takes.append(take)
        except InputError:  # its fit reports the reason, and other takes continue
            takes.append(take)
    return takes


def takes_without_consent(db: Database) -> list[str]:
    """Takes with a capture whose subject does not agree to fits; damaged ones are
    not looked at.
    """
    takes = []
    for take in db.takes("capture"):
        with suppress(InputError):
            takes += [take] if "fit" not in db.consent(take) else []
    return takes


def parameters_of(
    db: Database,
    take: str,
    changes: Attributes,
    *,
    dictionary: Path | None = None,
) -> FitParameters:
    """The parameters to fit a take with: those of its newest model, or the defaults.

    Parameters
    ----------
    db, take
        Which take.
    changes
        Parameters of `FitParameters` that the user gave.
    dictionary
        Path of the dictionary of the fit; None for the embedded one.

    Raises
    ------
    InputError
        If the newest model was made with a dictionary from files, and none is given.
    """
    if not db.has("model", take):
        return FitParameters(**changes)
    model = db.record("model", take).provenance
    if dictionary is None and model.get("dictionary", EMBEDDED) != EMBEDDED:
        raise input_error(
            take,
            "a fit keeps the dictionary of the take's model",
            f"no dictionary for a model made with {model['dictionary']!r}",
            f"name it with --dictionary, or give --dictionary {EMBEDDED_NAME}",
        )
    values = FitParameters.of({"parameters": model["requested"]}).as_dict()
    # those that only the surface model of the fit has
    if changes.get("surface", values["surface"]) != values["surface"]:
        for name in ("k", "rank"):
            del values[name]
    return FitParameters(**{**values, **changes})


def current_model(db: Database, take: str) -> Record | None:
    """The newest model of a take if it was made from the newest capture."""
    if not db.has("model", take):
        return None
    model = db.record("model", take)
    capture = db.record("capture", take).as_input()
    return model if capture in model.made_from else None


def dictionary_at(path: Path | None) -> Dictionary | None:
    """The dictionary of a path, read once in each process as long as its files stay the
    same; None for the embedded one.
    """
    if path is None or (path.name == EMBEDDED_NAME and not path.exists()):
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
    db: Database, record: Record, changes: Attributes, dictionary: Path | None
) -> bool:
    """Whether a fit with these parameters and this code would give the same model."""
    parameters = parameters_of(db, record.take, changes, dictionary=dictionary)
    capture = db.record("capture", record.take)
    brdfs = dictionary_at(dictionary)
    return fit_derivation(db, capture, parameters, brdfs).describes(record)
