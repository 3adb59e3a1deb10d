"""What the fits of one take work on: samples, surfels and dome in one Dataset."""

from __future__ import annotations

import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema import check

SAMPLES = ("reflectance_sample",)
SURFELS = ("surfel_position", "surfel_normal", "surfel_area")
DOME = ("light_position", "light_disc_radius", "camera_position")
GEOMETRY = (
    "reflectance_sample",
    "surfel_position",
    "light_position",
    "camera_position",
)  # first inputs of every kernel


def lumitexels(capture: xr.DataTree) -> xr.Dataset:
    """Samples of a take with where its surfels, lights and cameras are.

    Parameters
    ----------
    capture
        Version of kind "capture" with the groups samples, surfels and dome.

    Returns
    -------
    Dataset
        `reflectance_sample` (surfel, light, camera, channel) [sr^-1], as lazy as it was read, with position, normal and
        area of the surfels and positions of lights and cameras [mm].

    Raises
    ------
    InputError
        With every variable that is absent or does not fit the schema.
    """
    parts: list[xr.Dataset] = []
    faults: list[Fault] = []
    for group, names in (("samples", SAMPLES), ("surfels", SURFELS), ("dome", DOME)):
        dataset = capture[group].to_dataset() if group in capture.children else xr.Dataset()
        try:
            check(dataset, names, where=group)
            parts.append(dataset[list(names)])
        except InputError as error:  # the faults of all groups together
            faults += error.faults
    if faults:
        raise InputError(faults)
    merged = xr.merge(parts, compat="override", join="override", combine_attrs="override")
    small = [name for name in (*SURFELS, *DOME) if name not in SAMPLES]
    # geometry is read once: 28 bytes a surfel, against 43 kB of samples of a full dome
    return merged.assign({name: merged[name].load() for name in small})
