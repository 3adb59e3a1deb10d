"""Detection of failed lights in the pictures, for failures that the controller's current measurement does not show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.hw.sequence import DARK, Schedule
from skindb.ingest.frames import FrameKind, frame_size, is_linear, read_frame

THREADS = 2
MIN_NEIGHBOURS = 3
NEIGHBOURS = 6  # number of lights with which a light is compared
MIN_BRIGHTNESS = 0.1  # relative to the neighbours: a face turned away from a light still reaches a third
MAX_STUCK = 0.1  # brightness of a dark frame, relative to the median light, above which a light stayed on
LIT_QUANTILE = 0.9  # quantile of the pixels: most of a picture is background


@dataclass(frozen=True)
class Brightness:
    """Brightness of the lights in the pictures."""

    failed: dict[str, str]  # id of the light, or "-" for a dark frame that is bright -> description of the failure
    lamp: float  # brightness of the steady lamp relative to a light; NaN without a last dark frame


def light_brightness(schedule: Schedule, frames: Mapping[tuple[str, int], Path], dome: Mapping[str, Any]) -> Brightness:
    """Find lights that failed or stayed on, and measure the brightness of the steady lamp, from the pictures.

    Each light is measured at the longest exposure with the camera nearest to it, which sees the side that it lights,
    and compared with the lights around it. With a steady lamp, a light that stayed on cannot be detected.

    Parameters
    ----------
    schedule
        Steps of the session.
    frames
        (camera, step) -> file.
    dome
        Content of dome.json of the set-up.
    """
    lights = {str(one["id"]): _unit(one["position"]) for one in dome["lights"]}
    cameras = {str(one["id"]): _unit(-np.array(one["R"]).T @ np.array(one["t"])) for one in dome["cameras"]}
    seconds = {str(one["id"]): float(one["seconds"]) for one in dome["exposures"]}
    last = len(schedule.steps) - 1
    longest = max(seconds, key=seconds.__getitem__)
    wanted = dict[int, str]()
    for i, step in enumerate(schedule.steps):
        if step.light in lights and step.exposure == longest:
            wanted[i] = max(cameras, key=lambda name, at=step.light: float(cameras[name] @ lights[at]))  # type: ignore[misc]
    if last >= 0 and schedule.steps[last].light == DARK:
        wanted[last] = next(iter(cameras))
    level = _levels(wanted, frames, dome)
    share = seconds[schedule.steps[last].exposure] / seconds[longest] if last in level else 1.0
    steady = level[last] / share if last in level and schedule.base else 0.0
    lit = {schedule.steps[i].light: value - steady for i, value in level.items() if i != last}
    found = _darker(lit, lights)
    usual = float(np.median(list(lit.values()))) if lit else 0.0
    if last in level and not schedule.base and level[last] > MAX_STUCK * usual * share > 0:
        found[DARK] = f"a level of {level[last]:.0f} above black in the last dark frame of camera {wanted[last]}"
    return Brightness(found, steady / usual if last in level and usual > 0 else float("nan"))


def _levels(
    wanted: Mapping[int, str], frames: Mapping[tuple[str, int], Path], dome: Mapping[str, Any]
) -> dict[int, float]:
    """Brightness above the black level for each wanted step -> camera that has a frame."""
    bits = {str(one["id"]): int(one.get("bit_depth", 16)) for one in dome["cameras"]}
    black = {str(one["id"]): float(one.get("black_level", 0.0)) for one in dome["cameras"]}
    paths = {i: frames[camera, i] for i, camera in wanted.items() if (camera, i) in frames}
    with ThreadPoolExecutor(THREADS) as pool:
        found = pool.map(lambda i: _level(paths[i], bits[wanted[i]]) - black[wanted[i]], paths)
        return dict(zip(paths, found, strict=True))


def _darker(lit: Mapping[str, float], lights: Mapping[str, NDArray[np.float64]]) -> dict[str, str]:
    """Lights whose pictures are much darker than those of their neighbours, with a description."""
    found = {}
    for name, value in lit.items():
        others = sorted((one for one in lit if one != name), key=lambda one: -float(lights[one] @ lights[name]))
        near = [lit[one] for one in others[:NEIGHBOURS]]
        if len(near) >= MIN_NEIGHBOURS and value < MIN_BRIGHTNESS * float(np.median(near)):
            share = max(value, 0.0) / float(np.median(near))
            found[name] = f"its picture has {share:.0%} of the brightness of the neighbouring lights"
    return found


def _level(path: Path, bits: int) -> float:
    """Brightness of the lit part of a frame: a quantile of the mean of its channels."""
    size = frame_size(path)
    if size is None or is_linear(path):
        return float("nan")
    frame = read_frame(path, FrameKind(*size, bits))
    return float(np.quantile(frame.mean(axis=-1), LIT_QUANTILE))


def _unit(vector: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    direction = np.asarray(vector, np.float64)
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-12))
