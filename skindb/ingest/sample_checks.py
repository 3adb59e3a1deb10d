"""Sanity checks of the intensities of lights and of reflectance samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault
from skindb.format.devices import DomeRecord

Array = NDArray[np.float64]
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


def intensity_faults(dome: DomeRecord, intensity: Array) -> list[Fault]:
    """Faults of lights whose intensities (light, 3) are far above or below those of the others."""
    rule = (
        f"the intensity of a light must be at most {MAX_INTENSITY_RATIO:,g} times as "
        "large or small as the median"
    )
    return [
        Fault(
            f"{dome.file}[lights][{j}][intensity]",
            rule,
            f"{ratio:.3g} times, of light {dome.lights[j].id}",
            cure,
        )
        for j, ratio in _beyond(_relative(intensity), MAX_INTENSITY_RATIO)
        for cure in [
            "correct it; remove a light that was not switched on, and its frames"
        ]
    ]


def sample_faults(dome: DomeRecord, view_median: Array, bright: Array) -> list[Fault]:
    """Faults of samples that are too large or small for skin, by their medians and
    bright fractions (light, camera).
    """
    median, (least, most) = _light_medians(view_median), MEDIAN_SAMPLES
    middle = (
        float(np.median(known))
        if len(known := median[~np.isnan(median)])
        else float("nan")
    )
    if not np.isnan(middle) and not least <= middle <= most:
        rule = f"the median reflectance sample of a face must be {least:g} to {most:g} sr^-1"
        found = (
            f"{middle:.3g}"
            if np.isfinite(middle)
            else "samples beyond 65504, the largest half float"
        )
        return [Fault(f"{dome.file}[lights]", rule, found, SAMPLE_CURE)]
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


def _bright_faults(dome: DomeRecord, bright: Array) -> list[Fault]:
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


def light_notes(dome: DomeRecord, intensity: Array, view_median: Array) -> list[str]:
    """Warnings about lights whose intensities or samples are unusual, but not impossible."""
    median = _light_medians(view_median)
    middle = (
        np.median(median[~np.isnan(median)]) if np.isfinite(median).any() else np.nan
    )
    return [
        f"light {dome.lights[j].id}: its {what} {ratio:.3g} times the median of all lights"
        for what, ratios, limit in (
            ("intensity is", _relative(intensity), NOTED_INTENSITY_RATIO),
            ("samples are", median[:, None] / middle, NOTED_SAMPLE_RATIO),
        )
        for j, ratio in _beyond(ratios, limit)
    ]


def view_median(samples: NDArray[np.float16]) -> float:
    """Median of the usable samples (3, n) of a view, whose NaN, beyond half precision,
    count as infinite.
    """
    if samples.shape[1] < MIN_MEDIAN_SAMPLES:
        return float("nan")
    return float(
        np.median(np.where(np.isnan(samples), np.inf, samples.astype(np.float64)))
    )


def bright_fraction(samples: NDArray[np.float16]) -> float:
    """Fraction of the usable samples (3, n) of a view that are too large for a surface;
    NaN: beyond half precision.
    """
    if samples.shape[1] < MIN_MEDIAN_SAMPLES:
        return 0.0
    return float((~(samples <= MAX_SAMPLE)).any(axis=0).mean())


def unlit_fault(where: str, radiance: NDArray[np.float32], count: int) -> Fault | None:
    """Fault of a view whose usable pixels (n, 3), at `count` surfels, are all zero or negative."""
    if count < MIN_MEDIAN_SAMPLES or (radiance > 0).any():
        return None
    rule = "a frame must be bright where its light reaches the face"
    cure = "copy the frame from the camera again"
    return Fault(where, rule, f"none at {count} surfels", cure)


def _relative(intensity: Array) -> Array:
    return np.asarray(intensity / np.median(intensity, axis=0))


def _light_medians(view_median: Array) -> Array:
    """Median over the cameras (light,) of medians (light, camera); NaN where there is none."""
    return np.array(
        [
            np.median(row[~np.isnan(row)]) if (~np.isnan(row)).any() else np.nan
            for row in view_median
        ]
    )


def _beyond(ratios: Array, limit: float) -> list[tuple[int, float]]:
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
