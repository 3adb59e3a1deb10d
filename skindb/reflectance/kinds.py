"""The surface models that exist, by the option of a fit and by their stored form."""

from __future__ import annotations

from collections.abc import Container

import xarray as xr

from skindb.errors import Fault, InputError
from skindb.reflectance.dictionary import Dictionary, disc_dictionary
from skindb.reflectance.ggx import GGX
from skindb.reflectance.ggx import PARAMETERS as LOBE_VARIABLES
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import ReflectanceModel
from skindb.reflectance.tables import DEFAULT_GRID, brdf_coords, stored_brdf
from skindb.schema import check, dataset


def unfitted_model(
    kind: str,
    dictionary: Dictionary | None,
    disc_angular_radius: float,
    *,
    rank: int,
    mode: str,
    k: int,
    eta: float,
) -> ReflectanceModel:
    """The surface model of the first pass of a fit.

    Parameters
    ----------
    kind
        "mixture" of BRDFs of a dictionary, or "ggx": one analytic lobe.
    dictionary
        BRDFs for point lights; default the embedded 59.
    disc_angular_radius
        Of the lights as seen from the surfels [rad].
    rank, mode
        Rank of the reduced dictionary, and "perceptual", "linear" or "paper".
    k
        Components that the model is reduced to after the first pass.
    eta
        Refractive index of skin, also that of the lobe.

    Raises
    ------
    InputError
        If the dictionary has fewer than k BRDFs.
    """
    if kind == "ggx":
        if mode == "paper":
            rule = 'the surface "ggx" is fitted in the mode "perceptual" or "linear"'
            raise InputError(Fault("mode", rule, mode, "choose another mode"))
        return GGX(eta, disc_angular_radius)
    tables = disc_dictionary(dictionary, disc_angular_radius)
    if k > len(tables.names):  # checked before the fit
        rule = f"a reduced basis of this dictionary has 1 to {len(tables.names)} components"
        raise InputError(Fault("k", rule, str(k), "choose a smaller k"))
    return Mixture.of_dictionary(tables, rank=rank, mode=mode)


def surface_model(basis: xr.Dataset) -> ReflectanceModel:
    """The surface model of a take from its group "basis".

    Raises
    ------
    InputError
        If the group does not fit the schema.
    """
    return GGX.of_basis(basis) if "lobe_index" in basis else Mixture.of_basis(basis)


def parameter_variables(fitted: xr.Dataset) -> tuple[str, ...]:
    """Variables of the group "fitted" with the parameters of its surface model."""
    return LOBE_VARIABLES if LOBE_VARIABLES[0] in fitted else ("basis_weight",)


def as_mixture(model: xr.DataTree) -> xr.DataTree:
    """The model with its surface as a mixture of tables, for programs that read tables; a
    mixture is returned as it is.
    """
    basis = model["basis"].to_dataset()
    surface = surface_model(basis)
    if isinstance(surface, Mixture):
        return model
    fitted = model["fitted"].to_dataset()
    check(fitted, surface.parameter_variables, where="fitted")
    tables, weights = surface.resample(surface.parameters_of(fitted))
    names = [f"component{k}" for k in range(weights.shape[1])]
    mixed = dataset({"basis_weight": weights}, coords={"component": names})
    shared = dataset(
        {
            "basis_brdf": stored_brdf(tables),
            "disc_angular_radius": basis["disc_angular_radius"].values,
        },
        coords={"component": names, **brdf_coords(DEFAULT_GRID)},
    )
    groups = {name: node.to_dataset() for name, node in model.children.items()}
    groups |= {"fitted": fitted.merge(mixed), "basis": shared}
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = dict(model.attrs)
    return tree


def require_mixture(names: Container[object], where: str) -> None:
    """Raise `InputError` unless `names` has the weights of a dictionary."""
    if "dictionary_weight" not in names and "dictionary" not in names:
        rule = "edits and studies of BRDFs need mixtures of measured BRDFs"
        cure = "fit with --surface mixture"
        raise InputError(Fault(where, rule, "another surface model", cure))
