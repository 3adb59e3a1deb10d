"""From the values of exposures to radiance: levels, response, exposure time, vignette,
colour (format, dome.json).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from skindb.calibration._merge_kernels import (
    ExposureModel,
    develop,
    develop_linear,
)
from skindb.errors import Fault, attempt
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.format.frames import Digests, Frame, filled, read_frames
from skindb.format.sensor import SensorRecord
from skindb.jit import sample_bits
from skindb.types import Bytes, Float32, Float64, Index, float64

# number of radiances up to the white level at which the linear model is fitted to the
# variance
RADIANCES = 64
NO_ERROR = np.empty((0, 0, 0), np.float32)

Image = Float32


@dataclass(frozen=True)
class FrameMerger:
    """Merges exposures of one camera to radiance, with its dark frames."""

    camera: CameraRecord
    seconds: tuple[float, ...]
    dark: Frame | None = None  # (exposure, h, w, 3) mean dark frames

    def merge(
        self, frames: list[Frame], spans: Index | None = None
    ) -> tuple[Image, Bytes]:
        """Radiance (h, w, 3) and flags (h, w) of the exposures of one view, as of
        `merge_exposures`.

        `spans` (h, 2) are the first wanted column of each row and the one after the
        last, by default all; pixels outside may be NaN and SATURATED.
        """
        height, width, _ = frames[0].shape
        radiance = np.empty((height, width, 3), np.float32)
        flag = np.empty((height, width), np.uint8)
        if spans is None:
            spans = _whole_rows(radiance)
        if self.camera.sensor.kind.bits == 0:
            develop_linear(sample_bits(_only(frames)), spans, radiance, flag)
            if set(self.camera.gain) != {1.0}:
                with np.errstate(all="ignore"):  # outside the spans is any value
                    radiance /= np.array(self.camera.gain, np.float32)
        else:
            develop(tuple(frames), self._model, spans, radiance, flag, NO_ERROR)
        return radiance, flag

    @cached_property
    def _model(self) -> ExposureModel:
        camera = self.camera
        shade = np.ones((1, 1))
        if camera.vignette.any():
            shade = vignette_gain(camera)[..., 0].astype(float)
        matrix = camera.colour_matrix / np.array(camera.gain)[:, None]
        return _exposure_model(camera.sensor, self.seconds, self.dark, shade, matrix)


def _curve(sensor: SensorRecord, *, dark: bool) -> tuple[Image, int]:
    """Exposure and read variance (m, 3, 2) of value - dark + offset, without rows for
    linear sensors; the offset.
    """
    if sensor.response is None:
        return np.zeros((0, 3, 2), np.float32), 0
    top = int(np.iinfo(sensor.kind.dtype).max)
    offset = top if dark else 0
    values = np.arange(-offset, top + 1, dtype=np.float32)
    level = np.tile(values[None, :, None], 3)
    black = np.float32(0) if dark else None
    signal, slope = relative_exposure(level, black, sensor)
    variance = read_sigma(slope, sensor) ** 2
    return np.stack([signal[0], variance[0]], axis=-1), offset


def frame_merger(
    dome: DomeRecord, camera: CameraRecord, digests: Digests | None = None
) -> FrameMerger:
    """Read the dark frames of a camera."""
    kind = camera.sensor.kind
    dark = None
    if dome.dark and kind.bits:
        files = [
            dome.folder / filled(dome.dark, exposure=exposure, camera=camera.id)
            for exposure in dome.exposures
        ]
        dark = np.stack(read_frames(files, kind, digests))
    return FrameMerger(camera, tuple(dome.exposures.values()), dark)


def frame_mergers(
    dome: DomeRecord, faults: list[Fault], digests: Digests | None = None
) -> dict[str, FrameMerger]:
    """A frame merger for every camera; damaged dark frames are recorded in `faults` and
    replaced by the black level.
    """
    without_dark = replace(dome, dark=None)
    return {
        camera.id: attempt(faults, partial(frame_merger, dome, camera, digests))
        or frame_merger(without_dark, camera)
        for camera in dome.cameras
    }


def read_view(
    dome: DomeRecord,
    light: str,
    camera: CameraRecord,
    *,
    white: bool = False,
    digests: Digests | None = None,
) -> list[Frame]:
    """Decode the exposures of one light and camera."""
    paths = [
        dome.frame(light, camera.id, exposure, white=white)
        for exposure in dome.exposures
    ]
    return read_frames(paths, camera.sensor.kind, digests)


def vignette_gain(camera: CameraRecord) -> Image:
    """1 + a2 r^2 + a4 r^4 + a6 r^6 (h, w, 1), r from the principal point in half image
    diagonals.
    """
    column = np.arange(camera.width) + 0.5 - camera.K[0, 2]
    row = np.arange(camera.height) + 0.5 - camera.K[1, 2]
    half = np.hypot(camera.width, camera.height) / 2
    r2 = (column**2 + row[:, None] ** 2) / half**2
    a2, a4, a6 = camera.vignette
    return np.asarray(1 + r2 * (a2 + r2 * (a4 + r2 * a6)), np.float32)[..., None]


def merge_exposures(
    frames: Sequence[Frame],
    seconds: Sequence[float],
    sensor: SensorRecord,
    *,
    dark: Frame | None = None,
    vignette: Image | None = None,
) -> tuple[Image, Image, Bytes]:
    """Merge several exposures to one radiance, each weighted by its inverse variance.

    The variance is that of the expected signal, not of the measured value, as weights
    by noisy values would favour low values. Exposures at the white level are excluded;
    dark ones are included, as their noise is known.

    Parameters
    ----------
    frames
        One array (h, w, 3) per exposure: values of the file, or linear radiance.
    seconds
        Exposure times.
    sensor
        Levels, noise and response.
    dark
        (exposure, h, w, 3) mean dark frames; default `sensor.black`.
    vignette
        (h, w, 1) gain of the lens; default 1.

    Returns
    -------
    radiance : ndarray
        (h, w, 3) float32; NaN where a channel was saturated in every exposure.
    error : ndarray
        (h, w, 3) its standard error due to read noise, photons and quantisation.
    flag : ndarray
        (h, w) OK, SATURATED (a channel in every exposure) or DARK (all channels at most
        black + 2 sigma in every exposure).
    """
    radiance, error = np.zeros((2, *frames[0].shape), np.float32)
    flag = np.empty(radiance.shape[:2], np.uint8)
    spans = _whole_rows(radiance)
    if sensor.kind.bits == 0:
        develop_linear(sample_bits(_only(frames)), spans, radiance, flag)
        return radiance, error, flag
    shade = np.ones((1, 1)) if vignette is None else vignette[..., 0].astype(float)
    model = _exposure_model(sensor, seconds, dark, shade, np.eye(3))
    # one array: the kernel is compiled for each number of arrays
    develop(np.stack(frames), model, spans, radiance, flag, error)
    return radiance, error, flag


def _whole_rows(picture: Image) -> Index:
    """Spans (h, 2) of all pixels of a picture (h, w, 3)."""
    return np.tile(np.array([0, picture.shape[1]]), (picture.shape[0], 1))


def _exposure_model(
    sensor: SensorRecord,
    seconds: Sequence[float],
    dark: Frame | None,
    shade: Float64,
    matrix: Float64,
) -> ExposureModel:
    """From the values of exposures to radiance, with the gain (h, w) or (1, 1) of the lens
    and a colour matrix.
    """
    curve, offset = _curve(sensor, dark=dark is not None)
    if dark is None:
        dark = np.zeros((0, 1, 1, 3), sensor.kind.dtype)
    span = sensor.white - sensor.black
    slope = np.asarray([1 / np.float32(span)], np.float32)
    longest = max(seconds)
    colours = matrix if (matrix != np.eye(3)).any() else np.zeros((0, 3))
    return ExposureModel(
        dark=np.ascontiguousarray(dark),
        curve=curve,
        offset=offset,
        zero=float(np.float32(sensor.black)),
        span=float(span),
        variance=float(read_sigma(slope, sensor)[0]) ** 2,
        white=float(sensor.white),
        seconds=np.asarray(seconds, np.float32) / np.float32(longest),
        photon=1 / sensor.full_electrons,
        gain=(1 / shade / longest).astype(np.float32),
        matrix=np.ascontiguousarray(colours, np.float32),
    )


def radiance_floor(sensor: SensorRecord, exposures: Mapping[str, float]) -> float:
    """Standard deviation of merged radiance due to read noise and quantisation alone; 0
    for linear files.
    """
    if sensor.kind.bits == 0:
        return 0.0
    black = np.full((1, 1, 3), sensor.black, np.uint16)
    _, slope = relative_exposure(black, None, sensor)
    time = np.sqrt(sum(t * t for t in exposures.values()))
    return float(read_sigma(slope, sensor).mean() / time)


def _only(frames: Sequence[Frame]) -> Frame:
    """The frame of linear radiance, a single one, as `read_dome` requires."""
    (frame,) = frames
    return frame


def relative_exposure(
    frame: Frame, dark: Frame | np.float32 | None, sensor: SensorRecord
) -> tuple[Image, Image]:
    """Relative exposure (1 at the white level) and its slope per value of the file; one
    slope for a linear response.
    """
    span = np.float32(sensor.white - sensor.black)
    black = np.float32(sensor.black)
    level = frame.astype(np.float32) - (
        black if dark is None else dark.astype(np.float32)
    )
    if sensor.response is None:
        return level / span, np.full((1,) * frame.ndim, 1 / span)
    values = sensor.response[:, 0]
    value = level + black
    signal = np.empty(frame.shape, np.float32)
    slope = np.empty(frame.shape, np.float32)
    for c in range(3):
        exposure = sensor.response[:, c + 1]
        rise = np.diff(exposure) / np.diff(values)
        cell = np.searchsorted(values, value[..., c], side="right") - 1
        cell = np.clip(cell, 0, len(rise) - 1)
        slope[..., c] = rise[cell]
        # the first segment is extrapolated below black: clipping the noise would
        # brighten dark pixels
        signal[..., c] = exposure[cell] + (value[..., c] - values[cell]) * rise[cell]
    return signal, slope


def read_sigma(slope: Image, sensor: SensorRecord) -> Image:
    """Read noise and quantisation of a relative exposure; read noise arises before the
    response, quantisation after.
    """
    steps = np.float32(sensor.step / np.sqrt(12)) * slope
    read = np.float32(sensor.read_noise / sensor.full_electrons)
    return np.asarray(np.sqrt(steps**2 + read**2), np.float32)


def radiance_noise(
    camera: CameraRecord, seconds: Sequence[float] | Float64, gain: float
) -> tuple[Float64, Float64, Float64]:
    """Limit, read variance and shot variance (3, exposure) of merged radiance for a
    given gain of the lens.

    Exposures are merged with weights of inverse variance: the variance is 1 / sum of
    seconds^2 / (photons + read noise). A straight line, fitted with relative errors, is
    exact for one exposure, and accurate to 3 % for two exposures with a ratio of eight
    (5 % for eight exposures). A nonlinear response is replaced by its mean slope, and
    the colour matrix is applied to grey light. Radiance is divided by the gains of the
    camera.

    Parameters
    ----------
    camera
        Levels, noise and colour matrix.
    seconds
        (exposure,) exposure times, the longest first.
    gain
        Gain of the lens (vignette) at the face.
    """
    sensor = camera.sensor
    time = float64(seconds)
    per_value = np.asarray([1 / (sensor.white - sensor.black)], np.float32)
    read = float(read_sigma(per_value, sensor)[0]) ** 2
    # an exposure is the longest usable one where all longer ones are saturated
    lines = [
        _line(time[longest:] * gain, read, 1 / sensor.full_electrons)
        for longest in range(len(time))
    ]
    mixed = np.square(camera.colour_matrix).sum(axis=1)[:, None]
    sensitivity = np.array(camera.gain)[:, None]
    offset, slope = np.array(lines).T
    return (
        1 / (time * gain * sensitivity),
        mixed * offset / sensitivity**2,
        mixed * slope / sensitivity,
    )


def _line(seconds: Float64, read: float, photon: float) -> tuple[float, float]:
    """Offset and slope of the variance over radiance, from noise of relative exposures."""
    # begins where read noise dominates
    radiance = np.geomspace(read / photon / 10, 1.0, RADIANCES) / seconds[0]
    variance = 1 / (seconds**2 / (photon * radiance[:, None] * seconds + read)).sum(
        axis=1
    )
    design = np.stack([np.ones_like(radiance), radiance], axis=1) / variance[:, None]
    offset, slope = np.linalg.lstsq(design, np.ones(RADIANCES))[0]
    return float(offset), float(slope)
