"""Mean dark frame and map of defect pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from skindb.errors import Fault, InputError

Array = NDArray[np.float64]
# robust standard deviations: of a million good pixels less than one is marked
MAX_DEVIATIONS = 6.0
NEIGHBOURHOOD = 5  # px; side of the median that a pixel is compared with


@dataclass(frozen=True)
class DarkFrame:
    """Mean, its standard error, and mask of defect pixels, each (height, width, 3), in
    values of the file.
    """

    mean: Array
    error: Array
    defect: NDArray[np.bool_]


def average_dark(frames: ArrayLike) -> DarkFrame:
    """Average dark frames of one exposure time, and mark pixels that are hot, stuck or
    unusually noisy.

    A pixel is a defect if its mean or its deviation in time differs from the median of
    its neighbourhood by more than MAX_DEVIATIONS robust standard deviations of such
    differences over the channel. A pixel that never changes while its neighbours do is
    a defect too.

    Parameters
    ----------
    frames
        (frame, height, width, 3) values of the file, at least two frames. The lens is covered.

    Raises
    ------
    InputError
        Fewer than two frames, another shape, or values that are not finite.
    """
    stack = np.asarray(frames)
    if (
        stack.ndim != 4
        or stack.shape[-1] != 3
        or len(stack) < 2
        or not np.isfinite(stack.astype(np.float64)).all()
    ):
        rule = (
            "at least two frames (frame, height, width, 3) of finite values are needed"
        )
        raise InputError(
            Fault(
                "dark frames",
                rule,
                f"an array of {stack.shape}",
                "repeat the frame with the lens covered",
            )
        )
    values = stack.astype(np.float64)
    mean = values.mean(axis=0)
    spread = values.std(axis=0, ddof=1)
    noisy = float(np.median(spread)) > 0
    defect = (
        _outliers(mean) | _outliers(spread) | ((spread == 0) & noisy & (len(stack) > 3))
    )
    return DarkFrame(mean, spread / np.sqrt(len(stack)), defect)


def _outliers(picture: Array) -> NDArray[np.bool_]:
    """Mask (h, w, 3) of the pixels that deviate from their neighbourhood."""
    apart = picture - ndimage.median_filter(
        picture, size=(NEIGHBOURHOOD, NEIGHBOURHOOD, 1), mode="nearest"
    )
    spread = 1.4826 * np.median(np.abs(apart), axis=(0, 1))
    # in a perfectly even picture every difference is an outlier
    return np.asarray((np.abs(apart) > MAX_DEVIATIONS * spread) & (apart != 0))
