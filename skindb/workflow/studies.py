"""Population studies of a database: open a cohort, analyse it, commit the result with what it was made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.albedo import albedo_histograms, albedo_table
from skindb.analysis.basis_size import BASIS_SIZE_VARIABLES, basis_size_curve
from skindb.analysis.edit import apply_traits
from skindb.analysis.population_basis import population_basis
from skindb.analysis.registration import describe_registration
from skindb.analysis.summary import SAMPLED
from skindb.analysis.traits import trait_vectors
from skindb.analysis.translucency import translucency_table
from skindb.errors import Fault, InputError
from skindb.optics.dictionary import convolve_disc, embedded_dictionary
from skindb.optics.measured import read_dictionary
from skindb.schema.cohort import require_same_fit
from skindb.schema.consent import require_consent
from skindb.schema.regions import FACE
from skindb.store import STUDY, Database
from skindb.workflow.provenance import groups_of, provenance
from skindb.workflow.registration import (
    current_registrations,
    register_takes,
    registered_datasets,
    takes_with_landmarks,
)
from skindb.workflow.summaries import summarise

BASIS_SURFELS = 200  # of each take, that the number of bases is found from


def translucency(db: Database, *, takes: Sequence[str] = (), group_by: str | None = None) -> xr.DataTree:
    """Statistics of sigma_tr by site and channel, committed; see `skindb.analysis.translucency_table`.

    Parameters
    ----------
    db
        Database with models.
    takes
        Default all whose consent covers statistics. Takes that are named may be fitted with different parameters.
    group_by
        Attribute or trait to group by.

    Returns
    -------
    DataTree
        Version of kind "population".

    Raises
    ------
    InputError
        Without takes that consent to statistics, or if they were fitted with different parameters and none is named.
    """
    cohort = _cohort(db, "tables", takes)
    table = translucency_table(cohort, group_by=group_by, mixed_fits=bool(takes))
    return _commit(db, "translucency", {"translucency_table": table}, cohort, {"group_by": group_by or ""})


def albedo(db: Database, *, takes: Sequence[str] = (), group_by: str | None = None) -> xr.DataTree:
    """Histograms of diffuse albedo by take and region, and means of groups, committed; parameters as `translucency`.

    Regions that a capture lacks are those of its landmarks; takes are registered for that if need be.
    """
    cohort = _cohort(db, "surfels", takes, surfels=SAMPLED)
    if not takes:  # before anything is registered
        require_same_fit(cohort)
    histograms, said, used = _albedo(db, cohort, mixed=bool(takes))
    table = albedo_table(cohort, albedo=histograms, group_by=group_by)
    groups = {"albedo": histograms, "albedo_table": table}
    return _commit(db, "albedo", groups, cohort, {"group_by": group_by or ""}, inputs=used, registration=said)


def basis_size(
    db: Database, *, takes: Sequence[str] = (), seed: int = 0, dictionary: Path | None = None
) -> xr.DataTree:
    """Error of reflectance against the number of basis BRDFs, committed; see `skindb.analysis.basis_size_curve`.

    Parameters
    ----------
    db, takes
        As in `translucency`.
    seed
        Random seed of the bootstrap.
    dictionary
        Path of the dictionary that the takes were fitted with; default the embedded one.
    """
    _summarise(db, takes)
    variables = (*BASIS_SIZE_VARIABLES, "dictionary_weight")  # whose labels name the BRDFs of the fits
    cohort = db.cohort("surfels", takes=takes or None, surfels=BASIS_SURFELS, variables=variables)
    tables = _tables(db, cohort, dictionary)
    curve = basis_size_curve(cohort, tables=tables, mixed_fits=bool(takes), rng=np.random.default_rng(seed))
    return _commit(db, "brdf", {"basis_size": curve}, cohort, {}, seed=seed)


def traits(
    db: Database,
    *,
    takes: Sequence[str] = (),
    k: int = 6,
    in_metric: bool = False,
    seed: int = 0,
    dictionary: Path | None = None,
) -> xr.DataTree:
    """A common basis, histograms of albedo and trait vectors, committed; see `skindb.analysis.trait_vectors`.

    Parameters
    ----------
    db, takes, seed, dictionary
        As in `basis_size`; the seed is that of the factorisation.
    k
        Components of the common basis.
    in_metric
        Find that basis by distances between BRDFs, not between coefficients.
    """
    mixed = bool(takes)
    cohort, tables = _cohort(db, "surfels", takes, surfels=SAMPLED), _cohort(db, "tables", takes)
    if not takes:  # before anything is registered
        require_same_fit(cohort)
    rng = np.random.default_rng(seed)
    brdfs = _tables(db, cohort, dictionary)
    basis = population_basis(cohort, tables=brdfs, k=k, in_metric=in_metric, mixed_fits=mixed, rng=rng)
    histograms, said, used = _albedo(db, cohort, mixed=mixed)
    vectors = trait_vectors(tables, basis=basis, albedo=histograms, mixed_fits=mixed)
    groups = {"population_basis": basis, "albedo": histograms, "traits": vectors}
    asked = {"k": k, "in_metric": in_metric}
    return _commit(db, "traits", groups, cohort, asked, seed=seed, inputs=used, registration=said)


def edit(db: Database, take: str, amounts: Mapping[str, float], *, dictionary: Path | None = None) -> xr.DataTree:
    """Move the model of a take along traits and commit it as the kind "edit".

    Parameters
    ----------
    db
        Database in which the study `traits` was run.
    take
        Its model is moved.
    amounts, dictionary
        Trait -> amount, see `skindb.analysis.apply_traits`; path of the dictionary of the fits.
    """
    if not db.has(STUDY, "traits"):
        raise InputError(Fault(str(db.root), "an edit needs trait vectors", "none", "run: skindb analyze DB traits"))
    model, study = db.read("model", take), db.read(STUDY, "traits")
    require_consent({**model.attrs, "take": take}, "statistics")
    _require_current(db, study)
    names = [str(name) for name in model["fitted"].to_dataset()["dictionary"].values]
    edited = apply_traits(
        model,
        amounts=amounts,
        traits=study["traits"].to_dataset().compute(),
        basis=study["population_basis"].to_dataset().compute(),
        albedo=study["albedo"].to_dataset().compute(),
        tables=dictionary_tables(names, float(model["basis/disc_angular_radius"]), dictionary),
    )
    records = db.record("model", take, model.attrs["generation"]), db.record(STUDY, "traits", study.attrs["generation"])
    about = provenance("edit", [one.as_input() for one in records], parameters={"amounts": dict(amounts)})
    about |= {"study_takes": [str(one) for one in study["traits"].to_dataset()["take"].values]}
    with db.stage("edit", take) as stage:
        stage.write(groups_of(edited))
        stage.commit({str(name): value for name, value in edited.attrs.items()} | about)
    return db.read("edit", take)


def _require_current(db: Database, study: xr.DataTree) -> None:
    """Refuse a study whose takes were fitted again since, or do not consent to statistics any more."""
    faults = []
    for made in study.attrs["inputs"]:
        take = str(made["take"])
        if made["kind"] != "model":
            continue
        if not db.has("model", take) or db.record("model", take).as_input() != made:
            faults.append((take, "it was fitted again since"))
        elif "statistics" not in db.consent(take):
            faults.append((take, "its consent does not cover statistics any more"))
    rule, cure = "the study of traits must be up to date", "run: skindb analyze DB traits"
    if faults:
        raise InputError(Fault(f"population traits: {take}", rule, why, cure) for take, why in faults)


def dictionary_tables(names: Sequence[str], disc: float, dictionary: Path | None = None) -> NDArray[np.float32]:
    """Tables (nh, nd, np, m) that takes were fitted with, averaged over the discs of the lights.

    Parameters
    ----------
    names
        Of the BRDFs the takes were fitted with.
    disc
        Angular radius of the lights [rad].
    dictionary
        Path of the dictionary; default the embedded one.
    """
    own = embedded_dictionary() if dictionary is None else read_dictionary(dictionary)
    if list(own.names) != list(names):
        where, rule = "dictionary", "must be the one the takes were fitted with"
        found, cure = f"{len(names)} BRDFs, {names[0]} first", "name its folder with --dictionary"
        raise InputError(Fault(where, rule, found, cure))
    return convolve_disc(own, disc).table


def _cohort(db: Database, layout: Any, takes: Sequence[str], **options: Any) -> xr.Dataset:
    _summarise(db, takes)
    return db.cohort(layout, takes=takes or None, **options)


def _summarise(db: Database, takes: Sequence[str]) -> None:
    """Models of earlier versions of skindb keep nothing for cohorts."""
    known = set(db.takes("model"))
    if not known:
        raise InputError(Fault(str(db.root), "a study needs fitted takes", "no model", "run skindb fit first"))
    summarise(db, [take for take in (takes or sorted(known)) if take in known])


def _tables(db: Database, cohort: xr.Dataset, dictionary: Path | None) -> NDArray[np.float32]:
    first = str(cohort["take"].values[0])
    disc = float(db.cohort("tables", takes=[first], variables=["disc_angular_radius"])["disc_angular_radius"][0])
    return dictionary_tables([str(name) for name in cohort["dictionary"].values], disc, dictionary)


def _albedo(db: Database, cohort: xr.Dataset, *, mixed: bool) -> tuple[xr.Dataset, list[str], list[dict[str, Any]]]:
    """Histograms, in regions by landmarks where a capture names none; what the registration is worth; its versions."""
    takes = [str(take) for take in cohort["take"].values]
    able = takes_with_landmarks(db, takes)
    records = current_registrations(db, able)
    made = "the stored one" if records else "made for this study"
    if able and not records:  # all takes, so that the next study need not register others again
        records = {take: record for take, record in register_takes(db).items() if take in able}
    said = describe_registration(registered_datasets(db, records), takes)
    regions: tuple[str, ...] = (FACE, "beard")
    drawn = None
    if records:
        said.append(f"registration: {made}")
        regions = (FACE, "beard", "no_beard")
        summarise(db, able)
        drawn = db.cohort(
            "surfels", kind="registration", takes=able, surfels=SAMPLED, variables=["region_mask", "surfel_index"]
        )
    histograms = albedo_histograms(cohort, regions=regions, drawn=drawn, mixed_fits=mixed)
    return histograms, said, [record.as_input() for record in records.values()]


def _commit(
    db: Database,
    name: str,
    groups: Mapping[str, xr.Dataset],
    cohort: xr.Dataset,
    parameters: Mapping[str, Any],
    *,
    seed: int | None = None,
    inputs: Sequence[Mapping[str, Any]] = (),
    registration: Sequence[str] = (),
) -> xr.DataTree:
    """Commit a study as the kind "population", with the models it was made from."""
    generations = zip(cohort["take"].values, cohort["model_generation"].values, strict=True)
    models = [db.record("model", str(take), int(generation)).as_input() for take, generation in generations]
    seeds = {} if seed is None else {"analyze": seed}
    about = provenance("analyze", [*models, *inputs], parameters={"what": name, **parameters}, seeds=seeds)
    about |= {"skipped": list(cohort.attrs["skipped"]), "outdated": list(cohort.attrs["outdated"])}
    about |= {"registration": list(registration)} if registration else {}
    with db.stage(STUDY, name) as stage:
        stage.write(groups)
        stage.commit(about)
    return db.read(STUDY, name)
