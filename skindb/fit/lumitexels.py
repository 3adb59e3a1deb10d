"""What the fits of one take work on: samples, surfels and dome in one Dataset."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.schema import check

SAMPLES = ("reflectance_sample", "noise_floor")
SURFELS = ("surfel_position", "surfel_normal", "surfel_area")
DOME = ("light_position", "light_disc_radius", "camera_position")
GEOMETRY = (
    "reflectance_sample",
    "surfel_position",
    "light_position",
    "camera_position",
)  # first inputs of every kernel


def disc_angle(whole: xr.Dataset) -> float:
    """Median angular radius [rad] of the lights as seen from the middle of the surfels; 0 for point lights."""
    middle = whole["surfel_position"].values.astype(np.float64).mean(axis=0)
    distance = np.linalg.norm(whole["light_position"].values - middle, axis=1)
    return float(np.median(np.arctan2(whole["light_disc_radius"].values, distance)))


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
    small = (*SURFELS, *DOME, "noise_floor")
    # geometry is read once: 28 bytes a surfel, against 43 kB of samples of a full dome
    return merged.assign({name: merged[name].load() for name in small})
