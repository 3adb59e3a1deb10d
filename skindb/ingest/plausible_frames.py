"""Frames that contradict each other or their levels: exposures exchanged, dark frames that are not dark, no picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault
from skindb.ingest.devices import DomeRecord
from skindb.ingest.frames import Frame
from skindb.ingest.radiance import Darkroom, read_sigma, relative_exposure
from skindb.ingest.sensor import SensorRecord

Array = NDArray[np.float32]
MAX_JUDGED_PIXELS = 40_000  # of a frame, evenly spread: 1 % of the time to decode 10 megapixels
# standard deviations of read noise above black, and relative exposure: what dark frames would change is small beside it
MIN_SIGNAL_DEVIATIONS, MIN_SIGNAL = 20.0, 0.005
MAX_SIGNAL = 0.7  # relative exposure that is clearly below the white level
MIN_RATIO_VALUES = 50  # values that a ratio is judged by
# ratio of the radiance of two exposures beyond which they do not fit: a stop of the lens, half
MAX_RADIANCE_RATIO = 1.4
# of the judged values of two exposures, that differ by more than this ratio and noise: 0.01 where heads moved by 0.3 mm
# between them, 0.14 and more where one was mirrored, 0.7 where it was of another light
MAX_APART_FRACTION = 0.1
# of the white level: dark current of the warmest cameras in seconds; beyond it they say what black_level does not
MAX_DARK_OFFSET, NOTED_DARK_OFFSET = 0.05, 0.01
# standard deviations of read noise and relative exposure below black; the pixels beyond them; of noise one in 1e9 is
MAX_BELOW_DEVIATIONS, MAX_BELOW, MAX_BELOW_FRACTION = 6.0, 0.005, 0.05
MIN_POSITIVE_FRACTION = 0.01  # of the pixels of linear radiance; of noise about none half are


def view_faults(
    dome: DomeRecord, light: str, room: Darkroom, frames: Sequence[Frame], *, white: bool = False
) -> list[Fault]:
    """What is wrong with the exposures of one light and camera: at most one fault.

    Parameters
    ----------
    dome, light, room
        Whose frames they are.
    frames
        (h, w, 3) per exposure of the dome, decoded.
    white
        They show the white target.
    """
    where = f"{dome.file}[white][frames]" if white else f"{dome.file}[frames]"
    sensor, names = room.camera.sensor, [*dome.exposures]
    step = _step(frames[0])
    some = [frame[::step, ::step] for frame in frames]
    said = f"camera {room.camera.id}, light {light}: "
    if sensor.kind.bits == 0:
        fault = _linear_fault(where, some[0])
    else:
        dark = None if room.dark is None else [frame[::step, ::step] for frame in room.dark]
        fault = _saturated_fault(where, some, sensor) or _below_fault(where, names, some, dark, sensor)
        said += "" if fault else "exposure "
        seconds = dict(zip(names, room.seconds, strict=True))
        fault = fault or disagreement(where, seconds, some, sensor, dark=dark)
    return [] if fault is None else [Fault(fault.where, fault.rule, said + fault.found, fault.cure)]


def disagreement(
    where: str,
    seconds: Mapping[str, float],
    frames: Sequence[Frame],
    sensor: SensorRecord,
    *,
    dark: Sequence[Frame] | None = None,
) -> Fault | None:
    """Two exposures, neighbours in time, that tell different radiance; `frames` are in the order of `seconds`."""
    signals = [relative_exposure(f, None if dark is None else dark[i], sensor)[0] for i, f in enumerate(frames)]
    by_time = sorted(zip(seconds.items(), signals, frames, strict=True), key=lambda one: one[0][1])
    for ((short, a), low, dim), ((long, b), high, bright) in pairwise(by_time):
        ratio, apart = _radiance_ratio(sensor, (dim, low, a), (bright, high, b))
        if np.isnan(ratio) or (1 / MAX_RADIANCE_RATIO < ratio < MAX_RADIANCE_RATIO and apart <= MAX_APART_FRACTION):
            continue
        rule = "exposures of one view tell the same radiance: seconds, black_level and response fit the frames"
        found = f"{short} ({a:.3g} s) tells {ratio:.3g} times the radiance of {long} ({b:.3g} s)"
        if 1 / MAX_RADIANCE_RATIO < ratio < MAX_RADIANCE_RATIO:
            found = f"{short} and {long} differ in {apart:.0%} of the values that both must see"
        return Fault(where, rule, found, "give each exposure its own seconds, its own frames and no others'")
    return None


def _radiance_ratio(
    sensor: SensorRecord, short: tuple[Frame, Array, float], long: tuple[Frame, Array, float]
) -> tuple[float, float]:
    """Median ratio of the radiance of a short exposure to that of a long one, and the fraction of values that differ.

    Judged are values that one of them says both must see well: a black or white frame contradicts the other as well.
    NaN of too few.
    """
    (dim, low, a), (bright, high, b) = short, long
    slope = np.asarray([1 / (sensor.white - sensor.black)], np.float32)  # of a linear response
    read = float(read_sigma(slope, sensor)[0])
    least = max(MIN_SIGNAL, MIN_SIGNAL_DEVIATIONS * read)
    # the short one is noisier: of pixels near the limit it would choose those that noise has lifted above it
    by_short = (dim < sensor.white) & (low > 2 * least) & (low * (b / a) < MAX_SIGNAL)
    by_long = (bright < sensor.white) & (high < MAX_SIGNAL) & (high * (a / b) > least)
    good = by_short | by_long
    if good.sum() < MIN_RATIO_VALUES:
        return float("nan"), float("nan")
    one, other = np.maximum(low[good], 0), np.maximum(high[good] * np.float32(a / b), 0)
    larger = np.maximum(one, other)
    noise = MAX_BELOW_DEVIATIONS * np.sqrt(read**2 + larger / sensor.full_electrons) + MIN_SIGNAL
    apart = np.abs(one - other) > (MAX_RADIANCE_RATIO - 1) * larger + noise
    return float(np.median(one / np.maximum(other, 1e-9))), float(apart.mean())


def _saturated_fault(where: str, frames: Sequence[Frame], sensor: SensorRecord) -> Fault | None:
    """All of the picture at the white level, in every exposure."""
    if all((frame >= sensor.white).all() for frame in frames):
        rule, cure = "a photograph is not saturated everywhere", "take it with a shorter exposure"
        return Fault(where, rule, "no value below white_level", cure)
    return None


def _below_fault(
    where: str, names: Sequence[str], frames: Sequence[Frame], dark: Sequence[Frame] | None, sensor: SensorRecord
) -> Fault | None:
    """A picture darker than darkness: a black level, or dark frames, that are too high."""
    for i, frame in enumerate(frames):
        signal, slope = relative_exposure(frame, None if dark is None else dark[i], sensor)
        below = float((signal < -MAX_BELOW - MAX_BELOW_DEVIATIONS * read_sigma(slope, sensor)).mean())
        if below > MAX_BELOW_FRACTION:
            key = "black_level" if dark is None else "the dark frame"
            rule = f"at most {MAX_BELOW_FRACTION:.0%} of a frame is darker than {key}, beyond noise"
            cure = (
                "correct black_level" if dark is None else "take the dark frames again, with the exposures of the face"
            )
            return Fault(where, rule, f"{below:.0%} of exposure {names[i]}", cure)
    return None


def _linear_fault(where: str, frame: Frame) -> Fault | None:
    """Merged radiance that is negative, or one value everywhere; zero may be a light from behind."""
    low, high = float(np.nanmin(frame, initial=np.inf)), float(np.nanmax(frame, initial=-np.inf))
    rule, cure = "an OpenEXR frame holds the radiance of a photograph", "merge the exposures of this view again"
    if not low <= high:
        return Fault(where, rule, "no number in it", cure)
    if low == high != 0:
        return Fault(where, rule, f"{low:.3g} everywhere", cure)
    if low < 0 and float((frame > 0).mean()) < MIN_POSITIVE_FRACTION:
        return Fault(where, rule, f"values from {low:.3g} to {high:.3g}, nearly all negative", cure)
    return None


def dark_faults(dome: DomeRecord, room: Darkroom) -> list[Fault]:
    """Dark frames of a camera that are light, all zero, or far from its black level."""
    faults, key = [], f"{dome.file}[dark]"
    for i, (name, offset) in enumerate(_dark_offsets(dome, room).items()):
        said = f"exposure {name} of camera {room.camera.id}"
        if room.dark is not None and not room.dark[i].any() and room.camera.sensor.black > 0:
            rule, cure = "dark frames hold the values of black", "take them again, with the lens covered"
            faults.append(Fault(key, rule, f"0 everywhere, {said}, black_level {room.camera.sensor.black:g}", cure))
        elif abs(offset) > MAX_DARK_OFFSET:
            rule = f"dark frames and black_level differ by at most {MAX_DARK_OFFSET:.0%} of the range"
            found = f"{offset:+.1%}, {said}, black_level {room.camera.sensor.black:g}"
            cure = "give the values that the camera writes without light, and take dark frames with the lens covered"
            faults.append(Fault(key, rule, found, cure))
    return faults


def dark_notes(dome: DomeRecord, room: Darkroom) -> list[str]:
    """What to say of dark frames that are some way from the black level."""
    worst = max(_dark_offsets(dome, room).values(), key=abs, default=0.0)
    said = f"dark frames of camera {room.camera.id} differ from its black_level by {worst:+.1%} of the range"
    return [said] if abs(worst) > NOTED_DARK_OFFSET else []


def _dark_offsets(dome: DomeRecord, room: Darkroom) -> dict[str, float]:
    """Median of each dark frame above the black level, relative to the range of values."""
    if room.dark is None:
        return {}
    sensor = room.camera.sensor
    return {
        name: float(np.median(frame[:: _step(frame), :: _step(frame)]) - sensor.black) / (sensor.white - sensor.black)
        for name, frame in zip(dome.exposures, room.dark, strict=True)
    }


def _step(frame: Frame) -> int:
    return int(np.ceil(np.sqrt(frame.shape[0] * frame.shape[1] / MAX_JUDGED_PIXELS)))
