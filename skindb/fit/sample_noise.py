"""Variance of reflectance samples due to photons, read noise and quantisation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.fit._lumitexel_kernels import Noise
from skindb.schema import check
from skindb.types import Array

RADIANCE = ("radiance_limit", "radiance_read_variance", "radiance_shot_variance")
DEVICES = (
    "light_position",
    "light_intensity",
    "light_axis",
    "light_falloff",
    *RADIANCE,
)
NOISE_INPUTS = ("surfel_position", "effective_pixels", *DEVICES)
# captures of an earlier version, of linear files or of unknown electrons have none of these
NOISE_SAMPLES = ("effective_pixels", *RADIANCE)
NOISE_LIGHTS = ("light_intensity", "light_axis", "light_falloff")


def noise_inputs(lumitexels: xr.Dataset) -> tuple[str, ...]:
    """Names of the variables that `noise_of` takes; empty if the noise of the samples
    is unknown.
    """
    return NOISE_INPUTS if all(name in lumitexels for name in NOISE_INPUTS) else ()


class TypicalNoise(NamedTuple):
    """Noise of all samples: variance = floor^2 + shot sample [sr^-2]; unknown if shot is 0."""

    floor: float
    shot: float


NO_NOISE = TypicalNoise(0.0, 0.0)


def typical_noise(lumitexels: xr.Dataset) -> TypicalNoise:
    """Noise of captures without the noise of each sample; zero if their photon noise is unknown."""
    shot = float(lumitexels["shot_noise"]) if "shot_noise" in lumitexels else 0.0
    return TypicalNoise(float(lumitexels["noise_floor"]), shot)


def noise_of(arrays: Sequence[Array], typical: TypicalNoise) -> Noise:
    """Noise of the samples of a block of surfels from the arrays of `noise_inputs`, or
    else the typical one.
    """
    if not arrays:
        none = np.zeros((0, 0), np.float32)
        return Noise(none, none, none, none, none, *typical)
    position, pixels, place, intensity, axis, falloff, limit, read, shot = arrays
    scale = _reflectance_per_radiance(
        position, place, intensity.mean(axis=1, keepdims=True), axis, falloff
    )
    limit, read, shot = (
        np.ascontiguousarray(part.mean(axis=1), np.float32)
        for part in (limit, read, shot)
    )
    per_radiance = np.ascontiguousarray(scale[..., 0], np.float32)
    return Noise(
        per_radiance,
        np.ascontiguousarray(pixels, np.float32),
        limit,
        read,
        shot,
        *typical,
    )


def sample_variance(
    lumitexels: xr.Dataset, reflectance: NDArray[Any] | None = None
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
        If the capture does not hold the noise of its cameras: an earlier version,
        linear files, unknown electrons.

    Examples
    --------
    >>> variance = sample_variance(lumitexels(capture).isel(surfel=slice(100)))  # doctest: +SKIP
    """
    check(lumitexels, ("reflectance_sample", *NOISE_INPUTS), where="lumitexels")
    sample = lumitexels["reflectance_sample"]
    position, pixels, place, intensity, axis, falloff, limit, read, shot = (
        lumitexels[name].values.astype(np.float64) for name in NOISE_INPUTS
    )
    value = sample.values.astype(np.float64)
    expected = np.maximum(value if reflectance is None else reflectance, 0.0)
    scale = _reflectance_per_radiance(position, place, intensity, axis, falloff)[
        :, :, None
    ]
    # the longest exposure whose limit is not exceeded
    step = (value / scale)[..., None] > limit
    first = np.minimum(step.sum(axis=-1), limit.shape[2] - 1)
    camera, channel = np.ogrid[: limit.shape[0], : limit.shape[1]]
    variance = (
        scale**2 * read[camera, channel, first]
        + scale * shot[camera, channel, first] * expected
    )
    variance = np.where(np.isfinite(value), variance / pixels[:, None, :, None], np.nan)
    return xr.DataArray(
        variance,
        dims=sample.dims,
        attrs={"units": "sr-2", "long_name": "variance of a sample"},
    )


def _reflectance_per_radiance(
    position: Array, place: Array, intensity: Array, axis: Array, falloff: Array
) -> Array:
    """Distance squared over intensity and fall-off (n, light, channel) of lights at
    `place` (light, 3).
    """
    way = position.astype(np.float64)[:, None] - place
    square = np.einsum("nlk,nlk->nl", way, way)
    if falloff.any():
        cosine = np.einsum("nlk,lk->nl", way, axis) / np.sqrt(square)
        square = square / np.maximum(cosine, 1e-3) ** falloff
    return np.asarray(square[..., None] / intensity)
