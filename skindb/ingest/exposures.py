"""Whether the exposures of a view agree: seconds or a response that do not fit the frames would scale samples."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from skindb.errors import Fault, InputError
from skindb.geometry.camera import camera_centre
from skindb.ingest.devices import CameraRecord, DomeRecord
from skindb.ingest.frames import Frame
from skindb.ingest.radiance import read_sigma, read_view, relative_exposure

# standard deviations of read noise above black: what dark frames would change is small beside it
MIN_SIGNAL_DEVIATIONS = 20.0
MIN_RATIO_VALUES = 50  # values that a ratio is judged by
# ratio of the radiance of two exposures beyond which they do not fit: a stop of the lens, half
MAX_RADIANCE_RATIO = 1.4


def exposure_faults(dome: DomeRecord) -> list[Fault]:
    """A fault for every camera whose exposures tell different radiance, by the light that stands nearest to it."""
    return [fault for camera in dome.cameras if (fault := _fault(dome, camera)) is not None]


def _fault(dome: DomeRecord, camera: CameraRecord) -> Fault | None:
    seconds = sorted(dome.exposures.items(), key=lambda one: one[1])
    if camera.sensor.kind.bits == 0 or len(seconds) < 2:
        return None
    away = [np.linalg.norm(light.position - camera_centre(camera.R, camera.t)) for light in dome.lights]
    try:
        frames = dict(zip(dome.exposures, read_view(dome, dome.lights[int(np.argmin(away))].id, camera), strict=True))
    except InputError:
        return None  # told when the frames are sampled
    for (short, a), (long, b) in pairwise(seconds):
        ratio = _ratio(camera, frames[short], frames[long]) * b / a
        if not 1 / MAX_RADIANCE_RATIO < ratio < MAX_RADIANCE_RATIO and np.isfinite(ratio):
            rule = f"the seconds of exposures, black_level and response fit the frames of camera {camera.id}"
            found = f"{short} ({a:g} s) tells {ratio:.3g} times the radiance of {long} ({b:g} s)"
            return Fault(f"{dome.file}[exposures]", rule, found, "give each exposure its own seconds")
    return None


def _ratio(camera: CameraRecord, short: Frame, long: Frame) -> float:
    """Median ratio of the relative exposures where both are well above black and below white; NaN of too few."""
    sensor, good, signal = camera.sensor, np.ones(short.shape, bool), []
    for frame in (short, long):
        one, slope = relative_exposure(frame, None, sensor)
        good &= (frame < sensor.white) & (one > MIN_SIGNAL_DEVIATIONS * read_sigma(slope, sensor))
        signal.append(one)
    return float(np.median(signal[0][good] / signal[1][good])) if good.sum() >= MIN_RATIO_VALUES else float("nan")
