"""Positions of the fibres of the contact probe in a picture, and their flat field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, optimize

from skindb.errors import Fault, InputError

Array = NDArray[np.float64]
MIN_SPOT_PIXELS = 9
# contrast of a spot over the robust standard deviation of the background
MIN_CONTRAST = 8.0
MARGIN = 2  # px around a spot over which its light is summed
MIN_FRAMES = 3  # frames of the flat field, for a meaningful estimate of the scatter


@dataclass(frozen=True)
class Spots:
    """Fibres in a picture: centre (fibre, 2), column and row, and radius (fibre,) in
    px; sorted by column, then row.
    """

    centre: Array
    radius: Array


@dataclass(frozen=True)
class SpotOffsets:
    """Found minus given centres (fibre, 2) px, ratio of the radii (fibre,), and index
    of the found spot (fibre,).
    """

    offset: Array
    radius_ratio: Array
    order: NDArray[np.int64]


@dataclass(frozen=True)
class FibreGain:
    """Flat field (fibre, 3), relative to the mean fibre of each channel, and its
    standard error (fibre, 3).
    """

    gain: Array
    error: Array


def find_fibres(picture: ArrayLike, *, count: int) -> Spots:
    """Find the discs of the fibre faces in a picture of the probe on an evenly lit surface.

    Spots are connected pixels above half of the local brightness. The centre is the
    centroid of the light above the background, and the area is that light over the
    brightness at the centre of the spot, so that both have subpixel precision.

    Parameters
    ----------
    picture
        (height, width) linear signal, without saturation.
    count
        Number of fibres.

    Raises
    ------
    InputError
        The picture is not finite, or another number of spots is found.
    """
    grey = np.asarray(picture, np.float64)
    if grey.ndim != 2 or not np.isfinite(grey).all():
        rule = "it must be finite and have the shape (height, width)"
        cure = "give one channel of the merged brackets"
        raise InputError(Fault("picture of the fibres", rule, str(grey.shape), cure))
    dark = float(np.median(grey))
    noise = 1.4826 * float(np.median(np.abs(grey - dark)))
    level = dark + max(MIN_CONTRAST * noise, 0.05 * (float(grey.max()) - dark))
    labels, _ = (
        ndimage.label(grey > level)
        if grey.max() > level
        else (np.zeros(grey.shape, int), 0)
    )
    spots = [
        _measure(grey, labels == i + 1, box, dark)
        for i, box in enumerate(ndimage.find_objects(labels))
        if (labels[box] == i + 1).sum() >= MIN_SPOT_PIXELS
    ]
    if len(spots) != count:
        cure = (
            "light all fibres evenly, keep them from touching in the picture, and "
            "cover stray light"
        )
        raise InputError(
            Fault(
                "picture of the fibres",
                f"it must show {count} separate spots",
                f"{len(spots)}",
                cure,
            )
        )
    found = np.array(sorted(spots))
    return Spots(found[:, :2], found[:, 2])


def _measure(
    grey: Array, spot: NDArray[np.bool_], box: tuple[slice, slice], dark: float
) -> tuple[float, float, float]:
    """Column, row and radius of one spot, measured in its bounding box with a margin."""
    top, left = (max(side.start - MARGIN, 0) for side in box)
    bottom = box[0].stop + MARGIN
    right = box[1].stop + MARGIN
    light = np.where(
        ndimage.binary_dilation(spot[top:bottom, left:right], iterations=MARGIN),
        1.0,
        0.0,
    )
    light *= grey[top:bottom, left:right] - dark
    middle = float(np.percentile(light[spot[top:bottom, left:right]], 75))
    row, column = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    total = float(light.sum())
    centre = (
        left + float((column * light).sum()) / total,
        top + float((row * light).sum()) / total,
    )
    return (*centre, float(np.sqrt(total / middle / np.pi)))


def match_fibres(found: Spots, given: Spots) -> SpotOffsets:
    """Pair found with given fibres so that the sum of squared distances is smallest.

    Raises
    ------
    InputError
        The numbers differ, or a fibre is farther from its given position than its radius.
    """
    if len(found.radius) != len(given.radius):
        rule = "as many fibres must be found as are given"
        cure = "compare probe.json with the picture"
        raise InputError(
            Fault("fibres", rule, f"{len(found.radius)} and {len(given.radius)}", cure)
        )
    square = ((given.centre[:, None] - found.centre) ** 2).sum(axis=-1)
    _, order = optimize.linear_sum_assignment(square)
    offset = found.centre[order] - given.centre
    far = np.flatnonzero(np.linalg.norm(offset, axis=1) > given.radius)
    if len(far):
        rule = "every fibre must be found within its radius of the given centre"
        cure = "correct the centres"
        worst = float(np.linalg.norm(offset, axis=1).max())
        raise InputError(
            Fault(
                "fibres", rule, f"{len(far)} farther away, up to {worst:.1f} px", cure
            )
        )
    return SpotOffsets(
        offset, found.radius[order] / given.radius, np.asarray(order, np.int64)
    )


def fibre_gain(signal: ArrayLike) -> FibreGain:
    """Flat field from repeated frames of an evenly lit surface that is moved between the frames.

    The logarithm of the signal is modelled as a level of the frame plus a level of the
    fibre; the scatter of the residuals of each fibre gives its error, which includes
    the unevenness of the surface.

    Parameters
    ----------
    signal
        (frame, fibre, 3) mean signal of each fibre.

    Raises
    ------
    InputError
        Too few frames, or signals that are not positive and finite.
    """
    values = np.asarray(signal, np.float64)
    shape = (
        values.ndim == 3
        and values.shape[-1:] == (3,)
        and values.shape[0] >= MIN_FRAMES
        and values.shape[1] > 1
    )
    if not shape or not np.isfinite(values).all() or not (values > 0).all():
        rule = (
            "its signals must be positive, of the shape (frame, fibre, 3), and of "
            f"{MIN_FRAMES} frames or more"
        )
        cure = (
            "use brackets in which no fibre is dark or saturated, and repeat the frames"
        )
        raise InputError(
            Fault("flat field of the fibres", rule, f"an array of {values.shape}", cure)
        )
    log = np.log(values)
    log -= log.mean(axis=1, keepdims=True)
    gain = np.exp(log.mean(axis=0))
    gain /= gain.mean(axis=0)
    return FibreGain(gain, gain * log.std(axis=0, ddof=1) / np.sqrt(len(log)))
