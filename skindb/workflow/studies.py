"""Population studies of a database: open a cohort, analyse it, commit the result with what it was made from."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from dask.delayed import Delayed, delayed
from numpy.typing import NDArray

from skindb._blas import on_one_blas_thread
from skindb.analysis.albedo import albedo_histograms, albedo_table
from skindb.analysis.basis_size import BASIS_SIZE_VARIABLES, basis_size_curve
from skindb.analysis.brdf_space import brdf_space, grouped_takes
from skindb.analysis.chromophores import chromophore_axes, chromophore_statistics, chromophore_table
from skindb.analysis.components import face_components
from skindb.analysis.correlations import component_correlations
from skindb.analysis.coverage import coverage_report
from skindb.analysis.effect_maps import effect_maps
from skindb.analysis.group_effects import group_effects
from skindb.analysis.mean_face import mean_face
from skindb.analysis.population_basis import population_basis
from skindb.analysis.registration import describe_registration
from skindb.analysis.summary import SAMPLED
from skindb.analysis.texture import MAPPED, common_landmarks, texture_statistics
from skindb.analysis.texture import SIZE as TEXELS
from skindb.analysis.traits import trait_vectors
from skindb.analysis.translucency import translucency_table
from skindb.errors import Fault, InputError
from skindb.optics.dictionary import convolve_disc, embedded_dictionary
from skindb.optics.measured import read_dictionary
from skindb.schema.cohort import require_same_fit
from skindb.schema.regions import FACE
from skindb.store import STUDY, Database, Known, Record, Staleness, require_text
from skindb.workflow.provenance import provenance
from skindb.workflow.registration import (
    current_registrations,
    register_takes,
    registered_datasets,
    takes_with_landmarks,
)
from skindb.workflow.summaries import summarise

MAP_PERMUTATIONS = 1000  # each of 100,000 texels and more
BASIS_SURFELS = 200  # of each take, that the number of bases is found from
STUDY_NAME = r"[A-Za-z0-9_-]{1,64}"
DEFAULTS = {
    "group_by": "", "k": 6, "in_metric": False, "seed": 0, "takes": [], "release": "", "adjust": [],
    "permutations": 10_000,
}  # fmt: skip
OWN_DEFAULTS: dict[str, dict[str, Any]] = {"maps": {"permutations": MAP_PERMUTATIONS}, "components": {"k": 5}}


@dataclass(frozen=True)
class Asked:
    """A study as it was asked for."""

    what: str
    name: str | None
    release: str | None
    takes: tuple[str, ...]
    parameters: Mapping[str, Any]

    def recorded(self) -> dict[str, Any]:
        """What another run needs to repeat it."""
        return {**self.parameters, "takes": list(self.takes), "release": self.release or ""}


@on_one_blas_thread
def translucency(
    db: Database,
    *,
    takes: Sequence[str] = (),
    group_by: str | None = None,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Statistics of sigma_tr by site and channel, committed; see `skindb.analysis.translucency_table`.

    Parameters
    ----------
    db
        Database with models.
    takes
        Default all whose consent covers statistics. Takes that are named may be fitted with different parameters.
    group_by
        Attribute or trait to group by.
    release
        Name of a release to study; default the newest versions.
    name
        The study is stored as ``translucency.<name>``; default as in `study_key`.

    Returns
    -------
    DataTree
        Version of kind "population"; its attribute "study" is what it is stored as.

    Raises
    ------
    InputError
        Without takes that consent to statistics, or if they were fitted with different parameters and none is named.
    """
    cohort = _cohort(db, "tables", takes, release)
    table = translucency_table(cohort, group_by=group_by, mixed_fits=bool(takes))
    asked = Asked("translucency", name, release, tuple(takes), {"group_by": group_by or ""})
    return _commit(db, asked, {"translucency_table": table}, cohort)


