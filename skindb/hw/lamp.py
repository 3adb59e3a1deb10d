"""A steady lamp, beside which lights are no flashes: it is measured before the lights
flash fast.
"""

from __future__ import annotations

import numpy as np

from skindb.errors import Fault, InputError
from skindb.hw.brightness import (
    MAX_LAMP_LEVEL,
    Levels,
    dark_levels,
    lamp_brightness,
    usable_exposure,
)
from skindb.hw.cameras import Cameras
from skindb.hw.capture_folder import Setup
from skindb.hw.dome import Dome
from skindb.hw.safety import slowed_schedule
from skindb.hw.sequence import DARK, plan_schedule
from skindb.hw.session import capture_dome, require_complete, with_dark_frames

# measured over stated brightness: cameras see lamp and lights from different sides
MIN_LAMP = 0.5
# of a dark frame relative to white: with a light, a tenth of the lamp, it is white
MAX_FILLED_LEVEL = 0.9
MIN_LAMP_LEVEL = 0.005  # of a dark frame relative to white, below which no lamp is on
REFERENCE_LIGHTS = 4  # flashed at the safe rate of three in a second


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
        rule = (
            f"must be as bright as {stated} lights, and at least {MIN_LAMP:.0%} of that"
        )
        cure = "make it brighter, or state its brightness with --base-light"
        raise InputError(Fault("steady lamp", rule, text, cure))
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
        rule = (
            "must leave room for a light in every exposure, at most "
            f"{MAX_FILLED_LEVEL:.0%} of white"
        )
        cure = "shorten that exposure in dome.json, or make the lamp darker"
        text = f"a dark frame of {level[filled[0]]:.0%} in exposure {filled[0]}"
        raise InputError(Fault("steady lamp", rule, text, cure))
    exposure = usable_exposure(schedule, levels, setup.dome)
    if not exposure:
        rule = f"must be at most {MAX_LAMP_LEVEL:.0%} of white in the shortest exposure"
        text = f"a dark frame of {min(level.values()):.0%}"
        raise InputError(
            Fault("steady lamp", rule, text, "add a shorter exposure to dome.json")
        )
    if not level[exposure] > (0.0 if levels.linear else MIN_LAMP_LEVEL):
        rule = f"must be as bright as {stated} lights"
        text = (
            f"dark frames of {max(level[exposure], 0.0):.1%} of white, so no lamp is on"
        )
        raise InputError(
            Fault("steady lamp", rule, text, "switch it on, or omit --base-light")
        )
    return exposure
