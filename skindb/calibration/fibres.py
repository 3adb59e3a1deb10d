"""Fibres of the contact probe: their signals, and the calibration of their centres and gains."""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import ndimage, optimize

from skindb.calibration.frame_checks import compared_exposures, disagreement
from skindb.calibration.radiance import Image, merge_exposures
from skindb.calibration.setup import of_devices
from skindb.errors import Fault, InputError, attempt, require, require_none
from skindb.format.contact_probe import ProbeRecord
from skindb.format.frames import Digests, read_frame, read_frames
from skindb.limits import MAX_FIBRE_PIXELS
from skindb.numerics.statistics import robust_deviation
from skindb.schema import dataset
from skindb.types import Float64, Index, Mask, float64, lengths

# fraction of a fibre's pixels that may be missing in a channel (stuck ones): for a
# fibre whose centre is 50 % above its mean brightness, the signal is then 0.5 % too
# low, which is the default error of a gain
MAX_LOST_FRACTION = 0.01
ROWS = 256  # of the frames that are merged at a time
GREEN = 1
MIN_SPOT_PIXELS = 9
# contrast of a spot over the robust standard deviation of the background
MIN_CONTRAST = 8.0
MARGIN = 2  # px around a spot over which its light is summed


def placement_signal(
    probe: ProbeRecord, site: str, placement: str = "", digests: Digests | None = None
) -> tuple[Float64, Float64]:
    """Signal per second (fibre, 3) and its standard error; NaN where pixels are
    saturated in every bracket.
    """
    fibres = list[Index]()
    strips = []
    faults = list[Fault]()

    def read_strip(exposure: str) -> None:
        frame = read_frame(probe.frame(site, exposure, placement), None, digests)
        fibres[:] = fibres or fibre_pixels(probe, frame.shape[:2])
        # only the fibres' pixels are kept and merged: a few percent of the picture
        strips.append(frame.reshape(-1, 3)[np.unique(np.concatenate(fibres))][None])

    for exposure in probe.exposures:
        attempt(faults, partial(read_strip, exposure))
    if faults:
        raise InputError(dict.fromkeys(faults))
    exposures = compared_exposures(probe.exposures, strips, probe.sensor)
    fault = disagreement(f"{probe.file}[exposures]", exposures, probe.sensor)
    if fault is not None:
        finding = f"{place_text(site, placement)}: bracket {fault.found}"
        raise InputError(replace(fault, found=finding))
    seconds = tuple(probe.exposures.values())
    radiance, error, _ = merge_exposures(strips, seconds, probe.sensor)
    union = np.unique(np.concatenate(fibres))
    means = [
        _fibre_means(radiance[0, columns], error[0, columns])
        for columns in (np.searchsorted(union, pixels) for pixels in fibres)
    ]
    value, deviation = map(np.array, zip(*means, strict=True))
    return value, deviation


def _fibre_means(radiance: Image, error: Image) -> tuple[Float64, Float64]:
    """Mean (3,) over the pixels (n, 3) of a fibre, and its standard error; NaN of a
    channel with too many saturated pixels.
    """
    usable = np.isfinite(radiance)
    count = np.maximum(usable.sum(axis=0), 1)
    value = radiance.sum(axis=0, dtype=float, where=usable) / count
    variance = np.square(error, dtype=float).sum(axis=0, where=usable)
    lost = 1 - usable.mean(axis=0) > MAX_LOST_FRACTION
    value[lost] = np.nan
    return value, np.where(lost, np.nan, np.sqrt(variance) / count)


def place_text(site: str, placement: str) -> str:
    """A placement of the probe in a message."""
    return f"site {site}" + (f", placement {placement}" if placement else "")