@on_one_blas_thread
def albedo(
    db: Database,
    *,
    takes: Sequence[str] = (),
    group_by: str | None = None,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Histograms of diffuse albedo by take and region, and means of groups, committed; parameters as `translucency`.

    Regions that a capture lacks are those of its landmarks; takes are registered for that if need be.
    """
    _require_covered(db, release)
    cohort = _cohort(db, "surfels", takes, release, surfels=SAMPLED)
    if not takes:  # before anything is registered
        require_same_fit(cohort)
    histograms, texture, said, used = _albedo(db, cohort, release, mixed=bool(takes))
    table = albedo_table(cohort, albedo=histograms, group_by=group_by)
    groups = {"albedo": histograms, "albedo_table": table} | texture
    asked = Asked("albedo", name, release, tuple(takes), {"group_by": group_by or ""})
    return _commit(db, asked, groups, cohort, inputs=used, registration=said)


@on_one_blas_thread
def basis_size(
    db: Database,
    *,
    takes: Sequence[str] = (),
    seed: int = 0,
    dictionary: Path | None = None,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Error of reflectance against the number of basis BRDFs, committed; see `skindb.analysis.basis_size_curve`.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`.
    seed
        Random seed of the bootstrap.
    dictionary
        Path of the dictionary that the takes were fitted with; default the embedded one.
    """
    _summarise(db, takes, release)
    variables = (*BASIS_SIZE_VARIABLES, "dictionary_weight")  # whose labels name the BRDFs of the fits
    options: dict[str, Any] = {"surfels": BASIS_SURFELS, "variables": variables, "release": release}
    cohort = db.cohort("surfels", takes=takes or None, **options)
    tables = _tables(db, cohort, dictionary, release)
    curve = basis_size_curve(cohort, tables=tables, mixed_fits=bool(takes), rng=np.random.default_rng(seed))
    asked = Asked("brdf", name, release, tuple(takes), {"seed": seed})
    return _commit(db, asked, {"basis_size": curve}, cohort)


@on_one_blas_thread
def traits(
    db: Database,
    *,
    takes: Sequence[str] = (),
    k: int = 6,
    in_metric: bool = False,
    adjust: Sequence[str] = (),
    seed: int = 0,
    dictionary: Path | None = None,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """A common basis, histograms of albedo and trait vectors, committed; see `skindb.analysis.trait_vectors`.

    Parameters
    ----------
    db, takes, seed, dictionary, release, name
        As in `basis_size`; the seed is that of the factorisation.
    k
        Components of the common basis.
    in_metric
        Find that basis by distances between BRDFs, not between coefficients.
    adjust
        Attributes that are held fixed where subjects are compared.
    """
    mixed = bool(takes)
    _require_covered(db, release)
    cohort = _cohort(db, "surfels", takes, release, surfels=SAMPLED)
    tables = _cohort(db, "tables", takes, release)
    if not takes:  # before anything is registered
        require_same_fit(cohort)
    rng = np.random.default_rng(seed)
    brdfs = _tables(db, cohort, dictionary, release)
    basis = population_basis(cohort, tables=brdfs, k=k, in_metric=in_metric, mixed_fits=mixed, rng=rng)
    histograms, texture, said, used = _albedo(db, cohort, release, mixed=mixed)
    options: dict[str, Any] = {"adjust": adjust, "mixed_fits": mixed, "rng": rng} | texture
    vectors = trait_vectors(tables, basis=basis, albedo=histograms, **options)
    groups = {"population_basis": basis, "albedo": histograms, "traits": vectors} | texture
    given = {"k": k, "in_metric": in_metric, "adjust": list(adjust), "seed": seed}
    asked = Asked("traits", name, release, tuple(takes), given)
    return _commit(db, asked, groups, cohort, inputs=used, registration=said)


@on_one_blas_thread
def groups(
    db: Database,
    *,
    group_by: str,
    adjust: Sequence[str] = (),
    permutations: int = 10_000,
    takes: Sequence[str] = (),
    seed: int = 0,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Differences between groups of subjects, committed; see `skindb.analysis.group_effects`.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`.
    group_by, adjust, permutations
        As in `skindb.analysis.group_effects`.
    seed
        Random seed of the permutations.
    """
    cohort = _cohort(db, "tables", takes, release)
    table = group_effects(
        cohort, group_by=group_by, adjust=adjust, permutations=permutations, mixed_fits=bool(takes),
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    given = {"group_by": group_by, "adjust": list(adjust), "permutations": permutations, "seed": seed}
    return _commit(db, Asked("groups", name, release, tuple(takes), given), {"effects": table}, cohort)


@on_one_blas_thread
def correlations(
    db: Database,
    *,
    permutations: int = 10_000,
    takes: Sequence[str] = (),
    seed: int = 0,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Correlations of albedo, surface reflectance and translucency, committed.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`.
    permutations
        As in `skindb.analysis.component_correlations`.
    seed
        Random seed of permutations and bootstrap.
    """
    cohort, rng = _cohort(db, "tables", takes, release), np.random.default_rng(seed)
    table = component_correlations(cohort, permutations=permutations, mixed_fits=bool(takes), rng=rng)
    given = {"permutations": permutations, "seed": seed}
    return _commit(db, Asked("correlations", name, release, tuple(takes), given), {"correlations": table}, cohort)


@on_one_blas_thread
def components(
    db: Database,
    *,
    k: int = 5,
    takes: Sequence[str] = (),
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Principal components of the albedo maps of takes, committed; see `skindb.analysis.face_components`.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`. Takes must have landmarks; they are registered if need be.
    k
        Components, at most.
    """
    cohort, _, said, used = _registered_maps(db, takes, release)
    table = face_components(cohort, most=k, mixed_fits=bool(takes))
    asked = Asked("components", name, release, tuple(takes), {"k": k})
    return _commit(db, asked, {"components": table}, cohort, inputs=used, registration=said)


@on_one_blas_thread
def maps(
    db: Database,
    *,
    group_by: str,
    adjust: Sequence[str] = (),
    permutations: int = MAP_PERMUTATIONS,
    takes: Sequence[str] = (),
    seed: int = 0,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Differences between groups of subjects as maps, committed; see `skindb.analysis.effect_maps`.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`. Takes must have landmarks; they are registered if need be.
    group_by, adjust, permutations
        As in `skindb.analysis.effect_maps`.
    seed
        Random seed of the permutations.
    """
    cohort, _, said, used = _registered_maps(db, takes, release)
    table = effect_maps(
        cohort, group_by=group_by, adjust=adjust, permutations=permutations, mixed_fits=bool(takes),
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    given = {"group_by": group_by, "adjust": list(adjust), "permutations": permutations, "seed": seed}
    asked = Asked("maps", name, release, tuple(takes), given)
    return _commit(db, asked, {"effect_maps": table}, cohort, inputs=used, registration=said)


@on_one_blas_thread
def chromophores(
    db: Database,
    *,
    takes: Sequence[str] = (),
    group_by: str | None = None,
    seed: int = 0,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Melanin and haemoglobin of takes, regions and groups, and the mean face, committed.

    Takes are registered for that if need be. See `skindb.analysis.chromophore_axes`, `chromophore_table` and
    `mean_face`; the mean face is left out, and the study says so, where no texel has enough subjects.

    Parameters
    ----------
    db, takes, group_by, release, name
        As in `translucency`.
    seed
        Random seed of the independent components and of the bootstrap.
    """
    cohort, registered, said, used = _registered_maps(db, takes, release)
    mixed, landmarks = bool(takes), common_landmarks(registered)
    axes = chromophore_axes(cohort, landmarks=landmarks, mixed_fits=mixed, rng=np.random.default_rng(seed))
    statistics = chromophore_statistics(cohort, axes=axes, landmarks=landmarks)
    table = chromophore_table(cohort, statistics=statistics, group_by=group_by)
    found = {"chromophores": axes.merge(statistics, combine_attrs="override"), "chromophore_table": table}
    try:
        found["mean_face"] = mean_face(cohort, mixed_fits=mixed)
    except InputError as error:  # a few people have pigments, but no mean
        said += [str(fault) for fault in error.faults]
    asked = Asked("chromophores", name, release, tuple(takes), {"group_by": group_by or "", "seed": seed})
    return _commit(db, asked, found, cohort, inputs=used, registration=said)


@on_one_blas_thread
def coverage(
    db: Database, *, takes: Sequence[str] = (), release: str | None = None, name: str | None = None
) -> xr.DataTree:
    """Whom the fitted takes represent and whom not, committed; see `skindb.analysis.coverage_report`.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`.
    """
    cohort = _cohort(db, "tables", takes, release)
    return _commit(
        db, Asked("coverage", name, release, tuple(takes), {}), {"coverage": coverage_report(cohort)}, cohort
    )


@on_one_blas_thread
def surface(
    db: Database,
    *,
    group_by: str,
    k: int = 6,
    permutations: int = 10_000,
    takes: Sequence[str] = (),
    seed: int = 0,
    dictionary: Path | None = None,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Surface BRDFs of groups, distances between them and a map of the takes; see `skindb.analysis.brdf_space`.

    Parameters
    ----------
    db, takes, dictionary, release, name
        As in `basis_size`.
    group_by, permutations
        As in `skindb.analysis.brdf_space`.
    k
        Components of the common basis.
    seed
        Random seed of the factorisation and of the permutations.

    Raises
    ------
    InputError
        As `translucency` and `skindb.analysis.brdf_space`, and for a k above the number of BRDFs or of surfels.
    """
    mixed = bool(takes)
    tables = _cohort(db, "tables", takes, release)
    grouped_takes(tables, group_by)  # before anything is computed
    cohort = _cohort(db, "surfels", takes, release, surfels=SAMPLED)
    brdfs, rng = _tables(db, cohort, dictionary, release), np.random.default_rng(seed)
    basis = population_basis(cohort, tables=brdfs, k=k, mixed_fits=mixed, rng=rng)
    if (found := basis.sizes["component"]) < k:
        rule = "must not be above the number of BRDFs of the dictionary or of surfels"
        raise InputError(Fault("k", rule, f"{k}, and {found} of them", "choose a smaller k"))
    space = brdf_space(
        tables, basis=basis, tables=brdfs, group_by=group_by, permutations=permutations, mixed_fits=mixed, rng=rng
    )
    given = {"group_by": group_by, "k": k, "permutations": permutations, "seed": seed}
    asked = Asked("surface", name, release, tuple(takes), given)
    return _commit(db, asked, {"population_basis": basis, "brdf_space": space}, cohort)


STUDIES: dict[str, Callable[..., xr.DataTree]] = {
    "brdf": basis_size,
    "albedo": albedo,
    "translucency": translucency,
    "traits": traits,
    "groups": groups,
    "components": components,
    "correlations": correlations,
    "maps": maps,
    "chromophores": chromophores,
    "coverage": coverage,
    "surface": surface,
}


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


def _cohort(db: Database, layout: Any, takes: Sequence[str], release: str | None, **options: Any) -> xr.Dataset:
    _summarise(db, takes, release)
    return db.cohort(layout, takes=takes or None, release=release, **options)


def _summarise(db: Database, takes: Sequence[str], release: str | None) -> None:
    """Models of earlier versions of skindb keep nothing for cohorts."""
    known = set(db.takes("model", release=release))
    if not known:
        raise InputError(Fault(db.url, "a study needs fitted takes", "no model", "run skindb fit first"))
    summarise(db, [take for take in (takes or sorted(known)) if take in known], release=release)


def _tables(db: Database, cohort: xr.Dataset, dictionary: Path | None, release: str | None) -> Delayed:
    """The tables of the fits, computed once, where the study is: they travel to no other process by themselves."""
    first = str(cohort["take"].values[0])
    opened = db.cohort("tables", takes=[first], variables=["disc_angular_radius"], release=release)
    disc = float(opened["disc_angular_radius"][0])
    names = [str(name) for name in cohort["dictionary"].values]
    tables: Delayed = delayed(dictionary_tables, pure=False)(names, disc, dictionary).persist()
    return tables


def _albedo(
    db: Database, cohort: xr.Dataset, release: str | None, *, mixed: bool
) -> tuple[xr.Dataset, dict[str, xr.Dataset], list[str], list[dict[str, Any]]]:
    """Histograms, in regions by landmarks where a capture names none; distributions at every scale of takes that are
    registered; what the registration is worth; its versions.
    """
    takes = [str(take) for take in cohort["take"].values]
    records, made = _registrations(db, takes, release)
    registered = registered_datasets(db, records)
    said = describe_registration(registered, takes)
    regions: tuple[str, ...] = (FACE, "beard")
    drawn, texture = None, dict[str, xr.Dataset]()
    if records:
        said.append(f"registration: {made}")
        regions = (FACE, "beard", "no_beard")
        summarise(db, list(records), release=release)
        options: dict[str, Any] = {"surfels": SAMPLED, "variables": ["region_mask", "surfel_index"], "release": release}
        drawn = db.cohort("surfels", kind="registration", takes=list(records), **options)
        summarise(db, list(records), release=release, size=TEXELS)
        maps = db.cohort("maps", size=TEXELS, takes=list(records), variables=MAPPED, release=release)
        texture["texture"] = texture_statistics(maps, landmarks=common_landmarks(registered), mixed_fits=mixed)
    histograms = albedo_histograms(cohort, regions=regions, drawn=drawn, mixed_fits=mixed)
    return histograms, texture, said, [record.as_input() for record in records.values()]


def _registered_maps(
    db: Database, takes: Sequence[str], release: str | None
) -> tuple[xr.Dataset, dict[str, xr.Dataset], list[str], list[dict[str, Any]]]:
    """Maps of takes on the common (u, v); their registrations, what these are worth, and their versions."""
    _require_covered(db, release)
    models = _cohort(db, "tables", takes, release)
    if not takes:  # before anything is registered
        require_same_fit(models)
    named = [str(take) for take in models["take"].values]
    records, made = _registrations(db, named, release)
    if not records:
        rule, cure = "maps need registered takes", "add landmarks to the captures, then ingest and fit them"
        raise InputError(Fault(db.url, rule, f"none of {len(named)} takes has landmarks", cure))
    registered = registered_datasets(db, records)
    summarise(db, list(records), release=release)
    cohort = db.cohort("maps", takes=list(records), release=release)  # without a probe there is no map of sigma_tr
    cohort.attrs["skipped"] = list(dict.fromkeys([*models.attrs["skipped"], *cohort.attrs["skipped"]]))
    said = [*describe_registration(registered, named), f"registration: {made}"]
    return cohort, registered, said, [record.as_input() for record in records.values()]


def _require_covered(db: Database, release: str | None) -> None:
    """Refuse a release whose registrations contain data of somebody who does not consent to statistics any more."""
    if release is None:
        return
    known, staleness = Known(db, release), Staleness(db)
    records = [known.record("registration", take) for take in known.takes("registration")]
    reasons = [reason for record in records for reason in staleness.reasons(record) if reason.why != "superseded"]
    if found := list(dict.fromkeys(map(str, reasons))):
        rule = "the registrations of a release must be covered by consent"
        cure = "run skindb refresh, and make another release"
        raise InputError(Fault(f"release {release}", rule, "; ".join(found), cure))


def _registrations(db: Database, takes: Sequence[str], release: str | None) -> tuple[dict[str, Record], str]:
    """Registrations of the takes that can have one, and where they come from: a release is never registered anew."""
    if release is not None:
        known = Known(db, release)
        return {
            t: known.record("registration", t) for t in takes if known.has("registration", t)
        }, "that of the release"
    able = takes_with_landmarks(db, takes)
    records = current_registrations(db, able)
    if records or not able:
        return records, "the stored one"
    # all takes, so that the next study need not register others again
    made = {take: record for take, record in register_takes(db).items() if take in able}
    return made, "made for this study"


def study_key(asked: Asked) -> str:
    """What a study is stored as.

    The study of everything with default parameters is stored under its own word, "traits"; with other parameters it is
    "traits.k-8", and with a name "traits.<name>". No study replaces one that was asked for differently; one with
    another random seed is the next generation of the same.
    """
    if asked.name is not None:
        return f"{asked.what}.{require_text(asked.name, STUDY_NAME, 'name of a study')}"
    defaults = DEFAULTS | OWN_DEFAULTS.get(asked.what, {})
    given = {key: value for key, value in asked.recorded().items() if key != "seed" and value != defaults[key]}
    if not given:
        return asked.what
    words = dict(given)
    if "adjust" in given and "-" not in "".join(given["adjust"]):
        words["adjust"] = "-".join(given["adjust"])
    text = "_".join(f"{key}-{value}" for key, value in words.items())
    if not re.fullmatch(STUDY_NAME, text):
        text = hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:16]
    return f"{asked.what}.{text}"


def _commit(
    db: Database,
    asked: Asked,
    groups: Mapping[str, xr.Dataset],
    cohort: xr.Dataset,
    *,
    inputs: Sequence[Mapping[str, Any]] = (),
    registration: Sequence[str] = (),
) -> xr.DataTree:
    """Commit a study as the kind "population", with the models it was made from."""
    generations = zip(cohort["take"].values, cohort["model_generation"].values, strict=True)
    models = [db.record("model", str(take), int(generation)).as_input() for take, generation in generations]
    seeds = {"analyze": asked.parameters["seed"]} if "seed" in asked.parameters else {}
    parameters = {"what": asked.what, **asked.recorded()}
    about = provenance("analyze", [*models, *inputs], parameters=parameters, seeds=seeds)
    key = study_key(asked)
    about |= {"study": key, "skipped": list(cohort.attrs["skipped"]), "outdated": list(cohort.attrs["outdated"])}
    about |= {"registration": list(registration)} if registration else {}
    with db.stage(STUDY, key) as stage:
        stage.write(groups)
        stage.commit(about)
    return db.read(STUDY, key)
