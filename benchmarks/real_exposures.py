"""Responses of published exposure stacks and light directions from a published mirror
ball, for `benchmarks/real.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from skimage.io import imread

from skindb.calibration.mirror_ball import ball_outline, distant_light, highlight_centre
from skindb.calibration.response import (
    recover_response,
    response_samples,
)

Array = NDArray[np.float64]
# from exposures (exposure, height, width, 3) between 0 and 1 and their seconds to the
# relative exposure (value, channel) of VALUES
Recover = Callable[[Array, Array], Array]

VALUES = np.linspace(0.0, 1.0, 1025)
PUBLISHED_VALUES = np.arange(20, 251)
LIMITS = (0.05, 0.98)  # of the range of values that are compared
# fitted frames of memorial; those between them are held out
FITTED = ((2, 5), (2, 5, 8), (1, 4, 7, 10))
BORDER = (40, 64)  # px of memorial, rows and columns: its borders are coloured


def exposure_rows(folder: Path) -> list[list[str]]:
    """Differences from the published response of frobisher, and errors of the exposures
    of memorial that were not fitted.
    """
    counts = [f"memorial, {len(fitted)} fitted" for fitted in FITTED]
    rows = [["exposure stacks: error, R G B [%]", "frobisher, 3 fitted", *counts]]
    frobisher, published = _frobisher(folder / "frobisher")
    memorial, seconds = _memorial(folder / "memorial")
    methods: dict[str, Recover] = {
        "skindb": _skindb,
        "one exponent, fitted": _exponent,
        "sRGB": lambda *_: _srgb(),
    }
    for name, recover in methods.items():
        curve = recover(frobisher, np.array([0.125, 1.0, 8.0]))
        at = np.searchsorted(VALUES, PUBLISHED_VALUES / 255)
        ratio = np.log(curve[at] / published[PUBLISHED_VALUES])
        cells = [_three(ratio.std(axis=0))]
        for fitted in FITTED:
            chosen = np.array(fitted)
            between = np.setdiff1d(np.arange(chosen[0], chosen[-1]), chosen)
            curve = recover(memorial[chosen], seconds[chosen])
            cells.append(_three(_misfit(curve, memorial[between], seconds[between])))
        rows.append([name, *cells])
    return rows


def _frobisher(folder: Path) -> tuple[Array, Array]:
    """The frames, and the published exposure (256, 3) of each value."""
    name = "test_camera_response_function_Debevec1997_crfs.npy"
    frames = [imread(folder / f"IMG_{number}.jpg") for number in (2600, 2601, 2602)]
    return np.stack(frames) / 255, np.load(folder / "reference" / name)


def _memorial(folder: Path) -> tuple[Array, Array]:
    """The frames above the floor of the scanned film in each channel, and seconds."""
    rows, columns = (slice(side, -side) for side in BORDER)
    frames = np.stack(
        [imread(path)[rows, columns, :3] for path in sorted(folder.glob("*.png"))]
    )
    floor = np.median(frames[-3:], axis=(0, 1, 2))
    seconds = 2.0 ** np.arange(5, 5 - len(frames), -1)
    return np.clip((frames - floor) / (255 - floor), 0, 1), seconds


def _skindb(frames: Array, seconds: Array) -> Array:
    return recover_response(frames, seconds, black=0, white=1)[:, 1:]


def _srgb() -> Array:
    curve = np.where(
        VALUES <= 0.04045, VALUES / 12.92, ((VALUES + 0.055) / 1.055) ** 2.4
    )
    return np.repeat(curve[:, None], 3, axis=1)


def _exponent(frames: Array, seconds: Array) -> Array:
    """The power of the value that fits the exposure times best."""

    def misfit(power: float, channel: int) -> float:
        curve = np.repeat(VALUES[:, None] ** power, 3, axis=1)
        return float(_misfit(curve, frames, seconds)[channel])

    powers = [
        minimize_scalar(misfit, bounds=(0.5, 5), args=(c,), method="bounded").x
        for c in range(3)
    ]
    return np.asarray(VALUES[:, None] ** np.array(powers))


def _misfit(curve: Array, frames: Array, seconds: Array) -> Array:
    """RMS (channel,) of the logarithm of exposure over seconds of flat blocks, relative
    to the mean of each block over the frames.
    """
    result = []
    for channel in range(3):
        samples = response_samples(frames[..., channel], seconds)
        value = samples.value
        usable = samples.usable & (value > LIMITS[0]) & (value < LIMITS[1])
        several = usable.sum(axis=1) >= 2
        exposure = np.interp(value[several], VALUES, curve[:, channel])
        log = np.log(np.where(usable[several], exposure / seconds, np.nan))
        apart = log - np.nanmean(log, axis=1, keepdims=True)
        result.append(np.sqrt(np.nanmean(apart**2)))
    return np.array(result)


def _three(values: Sequence[float] | Array) -> str:
    return " ".join(f"{100 * value:.1f}" for value in values)


def ball_rows(folder: Path) -> list[list[str]]:
    """Angles between highlights on the chrome ball and the published directions."""
    mask = imread(folder / "chrome" / "chrome.mask.png")[..., 0] > 128
    outline = ball_outline(mask)
    published = np.loadtxt(folder / "light_directions_chrome.csv", delimiter=",")
    angles = []
    for number, expected in enumerate(published):
        picture = imread(folder / "chrome" / f"chrome.{number}.png")[..., :3]
        direction = distant_light(outline, highlight_centre(picture, outline))
        cosine = direction @ expected / np.linalg.norm(expected)
        angles.append(np.degrees(np.arccos(min(cosine, 1.0))))
    return [
        ["directions from a chrome ball, 12 lights", "median [deg]", "largest"],
        ["skindb", f"{np.median(angles):.2f}", f"{max(angles):.2f}"],
    ]
