"""Input of the fits of one take: samples, their noise, surfels and dome in one Dataset,
and in blocks of surfels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from skindb.errors import Fault, attempt, require_none
from skindb.parameters import SCAN_ERROR_DEGREES
from skindb.reflectance.model import UNKNOWN_NOISE, Block, Noise
from skindb.schema import check, variables
from skindb.types import AnyArray, Array, float64, lengths

Arrays = Mapping[str, AnyArray]  # of a block of surfels, by variable
GEOMETRY = (
    "reflectance_sample",
    "surfel_position",
    "light_position",
    "camera_position",
)
RADIANCE = ("radiance_limit", "radiance_read_variance", "radiance_shot_variance")
# captures of linear files or of unknown electrons have none of these
NOISE_SAMPLES = ("effective_pixels", *RADIANCE)
NOISE_LIGHTS = ("light_intensity", "light_axis", "light_falloff")
NOISE_INPUTS = (
    "surfel_position",
    "light_position",
    "effective_pixels",
    *NOISE_LIGHTS,
    *RADIANCE,
)
POLARISATION = (variables.LIGHT_POLARISATION, variables.CAMERA_POLARISATION)
REQUIRED = {
    "samples": ("reflectance_sample", "noise_floor"),
    "surfels": ("surfel_position", "surfel_normal", "surfel_area"),
    "dome": ("light_position", "light_disc_radius", "camera_position"),
}
OPTIONAL = {
    "samples": NOISE_SAMPLES,
    "dome": (
        *NOISE_LIGHTS,
        *POLARISATION,
        variables.RELATIVE_REFLECTANCE,
    ),
    "surfels": (variables.SCAN_NORMAL_ERROR, variables.LOBE_STRENGTH_APPLIED),
}


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
    parts = []
    faults: list[Fault] = []
    for group, required in REQUIRED.items():
        dataset = xr.Dataset()
        if group in capture.children:
            dataset = capture[group].to_dataset()
        names = [*required, *(name for name in OPTIONAL[group] if name in dataset)]
        attempt(faults, partial(check, dataset, names, where=group))
        parts.append((dataset, names))
    require_none(faults)
    merged = xr.merge(
        [dataset[names] for dataset, names in parts],
        compat="override",
        join="override",
        combine_attrs="override",
    )
    # geometry and noise are read once: 60 bytes per surfel, compared with 14 kB of
    # samples for a full dome
    small = [name for name in merged.data_vars if name != "reflectance_sample"]
    return merged.assign({name: merged[name].load() for name in small})


def scan_error(lumitexels: xr.Dataset) -> float:
    """RMS angle [degree] of the scan's normals to the true ones."""
    return float(lumitexels.get(variables.SCAN_NORMAL_ERROR, SCAN_ERROR_DEGREES))


def relative_reflectance(lumitexels: xr.Dataset) -> bool:
    """Whether R_d has an unknown factor per channel."""
    return bool(lumitexels.get(variables.RELATIVE_REFLECTANCE, 0))


def disc_angle(lumitexels: xr.Dataset) -> float:
    """Median angular radius [rad] of the lights as seen from the middle of the surfels;
    0 for point lights.
    """
    middle = float64(lumitexels["surfel_position"].values).mean(axis=0)
    distance = lengths(lumitexels["light_position"].values - middle)
    radius = lumitexels["light_disc_radius"].values
    return float(np.median(np.arctan2(radius, distance)))


def by_name(
    kernel: Callable[..., tuple[Any, ...]], names: Sequence[str]
) -> Callable[..., tuple[Any, ...]]:
    """A kernel of arrays by the names of their variables, as `elementwise` calls it."""

    def call(*arrays: Array, **params: Any) -> tuple[Any, ...]:
        return kernel(dict(zip(names, arrays, strict=True)), **params)

    return call


def block_of(arrays: Arrays) -> Block:
    """The block of surfels in these variables, and in those of `noise_inputs`; R_d is NaN
    where it is not among them.
    """
    normal = arrays["shading_normal"]
    return Block(
        sample=arrays["reflectance_sample"],
        position=arrays["surfel_position"],
        light=arrays["light_position"],
        camera=arrays["camera_position"],
        normal=normal,
        diffuse=arrays.get("diffuse_reflectance", np.full_like(normal, np.nan)),
        noise=noise_of(arrays),
        polarisation=polarisation(arrays),
    )


