"""Checks of frames of calibration targets, while the target is still in the dome."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from skindb.calibration.boards import MIN_CORNERS, board_corners
from skindb.calibration.mirror_ball import highlight_of
from skindb.errors import Fault, few_names
from skindb.format.dome import CameraRecord
from skindb.format.frames import read_frame

THREADS = 2
Taken = tuple[str, str, int]  # light, exposure, repeat
Frames = Sequence[tuple[Taken, Path]]
MAX_SATURATED = 0.02  # of the pixels
# of the range of values
MIN_LIGHT = 0.05
MAX_DARK = 0.01
USEFUL_LEVELS = (0.02, 0.95)  # of a diffuser
MIN_BRIGHTNESSES = 5  # of a diffuser; noise and vignette need them
MIN_EVEN = 0.2  # darkest pixels of a diffuser over its median; lenses darken to 0.3
# step between neighbouring pixels over the contrast: a blur of 2.7 px lowers it to this
MIN_SLOPE = 0.15
SLOPE_QUANTILE = 0.998  # edges are few pixels of a large picture
MIN_LIGHTS = 0.5  # whose highlights a camera that sees the ball shows
DIM = "lengthen the exposure, or make the lights brighter"
BRIGHT = "shorten the exposures, or dim the lights"


@dataclass(frozen=True)
class Target:
    """A recording: its kind, the number of the pose or place, and seconds by exposure."""

    kind: str
    number: int
    seconds: Mapping[str, float]
    board: Mapping[str, object]  # description of the board

    @property
    def name(self) -> str:
        """Words for messages."""
        return f"{self.kind} {self.number}"


@dataclass(frozen=True)
class _View:
    """What is checked of a frame: levels of its pixels, 0 at black and 1 at white."""

    low: float
    middle: float
    high: float
    saturated: float  # fraction of pixels
    slope: float


def target_faults(
    target: Target,
    cameras: Sequence[CameraRecord],
    steps: Sequence[Taken],
    files: Mapping[tuple[str, int], Path],
) -> list[Fault]:
    """What is wrong with the frames of one pose or place.

    Parameters
    ----------
    target
        The recording.
    cameras
        The cameras of the dome.
    steps
        Light, exposure and repeat of each step.
    files
        (camera, step) -> frame.
    """
    faults = []
    if target.kind in SEEN:
        seen = {
            camera.id: SEEN[target.kind](
                target,
                camera,
                [(step, files[camera.id, i]) for i, step in enumerate(steps)],
            )
            for camera in cameras
        }
        cameras = [camera for camera in cameras if seen[camera.id]]
        needed = min(2, len(seen))
        if len(cameras) < needed:
            return [
                Fault(
                    target.name,
                    f"must be found in the pictures of {needed} cameras",
                    ", ".join(camera.id for camera in cameras) or "none",
                    "put it where faces will be, sharp and lit, and run the command again",
                )
            ]
        if target.kind == "ball":
            return _dark_lights(target, steps, set().union(*seen.values()))
    bright = set()
    longest = max(target.seconds, key=target.seconds.__getitem__)
    with ThreadPoolExecutor(THREADS) as pool:
        for camera in cameras:
            paths = [files[camera.id, i] for i in range(len(steps))]
            views = dict(
                zip(steps, pool.map(partial(_view, camera), paths), strict=True)
            )
            bright |= {
                light
                for (light, exposure, _), view in views.items()
                if exposure == longest and view.high >= MIN_LIGHT
            }
            place = f"camera {camera.id}, {target.name}"
            faults += [
                Fault(place, rule, found, f"{cure}, and run the command again")
                for rule, found, cure in RULES[target.kind](target, views)
            ]
    if target.kind == "white" and not faults:
        faults = _dark_lights(target, steps, bright)
    return faults


def _dark_lights(
    target: Target, steps: Sequence[Taken], bright: Collection[str]
) -> list[Fault]:
    """Faults of lights that no camera sees on the target."""
    dark = [
        light
        for light in dict.fromkeys(step[0] for step in steps)
        if light not in bright
    ]
    if not dark:
        return []
    rule = f"every light must reach {MIN_LIGHT:.0%} of white on it in one camera"
    cure = "repair these lights, or turn them to the target, and run the command again"
    return [Fault(target.name, rule, f"less of {few_names(dark)}", cure)]


def _view(camera: CameraRecord, file: Path) -> _View:
    frame = read_frame(file, camera.sensor.kind)
    grey = np.asarray(frame.max(axis=-1), np.float32)
    sensor = camera.sensor
    white = sensor.white if np.isfinite(sensor.white) else float(grey.max())
    level = (grey - np.float32(sensor.black)) / np.float32(white - sensor.black)
    low, middle, high = np.quantile(level, [0.02, 0.5, 0.98])
    steps = [np.abs(np.diff(level, axis=axis)).ravel() for axis in (0, 1)]
    steepest = np.quantile(np.concatenate(steps), SLOPE_QUANTILE)
    return _View(
        float(low),
        float(middle),
        float(high),
        float((grey >= sensor.white).mean()),
        float(steepest / max(high - low, 1e-3)),
    )


Views = Mapping[Taken, _View]
Rule = tuple[str, str, str]  # rule, found, cure


def _exposed(target: Target, views: Views) -> Iterator[Rule]:
    """Frames of the longest exposure are light, those of the shortest not saturated."""
    order = sorted({step[1] for step in views}, key=target.seconds.__getitem__)
    light = max(view.high for step, view in views.items() if step[1] == order[-1])
    if light < MIN_LIGHT:
        found = f"{light:.1%} of white in the longest exposure"
        yield f"must be at least {MIN_LIGHT:.0%} of white", found, DIM
    top = max(view.saturated for step, view in views.items() if step[1] == order[0])
    if top > MAX_SATURATED:
        found = f"{top:.0%} in the shortest exposure"
        yield f"at most {MAX_SATURATED:.0%} may be saturated", found, BRIGHT


def _sharp(target: Target, views: Views) -> Iterator[Rule]:
    yield from _exposed(target, views)
    slope = max(view.slope for view in views.values())
    if slope < MIN_SLOPE and not (target.kind == "chart" and target.number > 1):
        yield (
            f"edges must reach {MIN_SLOPE:.0%} of their contrast from pixel to pixel",
            f"{slope:.0%}",
            "focus the camera, and let the target stand still",
        )


def _flat(_: Target, views: Views) -> Iterator[Rule]:
    low, high = USEFUL_LEVELS
    useful = {
        step[1]: view
        for step, view in views.items()
        if low < view.middle < high and view.saturated <= MAX_SATURATED
    }
    if len(useful) < MIN_BRIGHTNESSES:
        yield (
            f"{MIN_BRIGHTNESSES} exposures must be between {low:.0%} and {high:.0%} of white",
            f"{len(useful)}, of {len(views) // 2} with medians up to "
            f"{max(view.middle for view in views.values()):.0%}",
            "change the exposures of dome/calibration.json, or the brightness of the light",
        )
    darkest = min((view.low / view.middle for view in useful.values()), default=1.0)
    if darkest < MIN_EVEN:
        yield (
            f"its darkest pixels must have {MIN_EVEN:.0%} of the median",
            f"{darkest:.0%}",
            "cover the whole lens with the diffuser",
        )


def _dark(_: Target, views: Views) -> Iterator[Rule]:
    level = max((x for v in views.values() for x in (v.low, v.high)), key=abs)
    if abs(level) > MAX_DARK:
        yield (
            f"must be within {MAX_DARK:.0%} of black_level",
            f"{level:+.1%}",
            "darken the room, or correct black_level of dome.json",
        )


RULES: Mapping[str, Callable[[Target, Views], Iterator[Rule]]] = {
    "board": _sharp,
    "white": _exposed,
    "flat": _flat,
    "dark": _dark,
    "chart": _sharp,
    "response": _exposed,
}


def _corners(target: Target, _: CameraRecord, frames: Frames) -> set[str]:
    """Corners of the board that are found; none if they are too few."""
    file = frames[0][1]
    corners = board_corners(target.board, read_frame(file))[0]
    return set(map(str, corners)) if len(corners) >= MIN_CORNERS else set()


def _highlights(target: Target, camera: CameraRecord, frames: Frames) -> set[str]:
    """Lights whose highlights on the ball are found; none if they are too few."""
    shortest = min(target.seconds, key=target.seconds.__getitem__)
    lights = {step[0]: file for step, file in frames if step[1] == shortest}
    limit = camera.sensor.black + MIN_LIGHT * (
        camera.sensor.white - camera.sensor.black
    )
    found = set()
    for light, file in lights.items():
        frame = read_frame(file, camera.sensor.kind)
        if frame.max() > limit and highlight_of(camera, frame) is not None:
            found.add(light)
    return found if len(found) >= MIN_LIGHTS * len(lights) else set()


SEEN = {"board": _corners, "ball": _highlights}
