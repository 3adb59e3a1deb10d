"""Studies of the population of a database: computed if what is stored is not current,
and committed with what they were made from.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, asdict, fields
from functools import wraps
from typing import Any

import xarray as xr

from skindb.analysis.studies import STUDIES
from skindb.analysis.study import Population, Study
from skindb.analysis.subjects import CONDITION, subjects_of, subjects_without_normal
from skindb.errors import Fault, InputError
from skindb.parameters import option_of, require_limits
from skindb.store import STUDY, Database, Record, require_text
from skindb.threads import on_one_blas_thread
from skindb.workflow.audit import logged_action
from skindb.workflow.derive import Derivation
from skindb.workflow.study_inputs import open_population

STUDY_NAME = r"[A-Za-z0-9_-]{1,64}"


@on_one_blas_thread
def study(
    db: Database,
    what: str,
    *,
    takes: Sequence[str] = (),
    release: str | None = None,
    name: str | None = None,
    **parameters: Any,
) -> xr.DataTree:
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
    record = _record(what)
    chosen = _parameters(record, parameters)
    requested = _requested(chosen) | {"takes": [*takes], "release": release or ""}
    key = study_key(record, requested, name)
    dictionary = parameters.get("dictionary")
    used = takes or db.takes("model", release=release)
    with logged_action(db, "study", used, what=record.name):
        population, inputs = open_population(
            db, record, takes=takes, release=release, dictionary=dictionary
        )
        derivation = _derivation(db, key, record, requested, population, inputs)
        # the file of a dictionary may change: a study with one is always computed
        if dictionary is not None or derivation.current() is None:
            version = xr.DataTree.from_dict(record.compute(population, chosen))
            if population.notes:
                version.attrs["registration"] = population.notes
            derivation.commit(version)
    return db.read(STUDY, key)


def study_key(record: Study, requested: Mapping[str, Any], name: str | None) -> str:
    """What a study is stored as.

    The study of everything with default parameters is stored under its own word,
    "traits"; with other parameters it is "traits.k-8", and with a name "traits.<name>".
    No study replaces one that was asked for differently; one with another random seed
    is the next generation of the same.
    """
    if name is not None:
        return f"{record.name}.{require_text(name, STUDY_NAME, 'name of a study')}"
    defaults = {"takes": [], "release": ""} | {
        spec.name: _plain(spec.default) for spec in fields(record.parameters)
    }
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
        whole = json.dumps(chosen, sort_keys=True).encode()
        text = hashlib.sha256(whole).hexdigest()[:16]
    return f"{record.name}.{text}"


def study_function(record: Study) -> Callable[..., xr.DataTree]:
    """Function of a database that makes one study, with its parameters in signature and
    docstring, for notebooks.
    """

    @wraps(study)
    def function(db: Database, **options: Any) -> xr.DataTree:
        return study(db, record.name, **options)

    general = inspect.signature(study).parameters
    unset = inspect.Parameter.empty
    keywords = [
        inspect.Parameter(
            spec.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=unset if spec.default is MISSING else spec.default,
            annotation=spec.type,
        )
        for spec in fields(record.parameters)
    ]
    keywords += [general[name] for name in ("takes", "release", "name")]
    function.__signature__ = inspect.Signature([general["db"], *keywords])  # type: ignore[attr-defined]
    function.__name__ = function.__qualname__ = record.name
    helps = "".join(
        f"    {spec.name}\n        {option_of(record.parameters, spec.name).help}\n"
        for spec in fields(record.parameters)
    )
    function.__doc__ = (
        f"Study of the population: {record.description}; see `skindb.workflow.study`.\n\n"
        "    Parameters\n    ----------\n    db\n        Database with models.\n"
        f"{helps}    takes, release, name\n        As in `skindb.workflow.study`.\n    "
    )
    return function


STUDY_FUNCTIONS = {name: study_function(record) for name, record in STUDIES.items()}


def _record(what: str) -> Study:
    if what not in STUDIES:
        cure = f"choose from {', '.join(STUDIES)}"
        raise InputError(
            Fault(f"study {what}", "must be a known study", "another name", cure)
        )
    return STUDIES[what]


def _parameters(record: Study, options: Mapping[str, Any]) -> Any:
    """The parameters of a study as its record, checked."""
    specs = {spec.name: spec for spec in fields(record.parameters)}
    where = f"study {record.name}"
    if unknown := sorted(options.keys() - specs.keys()):
        rule = f"its parameters are {', '.join(specs) or 'none'}"
        raise InputError(Fault(where, rule, ", ".join(unknown), "omit the others"))
    required = [name for name, spec in specs.items() if spec.default is MISSING]
    if missing := [name for name in required if options.get(name) is None]:
        names = " and ".join(missing)
        raise InputError(
            Fault(where, f"needs {names}", "none", f"give {names}, such as 'gender'")
        )
    chosen = dict(options)
    if isinstance(chosen.get("adjust"), str):
        chosen["adjust"] = (chosen["adjust"],)
    parameters = record.parameters(**chosen)
    require_limits(parameters)
    return parameters


def _requested(parameters: Any) -> dict[str, Any]:
    """What another run needs to repeat a study with these parameters."""
    values = asdict(parameters)
    values.pop("dictionary", None)
    return {name: _plain(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    """A value of a parameter as it is stored."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        return list(value)
    return "" if value is None else value


def _derivation(
    db: Database,
    key: str,
    record: Study,
    requested: Mapping[str, Any],
    population: Population,
    inputs: Sequence[Record],
) -> Derivation:
    """Everything that decides the content of a study."""
    cohort = population.cohort
    skipped = list(cohort.attrs["skipped"])
    compares_conditions = str(requested.get("group_by", "")).startswith(CONDITION)
    if record.compares_normal and not compares_conditions:
        skipped += subjects_without_normal(subjects_of(cohort))
    outdated = list(cohort.attrs["outdated"])
    notes = [*skipped, *outdated, *population.notes]
    names = {note["take"] for note in notes if note["take"]}
    names.update(requested["takes"], *({used.take, *used.names} for used in inputs))
    return Derivation.of(
        db,
        STUDY,
        key,
        inputs=inputs,
        code=[record.compute, open_population],
        names=names,
        parameters={"what": record.name, **requested},
        seeds={"analyze": requested["seed"]} if "seed" in requested else {},
        skipped=skipped,
        outdated=outdated,
        attributes_digest=_attributes_digest(cohort),
    )


def _attributes_digest(cohort: xr.Dataset) -> str:
    """Digest of the coordinates that describe the takes: age, gender, condition,
    parameters of the fit.
    """
    values = {
        str(name): [str(value) for value in coordinate.values]
        for name, coordinate in cohort.coords.items()
        if coordinate.dims == ("take",)
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
