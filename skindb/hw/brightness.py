"""Brightness of lights in frames: lights that failed or stayed on."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from skindb.errors import InputError
from skindb.format.dome import CameraRecord, DomeRecord
from skindb.format.frames import is_linear, read_frame
from skindb.hw.sequence import DARK, Schedule
from skindb.types import Float64, unit

THREADS = 2
MIN_NEIGHBOURS = 3
NEIGHBOURS = 6  # number of lights with which a light is compared
# relative to the neighbours: a face turned away from a light still reaches a third
MIN_BRIGHTNESS = 0.1
# of the median light, relative to white: below it the pictures are black
MIN_LEVEL = 0.001
# brightness of a dark frame, relative to the median light, above which a light stayed
# on
MAX_STUCK = 0.1
LIT_QUANTILE = 0.9  # quantile of the pixels: most of a picture is background


def failed_lights(
    schedule: Schedule, frames: Mapping[tuple[str, int], Path], dome: DomeRecord
) -> dict[str, str]:
    """Lights that failed or stayed on, with a description; `DARK` if the last dark frame is bright.

    Each light is measured in the longest exposure with the camera nearest to it, which
    sees the side that it lights, and is compared with the lights around it.

    Parameters
    ----------
    schedule
        Steps of the session, with dark frames before and after the lights.
    frames
        (camera, step) -> file.
    dome
        The set-up.
    """
    exposure = max(dome.exposures, key=dome.exposures.__getitem__)
    centres = unit(np.array([camera.centre for camera in dome.cameras]))
    places = {light.id: unit(light.position) for light in dome.lights}
    pictures = {}
    for i, step in enumerate(schedule.steps):
        if step.light in places and step.exposure == exposure:
            camera = dome.cameras[int((centres @ places[step.light]).argmax())]
            if (camera.id, i) in frames:
                pictures[step.light] = (camera, frames[camera.id, i])
    with ThreadPoolExecutor(THREADS) as pool:
        levels = pool.map(lambda picture: _level(*picture), pictures.values())
        lit = dict(zip(pictures, levels, strict=True))
    failed = _darker_lights(lit, places, linear=any(map(is_linear, frames.values())))
    readable = [level for level in lit.values() if not np.isnan(level)]
    last_step = len(schedule.steps) - 1
    witness = dome.cameras[0]
    file = frames.get((witness.id, last_step))
    step = schedule.steps[last_step]
    if not readable or step.light != DARK or file is None:
        return failed
    level = _level(witness, file)
    ratio = dome.exposures[step.exposure] / dome.exposures[exposure]
    if not level <= MAX_STUCK * float(np.median(readable)) * ratio:
        text = "no readable picture" if np.isnan(level) else f"{level:.1%} of white"
        failed[DARK] = f"{text} in the last dark frame of camera {witness.id}"
    return failed


def _level(camera: CameraRecord, file: Path) -> float:
    """Level of the lit part of a picture, 0 at black and 1 at white, or radiance of
    OpenEXR: a quantile of the mean of the channels. NaN if it cannot be decoded.
    """
    try:
        value = read_frame(file).mean(axis=-1, dtype=float)
    except InputError:
        return float("nan")
    level = float(np.quantile(value, LIT_QUANTILE))
    if is_linear(file):
        return level
    sensor = camera.sensor
    return (level - sensor.black) / (sensor.white - sensor.black)


def _darker_lights(
    lit: Mapping[str, float], places: Mapping[str, Float64], *, linear: bool
) -> dict[str, str]:
    """Lights whose pictures are black or much darker than those of their neighbours."""
    failed = {
        name: "its picture cannot be read"
        for name, level in lit.items()
        if np.isnan(level)
    }
    level = {name: value for name, value in lit.items() if name not in failed}
    lowest = 0.0 if linear else MIN_LEVEL
    if level and not np.median(list(level.values())) > lowest:
        return failed | dict.fromkeys(
            level, "its picture is black, like those of most lights"
        )
    for name, value in level.items():
        distance = {
            neighbour: -float(places[neighbour] @ places[name])
            for neighbour in level
            if neighbour != name
        }
        near = [
            level[neighbour]
            for neighbour in sorted(distance, key=distance.__getitem__)[:NEIGHBOURS]
        ]
        usual = float(np.median(near)) if len(near) >= MIN_NEIGHBOURS else 0.0
        if usual > 0 and not value >= MIN_BRIGHTNESS * usual:
            fraction = max(value, 0.0) / usual
            rest = f"{fraction:.0%} of the brightness of the neighbouring lights"
            failed[name] = f"its picture has {rest}"
    return failed
