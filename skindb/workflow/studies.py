"""Population studies of a database: open a cohort, analyse it, commit the result with
what it was made from.

A study that is requested again is computed only if something changed: its takes, their
attributes, its parameters or the code that computes it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from skindb.analysis.albedo import albedo_histograms, albedo_table
from skindb.analysis.basis_size import BASIS_SIZE_VARIABLES, basis_size_curve
from skindb.analysis.brdf_space import brdf_space, grouped_takes
from skindb.analysis.chromophores import (
    chromophore_axes,
    chromophore_statistics,
    chromophore_table,
)
from skindb.analysis.components import face_components
from skindb.analysis.correlations import component_correlations
from skindb.analysis.coverage import coverage_report
from skindb.analysis.effect_maps import effect_maps
from skindb.analysis.group_effects import group_effects
from skindb.analysis.mean_face import mean_face
from skindb.analysis.population_basis import population_basis
from skindb.analysis.summary import SAMPLED
from skindb.analysis.texture import MAPPED, common_landmarks, texture_statistics
from skindb.analysis.texture import SIZE as TEXELS
from skindb.analysis.traits import trait_vectors
from skindb.analysis.translucency import translucency_table
from skindb.errors import Fault, InputError
from skindb.schema.cohort import require_same_fit
from skindb.schema.notes import note
from skindb.schema.regions import FACE
from skindb.store import Database
from skindb.threads import on_one_blas_thread
from skindb.workflow.audit import logged
from skindb.workflow.study_inputs import (
    Frame,
    brdf_tables,
    frame_of,
    registered_maps,
    require_covered,
    study_cohort,
)
from skindb.workflow.study_versions import MAP_PERMUTATIONS, Groups, StudyRequest, made
from skindb.workflow.summaries import summarise

BASIS_SURFELS = 200  # of each take, that the number of bases is found from


@on_one_blas_thread
@logged("study", what="translucency")
def translucency(
    db: Database,
    *,
    takes: Sequence[str] = (),
    group_by: str | None = None,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Statistics of sigma_tr by site and channel, committed; see
    `skindb.analysis.translucency_table`.

    Parameters
    ----------
    db
        Database with models.
    takes
        Default all whose consent covers statistics. Takes that are named may be fitted
        with different parameters.
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
        Without takes that consent to statistics, or if they were fitted with different
        parameters and none is named.
    """
    cohort = study_cohort(db, "tables", takes, release)

    def compute() -> Groups:
        return {
            "translucency_table": translucency_table(
                cohort, group_by=group_by, mixed_fits=bool(takes)
            )
        }

    asked = StudyRequest(
        "translucency", name, release, tuple(takes), {"group_by": group_by or ""}
    )
    return made(db, asked, compute, cohort)


