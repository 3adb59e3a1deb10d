"""Report on the measured BRDFs a fit mixes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import xarray as xr

from skindb.schema import dataset

if TYPE_CHECKING:
    from skindb.optics.dictionary import Dictionary


def dictionary_report(dictionary: Dictionary, *, disc_angular_radius: float) -> xr.Dataset:
    """Energy, reciprocity, errors and holes of every material, see `dictionary_quality`.

    Parameters
    ----------
    dictionary
        `embedded_dictionary()` or `read_dictionary(path)`.
    disc_angular_radius
        Of the lights as seen from the surface [rad]; the dictionary's own where its tables are averaged already.

    Returns
    -------
    Dataset
        Group `dictionary_report` of the schema, per basis; attributes: source, radius [rad] and notes on the files.
    """
    from skindb.optics.dictionary_quality import dictionary_quality

    radius = dictionary.disc_angular_radius or disc_angular_radius
    attrs = {"dictionary": dictionary.source, "disc_angular_radius": radius, "notes": list(dictionary.notes)}
    return dataset(dictionary_quality(dictionary, radius), coords={"basis": list(dictionary.names)}, attrs=attrs)
