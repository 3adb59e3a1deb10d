"""Noise of the samples due to photons, read noise and quantisation of merged exposures
(Janesick 2007).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.radiance import read_sigma, vignette_gain
from skindb.format.devices import CameraRecord, DomeRecord

Array = NDArray[np.float64]
# number of radiances up to the white level at which the linear model is fitted to the
# variance
RADIANCES = 64


@dataclass(frozen=True)
class SampleNoise:
    """Noise model of the samples; exposures are ordered from the longest to the shortest.

    Radiance up to `limit` is below the white level in an exposure and in all shorter
    ones. The radiance of a pixel that is merged from them has the variance
    read_variance + shot_variance * radiance, and a sample has that variance over its
    effective pixels.
    """

    limit: Array  # (camera, 3, exposure) radiance
    read_variance: Array  # (camera, 3, exposure) radiance^2
    shot_variance: Array  # (camera, 3, exposure) radiance
    # (n, camera); NaN where the camera takes no sample
    effective_pixels: NDArray[np.float32]


def sample_noise(
    dome: DomeRecord, pixels: NDArray[np.float32], effective_pixels: NDArray[np.float32]
) -> SampleNoise | None:
    """The noise of all samples from the sensors' electrons; None if those of a camera are unknown.

    Parameters
    ----------
    dome
        Cameras and exposures.
    pixels
        (n, camera, 2) projections of the surfels.
    effective_pixels
        (n, camera) from `pixel_counts`; NaN where no sample is taken.
    """
    if not all(camera.sensor.noise_known for camera in dome.cameras):
        return None
    seconds = np.sort(np.fromiter(dome.exposures.values(), float))[::-1]
    parts = []
    for c, camera in enumerate(dome.cameras):
        seen = np.isfinite(effective_pixels[:, c])
        parts.append(
            radiance_noise(camera, seconds, _mean_gain(camera, pixels[seen, c]))
        )
    limit, read, shot = (np.stack(part) for part in zip(*parts, strict=True))
    return SampleNoise(limit, read, shot, effective_pixels)


def radiance_noise(
    camera: CameraRecord, seconds: Sequence[float] | Array, gain: float
) -> tuple[Array, Array, Array]:
    """Limit, read variance and shot variance (3, exposure) of merged radiance for a
    given gain of the lens.

    Exposures are merged with weights of inverse variance: the variance is 1 / sum of
    seconds^2 / (photons + read noise). A straight line, fitted with relative errors, is
    exact for one exposure, and accurate to 3 % for two exposures with a ratio of eight
    (5 % for eight exposures). A nonlinear response is replaced by its mean slope, and
    the colour matrix is applied to grey light.

    Parameters
    ----------
    camera
        Levels, noise and colour matrix.
    seconds
        (exposure,) exposure times, the longest first.
    gain
        Gain of the lens (vignette) at the face.
    """
    sensor = camera.sensor
    time = np.asarray(seconds, np.float64)
    per_value = np.asarray([1 / (sensor.white - sensor.black)], np.float32)
    read = float(read_sigma(per_value, sensor)[0]) ** 2
    # an exposure is the longest usable one where all longer ones are saturated
    lines = [
        _line(time[first:] * gain, read, 1 / sensor.full_electrons)
        for first in range(len(time))
    ]
    mixed = np.square(camera.colour_matrix).sum(axis=1)[:, None]
    offset, slope = np.array(lines).T
    return np.tile(1 / (time * gain), (3, 1)), mixed * offset, mixed * slope


def _line(seconds: Array, read: float, photon: float) -> tuple[float, float]:
    """Offset and slope of the variance over radiance, from noise of relative exposures."""
    # begins where read noise dominates
    radiance = np.geomspace(read / photon / 10, 1.0, RADIANCES) / seconds[0]
    variance = 1 / (seconds**2 / (photon * radiance[:, None] * seconds + read)).sum(
        axis=1
    )
    design = np.stack([np.ones_like(radiance), radiance], axis=1) / variance[:, None]
    offset, slope = np.linalg.lstsq(design, np.ones(RADIANCES))[0]
    return float(offset), float(slope)


def _mean_gain(camera: CameraRecord, pixels: NDArray[np.float32]) -> float:
    """Mean vignette at projections (n, 2)."""
    if not camera.vignette.any() or not len(pixels):
        return 1.0
    column = np.clip(pixels[:, 0].astype(int), 0, camera.width - 1)
    row = np.clip(pixels[:, 1].astype(int), 0, camera.height - 1)
    return float(vignette_gain(camera)[row, column, 0].mean())
