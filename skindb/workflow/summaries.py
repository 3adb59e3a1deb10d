"""What cohorts need of versions that do not keep it themselves: kept as versions of
kind summary.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from skindb.analysis.regions import take_masks
from skindb.analysis.summary import (
    SAMPLED,
    SIZE,
    common_maps,
    region_tables,
    sample_surfels,
    summary_tables,
)
from skindb.fit import prediction_table
from skindb.schema import FitStatus, dataset
from skindb.schema.label import FACE
from skindb.store import SUMMARY, CohortRequest, Database, Lookup, Record, lacking
from skindb.workflow.audit import logged
from skindb.workflow.code_digest import code_digest
from skindb.workflow.derive import TABLES, Derivation, groups_of
from skindb.workflow.takes import map_takes, results_of


@logged("summarise")
def summarise(
    db: Database,
    takes: Sequence[str] | None = None,
    *,
    surfels: int = SAMPLED,
    seed: int = 0,
    size: int = SIZE,
    workers: int | None = None,
    release: str | None = None,
) -> list[str]:
    """Store what cohorts with these options need, for takes that lack it.

    New models and registrations keep their tables, a sample of 5,000 surfels with the
    seed 0, and maps of 512 texels; this is for other samples and sizes, and for models
    that were summarised by other code.

    Parameters
    ----------
    db
        Database with models.
    takes
        Default all.
    surfels, seed
        Number of surfels of the samples, and their random seed.
    size
        Texels along each side of the maps, for takes that are registered.
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
    sample = CohortRequest("surfels", surfels=surfels, seed=seed, digest=code)
    lookup = Lookup(db, release)
    maps = CohortRequest("maps", size=size, digest=code)
    models = [
        lookup.record("model", take)
        for take in lacking(db, "model", [tables, sample], names, release=release)
    ]
    registered = [take for take in names if lookup.has("registration", take)]
    lack = lacking(db, "registration", [maps, sample], registered, release=release)
    frames = [lookup.record("registration", take) for take in lack]
    records = list(
        results_of(
            map_takes(partial(_summarise_model, db, sample), models, workers=workers)
        )
    )
    records += results_of(
        map_takes(
            partial(_summarise_registration, db, sample, size), frames, workers=workers
        )
    )
    return sorted({record.take for record in records})


def summary_digest() -> str:
    """Digest of the code that computes tables, samples and maps; results of other code
    are computed again.
    """
    return code_digest(*METHOD)


def summary_parameters(
    *, surfels: int = SAMPLED, seed: int = 0, size: int | None = None
) -> dict[str, Any]:
    """How the parts for cohorts are computed, as versions record it."""
    parameters = {"surfels": surfels, "seed": seed, "digest": summary_digest()}
    return parameters if size is None else parameters | {"size": size}


def model_with_summary(model: xr.DataTree) -> xr.DataTree:
    """A model with what cohorts need of it: a sample of its surfels, and tables."""
    groups = groups_of(model) | sample_groups(model) | {TABLES: tables_of(model)}
    version = xr.DataTree.from_dict(groups)
    version.attrs = model.attrs
    return version


def tables_of(model: xr.DataTree) -> xr.Dataset:
    """What is kept beside a model: its summary for cohorts, and how well it predicts."""
    tables = summary_tables(model)
    prediction = prediction_table(model["fitted"].to_dataset().load())
    # a region without any surfel has no row there
    rows = prediction.reindex(
        region=tables["region"].values, fill_value={"prediction_surfels": 0}
    )
    return xr.merge(
        [tables, rows], combine_attrs="override", join="outer", compat="no_conflicts"
    )


def sample_groups(
    model: xr.DataTree, *, surfels: int = SAMPLED, seed: int = 0
) -> dict[str, xr.Dataset]:
    """The group "sample" of a model; none if no surfel was fitted."""
    if not bool((model["fitted"].to_dataset()["fit_status"] == FitStatus.FITTED).any()):
        return {}
    return {"sample": sample_surfels(model, surfels=surfels, seed=seed)}


def registered_parts(
    model: xr.DataTree,
    registered: xr.Dataset,
    *,
    surfels: int = SAMPLED,
    seed: int = 0,
    size: int = SIZE,
) -> dict[str, xr.Dataset]:
    """Groups and tables that cohorts need of a registered take: maps, and the regions
    that its landmarks give.
    """
    fitted = model["fitted"].to_dataset().load()
    masks = take_masks(model, registered)
    groups = {"maps": common_maps(model, registered, size=size)}
    if sampled := sample_groups(model, surfels=surfels, seed=seed):
        index = sampled["sample"]["surfel_index"].values
        mask = np.array([mask[index] for mask in masks.values()]).reshape(
            len(masks), len(index)
        )
        groups["sample"] = dataset(
            {"surfel_index": index, "region_mask": mask.T},
            coords={"region": list(masks)},
        )
    face = {FACE: np.ones(fitted.sizes["surfel"], np.bool_)}
    groups[TABLES] = region_tables(fitted, face | masks)
    return groups


def _summarise_model(db: Database, sample: CohortRequest, record: Record) -> Record:
    model = db.read("model", record.take, generation=record.generation)
    groups = sample_groups(model, surfels=sample.surfels, seed=sample.seed)
    parameters = summary_parameters(surfels=sample.surfels, seed=sample.seed)
    return _commit(db, record, groups | {TABLES: tables_of(model)}, parameters)


def _summarise_registration(
    db: Database, sample: CohortRequest, size: int, record: Record
) -> Record:
    version = db.read("registration", record.take, generation=record.generation)
    model = db.source(version, "model", record.take)
    registered = version["registration"].to_dataset()
    options = {"surfels": sample.surfels, "seed": sample.seed, "size": size}
    groups = registered_parts(model, registered, **options)
    return _commit(db, record, groups, summary_parameters(**options))


def _commit(
    db: Database,
    record: Record,
    groups: dict[str, xr.Dataset],
    parameters: dict[str, Any],
) -> Record:
    derivation = Derivation.of(
        db,
        SUMMARY,
        record.take,
        inputs=[record],
        code=METHOD,
        names=record.names,
        parameters=parameters,
        summary_parameters=parameters,
        seeds={"sample": parameters["seed"]},
    )
    summary = xr.DataTree.from_dict(groups)
    summary.attrs["consent_scope"] = record.provenance.get("consent_scope", [])
    return derivation.commit(summary)


# functions that compute what cohorts need
METHOD = (tables_of, sample_groups, registered_parts)
