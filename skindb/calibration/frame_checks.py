"""Sanity checks of frames: exchanged exposures, dark frames that are not dark or not of
their camera, wrong levels, blank pictures.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.radiance import FrameMerger, read_sigma, relative_exposure
from skindb.errors import Fault
from skindb.format.dome import DomeRecord
from skindb.format.frames import Digests, Frame, read_frame
from skindb.format.json_file import MAX_MAGNITUDE
from skindb.format.sensor import SensorRecord

Array = NDArray[np.float32]

Values = NDArray[np.float64]
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
# of a camera that are averaged; more reduce noise that is already below the pattern
MAX_PHOTOGRAPHS = 12
MAX_PIXELS = 250_000  # in whole rows, evenly spread over the picture
MIN_PIXELS = 1_000
# of the pixels, by their mean value: the noise of light hides the pattern in the others
DARK_QUANTILE = 0.25
# robust standard deviations, beyond which hot pixels and edges are clipped
MAX_DEVIATIONS = 3.0
# standard deviations of the correlations with shifted frames, which are unrelated
MIN_CORRELATION = 6.0
SHIFTS = 16
# to the correlation as given; a pattern of columns is the same upside down
MIN_CORRELATION_RATIO = 2.0


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
    where = f"{dome.file}[white][frames]" if white else f"{dome.file}[frames]"
    sensor = merger.camera.sensor
    names = [*dome.exposures]
    step = _step(frames[0])
    some = [frame[::step, ::step] for frame in frames]
    said = f"camera {merger.camera.id}, light {light}: "
    if sensor.kind.bits == 0:
        fault = _linear_fault(where, frames[0])
    else:
        dark = (
            None
            if merger.dark is None
            else [frame[::step, ::step] for frame in merger.dark]
        )
        fault = _saturated_fault(where, some, sensor) or _below_fault(
            where, names, some, dark, sensor
        )
        said += "" if fault else "exposure "
        seconds = dict(zip(names, merger.seconds, strict=True))
        fault = fault or disagreement(where, seconds, some, sensor, dark=dark)
    return (
        []
        if fault is None
        else [Fault(fault.where, fault.rule, said + fault.found, fault.cure)]
    )


def disagreement(
    where: str,
    seconds: Mapping[str, float],
    frames: Sequence[Frame],
    sensor: SensorRecord,
    *,
    dark: Sequence[Frame] | None = None,
) -> Fault | None:
    """Fault of two neighbouring exposures with different radiance; `frames` are in the
    order of `seconds`.
    """
    signals = [
        relative_exposure(f, None if dark is None else dark[i], sensor)[0]
        for i, f in enumerate(frames)
    ]
    by_time = sorted(
        zip(seconds.items(), signals, frames, strict=True), key=lambda one: one[0][1]
    )
    for ((short, a), low, dim), ((long, b), high, bright) in pairwise(by_time):
        ratio, apart = _radiance_ratio(sensor, (dim, low, a), (bright, high, b))
        if np.isnan(ratio) or (
            1 / MAX_RADIANCE_RATIO < ratio < MAX_RADIANCE_RATIO
            and apart <= MAX_APART_FRACTION
        ):
            continue
        rule = (
            "exposures of one view must have the same radiance: check seconds, "
            "black_level and response"
        )
        found = f"{short} ({a:.3g} s) has {ratio:.3g} times the radiance of {long} ({b:.3g} s)"
        if 1 / MAX_RADIANCE_RATIO < ratio < MAX_RADIANCE_RATIO:
            found = f"{short} and {long} differ in {apart:.0%} of the values that both must contain"
        return Fault(
            where, rule, found, "assign the correct seconds and frames to each exposure"
        )
    return None


def _radiance_ratio(
    sensor: SensorRecord,
    short: tuple[Frame, Array, float],
    long: tuple[Frame, Array, float],
) -> tuple[float, float]:
    """Median ratio of the radiance of a short exposure to that of a long one, and the
    fraction of values that differ.

    Compared are values that, according to one of them, both must record well, so that a
    black or white frame also contradicts the other one. NaN for too few values.
    """
    (dim, low, a), (bright, high, b) = short, long
    # for a linear response
    slope = np.asarray([1 / (sensor.white - sensor.black)], np.float32)
    read = float(read_sigma(slope, sensor)[0])
    least = max(MIN_SIGNAL, MIN_SIGNAL_DEVIATIONS * read)
    # the short one is noisier: near the limit it would select pixels that noise has raised
    by_short = (dim < sensor.white) & (low > 2 * least) & (low * (b / a) < MAX_SIGNAL)
    by_long = (bright < sensor.white) & (high < MAX_SIGNAL) & (high * (a / b) > least)
    good = by_short | by_long
    if good.sum() < MIN_RATIO_VALUES:
        return float("nan"), float("nan")
    one = np.maximum(low[good], 0)
    other = np.maximum(high[good] * np.float32(a / b), 0)
    larger = np.maximum(one, other)
    noise = (
        MAX_BELOW_DEVIATIONS * np.sqrt(read**2 + larger / sensor.full_electrons)
        + MIN_SIGNAL
    )
    apart = np.abs(one - other) > (MAX_RADIANCE_RATIO - 1) * larger + noise
    return float(np.median(one / np.maximum(other, 1e-9))), float(apart.mean())


def _saturated_fault(
    where: str, frames: Sequence[Frame], sensor: SensorRecord
) -> Fault | None:
    """Fault of a picture that is at the white level everywhere, in every exposure."""
    if all((frame >= sensor.white).all() for frame in frames):
        rule = "a photograph must not be saturated everywhere"
        cure = "take it with a shorter exposure"
        return Fault(where, rule, "no value below white_level", cure)
    return None


def _below_fault(
    where: str,
    names: Sequence[str],
    frames: Sequence[Frame],
    dark: Sequence[Frame] | None,
    sensor: SensorRecord,
) -> Fault | None:
    """Fault of a picture that is darker than black: the black level or the dark frames
    are too high.
    """
    for i, frame in enumerate(frames):
        signal, slope = relative_exposure(
            frame, None if dark is None else dark[i], sensor
        )
        below = float(
            (
                signal < -MAX_BELOW - MAX_BELOW_DEVIATIONS * read_sigma(slope, sensor)
            ).mean()
        )
        if below > MAX_BELOW_FRACTION:
            key = "black_level" if dark is None else "the dark frame"
            rule = (
                f"at most {MAX_BELOW_FRACTION:.0%} of a frame may be darker than "
                f"{key}, beyond noise"
            )
            cure = (
                "correct black_level"
                if dark is None
                else "take the dark frames again, with the exposures of the face"
            )
            return Fault(where, rule, f"{below:.0%} of exposure {names[i]}", cure)
    return None


def _linear_fault(where: str, frame: Frame) -> Fault | None:
    """Fault of merged radiance that is negative or constant; zero is allowed, for
    lights behind the face.
    """
    finite = np.isfinite(frame)
    low = float(np.min(frame, where=finite, initial=np.inf))
    high = float(np.max(frame, where=finite, initial=-np.inf))
    rule = "an OpenEXR frame must hold the radiance of a photograph"
    cure = "merge the exposures of this view again"
    if not low <= high:
        return Fault(where, rule, "no finite value", cure)
    if max(-low, high) > MAX_MAGNITUDE:
        return Fault(
            where,
            f"radiance must be at most {MAX_MAGNITUDE:g}",
            f"{low:.3g} to {high:.3g}",
            cure,
        )
    if low == high != 0:
        return Fault(where, rule, f"{low:.3g} everywhere", cure)
    if low < 0 and float((frame > 0).mean()) < MIN_POSITIVE_FRACTION:
        return Fault(
            where,
            rule,
            f"values from {low:.3g} to {high:.3g}, nearly all negative",
            cure,
        )
    return None


def highest_value(merger: FrameMerger, frames: Sequence[Frame]) -> tuple[float, bool]:
    """Highest value of the longest exposure of a view, and whether the picture is cut off there."""
    frame = frames[int(np.argmax(merger.seconds))]
    values = frame[:: _step(frame), :: _step(frame)]
    highest = float(values.max())
    near = values > highest - 0.1 * (highest - merger.camera.sensor.black)
    count = int((values == highest).sum())
    return highest, count >= max(
        MIN_CLIPPED_VALUES, MIN_CLIPPED_FRACTION * int(near.sum())
    )


def level_notes(
    dome: DomeRecord, highest: Values, clipped: NDArray[np.bool_]
) -> list[str]:
    """Warnings about white levels that the photographs contradict.

    Parameters
    ----------
    dome
        The cameras.
    highest, clipped
        (light, camera) results of `highest_value`; NaN for views of an earlier run.
    """
    notes = list[str]()
    for c, camera in enumerate(dome.cameras):
        sensor = camera.sensor
        known = highest[np.isfinite(highest[:, c]), c]
        if sensor.kind.bits == 0 or not len(known):
            continue
        top = float(known.max())
        used = (top - sensor.black) / (sensor.white - sensor.black)
        said = f"camera {camera.id}: its photographs have values up to {top:g}"
        if used > MAX_ABOVE_WHITE:
            notes.append(
                f"{said}, above white_level {sensor.white:g}, from which pixels "
                "count as saturated; correct it"
            )
        elif used < MIN_USED_RANGE:
            notes.append(
                f"{said}, {used:.1%} of the range to white_level {sensor.white:g}; "
                "correct it, or expose longer"
            )
        elif (
            top < sensor.white
            and (clipped[:, c] & (highest[:, c] == top)).sum() >= MIN_CLIPPED_VIEWS
        ):
            notes.append(
                f"{said} and are cut off there; set white_level to it, so that "
                "these pixels count as saturated"
            )
    return notes


def dark_faults(dome: DomeRecord, merger: FrameMerger) -> list[Fault]:
    """Faults of dark frames that are bright, all zero, or far from the black level of
    their camera.
    """
    faults = []
    key = f"{dome.file}[dark]"
    for i, (name, offset) in enumerate(_dark_offsets(dome, merger).items()):
        said = f"exposure {name} of camera {merger.camera.id}"
        if (
            merger.dark is not None
            and not merger.dark[i].any()
            and merger.camera.sensor.black > 0
        ):
            rule = "dark frames must hold the values of black"
            cure = "take them again, with the lens covered"
            faults.append(
                Fault(
                    key,
                    rule,
                    f"0 everywhere, {said}, black_level {merger.camera.sensor.black:g}",
                    cure,
                )
            )
        elif abs(offset) > MAX_DARK_OFFSET:
            rule = (
                "dark frames and black_level must differ by at most "
                f"{MAX_DARK_OFFSET:.0%} of the range"
            )
            found = f"{offset:+.1%}, {said}, black_level {merger.camera.sensor.black:g}"
            cure = (
                "set black_level to the camera's value without light, and cover the "
                "lens for dark frames"
            )
            faults.append(Fault(key, rule, found, cure))
    return faults


def dark_notes(dome: DomeRecord, merger: FrameMerger) -> list[str]:
    """Warnings about dark frames that differ noticeably from the black level."""
    worst = max(_dark_offsets(dome, merger).values(), key=abs, default=0.0)
    said = (
        f"dark frames of camera {merger.camera.id} differ from its black_level by "
        f"{worst:+.1%} of the range"
    )
    return [said] if abs(worst) > NOTED_DARK_OFFSET else []


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
    rule = "every frame must have been taken by itself"
    cure = "copy the right frames from the camera again"
    return [
        Fault(
            str(folder),
            rule,
            f"{first.relative_to(folder)} is a copy of {second.relative_to(folder)}",
            cure,
        )
        for first, second in (same[:2] for same in alike.values() if len(same) > 1)
        if np.ptp(read_frame(first)) > 0
    ]


def _dark_offsets(dome: DomeRecord, merger: FrameMerger) -> dict[str, float]:
    """Median of each dark frame above the black level, relative to the range of values."""
    if merger.dark is None:
        return {}
    sensor = merger.camera.sensor
    return {
        name: float(np.median(frame[:: _step(frame), :: _step(frame)]) - sensor.black)
        / (sensor.white - sensor.black)
        for name, frame in zip(dome.exposures, merger.dark, strict=True)
    }


def _step(frame: Frame) -> int:
    return int(np.ceil(np.sqrt(frame.shape[0] * frame.shape[1] / MAX_COMPARED_PIXELS)))


def dark_pattern_fault(
    dome: DomeRecord, camera: str, mergers: Mapping[str, FrameMerger]
) -> Fault | None:
    """Fault of the dark frames of a camera that match its photographs only turned, or
    those of another camera.

    Compared is the shortest exposure, in which the least light hides the pattern.

    Raises
    ------
    InputError
        If a photograph cannot be decoded.
    """
    merger = mergers[camera]
    shortest = int(np.argmin(merger.seconds))
    if merger.dark is None:
        return None
    step = -(
        -merger.dark[shortest].shape[0] * merger.dark[shortest].shape[1] // MAX_PIXELS
    )
    lights = dome.lights[:: -(-len(dome.lights) // MAX_PHOTOGRAPHS)]
    exposure = [*dome.exposures][shortest]
    kind = merger.camera.sensor.kind
    photographs = (
        read_frame(dome.frame(light.id, camera, exposure), kind)[::step]
        for light in lights
    )
    mean = np.mean(
        [photograph.astype(np.float32) for photograph in photographs], axis=0
    )
    inner = mean[:, 1:-1]
    dark = inner <= np.quantile(inner, DARK_QUANTILE)
    if dark.sum() < MIN_PIXELS:
        return None
    pattern = _pattern(mean, dark)
    own = merger.dark[shortest][::step]
    given = _correlation(pattern, _pattern(own, dark))
    # neighbouring pixels may share noise, for example by the interpolation of colours
    shifted = (np.roll(own, (5 * i, 7 * i), axis=(0, 1)) for i in range(1, SHIFTS + 1))
    unrelated = [_correlation(pattern, _pattern(frame, dark)) for frame in shifted]
    spread = max(float(np.std(unrelated)), 1 / np.sqrt(len(pattern)))
    least = max(MIN_CORRELATION * spread, MIN_CORRELATION_RATIO * given)
    for said, frame in _alternatives(camera, mergers, shortest):
        if _correlation(pattern, _pattern(frame[::step], dark)) > least:
            rule = "dark frames must show the pattern of the sensor where the photographs show it"
            cure = (
                "write them like the photographs: in the same orientation, under the "
                "id of their camera"
            )
            return Fault(f"{dome.file}[dark]", rule, f"camera {camera}: {said}", cure)
    return None


def _alternatives(
    camera: str, mergers: Mapping[str, FrameMerger], exposure: int
) -> Iterator[tuple[str, Frame]]:
    """What the dark frames of a camera may be instead, each with the frame that would
    then be the right one.
    """
    own = mergers[camera].dark
    assert own is not None
    yield "they look upside down", own[exposure][::-1, ::-1]
    yield "they look mirrored", own[exposure][:, ::-1]
    yield "they look mirrored top to bottom", own[exposure][::-1]
    for name, other in mergers.items():
        if name != camera and other.dark is not None and other.dark.shape == own.shape:
            yield f"those of camera {name} match its photographs", other.dark[exposure]


def _pattern(frame: Frame | Array, chosen: NDArray[np.bool_]) -> Array:
    """Differences (n,) of chosen values (h, w - 2, 3) from both neighbours in their
    row, without outliers.
    """
    values = frame.astype(np.float32)
    difference = (values[:, 1:-1] - (values[:, :-2] + values[:, 2:]) / 2)[chosen]
    limit = MAX_DEVIATIONS * 1.4826 * np.median(np.abs(difference))
    return np.asarray(np.clip(difference, -limit, limit))


def _correlation(a: Array, b: Array) -> float:
    """Pearson's correlation; 0 if one of the two is constant."""
    first = a.astype(np.float64) - a.mean(dtype=np.float64)
    second = b.astype(np.float64) - b.mean(dtype=np.float64)
    product = float(np.sqrt((first @ first) * (second @ second)))
    return float(first @ second) / product if product > 0 else 0.0
