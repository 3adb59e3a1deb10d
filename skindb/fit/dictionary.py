"""Report on the measured BRDFs of a dictionary."""

from __future__ import annotations

from typing import TYPE_CHECKING

import xarray as xr

from skindb.reflectance.dictionary import dictionary_quality
from skindb.schema import dataset

if TYPE_CHECKING:
    from skindb.reflectance.dictionary import Dictionary


def dictionary_report(
    dictionary: Dictionary, *, disc_angular_radius: float
) -> xr.Dataset:
    """Energy, reciprocity, errors and holes of every material, see `dictionary_quality`.

    Parameters
    ----------
    dictionary
        `embedded_dictionary()` or `read_dictionary(path)`.
    disc_angular_radius
        Angular radius of the lights as seen from the surface [rad]; ignored if the
        tables are already averaged.

    Returns
    -------
    Dataset
        Group `dictionary_report` of the schema and `disc_angular_radius` [rad];
        attributes `source` and `notes`.
    """
    radius = dictionary.disc_angular_radius or disc_angular_radius
    attrs = {"source": dictionary.source, "notes": list(dictionary.notes)}
    found = dictionary_quality(dictionary, radius) | {"disc_angular_radius": radius}
    return dataset(found, coords={"dictionary": list(dictionary.names)}, attrs=attrs)
