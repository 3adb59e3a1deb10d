"""Check of dark frames by the fixed pattern of the sensor, which they share with the
dark parts of photographs.

The pattern differs from pixel to pixel, so that even a small part of it shows whether
dark frames are turned, mirrored, or of another camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from skindb.calibration.radiance import FrameMerger
from skindb.errors import Fault
from skindb.format.devices import DomeRecord
from skindb.format.frames import Frame, read_frame

Array = NDArray[np.float32]
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