@on_one_blas_thread
@logged("study", what="albedo")
def albedo(
    db: Database,
    *,
    takes: Sequence[str] = (),
    group_by: str | None = None,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Histograms of diffuse albedo by take and region, and means of groups, committed;
    parameters as `translucency`.

    Regions that a capture lacks are those of its landmarks; takes are registered for
    that if need be.
    """
    require_covered(db, release)
    cohort = study_cohort(db, "surfels", takes, release, surfels=SAMPLED)
    if not takes:  # before anything is registered
        require_same_fit(cohort)
    frame = frame_of(db, cohort, release)

    def compute() -> Groups:
        found = _albedo(db, cohort, frame, release, mixed=bool(takes))
        return found | {
            "albedo_table": albedo_table(
                cohort, albedo=found["albedo"], group_by=group_by
            )
        }

    asked = StudyRequest(
        "albedo", name, release, tuple(takes), {"group_by": group_by or ""}
    )
    return made(db, asked, compute, cohort, frame)


@on_one_blas_thread
@logged("study", what="brdf")
def basis_size(
    db: Database,
    *,
    takes: Sequence[str] = (),
    seed: int = 0,
    dictionary: Path | None = None,
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Error of reflectance against the number of basis BRDFs, committed; see
    `skindb.analysis.basis_size_curve`.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`.
    seed
        Random seed of the bootstrap.
    dictionary
        Path of the dictionary that the takes were fitted with; default the embedded one.
    """
    # whose labels name the BRDFs of the fits
    variables = (*BASIS_SIZE_VARIABLES, "dictionary_weight")
    cohort = study_cohort(
        db, "surfels", takes, release, surfels=BASIS_SURFELS, variables=variables
    )

    def compute() -> Groups:
        tables = brdf_tables(db, cohort, dictionary, release)
        rng = np.random.default_rng(seed)
        return {
            "basis_size": basis_size_curve(
                cohort, tables=tables, mixed_fits=bool(takes), rng=rng
            )
        }

    return made(
        db,
        StudyRequest("brdf", name, release, tuple(takes), {"seed": seed}, dictionary),
        compute,
        cohort,
    )


@on_one_blas_thread
@logged("study", what="traits")
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
    """A common basis, histograms of albedo and trait vectors, committed; see
    `skindb.analysis.trait_vectors`.

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
    require_covered(db, release)
    cohort = study_cohort(db, "surfels", takes, release, surfels=SAMPLED)
    tables = study_cohort(db, "tables", takes, release)
    if not takes:  # before anything is registered
        require_same_fit(cohort)
    frame = frame_of(db, cohort, release)

    def compute() -> Groups:
        rng = np.random.default_rng(seed)
        brdfs = brdf_tables(db, cohort, dictionary, release)
        basis = population_basis(
            cohort, tables=brdfs, k=k, in_metric=in_metric, mixed_fits=mixed, rng=rng
        )
        found = _albedo(db, cohort, frame, release, mixed=mixed)
        options: dict[str, Any] = {
            "adjust": adjust,
            "mixed_fits": mixed,
            "rng": rng,
        } | found
        vectors = trait_vectors(tables, basis=basis, **options)
        return {"population_basis": basis, "traits": vectors} | found

    given = {"k": k, "in_metric": in_metric, "adjust": list(adjust), "seed": seed}
    return made(
        db,
        StudyRequest("traits", name, release, tuple(takes), given, dictionary),
        compute,
        cohort,
        frame,
    )


@on_one_blas_thread
@logged("study", what="groups")
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
    cohort = study_cohort(db, "tables", takes, release)
    given: dict[str, Any] = {
        "group_by": group_by,
        "adjust": list(adjust),
        "permutations": permutations,
    }

    def compute() -> Groups:
        return {
            "effects": group_effects(
                cohort, **given, mixed_fits=bool(takes), rng=np.random.default_rng(seed)
            )
        }

    return made(
        db,
        StudyRequest("groups", name, release, tuple(takes), given | {"seed": seed}),
        compute,
        cohort,
    )


@on_one_blas_thread
@logged("study", what="correlations")
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
    cohort = study_cohort(db, "tables", takes, release)

    def compute() -> Groups:
        rng = np.random.default_rng(seed)
        table = component_correlations(
            cohort, permutations=permutations, mixed_fits=bool(takes), rng=rng
        )
        return {"correlations": table}

    given = {"permutations": permutations, "seed": seed}
    return made(
        db,
        StudyRequest("correlations", name, release, tuple(takes), given),
        compute,
        cohort,
    )


@on_one_blas_thread
@logged("study", what="components")
def components(
    db: Database,
    *,
    k: int = 5,
    takes: Sequence[str] = (),
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Principal components of the albedo maps of takes, committed; see
    `skindb.analysis.face_components`.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`. Takes must have landmarks; they are registered if need be.
    k
        Components, at most.
    """
    cohort, frame = registered_maps(db, takes, release)

    def compute() -> Groups:
        return {"components": face_components(cohort, most=k, mixed_fits=bool(takes))}

    return made(
        db,
        StudyRequest("components", name, release, tuple(takes), {"k": k}),
        compute,
        cohort,
        frame,
    )


@on_one_blas_thread
@logged("study", what="maps")
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
    cohort, frame = registered_maps(db, takes, release)
    given: dict[str, Any] = {
        "group_by": group_by,
        "adjust": list(adjust),
        "permutations": permutations,
    }

    def compute() -> Groups:
        return {
            "effect_maps": effect_maps(
                cohort, **given, mixed_fits=bool(takes), rng=np.random.default_rng(seed)
            )
        }

    return made(
        db,
        StudyRequest("maps", name, release, tuple(takes), given | {"seed": seed}),
        compute,
        cohort,
        frame,
    )


@on_one_blas_thread
@logged("study", what="chromophores")
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

    Takes are registered for that if need be. See `skindb.analysis.chromophore_axes`,
    `chromophore_table` and `mean_face`; the mean face is omitted, with a note, where no
    texel has enough subjects.

    Parameters
    ----------
    db, takes, group_by, release, name
        As in `translucency`.
    seed
        Random seed of the independent components and of the bootstrap.
    """
    cohort, frame = registered_maps(db, takes, release)

    def compute() -> Groups:
        mixed = bool(takes)
        landmarks = common_landmarks(frame.datasets)
        axes = chromophore_axes(
            cohort,
            landmarks=landmarks,
            mixed_fits=mixed,
            rng=np.random.default_rng(seed),
        )
        statistics = chromophore_statistics(cohort, axes=axes, landmarks=landmarks)
        table = chromophore_table(cohort, statistics=statistics, group_by=group_by)
        found = {
            "chromophores": axes.merge(statistics, combine_attrs="override"),
            "chromophore_table": table,
        }
        try:
            found["mean_face"] = mean_face(cohort, mixed_fits=mixed)
        except InputError as error:  # a few people have pigments, but no mean
            frame.notes.extend(note("", str(fault)) for fault in error.faults)
        return found

    asked = StudyRequest(
        "chromophores",
        name,
        release,
        tuple(takes),
        {"group_by": group_by or "", "seed": seed},
    )
    return made(db, asked, compute, cohort, frame)


@on_one_blas_thread
@logged("study", what="coverage")
def coverage(
    db: Database,
    *,
    takes: Sequence[str] = (),
    release: str | None = None,
    name: str | None = None,
) -> xr.DataTree:
    """Report which groups the fitted takes represent; see `skindb.analysis.coverage_report`.

    Parameters
    ----------
    db, takes, release, name
        As in `translucency`.
    """
    cohort = study_cohort(db, "tables", takes, release)

    def compute() -> Groups:
        return {"coverage": coverage_report(cohort)}

    return made(
        db, StudyRequest("coverage", name, release, tuple(takes), {}), compute, cohort
    )


@on_one_blas_thread
@logged("study", what="surface")
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
    """Surface BRDFs of groups, distances between them and a map of the takes; see
    `skindb.analysis.brdf_space`.

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
        As `translucency` and `skindb.analysis.brdf_space`, and for a k above the number
        of BRDFs or of surfels.
    """
    mixed = bool(takes)
    tables = study_cohort(db, "tables", takes, release)
    grouped_takes(tables, group_by)  # before anything is computed
    cohort = study_cohort(db, "surfels", takes, release, surfels=SAMPLED)

    def compute() -> Groups:
        brdfs = brdf_tables(db, cohort, dictionary, release)
        rng = np.random.default_rng(seed)
        basis = population_basis(cohort, tables=brdfs, k=k, mixed_fits=mixed, rng=rng)
        if (found := basis.sizes["component"]) < k:
            rule = (
                "must not be above the number of BRDFs of the dictionary or of surfels"
            )
            raise InputError(
                Fault("k", rule, f"{k}, and {found} of them", "choose a smaller k")
            )
        space = brdf_space(
            tables,
            basis=basis,
            tables=brdfs,
            group_by=group_by,
            permutations=permutations,
            mixed_fits=mixed,
            rng=rng,
        )
        return {"population_basis": basis, "brdf_space": space}

    given = {"group_by": group_by, "k": k, "permutations": permutations, "seed": seed}
    return made(
        db,
        StudyRequest("surface", name, release, tuple(takes), given, dictionary),
        compute,
        cohort,
    )


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


def _albedo(
    db: Database, cohort: xr.Dataset, frame: Frame, release: str | None, *, mixed: bool
) -> dict[str, xr.Dataset]:
    """Histograms, in regions by landmarks where a capture names none; distributions at
    every scale of takes that are registered.
    """
    regions: tuple[str, ...] = (FACE, "beard")
    drawn = None
    texture = dict[str, xr.Dataset]()
    if names := list(frame.records):
        regions = (FACE, "beard", "no_beard")
        summarise(db, names, release=release)
        options: dict[str, Any] = {
            "surfels": SAMPLED,
            "variables": ["region_mask", "surfel_index"],
            "release": release,
        }
        drawn = db.cohort("surfels", kind="registration", takes=names, **options)
        summarise(db, names, release=release, size=TEXELS)
        maps = db.cohort(
            "maps", size=TEXELS, takes=names, variables=MAPPED, release=release
        )
        texture["texture"] = texture_statistics(
            maps, landmarks=common_landmarks(frame.datasets), mixed_fits=mixed
        )
    return {
        "albedo": albedo_histograms(
            cohort, regions=regions, drawn=drawn, mixed_fits=mixed
        )
    } | texture