def polarisation(arrays: Arrays | xr.Dataset) -> Array:
    """Products (lights, cameras) of the degrees of polarisation; (0, 0) without polarisers."""
    if not all(name in arrays for name in POLARISATION):
        return np.zeros((0, 0))
    by_light, by_camera = (float64(arrays[name]) for name in POLARISATION)
    return np.outer(by_light, by_camera)


def noise_inputs(lumitexels: xr.Dataset) -> tuple[str, ...]:
    """Names of the variables that fits take where they are known: those of `noise_of`, the
    polarisers and the lobes of the rig.
    """
    return tuple(
        name
        for group in (NOISE_INPUTS, POLARISATION, (variables.LOBE_STRENGTH_APPLIED,))
        if all(name in lumitexels for name in group)
        for name in group
    )


def noise_of(arrays: Arrays) -> Noise:
    """Noise of the samples of a block of surfels from the variables of `noise_inputs`,
    if it has them.
    """
    if not all(name in arrays for name in NOISE_INPUTS):
        return UNKNOWN_NOISE
    scale = _reflectance_per_radiance(
        arrays, arrays["light_intensity"].mean(axis=1, keepdims=True)
    )
    limit, read, slope = (
        np.ascontiguousarray(arrays[name].mean(axis=1), np.float32) for name in RADIANCE
    )
    return Noise(
        per_radiance=np.ascontiguousarray(scale[..., 0], np.float32),
        pixels=np.ascontiguousarray(arrays["effective_pixels"], np.float32),
        limit=limit,
        read=read,
        slope=slope,
    )


def sample_variance(
    lumitexels: xr.Dataset, reflectance: AnyArray | None = None
) -> xr.DataArray:
    """Variance (surfel, light, camera, channel) [sr^-2] of samples due to photons, read
    noise and quantisation.

    Parameters
    ----------
    lumitexels
        From `lumitexels`.
    reflectance
        (surfel, light, camera, channel) [sr^-1] samples without noise; default the
        samples themselves, whose noise makes the variance of low ones too small.

    Returns
    -------
    DataArray
        NaN where there is no sample. The result is held in memory: select some surfels
        of a large capture.

    Raises
    ------
    InputError
        If the capture does not hold the noise of its cameras: linear files, unknown
        electrons.

    Examples
    --------
    >>> variance = sample_variance(lumitexels(capture).isel(surfel=slice(100)))  # doctest: +SKIP
    """
    check(lumitexels, ("reflectance_sample", *NOISE_INPUTS), where="lumitexels")
    sample = lumitexels["reflectance_sample"]
    arrays = {name: float64(lumitexels[name].values) for name in NOISE_INPUTS}
    limit, read, slope = (arrays[name] for name in RADIANCE)
    value = float64(sample.values)
    expected = np.maximum(value if reflectance is None else reflectance, 0.0)
    scale = _reflectance_per_radiance(arrays, arrays["light_intensity"])[:, :, None]
    # the longest exposure whose limit is not exceeded
    step = (value / scale)[..., None] > limit
    exposure = np.minimum(step.sum(axis=-1), limit.shape[2] - 1)
    camera, channel = np.ogrid[: limit.shape[0], : limit.shape[1]]
    variance = (
        scale**2 * read[camera, channel, exposure]
        + scale * slope[camera, channel, exposure] * expected
    )
    pixels = arrays["effective_pixels"][:, None, :, None]
    variance = np.where(np.isfinite(value), variance / pixels, np.nan)
    return xr.DataArray(
        variance,
        dims=sample.dims,
        attrs={"units": "sr-2", "long_name": "variance of a sample"},
    )


def _reflectance_per_radiance(arrays: Arrays, intensity: Array) -> Array:
    """Distance squared over intensity and fall-off (n, light, channel)."""
    position = float64(arrays["surfel_position"])
    falloff = arrays["light_falloff"]
    way = position[:, None] - arrays["light_position"]
    square = np.einsum("nlk,nlk->nl", way, way)
    if falloff.any():
        cosine = np.einsum("nlk,lk->nl", way, arrays["light_axis"]) / np.sqrt(square)
        square = square / np.maximum(cosine, 1e-3) ** falloff
    return square[..., None] / intensity


def directions(points: Array, targets: Array) -> Array:
    """(n, t, 3) unit directions from points (n, 3) to targets (t, 3); NaN where both
    coincide.
    """
    way = float64(targets)[None] - float64(points)[:, None]
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    return way / np.where(length > 0, length, np.nan)


def cosines(normal: Array, towards: Array) -> Array:
    """(n, t) cosines between normals (n, 3) and directions (n, t, 3)."""
    return np.einsum("nk,ntk->nt", normal, towards)
