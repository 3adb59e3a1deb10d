"""Lights that failed although the controller measured their current: they are missing in the pictures."""

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
NEIGHBOURS = 6  # lights that a light is compared with
MIN_BRIGHTNESS = 0.1  # of the neighbours: a face that is turned away from a light still shows a third
MAX_STUCK = 0.1  # of the median light: brightness of a dark frame beyond which a light stayed on
LIT_QUANTILE = 0.9  # of the pixels: most of a picture is background


@dataclass(frozen=True)
class Brightness:
    """What the pictures show of the lights."""

    failed: dict[str, str]  # light, or "-" for a dark frame that is bright -> what was found
    lamp: float  # brightness of the steady lamp relative to a light; NaN without a last dark frame


def look_at_lights(schedule: Schedule, frames: Mapping[tuple[str, int], Path], dome: Mapping[str, Any]) -> Brightness:
    """Lights that the pictures do not show, whether one stayed on, and how bright the steady lamp is.

    Each light is looked at in the camera that stands nearest to it, which sees what it lights, at the longest
    exposure, and compared with the lights around it. Beside a steady lamp, a light that stayed on is not found.

    Parameters
    ----------
    schedule, frames
        Of the session: (camera, step) -> file.
    dome
        dome.json of the set-up.
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
        found[DARK] = f"the last dark frame of camera {wanted[last]} is {level[last]:.0f} above black"
    return Brightness(found, steady / usual if last in level and usual > 0 else float("nan"))


def _levels(
    wanted: Mapping[int, str], frames: Mapping[tuple[str, int], Path], dome: Mapping[str, Any]
) -> dict[int, float]:
    """Brightness above black of the frame of every step that has one, in its camera."""
    bits = {str(one["id"]): int(one.get("bit_depth", 16)) for one in dome["cameras"]}
    black = {str(one["id"]): float(one.get("black_level", 0.0)) for one in dome["cameras"]}
    paths = {i: frames[camera, i] for i, camera in wanted.items() if (camera, i) in frames}
    with ThreadPoolExecutor(THREADS) as pool:
        found = pool.map(lambda i: _level(paths[i], bits[wanted[i]]) - black[wanted[i]], paths)
        return dict(zip(paths, found, strict=True))


def _darker(lit: Mapping[str, float], lights: Mapping[str, NDArray[np.float64]]) -> dict[str, str]:
    """Lights whose pictures are much darker than those of the lights around them."""
    found = {}
    for name, value in lit.items():
        others = sorted((one for one in lit if one != name), key=lambda one: -float(lights[one] @ lights[name]))
        near = [lit[one] for one in others[:NEIGHBOURS]]
        if len(near) >= MIN_NEIGHBOURS and value < MIN_BRIGHTNESS * float(np.median(near)):
            share = max(value, 0.0) / float(np.median(near))
            found[name] = f"its picture is {share:.0%} as bright as those of the lights around it"
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
