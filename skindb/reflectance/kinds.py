"""The surface models that exist, by the option of a fit and by their stored form."""

from __future__ import annotations

from collections.abc import Container

import numpy as np
import xarray as xr

from skindb.errors import require
from skindb.reflectance.ggx import GGX
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import ReflectanceModel, SurfaceKind
from skindb.reflectance.tables import DEFAULT_GRID, brdf_coords, stored_brdf
from skindb.schema import check, dataset, fitted_of, variables
from skindb.types import Array

# by the option `surface` of a fit
SURFACES: dict[str, SurfaceKind] = {"mixture": Mixture, "ggx": GGX}


def surface_model(basis: xr.Dataset) -> ReflectanceModel:
    """The surface model of a take from its group "basis".

    Raises
    ------
    InputError
        If the group does not fit the schema.
    """
    for surface in SURFACES.values():
        if surface.BASIS_VARIABLE in basis:
            return surface.of_basis(basis)
    return Mixture.of_basis(basis)  # raises the fault


def even_diffuse(fitted: xr.Dataset) -> Array:
    """Albedo (n, 3) of the light that leaves by F_t(i) F_t(o) / pi: R_d, and what the
    surface reflects evenly.
    """
    even = np.float32(fitted.get(variables.EVEN_REFLECTION, 0.0))
    return fitted[variables.DIFFUSE_REFLECTANCE].values + even


def as_mixture(model: xr.DataTree) -> xr.DataTree:
    """The model with its surface as a mixture of tables, for programs that read tables; a
    mixture is returned as it is.
    """
    fitted = fitted_of(model)
    basis = model["basis"].to_dataset()
    surface = surface_model(basis)
    if isinstance(surface, Mixture):
        return model
    check(fitted, surface.parameter_variables, where="fitted")
    tables, weights = surface.resample(surface.parameters_of(fitted))
    names = [f"component{k}" for k in range(weights.shape[1])]
    mixed = dataset({"basis_weight": weights}, coords={"component": names})
    shared = dataset(
        {
            variables.BASIS_BRDF: stored_brdf(tables),
            "disc_angular_radius": basis["disc_angular_radius"].values,
        },
        coords={"component": names, **brdf_coords(DEFAULT_GRID)},
    )
    groups = {name: node.to_dataset() for name, node in model.children.items()}
    groups |= {"fitted": fitted.merge(mixed), "basis": shared}
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = dict(model.attrs)
    return tree


def require_mixture(names: Container[object], place: str) -> None:
    """Raise `InputError` unless `names` has the weights of a dictionary."""
    require(
        "dictionary_weight" in names or "dictionary" in names,
        place,
        "edits and studies of BRDFs need mixtures of measured BRDFs",
        "another surface model",
        "fit with --surface mixture",
    )
