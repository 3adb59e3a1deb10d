"""Sanity checks of frames: exchanged exposures, dark frames that are not dark, wrong
levels, blank pictures.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from skindb.calibration.radiance import (
    FrameMerger,
    read_sigma,
    read_view,
    relative_exposure,
)
from skindb.errors import Fault, require_none
from skindb.format.dome import DomeRecord
from skindb.format.fields import MAX_MAGNITUDE
from skindb.format.frames import Digests, Frame, read_frame
from skindb.format.sensor import SensorRecord
from skindb.types import Float32, Float64, Mask

# of a frame, evenly spread: takes 1 % of the time to decode 10 megapixels
MAX_COMPARED_PIXELS = 40_000
# standard deviations of read noise above black, and relative exposure: the effect of
# dark frames is small above both
MIN_SIGNAL_DEVIATIONS = 20.0
MIN_SIGNAL = 0.005
MAX_SIGNAL = 0.7  # relative exposure that is clearly below the white level
MIN_RATIO_VALUES = 50  # values that are needed for a ratio
# largest ratio between the radiance of two exposures
MAX_RADIANCE_RATIO = 1.4
# of the compared values of two exposures, those that differ by more than this ratio and
# noise: 0.01 if the head moved by 0.3 mm between them, 0.14 and more if one was
# mirrored, 0.7 if it was taken under another light
MAX_APART_FRACTION = 0.1
# of the white level: larger than the dark current of warm cameras in seconds; beyond
# it, black_level is wrong
MAX_DARK_OFFSET = 0.05
NOTED_DARK_OFFSET = 0.01
# standard deviations of read noise and relative exposure below black, and fraction of
# pixels; noise reaches one in 1e9
MAX_BELOW_DEVIATIONS = 6.0
MAX_BELOW = 0.005
MAX_BELOW_FRACTION = 0.05
# values at the highest one, of those in the upper tenth below it, in a picture that is
# cut off there; noise has one
MIN_CLIPPED_FRACTION = 0.3
MIN_CLIPPED_VALUES = 50
MIN_CLIPPED_VIEWS = 2
# highest value over white_level, both above black; cameras are linear up to at least
# 0.8
MAX_ABOVE_WHITE = 1.25
MIN_USED_RANGE = 0.02  # of the range of values, by the brightest photograph of a camera
# of the pixels of linear radiance; of noise around zero, half are positive
MIN_POSITIVE_FRACTION = 0.01


def view_faults(
    dome: DomeRecord,
    light: str,
    merger: FrameMerger,
    frames: Sequence[Frame],
    *,
    white: bool = False,
) -> list[Fault]:
    """Fault of the exposures of one light and camera, in a list of at most one.

    Parameters
    ----------
    dome, light, merger
        The light and the camera that the frames belong to.
    frames
        One decoded array (h, w, 3) per exposure of the dome.
    white
        Whether the frames show the white target.
    """
    place = f"{dome.file}[white][frames]" if white else f"{dome.file}[frames]"
    sensor = merger.camera.sensor
    view = f"camera {merger.camera.id}, light {light}: "
    if sensor.kind.bits == 0:
        fault = _linear_fault(place, frames[0])
    else:
        seconds = dict(zip(dome.exposures, merger.seconds, strict=True))
        thinned = [_thinned(frame) for frame in frames]
        dark = None if merger.dark is None else [_thinned(x) for x in merger.dark]
        exposures = compared_exposures(seconds, thinned, sensor, dark=dark)
        fault = _below_fault(place, exposures, sensor, dark=dark is not None)
        if min(exposure.frame.min() for exposure in exposures) >= sensor.white:
            fault = Fault(
                place,
                "a photograph must not be saturated everywhere",
                "no value below white_level",
                "take it with a shorter exposure",
            )
        if fault is None:
            view += "exposure "
            fault = disagreement(place, exposures, sensor)
    return [] if fault is None else [replace(fault, found=view + fault.found)]


def checked_white_view(
    dome: DomeRecord,
    light: str,
    merger: FrameMerger,
    *,
    digests: Digests | None = None,
) -> list[Frame]:
    """Decode the exposures of the white target under one light.

    Raises
    ------
    InputError
        With every frame that cannot be decoded, or the fault of the view.
    """
    frames = read_view(dome, light, merger.camera, white=True, digests=digests)
    require_none(view_faults(dome, light, merger, frames, white=True))
    return frames


class ComparedExposure(NamedTuple):
    """One exposure of a view, or some of its pixels."""

    name: str
    seconds: float
    frame: Frame
    signal: Float32  # relative exposure
    slope: Float32  # its change per value of the file


def compared_exposures(
    seconds: Mapping[str, float],
    frames: Sequence[Frame],
    sensor: SensorRecord,
    *,
    dark: Sequence[Frame] | None = None,
) -> list[ComparedExposure]:
    """The exposures of a view; `frames`, and dark ones, are in the order of `seconds`."""
    darks: Sequence[Frame | None] = dark or [None] * len(frames)
    return [
        ComparedExposure(
            name, seconds[name], frame, *relative_exposure(frame, black, sensor)
        )
        for name, frame, black in zip(seconds, frames, darks, strict=True)
    ]


def disagreement(
    place: str, exposures: Sequence[ComparedExposure], sensor: SensorRecord
) -> Fault | None:
    """Fault of two neighbouring exposures of a view with different radiance."""
    ordered = sorted(exposures, key=lambda exposure: exposure.seconds)
    for short, long in pairwise(ordered):
        ratio, apart = _radiance_ratio(sensor, short, long)
        similar = 1 / MAX_RADIANCE_RATIO < ratio < MAX_RADIANCE_RATIO
        if np.isnan(ratio) or (similar and apart <= MAX_APART_FRACTION):
            continue
        finding = (
            f"{short.name} ({short.seconds:.3g} s) has {ratio:.3g} times the radiance "
            f"of {long.name} ({long.seconds:.3g} s)"
        )
        if similar:
            finding = (
                f"{short.name} and {long.name} differ in {apart:.0%} of the values that "
                "both must contain"
            )
        return Fault(
            place,
            "exposures of one view must have the same radiance: check seconds, "
            "black_level and response",
            finding,
            "assign the correct seconds and frames to each exposure",
        )
    return None


def _radiance_ratio(
    sensor: SensorRecord, short: ComparedExposure, long: ComparedExposure
) -> tuple[float, float]:
    """Median ratio of the radiance of a short exposure to that of a long one, and the
    fraction of values that differ.

    Compared are values that, according to one of them, both must record well, so that a
    black or white frame also contradicts the other one. NaN for too few values.
    """
    low = short.signal
    high = long.signal
    times = long.seconds / short.seconds
    # for a linear response
    slope = np.asarray([1 / (sensor.white - sensor.black)], np.float32)
    read = float(read_sigma(slope, sensor)[0])
    minimum = max(MIN_SIGNAL, MIN_SIGNAL_DEVIATIONS * read)
    # the short one is noisier: near the limit it would select pixels that noise has raised
    by_short = (low > 2 * minimum) & (low * times < MAX_SIGNAL)
    by_long = (high < MAX_SIGNAL) & (high / times > minimum)
    good = (by_short & (short.frame < sensor.white)) | (
        by_long & (long.frame < sensor.white)
    )
    if good.sum() < MIN_RATIO_VALUES:
        return float("nan"), float("nan")
    by_short_values = np.maximum(low[good], 0)
    by_long_values = np.maximum(high[good] / np.float32(times), 0)
    larger = np.maximum(by_short_values, by_long_values)
    noise = MAX_BELOW_DEVIATIONS * np.sqrt(read**2 + larger / sensor.full_electrons)
    limit = (MAX_RADIANCE_RATIO - 1) * larger + (noise + MIN_SIGNAL)
    apart = np.abs(by_short_values - by_long_values) > limit
    ratio = np.median(by_short_values / np.maximum(by_long_values, 1e-9))
    return float(ratio), float(apart.mean())


def _below_fault(
    place: str,
    exposures: Sequence[ComparedExposure],
    sensor: SensorRecord,
    *,
    dark: bool,
) -> Fault | None:
    """Fault of a picture that is darker than black: the black level or the dark frames
    are too high.
    """
    for exposure in exposures:
        sigma = read_sigma(exposure.slope, sensor)
        limit = -MAX_BELOW - MAX_BELOW_DEVIATIONS * sigma
        below = float((exposure.signal < limit).mean())
        if below > MAX_BELOW_FRACTION:
            reference = "black_level"
            cure = "correct black_level"
            if dark:
                reference = "the dark frame"
                cure = "take the dark frames again, with the exposures of the face"
            return Fault(
                place,
                f"at most {MAX_BELOW_FRACTION:.0%} of a frame may be darker than "
                f"{reference}, beyond noise",
                f"{below:.0%} of exposure {exposure.name}",
                cure,
            )
    return None


def _linear_fault(place: str, frame: Frame) -> Fault | None:
    """Fault of merged radiance that is negative or constant; zero is allowed, for
    lights behind the face.
    """
    values = frame
    # half floats cannot exceed the limit, and some pixels show the rest
    if frame.dtype == np.float16:
        values = _thinned(frame).astype(np.float32)
    finite = values[np.isfinite(values)]
    low = finite.min(initial=np.inf)
    high = finite.max(initial=-np.inf)
    positive = np.count_nonzero(finite > 0) / max(values.size, 1)
    rule = "an OpenEXR frame must hold the radiance of a photograph"
    if not low <= high:
        finding = "no finite value"
    elif max(-low, high) > MAX_MAGNITUDE:
        rule = f"radiance must be at most {MAX_MAGNITUDE:g}"
        finding = f"{low:.3g} to {high:.3g}"
    elif low == high != 0:
        finding = f"{low:.3g} everywhere"
    elif low < 0 and positive < MIN_POSITIVE_FRACTION:
        finding = f"values from {low:.3g} to {high:.3g}, nearly all negative"
    else:
        return None
    return Fault(place, rule, finding, "merge the exposures of this view again")


def highest_value(merger: FrameMerger, frames: Sequence[Frame]) -> tuple[float, bool]:
    """Highest value of the longest exposure of a view, and whether the picture is cut off
    there; NaN for linear radiance.
    """
    if merger.camera.sensor.kind.bits == 0:
        return float("nan"), False
    values = _thinned(frames[int(np.argmax(merger.seconds))])
    highest = float(values.max())
    near = values > highest - 0.1 * (highest - merger.camera.sensor.black)
    minimum = max(MIN_CLIPPED_VALUES, MIN_CLIPPED_FRACTION * int(near.sum()))
    return highest, int((values == highest).sum()) >= minimum


def level_notes(dome: DomeRecord, highest: Float64, clipped: Mask) -> list[str]:
    """Warnings about white levels that the photographs contradict.

    Parameters
    ----------
    dome
        The cameras.
    highest, clipped
        (light, camera) results of `highest_value`; NaN for views of an earlier run.
    """
    notes = []
    for c, camera in enumerate(dome.cameras):
        sensor = camera.sensor
        values = highest[np.isfinite(highest[:, c]), c]
        if not len(values):
            continue
        top = float(values.max())
        fraction = (top - sensor.black) / (sensor.white - sensor.black)
        note = f"camera {camera.id}: its photographs have values up to {top:g}"
        if fraction > MAX_ABOVE_WHITE:
            note += (
                f", above white_level {sensor.white:g}, from which pixels "
                "count as saturated; correct it"
            )
        elif fraction < MIN_USED_RANGE:
            note += (
                f", {fraction:.1%} of the range to white_level {sensor.white:g}; "
                "correct it, or expose longer"
            )
        elif (
            top < sensor.white
            and (clipped[:, c] & (highest[:, c] == top)).sum() >= MIN_CLIPPED_VIEWS
        ):
            note += (
                " and are cut off there; set white_level to it, so that "
                "these pixels count as saturated"
            )
        else:
            continue
        notes.append(note)
    return notes


def dark_faults(dome: DomeRecord, merger: FrameMerger) -> list[Fault]:
    """Faults of dark frames that are bright, all zero, or far from the black level of
    their camera.
    """
    faults = []
    black = merger.camera.sensor.black
    for name, frame, offset in _dark_offsets(dome, merger):
        exposure = (
            f"exposure {name} of camera {merger.camera.id}, black_level {black:g}"
        )
        if black > 0 and not frame.any():
            rule = "dark frames must hold the values of black"
            finding = f"0 everywhere, {exposure}"
            cure = "take them again, with the lens covered"
        elif abs(offset) > MAX_DARK_OFFSET:
            rule = (
                "dark frames and black_level must differ by at most "
                f"{MAX_DARK_OFFSET:.0%} of the range"
            )
            finding = f"{offset:+.1%}, {exposure}"
            cure = (
                "set black_level to the camera's value without light, and cover the "
                "lens for dark frames"
            )
        else:
            continue
        faults.append(Fault(f"{dome.file}[dark]", rule, finding, cure))
    return faults


def dark_notes(dome: DomeRecord, merger: FrameMerger) -> list[str]:
    """Warnings about dark frames that differ noticeably from the black level."""
    offsets = [offset for _, _, offset in _dark_offsets(dome, merger)]
    worst = max(offsets, key=abs, default=0.0)
    if abs(worst) <= NOTED_DARK_OFFSET:
        return []
    return [
        f"dark frames of camera {merger.camera.id} differ from its black_level by "
        f"{worst:+.1%} of the range"
    ]


def repeated_frame_faults(
    folder: Path, digests: Digests, *, besides: Collection[Path] = ()
) -> list[Fault]:
    """Faults of frames with the same content, which noise makes impossible; frames of
    one value are allowed.

    Parameters
    ----------
    folder
        Folder of the capture.
    digests
        Of all frames that were read.
    besides
        Frames that may be copies of each other, such as dark frames.
    """
    alike = dict[str, list[Path]]()
    for path in sorted(digests.keys() - set(besides)):
        alike.setdefault(digests[path], []).append(path)
    return [
        Fault(
            str(folder),
            "every frame must have been taken by itself",
            f"{paths[0].relative_to(folder)} is a copy of {paths[1].relative_to(folder)}",
            "copy the right frames from the camera again",
        )
        for paths in alike.values()
        if len(paths) > 1 and np.ptp(read_frame(paths[0])) > 0
    ]


def _dark_offsets(
    dome: DomeRecord, merger: FrameMerger
) -> Iterator[tuple[str, Frame, float]]:
    """Each dark frame, and its median above the black level, relative to the range of values."""
    sensor = merger.camera.sensor
    darks = () if merger.dark is None else merger.dark
    for name, frame in zip(dome.exposures, darks, strict=False):
        above = float(np.median(_thinned(frame)) - sensor.black)
        yield name, frame, above / (sensor.white - sensor.black)


def _thinned(frame: Frame) -> Frame:
    """At most `MAX_COMPARED_PIXELS` pixels of a frame, evenly spread."""
    step = int(np.ceil(np.sqrt(frame.shape[0] * frame.shape[1] / MAX_COMPARED_PIXELS)))
    return np.ascontiguousarray(frame[::step, ::step])
