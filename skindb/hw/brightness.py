"""Brightness of lights in frames: lights that failed, and a steady lamp, which is measured
before the lights flash fast.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from skindb.errors import InputError, input_error
from skindb.format.frames import is_linear, read_frame
from skindb.hw.cameras import Cameras
from skindb.hw.capture_folder import Setup
from skindb.hw.dome import Dome
from skindb.hw.sequence import DARK, Schedule, plan_schedule, slowed_schedule
from skindb.hw.session import capture_dome, require_complete, with_dark_frames
from skindb.types import Float64, float64

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
# of a steady lamp, relative to white, so that a light can be seen beside it
MAX_LAMP_LEVEL = 0.5
LIT_QUANTILE = 0.9  # quantile of the pixels: most of a picture is background
NO_STEP = -1
# measured over stated brightness: cameras see lamp and lights from different sides
MIN_LAMP = 0.5
# of a dark frame relative to white: with a light, a tenth of the lamp, it is white
MAX_FILLED_LEVEL = 0.9
MIN_LAMP_LEVEL = 0.005  # of a dark frame relative to white, below which no lamp is on
REFERENCE_LIGHTS = 4  # flashed at the safe rate of three in a second


class Picture(NamedTuple):
    """A frame, or its difference to another frame of the same camera."""

    camera: str
    step: int
    background: int = NO_STEP  # step of a dark frame


class Levels:
    """Brightness of pictures relative to white, each measured once.

    Parameters
    ----------
    frames
        (camera, step) -> file.
    dome
        Content of dome.json of the set-up.
    """

    def __init__(
        self, frames: Mapping[tuple[str, int], Path], dome: Mapping[str, Any]
    ) -> None:
        self.linear = any(is_linear(path) for path in frames.values())
        self._frames = frames
        self._cameras = {str(camera["id"]): camera for camera in dome["cameras"]}
        self._levels = dict[Picture, float]()

    def has(self, picture: Picture) -> bool:
        """Whether the frame was taken."""
        return (picture.camera, picture.step) in self._frames

    def of(self, pictures: Sequence[Picture]) -> Float64:
        """Levels above black or background; NaN if a frame is missing or cannot be decoded."""
        new = [
            picture
            for picture in dict.fromkeys(pictures)
            if picture not in self._levels
        ]
        with ThreadPoolExecutor(THREADS) as pool:
            self._levels |= zip(new, pool.map(self._measure, new), strict=True)
        return np.array([self._levels[picture] for picture in pictures])

    def _measure(self, picture: Picture) -> float:
        """Level of the lit part of a picture: a quantile of the mean of its channels."""
        try:
            value = self._read(picture.camera, picture.step)
            if picture.background != NO_STEP:
                value = value - self._read(picture.camera, picture.background)
        except (InputError, KeyError):
            return float("nan")
        return float(np.quantile(value, LIT_QUANTILE))

    def _read(self, name: str, step: int) -> Float64:
        """Mean of the channels, 0 at black and 1 at white; OpenEXR files hold such values."""
        path = self._frames[name, step]
        value = np.asarray(read_frame(path).mean(axis=-1, dtype=float))
        if is_linear(path):
            return value
        camera = self._cameras[name]
        black = float(camera.get("black_level", 0.0))
        white = float(
            camera.get("white_level", 2 ** int(camera.get("bit_depth", 16)) - 1)
        )
        return (value - black) / (white - black)


def failed_lights(
    schedule: Schedule, levels: Levels, dome: Mapping[str, Any], *, lamp: bool
) -> dict[str, str]:
    """Lights that failed or stayed on, with a description; `DARK` if the last dark frame is bright.

    Each light is measured with the camera nearest to it, which sees the side that it lights, and is
    compared with the lights around it. Beside a steady lamp, one that stayed on cannot be detected.

    Parameters
    ----------
    schedule
        Steps of the session, with dark frames before and after the lights.
    levels
        Brightness of their frames.
    dome
        Content of dome.json of the set-up.
    lamp
        Whether a steady lamp is on.
    """
    exposure = (
        usable_exposure(schedule, levels, dome) if lamp else _longest_exposure(dome)
    )
    pictures = _light_pictures(schedule, dome, exposure, lamp=lamp)
    taken = {
        light: picture for light, picture in pictures.items() if levels.has(picture)
    }
    lit = dict(zip(taken, levels.of(list(taken.values())), strict=True))
    failed = _darker_lights(lit, dome, lowest=0.0 if levels.linear else MIN_LEVEL)
    readable = [level for level in lit.values() if not np.isnan(level)]
    last_step = len(schedule.steps) - 1
    witness = Picture(str(dome["cameras"][0]["id"]), last_step)
    if (
        lamp
        or not readable
        or schedule.steps[last_step].light != DARK
        or not levels.has(witness)
    ):
        return failed
    level = levels.of([witness])[0]
    usual = float(np.median(readable))
    limit = (
        MAX_STUCK * usual * _ratio(dome, schedule.steps[last_step].exposure, exposure)
    )
    if not level <= limit:
        text = "no readable picture" if np.isnan(level) else f"{level:.1%} of white"
        failed[DARK] = f"{text} in the last dark frame of camera {witness.camera}"
    return failed


def lamp_brightness(
    schedule: Schedule, levels: Levels, dome: Mapping[str, Any]
) -> float:
    """Brightness of a steady lamp relative to the light beside which it is darkest; NaN if unknown.

    Each light is measured with the camera nearest to it, above a dark frame of the same exposure.
    The lamp is measured in the last dark frame of the same camera.

    Parameters
    ----------
    schedule, levels, dome
        As in `failed_lights`.
    """
    exposure = usable_exposure(schedule, levels, dome)
    pictures = _light_pictures(schedule, dome, exposure, lamp=True)
    if not pictures:
        return float("nan")
    last_step = len(schedule.steps) - 1
    light = levels.of(list(pictures.values()))
    lamp = levels.of(
        [Picture(picture.camera, last_step) for picture in pictures.values()]
    )
    lamp = lamp * _ratio(dome, exposure, schedule.steps[last_step].exposure)
    if not (light > 0).all():  # also if one is NaN
        return float("nan")
    return float((lamp / light).min())


def dark_levels(
    schedule: Schedule, levels: Levels, dome: Mapping[str, Any]
) -> dict[str, float]:
    """Level of the first dark frame of every exposure, in the brightest camera."""
    cameras = [str(camera["id"]) for camera in dome["cameras"]]
    steps = _dark_steps(schedule).items()
    return {
        name: float(levels.of([Picture(c, step) for c in cameras]).max())
        for name, step in steps
    }


def usable_exposure(schedule: Schedule, levels: Levels, dome: Mapping[str, Any]) -> str:
    """The longest exposure in which the lamp leaves room for a light; "" if there is none."""
    usable = ""
    longest = 0.0
    for exposure, level in dark_levels(schedule, levels, dome).items():
        if _seconds(dome, exposure) > longest and level <= MAX_LAMP_LEVEL:
            usable = exposure
            longest = _seconds(dome, exposure)
    return usable


def _light_pictures(
    schedule: Schedule, dome: Mapping[str, Any], exposure: str, *, lamp: bool
) -> dict[str, Picture]:
    """The picture in which each light is measured, above a dark frame if a lamp is on."""
    # light -> the camera that sees most of the side that it lights
    names = [str(camera["id"]) for camera in dome["cameras"]]
    poses = [
        (np.array(camera["R"]), np.array(camera["t"])) for camera in dome["cameras"]
    ]
    centres = [_unit(-rotation.T @ shift) for rotation, shift in poses]
    viewers = {}
    for light in dome["lights"]:
        cosines = np.stack(centres) @ _unit(light["position"])
        viewers[str(light["id"])] = names[int(cosines.argmax())]
    background = _dark_steps(schedule).get(exposure, NO_STEP) if lamp else NO_STEP
    pictures = {}
    for i, step in enumerate(schedule.steps):
        if step.light in viewers and step.exposure == exposure:
            pictures[step.light] = Picture(viewers[step.light], i, background)
    return pictures


def _darker_lights(
    lit: Mapping[str, float], dome: Mapping[str, Any], *, lowest: float
) -> dict[str, str]:
    """Lights whose pictures are black or much darker than those of their neighbours."""
    failed = {
        name: "its picture cannot be read"
        for name, level in lit.items()
        if np.isnan(level)
    }
    level = {name: value for name, value in lit.items() if name not in failed}
    if level and not np.median(list(level.values())) > lowest:
        return failed | dict.fromkeys(
            level, "its picture is black, like those of most lights"
        )
    places = {str(light["id"]): _unit(light["position"]) for light in dome["lights"]}
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


def _dark_steps(schedule: Schedule) -> dict[str, int]:
    """First dark frame of each exposure."""
    dark = dict[str, int]()
    for i, step in enumerate(schedule.steps):
        if step.light == DARK:
            dark.setdefault(step.exposure, i)
    return dark


def _longest_exposure(dome: Mapping[str, Any]) -> str:
    return str(
        max(dome["exposures"], key=lambda exposure: float(exposure["seconds"]))["id"]
    )


def _seconds(dome: Mapping[str, Any], exposure: str) -> float:
    return next(
        float(entry["seconds"])
        for entry in dome["exposures"]
        if str(entry["id"]) == exposure
    )


def _ratio(dome: Mapping[str, Any], exposure: str, reference: str) -> float:
    """Length of an exposure relative to another one."""
    return _seconds(dome, exposure) / _seconds(dome, reference)


def _unit(vector: Sequence[float] | Float64) -> Float64:
    direction = float64(vector)
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-12))


def measure_lamp(dome: Dome, cameras: Cameras, setup: Setup, stated: int) -> float:
    """Measure the brightness of the steady lamp relative to one light.

    The lamp must first be visible in dark frames. A few lights are then flashed at a rate that is
    safe without a lamp, and compared with it.

    Parameters
    ----------
    dome, cameras, setup
        The devices and the calibrated laboratory.
    stated
        Brightness that the operator stated.

    Raises
    ------
    InputError
        If no lamp is on, or if it is too bright for the cameras or much darker than stated.
    """
    exposure = _require_visible(dome, cameras, setup, stated)
    lights = setup.lights[:: -(-len(setup.lights) // REFERENCE_LIGHTS)]
    flashes = slowed_schedule(
        plan_schedule(lights, {exposure: setup.exposures[exposure]})
    )
    schedule = with_dark_frames(flashes, count=1)
    run = capture_dome(dome, cameras, schedule)
    require_complete(run, setup.cameras)
    brightness = lamp_brightness(schedule, Levels(run.frames, setup.dome), setup.dome)
    if not brightness >= MIN_LAMP * stated:
        text = f"{brightness:.1f} lights"
        if np.isnan(brightness):
            text = "lights that are not visible beside it"
        raise input_error(
            "steady lamp",
            f"must be as bright as {stated} lights, and at least {MIN_LAMP:.0%} of that",
            text,
            "make it brighter, or state its brightness with --base-light",
        )
    return brightness


def _require_visible(dome: Dome, cameras: Cameras, setup: Setup, stated: int) -> str:
    """Require dark frames that show the lamp; returns the longest exposure that it does
    not fill.
    """
    schedule = plan_schedule([DARK], setup.exposures)
    run = capture_dome(dome, cameras, schedule)
    require_complete(run, setup.cameras)
    levels = Levels(run.frames, setup.dome)
    level = dark_levels(schedule, levels, setup.dome)
    filled = [name for name in level if not level[name] <= MAX_FILLED_LEVEL]
    if filled:
        raise input_error(
            "steady lamp",
            "must leave room for a light in every exposure, at most "
            f"{MAX_FILLED_LEVEL:.0%} of white",
            f"a dark frame of {level[filled[0]]:.0%} in exposure {filled[0]}",
            "shorten that exposure in dome.json, or make the lamp darker",
        )
    exposure = usable_exposure(schedule, levels, setup.dome)
    if not exposure:
        raise input_error(
            "steady lamp",
            f"must be at most {MAX_LAMP_LEVEL:.0%} of white in the shortest exposure",
            f"a dark frame of {min(level.values()):.0%}",
            "add a shorter exposure to dome.json",
        )
    if not level[exposure] > (0.0 if levels.linear else MIN_LAMP_LEVEL):
        raise input_error(
            "steady lamp",
            f"must be as bright as {stated} lights",
            f"dark frames of {max(level[exposure], 0.0):.1%} of white, so no lamp is on",
            "switch it on, or omit --base-light",
        )
    return exposure
