"""The first pass of a fit, kept until the model is committed, so that a killed fit need
not repeat it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import xarray as xr

from skindb import __version__
from skindb.errors import InputError
from skindb.fit import FitParameters
from skindb.reflectance.dictionary import Dictionary, embedded_dictionary
from skindb.schema import SCHEMA_VERSION
from skindb.schema.plain import plain
from skindb.store import Database, Lease
from skindb.workflow.provenance import groups_of, provenance

FIRST = "first"  # transient kind: no result, and gone when the model is there


def inputs_of_first_pass(
    parameters: FitParameters,
    dictionary: Dictionary | None,
    capture: Mapping[str, Any],
    method: str,
) -> dict[str, Any]:
    """What decides the numbers of a first pass: parameters, BRDFs, the capture with its
    seal, digest of the code.
    """
    return {
        "requested": parameters.as_dict(),
        "dictionary_digest": (dictionary or embedded_dictionary()).digest,
        "inputs": [dict(capture)],
        "method_digest": method,
        "schema_version": SCHEMA_VERSION,
        "software_version": __version__,
    }


def kept_first_pass(
    db: Database, take: str, inputs: Mapping[str, Any]
) -> xr.DataTree | None:
    """The first pass of a killed fit with the same inputs, in memory; None if there is
    no such one.
    """
    try:
        if not db.has(FIRST, take):
            return None
        about = db.record(FIRST, take).provenance
        if any(about.get(name) != plain(value) for name, value in inputs.items()):
            return None
        kept = db.read(FIRST, take)
        first = xr.DataTree.from_dict(
            {name: ds.compute() for name, ds in groups_of(kept).items()}
        )
    except InputError:  # damaged: it is repeated
        return None
    first.attrs = kept.attrs
    return first


def keep_first_pass(
    db: Database, take: str, first: xr.DataTree, inputs: Mapping[str, Any], lease: Lease
) -> None:
    """Keep a first pass for the case that the fit is killed; it replaces that of another fit."""
    about = {str(name): value for name, value in first.attrs.items()}
    about |= provenance("fit", inputs["inputs"], parameters=about["parameters"])
    db.forget(FIRST, take)
    with db.stage(FIRST, take, lease) as stage:
        stage.write(groups_of(first))
        stage.commit({**about, **inputs, "take": take})
