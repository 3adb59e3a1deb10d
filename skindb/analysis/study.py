"""Population studies on a database: read the models, analyse, commit the result with what it was made from."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.albedo import albedo_histograms, albedo_table, plot_albedo
from skindb.analysis.basis_size import basis_size_curve, plot_basis_size
from skindb.analysis.edit import apply_traits
from skindb.analysis.members import consenting, left_out
from skindb.analysis.population_basis import population_basis, same_dictionary
from skindb.analysis.registered import model_inputs, registration_of
from skindb.analysis.registration import describe_registration, registrations, with_landmarks
from skindb.analysis.traits import plot_traits, trait_vectors
from skindb.analysis.translucency import plot_translucency, translucency_table
from skindb.errors import Fault, InputError
from skindb.optics.dictionary import convolve_disc, embedded_dictionary
from skindb.optics.measured import read_dictionary
from skindb.store import Database, Record

Progress = Callable[[str, int, int], None]
Models = dict[str, xr.DataTree]
STUDIES = ("brdf", "albedo", "translucency", "traits")


def read_models(db: Database, takes: Sequence[str] = ()) -> Models:
    """Take -> current model, of these takes or of all."""
    names = list(takes) or db.takes("model")
    if not names:
        raise InputError(Fault(str(db.root), "a study needs fitted takes", "no model", "run skindb fit first"))
    return {take: db.read("model", take) for take in names}


def dictionary_tables(models: Models, merl: Path | None = None) -> NDArray[np.float32]:
    """Tables (nh, nd, np, m) the takes were fitted with: embedded or from files, see `read_dictionary`."""
    names = same_dictionary(models)
    own = embedded_dictionary() if merl is None else read_dictionary(merl)
    if list(own.names) != names:
        where, rule = "dictionary", "must be the one the takes were fitted with"
        raise InputError(Fault(where, rule, f"{len(names)} BRDFs, {names[0]} first", "name its folder with --basis"))
    first = next(iter(models.values()))
    return convolve_disc(own, float(first["basis"].attrs.get("disc_angular_radius", 0.0))).table


def analyze(
    db: Database,
    what: str,
    *,
    takes: Sequence[str] = (),
    group_by: str | None = None,
    k: int = 6,
    in_metric: bool = False,
    seed: int = 0,
    merl: Path | None = None,
    progress: Progress | None = None,
) -> tuple[Record, xr.DataTree]:
    """Run one study and commit it as the kind "population".

    Parameters
    ----------
    db
        Database with models.
    what
        "brdf": error against basis size. "albedo": colour histograms. "translucency": table of sigma_tr.
        "traits": common basis, histograms and trait vectors.
    takes
        Default all; takes whose consent does not cover statistics are left out and named.
    group_by
        Attribute or trait to group the tables of "translucency" and "albedo" by.
    k
        Components of the common basis of "traits".
    in_metric
        Find that basis by distances between BRDFs, not between coefficients.
    seed
        Of everything random.
    merl
        Path of what the takes were fitted with; default the embedded dictionary.
    progress
        Called with stage, steps done and steps in all.
    """
    if what not in STUDIES:
        raise InputError(Fault("study", f"must be one of {', '.join(STUDIES)}", repr(what), "choose one"))
    if group_by and what not in ("translucency", "albedo"):
        raise InputError(Fault("group-by", "groups translucency or albedo", f"the study {what}", "leave it out"))
    tell = progress or (lambda *_: None)
    models = read_models(db, takes)
    refused = left_out(models)
    models = consenting(models)
    rng = np.random.default_rng(seed)
    inputs, said = model_inputs(db, models), list[str]()
    tell(f"analyze {what}", 0, 1)
    if what == "translucency":
        groups = {"translucency_table": translucency_table(models, group_by=group_by)}
    elif what == "albedo":
        albedo, said, used = _albedo(db, models)
        inputs += used
        groups = {"albedo": albedo, "albedo_table": albedo_table(models, albedo=albedo, group_by=group_by)}
    elif what == "brdf":
        captures = {take: db.source(model) for take, model in models.items()}
        tables = dictionary_tables(models, merl)
        groups = {"basis_size": basis_size_curve(captures, models, tables=tables, rng=rng)}
    else:
        tables = dictionary_tables(models, merl)
        basis = population_basis(models, tables=tables, k=k, in_metric=in_metric, rng=rng)
        albedo, said, used = _albedo(db, models)
        inputs += used
        groups = {"population_basis": basis, "albedo": albedo}
        groups["traits"] = trait_vectors(models, basis=basis, albedo=albedo)
    parameters = {"what": what, "group_by": group_by or ""} | (
        {"k": k, "in_metric": in_metric} if what == "traits" else {}
    )
    provenance = {"command": "analyze", "parameters": parameters, "seeds": {"analyze": seed}, "left_out": refused}
    provenance |= {"registration": said} if said else {}
    record = _commit(db, "population", what, groups, provenance | {"inputs": inputs})
    tell(f"analyze {what}", 1, 1)
    return record, db.read("population", what)


def _albedo(db: Database, models: Models) -> tuple[xr.Dataset, list[str], list[dict[str, Any]]]:
    """Histograms, in regions by landmarks where a capture names none; what the registration is worth; its versions."""
    registered, versions = registration_of(db, models)
    regions = ("face", "beard", "no_beard") if registered else ("face", "beard")
    said = describe_registration(registered, models)
    if versions:
        said.append("registration: the stored one")
    return albedo_histograms(models, regions=regions, registered=registered), said, versions


def register_takes(
    db: Database, *, takes: Sequence[str] = (), reference: str | None = None
) -> tuple[dict[str, Record], dict[str, xr.Dataset]]:
    """Register takes by their landmarks and commit each one's common (u, v) as the kind "registration".

    Parameters
    ----------
    db
        Database with models.
    takes
        Default all; takes whose consent does not cover statistics are left out.
    reference
        See `register`.
    """
    models = with_landmarks(consenting(read_models(db, takes)))
    if not models:
        found, cure = "no take has any", "name the 20 points in the capture's landmarks.json"
        raise InputError(Fault(str(db.root), "a registration needs landmarks", found, cure))
    parameters = {"reference": reference or ""}
    provenance = {"command": "register", "parameters": parameters, "seeds": {}, "inputs": model_inputs(db, models)}
    committed: dict[str, Record] = {}
    for take, one in registrations(models, reference=reference):  # one in memory at a time
        committed[take] = _commit(db, "registration", take, {"registration": one}, provenance)
    return committed, {take: db.read("registration", take)["registration"].to_dataset() for take in committed}


def edit_take(
    db: Database, take: str, amounts: Mapping[str, float], *, merl: Path | None = None
) -> tuple[Record, xr.DataTree]:
    """Move the model of a take along traits and commit it as the kind "edit"; the study "traits" must have been run."""
    if "traits" not in db.takes("population"):
        raise InputError(Fault(str(db.root), "an edit needs trait vectors", "none", "run: skindb analyze DB traits"))
    model, study = db.read("model", take), db.read("population", "traits")
    edited = apply_traits(
        model,
        amounts=amounts,
        traits=study["traits"].to_dataset().compute(),
        basis=study["population_basis"].to_dataset().compute(),
        albedo=study["albedo"].to_dataset().compute(),
        tables=dictionary_tables({take: model}, merl),
    )
    sources = [
        *model_inputs(db, {take: model}),
        {"kind": "population", "take": "traits", "generation": study.attrs["generation"]},
    ]
    groups = {str(name): node.to_dataset() for name, node in edited.children.items()}
    provenance = {"command": "edit", "parameters": {"amounts": dict(amounts)}, "seeds": {}, "inputs": sources}
    record = _commit(db, "edit", take, groups, {str(k): v for k, v in edited.attrs.items()} | provenance)
    return record, db.read("edit", take)


def tabulate_study(study: xr.DataTree) -> tuple[list[str], list[list[Any]]]:
    """Header and rows of a study, for a terminal or a page."""
    if "translucency_table" in study.children:
        table = study["translucency_table"].to_dataset()
        names = [
            "sigma_tr_count",
            "sigma_tr_mean",
            "sigma_tr_mean_low",
            "sigma_tr_mean_high",
            "sigma_tr_standard_deviation",
            "sigma_tr_variance",
        ]
        dims = ["group", "site", "channel"]
    elif "basis_size" in study.children:
        table = study["basis_size"].to_dataset()
        names, dims = ["relative_error", "relative_error_low", "relative_error_high"], ["k"]
    elif "traits" in study.children:
        table = study["traits"].to_dataset()
        table = table.assign(
            {"brdf_shift": np.sqrt((table["trait_brdf_shift"] ** 2).sum("component")), **_sides(table)}
        )
        names, dims = ["takes_with", "takes_without", "brdf_shift"], ["trait"]
    elif study["albedo_table"].attrs["group_by"]:
        table = study["albedo_table"].to_dataset()
        columns = ("count", "mean", "mean_low", "mean_high", "standard_deviation")
        names, dims = [f"group_albedo_{column}" for column in columns], ["group", "region", "channel"]
    else:
        table = study["albedo"].to_dataset()
        names, dims = ["albedo_mean"], ["take", "region", "channel"]
    stacked = table[names].stack(row=dims, create_index=False).load()
    keys = [list(key) for key in itertools.product(*(table[d].values.tolist() for d in dims))]
    return [*dims, *names], [[*k, *(stacked[n].values[i].item() for n in names)] for i, k in enumerate(keys)]


def _sides(table: xr.Dataset) -> dict[str, xr.DataArray]:
    return {f"takes_{side}": table["trait_count"].sel(side=side, drop=True) for side in ("with", "without")}


def plot_study(study: xr.DataTree, path: Path) -> None:
    """Write the plot of a study as a picture."""
    from matplotlib import pyplot

    drawn = {
        "translucency_table": plot_translucency,
        "basis_size": plot_basis_size,
        "traits": plot_traits,  # before the albedo that this study also holds
        "albedo": plot_albedo,
    }
    names = [name for name in drawn if name in study.children]
    figure, ax = pyplot.subplots(figsize=(7, 4))
    drawn[names[0]](study[names[0]].to_dataset().load(), ax=ax)
    figure.savefig(path, dpi=120, bbox_inches="tight")
    pyplot.close(figure)


def _commit(
    db: Database, kind: str, take: str, groups: Mapping[str, xr.Dataset], provenance: Mapping[str, Any]
) -> Record:
    with db.stage(kind, take) as stage:
        stage.write(groups)
        return stage.commit(provenance)
