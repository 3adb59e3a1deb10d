"""Noise of the samples due to photons, read noise and quantisation of merged exposures
(Janesick 2007), and sanity checks of samples and of the intensities of lights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.radiance import read_sigma, vignette_gain
from skindb.errors import Fault, require
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.types import Float64

# number of radiances up to the white level at which the linear model is fitted to the
# variance
RADIANCES = 64
MIN_MEDIAN_SAMPLES = 50  # of a view, for a reliable median
# of a light to the median one, in a channel: lights of a dome differ by tens of
# percent, of two types by ten times
MAX_INTENSITY_RATIO = 1_000.0
NOTED_INTENSITY_RATIO = 20.0
# sr^-1, of the median sample: black velvet has 0.002, a perfect diffuser 0.3
MEDIAN_SAMPLES = (3e-4, 3.0)
# of the median sample of a light to that of all lights: 0.55 to 1.3 in virtual domes,
# less for grazing lights
MAX_SAMPLE_RATIO = 50.0
NOTED_SAMPLE_RATIO = 8.0
# sr^-1, of a sample: sharp highlights of wet skin have about 50; and fraction of the
# samples of a view that exceed it
MAX_SAMPLE = 1_000.0
MAX_BRIGHT_FRACTION = 0.05
SAMPLE_CURE = (
    "give each light its intensity in the unit of the frames, times mm^2, or a white "
    "target; check the frames"
)


@dataclass(frozen=True)
class SampleNoise:
    """Noise model of the samples; exposures are ordered from the longest to the shortest.

    Radiance up to `limit` is below the white level in an exposure and in all shorter
    ones. The radiance of a pixel that is merged from them has the variance
    read_variance + shot_variance * radiance, and a sample has that variance over its
    effective pixels.
    """

    limit: Float64  # (camera, 3, exposure) radiance
    read_variance: Float64  # (camera, 3, exposure) radiance^2
    shot_variance: Float64  # (camera, 3, exposure) radiance
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
    camera: CameraRecord, seconds: Sequence[float] | Float64, gain: float
) -> tuple[Float64, Float64, Float64]:
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
        _line(time[longest:] * gain, read, 1 / sensor.full_electrons)
        for longest in range(len(time))
    ]
    mixed = np.square(camera.colour_matrix).sum(axis=1)[:, None]
    offset, slope = np.array(lines).T
    return np.tile(1 / (time * gain), (3, 1)), mixed * offset, mixed * slope


def _line(seconds: Float64, read: float, photon: float) -> tuple[float, float]:
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


def intensity_faults(dome: DomeRecord, intensity: Float64) -> list[Fault]:
    """Faults of lights whose intensities (light, 3) are far above or below those of the others."""
    rule = (
        f"the intensity of a light must be at most {MAX_INTENSITY_RATIO:,g} times as "
        "large or small as the median"
    )
    cure = "correct it; remove a light that was not switched on, and its frames"
    return [
        Fault(
            f"{dome.file}[lights][{j}][intensity]",
            rule,
            f"{ratio:.3g} times, of light {dome.lights[j].id}",
            cure,
        )
        for j, ratio in _beyond(_relative(intensity), MAX_INTENSITY_RATIO)
    ]


def sample_faults(
    dome: DomeRecord, view_median: Float64, bright: Float64
) -> list[Fault]:
    """Faults of samples that are too large or small for skin, by their medians and
    bright fractions (light, camera).
    """
    median = _light_medians(view_median)
    middle = _nan_median(median)
    smallest, largest = MEDIAN_SAMPLES
    if not np.isnan(middle) and not smallest <= middle <= largest:
        rule = f"the median reflectance sample of a face must be {smallest:g} to {largest:g} sr^-1"
        finding = f"{middle:.3g}"
        if np.isinf(middle):
            finding = "samples beyond 65504, the largest half float"
        return [Fault(f"{dome.file}[lights]", rule, finding, SAMPLE_CURE)]
    rule = (
        f"the median sample of a light must be at most {MAX_SAMPLE_RATIO:g} times the "
        "overall median, or its inverse"
    )
    lights = [
        Fault(
            f"{dome.file}[lights][{j}]",
            rule,
            f"{ratio:.3g} times, of light {dome.lights[j].id}",
            SAMPLE_CURE,
        )
        for j, ratio in _beyond(median[:, None] / middle, MAX_SAMPLE_RATIO)
    ]
    return lights or _bright_faults(dome, bright)


def _bright_faults(dome: DomeRecord, bright: Float64) -> list[Fault]:
    """Faults of views (light, camera) in which more than a few samples are too large
    for a surface.
    """
    rule = (
        f"at most {MAX_BRIGHT_FRACTION:.0%} of the samples of a view may be above "
        f"{MAX_SAMPLE:g} sr^-1"
    )
    cure = "copy the frame from the camera again, or merge its exposures again"
    return [
        Fault(
            f"{dome.file}[frames]",
            rule,
            f"camera {dome.cameras[c].id}, light {dome.lights[j].id}: {bright[j, c]:.0%}",
            cure,
        )
        for j, c in np.argwhere(bright > MAX_BRIGHT_FRACTION)
    ]


def light_notes(
    dome: DomeRecord, intensity: Float64, view_median: Float64
) -> list[str]:
    """Warnings about lights whose intensities or samples are unusual, but not impossible."""
    median = _light_medians(view_median)
    return [
        f"light {dome.lights[j].id}: its {quantity} {ratio:.3g} times the median of all lights"
        for quantity, ratios, limit in (
            ("intensity is", _relative(intensity), NOTED_INTENSITY_RATIO),
            ("samples are", median[:, None] / _nan_median(median), NOTED_SAMPLE_RATIO),
        )
        for j, ratio in _beyond(ratios, limit)
    ]


def view_median(samples: NDArray[np.float16]) -> float:
    """Median of the usable samples (3, n) of a view, whose NaN, beyond half precision,
    count as infinite.
    """
    if samples.shape[1] < MIN_MEDIAN_SAMPLES:
        return float("nan")
    values = samples.astype(np.float64)
    return float(np.median(np.where(np.isnan(values), np.inf, values)))


def bright_fraction(samples: NDArray[np.float16]) -> float:
    """Fraction of the usable samples (3, n) of a view that are too large for a surface;
    NaN: beyond half precision.
    """
    if samples.shape[1] < MIN_MEDIAN_SAMPLES:
        return 0.0
    return float((~(samples <= MAX_SAMPLE)).any(axis=0).mean())


def require_lit(where: str, radiance: NDArray[np.float32], count: int) -> None:
    """Require a view whose usable pixels (n, 3), at `count` surfels, are not all zero
    or negative.
    """
    require(
        count < MIN_MEDIAN_SAMPLES or (radiance > 0).any(),
        where,
        "a frame must be bright where its light reaches the face",
        f"none at {count} surfels",
        "copy the frame from the camera again",
    )


def _relative(intensity: Float64) -> Float64:
    return intensity / np.median(intensity, axis=0)


def _light_medians(view_median: Float64) -> Float64:
    """Median over the cameras (light,) of medians (light, camera); NaN where there is none."""
    return np.array([_nan_median(row) for row in view_median])


def _nan_median(values: Float64) -> float:
    """Median of the values that are not NaN; NaN if there is none."""
    numbers = values[~np.isnan(values)]
    return float(np.median(numbers)) if len(numbers) else float("nan")


def _beyond(ratios: Float64, limit: float) -> list[tuple[int, float]]:
    """Rows of ratios (n, k) that differ from 1 by more than the limit, each with its
    most extreme ratio.
    """
    out = []
    for j, row in enumerate(ratios):
        with np.errstate(divide="ignore"):
            away = np.where(row > 0, np.abs(np.log(np.maximum(row, 1e-300))), np.inf)
        if (away[~np.isnan(row)] > np.log(limit)).any():
            out.append((j, float(row[np.nanargmax(np.where(np.isnan(row), -1, away))])))
    return out
