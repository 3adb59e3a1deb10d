"""The surface models that exist, by the option of a fit and by their stored form."""

from __future__ import annotations

import xarray as xr

from skindb.errors import Fault, InputError
from skindb.reflectance.dictionary import Dictionary, disc_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import ReflectanceModel


def unfitted_model(
    dictionary: Dictionary | None,
    disc_angular_radius: float,
    *,
    rank: int,
    mode: str,
    k: int,
) -> ReflectanceModel:
    """The surface model of the first pass of a fit.

    Parameters
    ----------
    dictionary
        BRDFs for point lights; default the embedded 59.
    disc_angular_radius
        Of the lights as seen from the surfels [rad].
    rank, mode
        Rank of the reduced dictionary, and "perceptual", "linear" or "paper".
    k
        Components that the model is reduced to after the first pass.

    Raises
    ------
    InputError
        If the dictionary has fewer than k BRDFs.
    """
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
    return Mixture.of_basis(basis)
