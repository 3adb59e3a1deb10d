"""Input of the fits of one take: samples, surfels and dome in one Dataset."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.errors import Fault, InputError
from skindb.fit.sample_noise import NOISE_LIGHTS, NOISE_SAMPLES
from skindb.schema import check, label

SAMPLES = ("reflectance_sample", "noise_floor")
SHOT = "shot_noise"  # 0 for captures that were ingested before it was stored
SURFELS = ("surfel_position", "surfel_normal", "surfel_area")
DOME = ("light_position", "light_disc_radius", "camera_position")
GEOMETRY = (
    "reflectance_sample",
    "surfel_position",
    "light_position",
    "camera_position",
)  # first inputs of every kernel


def disc_angle(whole: xr.Dataset) -> float:
    """Median angular radius [rad] of the lights as seen from the middle of the surfels;
    0 for point lights.
    """
    middle = whole["surfel_position"].values.astype(np.float64).mean(axis=0)
    distance = np.linalg.norm(whole["light_position"].values - middle, axis=1)
    return float(np.median(np.arctan2(whole["light_disc_radius"].values, distance)))


def lumitexels(capture: xr.DataTree) -> xr.Dataset:
    """Samples of a take with the positions of its surfels, lights and cameras.

    Parameters
    ----------
    capture
        Version of kind "capture" with the groups samples, surfels and dome.

    Returns
    -------
    Dataset
        `reflectance_sample` (surfel, light, camera, channel) [sr^-1], lazy if the
        capture is, with position, normal and area of the surfels, positions of lights
        and cameras [mm], and the noise of the samples if it is known.

    Raises
    ------
    InputError
        With every variable that is absent or does not fit the schema.
    """
    parts: list[xr.Dataset] = []
    faults: list[Fault] = []
    read: list[str] = []
    optional = {"samples": (SHOT, *NOISE_SAMPLES), "dome": NOISE_LIGHTS}
    for group, required in (("samples", SAMPLES), ("surfels", SURFELS), ("dome", DOME)):
        dataset = (
            capture[group].to_dataset() if group in capture.children else xr.Dataset()
        )
        names = [
            *required,
            *(name for name in optional.get(group, ()) if name in dataset),
        ]
        try:
            check(dataset, names, where=group)
            parts.append(dataset[names])
            read += names
        except InputError as error:  # collects the faults of all groups
            faults += error.faults
    if faults:
        raise InputError(faults)
    merged = xr.merge(
        parts, compat="override", join="override", combine_attrs="override"
    )
    if SHOT not in merged:
        merged = merged.assign({SHOT: label(SHOT, 0.0)})
    # geometry and noise are read once: 60 bytes per surfel, compared with 14 kB of
    # samples for a full dome
    return merged.assign(
        {name: merged[name].load() for name in read if name != "reflectance_sample"}
    )
