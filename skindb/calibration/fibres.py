"""Fibres of the contact probe: their signals, and the calibration of their centres and gains."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, optimize

from skindb.calibration.frame_checks import disagreement
from skindb.calibration.radiance import merge_exposures
from skindb.errors import Fault, InputError
from skindb.format.contact_probe import ProbeRecord
from skindb.format.frames import Digests, Frame, read_frame, read_frames
from skindb.limits import MAX_FIBRE_PIXELS
from skindb.schema import dataset

Array = NDArray[np.float64]

Index = NDArray[np.int64]
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
MIN_FRAMES = 3  # frames of the flat field, for a meaningful estimate of the scatter


def placement_signal(
    probe: ProbeRecord, site: str, placement: str = "", digests: Digests | None = None
) -> tuple[Array, Array]:
    """Signal per second (fibre, 3) and its standard error; NaN where pixels are
    saturated in every bracket.
    """
    fibres = list[Index]()
    strips = list[Frame]()
    faults = dict[Fault, None]()
    for exposure in probe.exposures:
        try:
            frame = read_frame(probe.frame(site, exposure, placement), None, digests)
            fibres = fibres or fibre_pixels(probe, frame.shape[:2])
        except InputError as problem:
            faults |= dict.fromkeys(problem.faults)
            continue
        # only the fibres' pixels are kept and merged: a few percent of the picture
        strips.append(frame.reshape(-1, 3)[np.unique(np.concatenate(fibres))][None])
    if faults:
        raise InputError(faults)
    fault = disagreement(
        f"{probe.file}[exposures]", probe.exposures, strips, probe.sensor
    )
    if fault is not None:
        at = f"site {site}, placement {placement}" if placement else f"site {site}"
        raise InputError(replace(fault, found=f"{at}: bracket {fault.found}"))
    radiance, error, _ = merge_exposures(
        strips, tuple(probe.exposures.values()), probe.sensor
    )
    value = np.full((len(fibres), 3), np.nan)
    spread = np.full((len(fibres), 3), np.nan)
    union = np.unique(np.concatenate(fibres))
    for i, pixels in enumerate(fibres):
        own = np.searchsorted(union, pixels)
        signal = radiance[0, own].astype(np.float64)
        noise = error[0, own].astype(np.float64)
        for c in range(3):
            usable = np.isfinite(signal[:, c])
            if 1 - usable.mean() <= MAX_LOST_FRACTION:
                value[i, c] = signal[usable, c].mean()
                spread[i, c] = np.sqrt((noise[usable, c] ** 2).sum()) / usable.sum()
    return value, spread


def fibre_pixels(probe: ProbeRecord, shape: tuple[int, ...]) -> list[Index]:
    """Indices into the flattened picture of each fibre's pixels, whose centres are
    within its radius.

    Raises
    ------
    InputError
        With every fibre without a pixel, or if the fibres cover more pixels than the
        memory is planned for.
    """
    fibres = list[Index]()
    total = 0
    for centre, radius in zip(probe.centre, probe.radius, strict=True):
        (left, right), (top, bottom) = (
            (
                min(max(math.floor(c - radius), 0), side),
                min(math.ceil(c + radius), side),
            )
            for c, side in zip(centre, shape[::-1], strict=True)
        )
        total += max(right - left, 0) * max(bottom - top, 0)
        if total > MAX_FIBRE_PIXELS:
            rule = f"the fibres must cover at most {MAX_FIBRE_PIXELS:,} pixels"
            cure = "give centre and radius in pixels of the picture"
            raise InputError(
                Fault(f"{probe.file}[fibres]", rule, f"{total:,} or more", cure)
            )
        y = np.arange(top, bottom)[:, None] + 0.5
        x = np.arange(left, right) + 0.5
        row, column = np.nonzero(
            (x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius * radius
        )
        fibres.append((row + top) * shape[1] + column + left)
    faults = [
        Fault(
            f"{probe.file}[fibres][{i}]",
            "a fibre must lie in the picture",
            f"no pixel of {shape[1]} x {shape[0]}",
            "correct its centre and radius, in pixels",
        )
        for i, pixels in enumerate(fibres)
        if not len(pixels)
    ]
    if faults:
        raise InputError(faults)
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
    given = Spots(flat.centre, flat.radius)
    spots = find_fibres(picture, count=len(flat.fibres))
    offsets = match_fibres(spots, given)
    moved = replace(flat, centre=flat.centre + offsets.offset)
    found = fibre_gain(
        np.stack([placement_signal(moved, site)[0] for site in flat.sites])
    )
    level = flat.gain.mean(axis=0)
    return dataset(
        {
            "calibrated_fibre_centre": moved.centre,
            "fibre_spot_radius": spots.radius[offsets.order],
            "calibrated_fibre_gain": found.gain * level,
            "calibrated_fibre_gain_error": found.error * level,
        },
        coords={
            "fibre": list(flat.fibres),
            "axis": ["x", "y"],
            "channel": ["R", "G", "B"],
        },
    )


def _green(flat: ProbeRecord, site: str) -> NDArray[np.float64]:
    """Merged green channel (h, w) of one repeat; the brightest value where it is
    saturated in all brackets.
    """
    frames = read_frames(
        [flat.frame(site, exposure) for exposure in flat.exposures], None
    )
    seconds = tuple(flat.exposures.values())
    parts = [
        merge_exposures(
            [frame[top : top + ROWS] for frame in frames], seconds, flat.sensor
        )[0][..., GREEN]
        for top in range(0, frames[0].shape[0], ROWS)
    ]
    green = np.concatenate(parts).astype(np.float64)
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
    known = calibration.load()
    names = set(map(str, known["fibre"].values))
    if missing := [fibre for fibre in probe.fibres if fibre not in names]:
        found = f"none of {', '.join(missing[:5])}"
        raise InputError(
            Fault(
                where,
                "a calibration must have every fibre of the capture",
                found,
                "calibrate again",
            )
        )
    own = known.sel(fibre=list(probe.fibres))
    gain = own["calibrated_fibre_gain"].values
    error = float(
        np.sqrt(np.mean((own["calibrated_fibre_gain_error"].values / gain) ** 2))
    )
    return replace(
        probe, centre=own["calibrated_fibre_centre"].values, gain=gain, gain_error=error
    )


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