def fibre_pixels(probe: ProbeRecord, shape: tuple[int, ...]) -> list[Index]:
    """Indices into the flattened picture of each fibre's pixels, whose centres are
    within its radius.

    Raises
    ------
    InputError
        With every fibre without a pixel, or if the fibres cover more pixels than the
        memory is planned for.
    """
    fibres = []
    total = 0
    for centre, radius in zip(probe.centre, probe.radius, strict=True):
        left, top = (max(math.floor(c - radius), 0) for c in centre)
        right, bottom = (
            min(math.ceil(c + radius), side)
            for c, side in zip(centre, shape[::-1], strict=True)
        )
        total += max(right - left, 0) * max(bottom - top, 0)
        require(
            total <= MAX_FIBRE_PIXELS,
            f"{probe.file}[fibres]",
            f"the fibres must cover at most {MAX_FIBRE_PIXELS:,} pixels",
            f"{total:,} or more",
            "give centre and radius in pixels of the picture",
        )
        y = np.arange(top, bottom)[:, None] + 0.5
        x = np.arange(left, right) + 0.5
        row, column = np.nonzero(
            (x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius * radius
        )
        fibres.append((row + top) * shape[1] + column + left)
    rule = "a fibre must lie in the picture"
    finding = f"no pixel of {shape[1]} x {shape[0]}"
    cure = "correct its centre and radius, in pixels"
    outside = [i for i, pixels in enumerate(fibres) if not len(pixels)]
    place = f"{probe.file}[fibres]"
    require_none([Fault(f"{place}[{i}]", rule, finding, cure) for i in outside])
    return fibres


def calibrate_probe(flat: ProbeRecord) -> xr.Dataset:
    """Centre and gain of every fibre, from frames of an evenly lit surface that is
    moved between them.

    Signals are means within the radius of probe.json around the new centres. The gains
    of each channel keep the mean of those in probe.json, so that `scale` remains valid.

    Parameters
    ----------
    flat
        From `read_flat_frames`.

    Returns
    -------
    Dataset
        Group "probe_calibration".

    Raises
    ------
    InputError
        If a frame cannot be read, if another number of fibres is visible, if a fibre
        lies farther from its stated centre than its radius, or if it is dark or
        saturated in all brackets.
    """
    picture = np.mean([_green(flat, site) for site in flat.sites], axis=0)
    spots = find_fibres(picture, count=len(flat.fibres))
    offset, order = match_fibres(spots, Spots(flat.centre, flat.radius))
    moved = replace(flat, centre=flat.centre + offset)
    signals = [placement_signal(moved, site)[0] for site in flat.sites]
    gain, error = fibre_gain(np.stack(signals))
    level = flat.gain.mean(axis=0)
    return dataset(
        {
            "calibrated_fibre_centre": moved.centre,
            "fibre_spot_radius": spots.radius[order],
            "calibrated_fibre_gain": gain * level,
            "calibrated_fibre_gain_error": error * level,
        },
        coords={
            "fibre": list(flat.fibres),
            "axis": ["x", "y"],
            "channel": ["R", "G", "B"],
        },
    )


def _green(flat: ProbeRecord, site: str) -> Float64:
    """Merged green channel (h, w) of one repeat; the brightest value where it is
    saturated in all brackets.
    """
    frames = read_frames([flat.frame(site, exposure) for exposure in flat.exposures])
    seconds = tuple(flat.exposures.values())
    strips = []
    for top in range(0, frames[0].shape[0], ROWS):
        strip = [frame[top : top + ROWS] for frame in frames]
        strips.append(merge_exposures(strip, seconds, flat.sensor)[0][..., GREEN])
    green = float64(np.concatenate(strips))
    return np.nan_to_num(green, nan=float(np.nanmax(green, initial=0.0)))


def calibrated_probe(
    probe: ProbeRecord, calibration: xr.Dataset, *, where: str
) -> ProbeRecord:
    """The probe with the centres and gains of a calibration; the error of a gain is the
    root mean square of theirs.

    Raises
    ------
    InputError
        If the calibration lacks a fibre.
    """
    fibres = of_devices(calibration, "fibre", probe.fibres, where=where)
    gain = fibres["calibrated_fibre_gain"].values
    relative = fibres["calibrated_fibre_gain_error"].values / gain
    return replace(
        probe,
        centre=fibres["calibrated_fibre_centre"].values,
        gain=gain,
        gain_error=float(np.sqrt(np.mean(relative**2))),
    )


@dataclass(frozen=True)
class Spots:
    """Fibres in a picture: centre (fibre, 2), column and row, and radius (fibre,) in
    px; sorted by column, then row.
    """

    centre: Float64
    radius: Float64


def find_fibres(picture: ArrayLike, *, count: int) -> Spots:
    """Find the discs of the fibre faces in a picture of the probe on an evenly lit surface.

    Spots are connected pixels above half of the local brightness. The centre is the
    centroid of the light above the background, and the area is that light over the
    brightness at the centre of the spot, so that both have subpixel precision.

    Parameters
    ----------
    picture
        (height, width) finite linear signal, without saturation.
    count
        Number of fibres.

    Raises
    ------
    InputError
        Another number of spots is found.
    """
    grey = float64(picture)
    dark = float(np.median(grey))
    noise = float(robust_deviation(grey - dark))
    level = dark + max(MIN_CONTRAST * noise, 0.05 * (float(grey.max()) - dark))
    labels, _ = ndimage.label(grey > level)
    spots = [
        _measure(grey, labels == i + 1, box, dark)
        for i, box in enumerate(ndimage.find_objects(labels))
        if (labels[box] == i + 1).sum() >= MIN_SPOT_PIXELS
    ]
    require(
        len(spots) == count,
        "picture of the fibres",
        f"it must show {count} separate spots",
        f"{len(spots)}",
        "light all fibres evenly, keep them from touching in the picture, and cover stray light",
    )
    table = np.array(sorted(spots))
    return Spots(table[:, :2], table[:, 2])


def _measure(
    grey: Float64, spot: Mask, box: tuple[slice, slice], dark: float
) -> tuple[float, float, float]:
    """Column, row and radius of one spot, measured in its bounding box with a margin."""
    top, left = (max(side.start - MARGIN, 0) for side in box)
    window = np.s_[top : box[0].stop + MARGIN, left : box[1].stop + MARGIN]
    near = ndimage.binary_dilation(spot[window], iterations=MARGIN)
    light = np.where(near, 1.0, 0.0) * (grey[window] - dark)
    middle = float(np.percentile(light[spot[window]], 75))
    row, column = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    total = float(light.sum())
    return (
        left + float((column * light).sum()) / total,
        top + float((row * light).sum()) / total,
        float(np.sqrt(total / middle / np.pi)),
    )


def match_fibres(spots: Spots, stated: Spots) -> tuple[Float64, Index]:
    """Pair found with given fibres so that the sum of squared distances is smallest.

    Returns
    -------
    offset, order : ndarray
        Found minus given centres (fibre, 2) px, and index of the found spot (fibre,).

    Raises
    ------
    InputError
        A fibre is farther from its given position than its radius.
    """
    square = ((stated.centre[:, None] - spots.centre) ** 2).sum(axis=-1)
    _, order = optimize.linear_sum_assignment(square)
    offset = spots.centre[order] - stated.centre
    distance = lengths(offset)
    count = int((distance > stated.radius).sum())
    require(
        not count,
        "fibres",
        "every fibre must be found within its radius of the given centre",
        f"{count} farther away, up to {distance.max():.1f} px",
        "correct the centres",
    )
    return offset, np.asarray(order, int)


def fibre_gain(signal: ArrayLike) -> tuple[Float64, Float64]:
    """Flat field from repeated frames of an evenly lit surface that is moved between the frames.

    The logarithm of the signal is modelled as a level of the frame plus a level of the
    fibre; the scatter of the residuals of each fibre gives its error, which includes
    the unevenness of the surface.

    Parameters
    ----------
    signal
        (frame, fibre, 3) mean signal of each fibre, of several frames.

    Returns
    -------
    gain, error : ndarray
        (fibre, 3) relative to the mean fibre of each channel, and its standard error.

    Raises
    ------
    InputError
        Signals that are not positive and finite.
    """
    values = float64(signal)
    lost = ~(values > 0)  # also if NaN
    require(
        not lost.any(),
        "flat field of the fibres",
        "no fibre may be dark, or saturated in all brackets",
        f"{lost.any(axis=(0, 2)).sum()} of {values.shape[1]} fibres are",
        "use other brackets, and repeat the frames",
    )
    log = np.log(values)
    log -= log.mean(axis=1, keepdims=True)
    gain = np.exp(log.mean(axis=0))
    gain /= gain.mean(axis=0)
    return gain, gain * log.std(axis=0, ddof=1) / np.sqrt(len(log))
