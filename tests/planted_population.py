"""Small populations of takes with planted bases, colours and traits."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.analysis import (
    albedo_histograms,
    cohort_of,
    population_basis,
    trait_vectors,
)
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.tables import TableGrid, stored_brdf
from skindb.schema import dataset

TABLES = np.ascontiguousarray(embedded_dictionary().table[..., :8])
NAMES = list(embedded_dictionary().names[:8])
GRID = TableGrid(*TABLES.shape[:3])
H = np.zeros((3, 8))
H[0, [0, 1]], H[1, [3]], H[2, [5, 6]] = (0.5, 0.5), 1.0, (0.3, 0.7)
N = 60


def unit(v):
    """Vectors of unit length."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def model_of(
    seed: int,
    *,
    gloss=1.0,
    tint=1.0,
    tr=1.0,
    scope=("fit", "statistics"),
    probe=True,
    **attrs,
) -> xr.DataTree:
    rng = np.random.default_rng(seed)
    weight = (rng.gamma(4.0, 0.02, (N, 3)) * [gloss, 1, 1]) @ H
    colour = np.clip(
        np.array([0.5, 0.3, 0.2]) * tint * rng.lognormal(0, 0.08, (N, 3)), 0.01, 0.95
    )
    status = np.zeros(N)
    status[0] = 1
    weight[0], colour[0] = np.nan, np.nan
    position = unit(rng.normal(size=(N, 3)) * [1, 1, 0.3] + [0, 0, 1]) * 80
    fitted = dataset(
        {
            "dictionary_weight": weight,
            "diffuse_reflectance": colour,
            "dipole_s": np.full((N, 3), 0.5),
            "basis_weight": weight[:, :2],
            "surfel_area": rng.uniform(0.5, 1.5, N),
            "fit_status": status,
            "surfel_position": position,
            "shading_normal": unit(position),
            "sigma_tr": np.full((N, 3), 1.0),
            "region_mask": rng.random((N, 1)) < 0.4,
            "refractive_index": 1.3,
        },
        coords={
            "dictionary": NAMES,
            "region": ["beard"],
            "component": ["component0", "component1"],
        },
    )
    brdf = stored_brdf(TABLES[..., :2])
    groups = {
        "fitted": fitted,
        "basis": dataset({"basis_brdf": brdf, "disc_angular_radius": 0.0}),
    }
    if probe:
        sites = {
            "site_sigma_tr": tr * np.array([[0.5, 1.0, 1.5], [0.6, 1.1, 1.6]]),
            "site_sigma_tr_error": np.full((2, 3), 0.05 * tr),
            "site_status": np.zeros((2, 3)),
        }
        groups["translucency"] = dataset(
            sites, coords={"site": ["cheek", "neck"], "channel": ["R", "G", "B"]}
        )
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {"consent_scope": list(scope), "condition": "normal", **attrs}
    return tree


def population() -> dict[str, xr.DataTree]:
    """Three subjects, one of them also with lotion."""
    return {
        "A": model_of(1, subject="A", traits={"age": 20, "gender": "female"}),
        "A.lotion": model_of(
            1,
            gloss=3.0,
            subject="A",
            condition="lotion",
            traits={"age": 20, "gender": "female"},
        ),
        "B": model_of(
            2, tint=0.6, tr=1.2, subject="B", traits={"age": 60, "gender": "male"}
        ),
        "C": model_of(
            3, tint=0.7, tr=0.8, subject="C", traits={"age": 50, "gender": "male"}
        ),
    }


def tables(models):
    """The cohort of tables of these takes."""
    return cohort_of(models, "tables")


def surfels(models, **options):
    """The cohort of all fitted surfels of these takes."""
    most = max(
        int((model["fitted"]["fit_status"] == 0).sum()) for model in models.values()
    )
    return cohort_of(models, "surfels", **{"surfels": max(most, 1)} | options)


def analysed(models):
    """Basis, albedo and trait vectors of these takes."""
    cohort = surfels(models)
    basis = population_basis(cohort, tables=TABLES, k=3, rng=np.random.default_rng(0))
    albedo = albedo_histograms(cohort)
    return basis, albedo, trait_vectors(tables(models), basis=basis, albedo=albedo)
