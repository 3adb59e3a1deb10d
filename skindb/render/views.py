"""Cameras and lights around a head, which need no dome."""

from __future__ import annotations

import numpy as np

from skindb.errors import input_error
from skindb.render.scene import Camera, Lights, Surface
from skindb.types import Array

# degrees of azimuth, from the front to the subject's left
VIEWS = {"front": 0.0, "three-quarter": 40.0, "left": 90.0, "right": -90.0}
DISTANCE_MM = 900.0  # of a camera or a light, as in photographs of a person who sits
DISC_MM = 15.0  # radius of a light
ASPECT = 1.25  # height of a picture over its width
MARGIN = 1.08  # of the picture over the head
SWING_DEGREES = 50.0  # of a turntable, to both sides of the front
FRAMES = 24
VIEW_PX = 480  # width of a picture


def turntable_azimuths() -> Array:
    """Azimuths [degrees] of the frames of a turntable, whose end joins its beginning."""
    return SWING_DEGREES * np.sin(2 * np.pi * np.arange(FRAMES) / FRAMES)


def direction(azimuth: float, elevation: float = 0.0) -> Array:
    """Unit direction (3,) at an azimuth, from the front to the subject's left, and an elevation
    [degrees].
    """
    turn, rise = np.radians([azimuth, elevation])
    level = np.cos(rise)
    return np.array([level * np.sin(turn), np.sin(rise), level * np.cos(turn)])


def camera_around(surface: Surface, azimuth: float, width: int) -> Camera:
    """A camera at the height of the middle of a surface, which it fits from every azimuth."""
    low = surface.vertices.min(axis=0)
    high = surface.vertices.max(axis=0)
    middle = (low + high) / 2
    about = np.hypot(*(surface.vertices - middle)[:, [0, 2]].T).max()
    height = round(ASPECT * width)
    tall = (high - low)[1] / 2
    zoom = (DISTANCE_MM - about) / MARGIN * min(height / 2 / tall, width / 2 / about)
    towards = direction(azimuth)
    R = np.stack([direction(azimuth + 90), [0.0, -1, 0], -towards])
    K = np.array([[zoom, 0, width / 2], [0, zoom, height / 2], [0, 0, 1]])
    eye = middle + DISTANCE_MM * towards
    camera = Camera(K, R, -R @ eye, np.zeros(5), width, height)
    return camera.scaled(1.0)  # which checks its size


def light_from(surface: Surface, text: str) -> Lights:
    """A light of radiant intensity 1e6 at "AZIMUTH,ELEVATION" in degrees.

    Raises
    ------
    InputError
        If the text is not two such numbers.
    """
    try:
        azimuth, elevation = map(float, text.split(","))
        inside = abs(azimuth) <= 180 and abs(elevation) <= 90
    except ValueError:
        inside = False
    if not inside:
        rule = "must be an azimuth in [-180, 180] and an elevation in [-90, 90] degrees"
        raise input_error("light_from", rule, repr(text), "give, for example, 45,20")
    towards = direction(azimuth, elevation)
    place = surface.vertices.mean(axis=0) + DISTANCE_MM * towards
    power = np.full((1, 3), 1e6)
    return Lights(place[None], power, np.full(1, DISC_MM), -towards[None], np.zeros(1))
