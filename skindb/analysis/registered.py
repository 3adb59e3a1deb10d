"""Registrations of the database, which studies use as long as they are current."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import xarray as xr

from skindb import __version__
from skindb.analysis.members import Takes
from skindb.analysis.registration import register, with_landmarks
from skindb.store import Database

Input = dict[str, Any]


def registration_of(db: Database, models: Takes) -> tuple[Mapping[str, xr.Dataset], list[Input]]:
    """Registration of takes: the stored one where it is current, else made here.

    Returns
    -------
    registered, inputs
        As from `register`; and the stored versions used, as a provenance names them: none where it was made here.
    """
    stored = _current(db, models)
    if not stored:
        return register(models), []
    versions = [{"kind": "registration", "take": t, "generation": v.attrs["generation"]} for t, v in stored.items()]
    return {take: _landmarks_loaded(v["registration"].to_dataset()) for take, v in stored.items()}, versions


def model_inputs(db: Database, models: Takes) -> list[Input]:
    """The versions of models, as a provenance names them."""
    records = {take: db.record("model", take, model.attrs["generation"]) for take, model in models.items()}
    return [{"kind": "model", "take": t, "generation": r.generation, "path": r.path} for t, r in records.items()]


def _current(db: Database, models: Takes) -> dict[str, xr.DataTree]:
    """The stored registrations of all takes with landmarks; none if any is missing or stale.

    The common coordinates depend on every take that was registered along: it must have been these and no others, in
    these versions of their models, together and by this version of skindb.
    """
    wanted = model_inputs(db, with_landmarks(models))
    takes = [one["take"] for one in wanted]
    if not set(takes) <= set(db.takes("registration")):
        return {}
    versions = {take: db.read("registration", take) for take in takes}
    made_by = [_made_by(version) for version in versions.values()]
    # of a run that was stopped, some takes have the new one: a reference tells it from the one before
    same = all(one == (_by_take(wanted), __version__, made_by[0][2]) for one in made_by)
    return versions if same else {}


def _made_by(version: xr.DataTree) -> tuple[list[Input], str, dict[str, Any]]:
    """What a registration follows from: versions of models, of the software, parameters."""
    return _by_take(version.attrs["inputs"]), version.attrs["software_version"], version.attrs["parameters"]


def _by_take(inputs: list[Input]) -> list[Input]:
    return sorted(inputs, key=lambda one: str(one["take"]))


def _landmarks_loaded(registered: xr.Dataset) -> xr.Dataset:
    """The few numbers of a take in memory; the surfels' coordinates are read when they are asked for."""
    return registered.assign(
        {name: registered[name].load() for name in registered if "surfel" not in registered[name].dims}
    )
