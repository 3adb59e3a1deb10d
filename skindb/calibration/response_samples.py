"""Samples of an exposure stack that determine the response of its camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skindb.errors import Fault, InputError

Array = NDArray[np.float64]
STRATA = 40  # classes of brightness with equally many samples
# of the range of values: nearer to black, quantisation and the error of the black level
# exceed a few per cent
MIN_VALUE = 0.004
# of the range of values: noise must not reach the white level, where it is clipped
MAX_VALUE = 0.995


@dataclass(frozen=True)
class ResponseSamples:
    """Samples of one channel.

    `pixels` (sample, exposure, pixel) are values of blocks, 0 black and 1 white;
    `usable` (sample, exposure) says in which exposures a block counts; `seconds`
    (exposure,).
    """

    pixels: Array
    usable: NDArray[np.bool_]
    seconds: Array

    @property
    def value(self) -> Array:
        """Mean value (sample, exposure) of each block."""
        return np.asarray(self.pixels.mean(axis=-1))


def response_samples(
    stack: ArrayLike,
    seconds: ArrayLike,
    *,
    channel: int,
    levels: tuple[float, float],
    count: int,
    block: int,
) -> ResponseSamples:
    """Choose flat blocks of pixels that are spread over all brightnesses.

    Blocks are divided into classes of equal width of their mean value over all
    exposures, and the flattest of each class are taken. A block counts in an exposure
    if none of its pixels is at the white level, and if its mean lies between MIN_VALUE
    and MAX_VALUE; it is a sample if it counts in two.

    Parameters
    ----------
    stack
        (exposure, height, width, 3) values of the file.
    seconds
        (exposure,) s.
    channel
        0 red, 1 green, 2 blue.
    levels
        Black and white in values of the file.
    count
        Number of samples wanted.
    block
        Side of the blocks in px.

    Raises
    ------
    InputError
        Wrong shapes, non-finite values, levels that do not rise, or times that are all
        equal or not positive.
    """
    frames = np.asarray(stack)
    times = np.asarray(seconds, np.float64)
    _require_stack(frames, times, levels, block)
    values = (frames[..., channel].astype(np.float64) - levels[0]) / (
        levels[1] - levels[0]
    )
    height, width = (side // block * block for side in values.shape[1:])
    tiles = values[:, :height, :width].reshape(
        len(times), height // block, block, width // block, block
    )
    tiles = tiles.transpose(1, 3, 0, 2, 4).reshape(-1, len(times), block * block)
    mean = tiles.mean(axis=-1)
    top = tiles.max(axis=-1)
    spread = tiles.std(axis=-1)
    usable = (mean >= MIN_VALUE) & (mean <= MAX_VALUE) & (top < 1)
    enough = usable.sum(axis=1) >= 2
    tiles = tiles[enough]
    mean = mean[enough]
    usable = usable[enough]
    spread = spread[enough]
    rough = np.where(usable, spread / np.maximum(mean, MIN_VALUE), 0).max(
        axis=1, initial=0
    )
    bright = np.clip(mean, 0, 1).mean(axis=1)
    low, high = (bright.min(), bright.max()) if len(bright) else (0.0, 1.0)
    stratum = np.minimum(
        ((bright - low) / max(high - low, 1e-12) * STRATA).astype(int), STRATA - 1
    )
    order = np.lexsort((rough, stratum))
    first = np.searchsorted(stratum[order], np.arange(STRATA))
    rank = np.arange(len(order)) - first[stratum[order]]
    chosen = order[np.argsort(rank, kind="stable")[:count]]
    return ResponseSamples(tiles[chosen], usable[chosen], times)


def _require_stack(
    frames: NDArray[np.generic], times: Array, levels: tuple[float, float], block: int
) -> None:
    """Report every fault of the arguments at once."""
    where = "the exposure stack"
    faults = list[Fault]()
    if frames.ndim != 4 or frames.shape[-1] != 3 or times.shape != frames.shape[:1]:
        rule = "it must have the shape (exposure, height, width, 3) and one time for each exposure"
        faults.append(
            Fault(
                where,
                rule,
                f"{frames.shape} and {times.shape}",
                "stack the frames along a new first axis",
            )
        )
    elif min(frames.shape[1:3]) < block:
        faults.append(
            Fault(
                where,
                f"frames must be at least {block} px wide and high",
                str(frames.shape),
            )
        )
    elif not np.isfinite(frames.astype(np.float64)).all():
        faults.append(
            Fault(
                where,
                "its values must be finite",
                "NaN or infinity",
                "remove damaged frames",
            )
        )
    good = np.isfinite(times).all() and (times > 0).all()
    if not good or len(np.unique(times)) < 2:
        rule = "exposure times must be positive, and at least two of them different"
        faults.append(
            Fault(
                where,
                rule,
                np.array2string(times, threshold=8),
                "photograph the scene with several times",
            )
        )
    if not levels[0] < levels[1]:
        faults.append(
            Fault(
                where,
                "the white level must be above the black level",
                f"{levels[0]:g}, {levels[1]:g}",
            )
        )
    if faults:
        raise InputError(faults)
