"""The virtual dome: lights and cameras on a sphere around the head, one device for all takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.limits import MAX_CAMERAS, MAX_FRAMES, MAX_LIGHTS, MAX_VIRTUAL_PIXELS

Array = NDArray[np.float64]
CENTRE = np.array([0.0, -8.0, 45.0])  # of the dome in the subject frame, mm
# mm
LIGHT_RADIUS = 880.0
CAMERA_RADIUS = 830.0
DISC_RADIUS = 12.5  # mm
INTENSITY = 6.0e7  # radiance mm2
# half axes of the ellipsoid that every camera frames, mm
HEAD = np.array([96.0, 138.0, 92.0])
EXPOSURES = 2  # of every view
FRONT = 78.0  # degrees: lights farther from the front would not reach the white target


@dataclass(frozen=True)
class DomeCamera:
    """A pinhole camera with OpenCV distortion; x_cam = R x + t, pixel centres at integer + 0.5."""

    name: str
    width: int
    height: int
    matrix: Array  # (3, 3) pixel
    rotation: Array  # (3, 3)
    translation: Array  # (3,) mm
    distortion: Array  # (5,) k1 k2 p1 p2 k3
    vignette: Array  # (3,) a2 a4 a6

    @property
    def position(self) -> Array:
        """Centre of projection (3,) mm."""
        return np.asarray(-self.rotation.T @ self.translation)


@dataclass(frozen=True)
class DomeLight:
    """A disc light that faces the centre, with equal intensity in all directions."""

    name: str
    position: Array  # (3,) mm
    axis: Array  # (3,) unit, the direction it shines along
    intensity: Array  # (3,) radiance mm2
    disc_radius: float = DISC_RADIUS


@dataclass(frozen=True)
class Dome:
    """Lights and cameras of a virtual dome."""

    cameras: tuple[DomeCamera, ...]
    lights: tuple[DomeLight, ...]


def build_dome(
    lights: int = 48,
    cameras: int = 8,
    *,
    width: int = 160,
    height: int = 200,
    rng: np.random.Generator,
) -> Dome:
    """A dome of any size with small individual deviations; the same `rng` state gives
    the same device.

    Parameters
    ----------
    lights, cameras
        Numbers of devices; lights cover the front up to 78 degrees, cameras up to 60 degrees.
    width, height
        Image size in pixels.
    rng
        Deviations of positions, intensities and lenses.

    Raises
    ------
    InputError
        If a capture with this dome could not be ingested, or if a frame would not fit into memory.
    """
    require_sizes(lights, cameras, width, height)
    lamps = _spiral(lights, np.radians(FRONT), turn=0.0)
    eyes = _spiral(cameras, np.radians(60.0), turn=0.7)
    eyes[:, 1] *= 0.7  # concentrated around the head rather than above and below it
    eyes /= np.linalg.norm(eyes, axis=1, keepdims=True)
    return Dome(
        tuple(
            _camera(i, e, width, height, rng) for i, e in enumerate(_apart(eyes, lamps))
        ),
        tuple(_light(i, d, rng) for i, d in enumerate(lamps)),
    )


def require_sizes(lights: int, cameras: int, width: int, height: int) -> None:
    """Require sizes within the limits of captures, before memory is allocated for them.

    Raises
    ------
    InputError
        With the first size beyond its limit.
    """
    views = MAX_FRAMES // EXPOSURES
    for what, size, most in (
        ("lights", lights, MAX_LIGHTS),
        ("cameras", cameras, MAX_CAMERAS),
        ("lights x cameras", lights * cameras, views),
        ("width x height", width * height, MAX_VIRTUAL_PIXELS),
    ):
        if not 1 <= size <= most:
            raise InputError(
                Fault(
                    "virtual dome",
                    f"{what} must be 1 to {most:,}",
                    f"{size:,}",
                    "choose another number",
                )
            )


def _spiral(count: int, reach: float, *, turn: float) -> Array:
    """`count` unit directions spread evenly over the cap within `reach` of +z
    (golden-angle spiral).
    """
    k = np.arange(count)
    cosine = 1 - (k + 0.5) / count * (1 - np.cos(reach)) if count > 1 else np.ones(1)
    angle = k * np.pi * (3 - 5**0.5) + turn
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)


def _apart(eyes: Array, lamps: Array) -> Array:
    """Rotate cameras about +z if a light obstructs their view (a light's disc is 1.6
    degrees wide).
    """
    turn = np.radians(1.5)
    spin = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    lift = np.array(
        [[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]]
    )
    out = eyes.copy()
    for i in range(len(out)):
        for step in range(60):
            if (lamps @ out[i]).max() < np.cos(np.radians(3.0)):
                break
            out[i] = (spin if step % 2 else lift) @ out[i]
    return out


def _light(index: int, direction: Array, rng: np.random.Generator) -> DomeLight:
    position = (
        CENTRE + direction * (LIGHT_RADIUS + rng.normal(0, 3)) + rng.normal(0, 1.5, 3)
    )
    axis = (CENTRE - position) / np.linalg.norm(CENTRE - position)
    level = rng.uniform(0.85, 1.15) * (
        np.array([1.0, 0.97, 1.03]) + 0.02 * rng.standard_normal(3)
    )
    return DomeLight(f"l{index:03d}", position, axis, INTENSITY * level)


def _camera(
    index: int, direction: Array, width: int, height: int, rng: np.random.Generator
) -> DomeCamera:
    eye = CENTRE + direction * (CAMERA_RADIUS + rng.normal(0, 5))
    rotation = _look_at(
        eye, CENTRE + rng.normal(0, 1.5, 3), np.radians(rng.normal(0, 1.0))
    )
    # half extents of the framed ellipsoid as this camera sees it (small-angle: the head
    # is a tenth of the distance)
    extent = np.linalg.norm(rotation[:2] * HEAD, axis=1) / np.linalg.norm(eye - CENTRE)
    focal = 0.97 * min(width / (2 * extent[0]), height / (2 * extent[1]))
    k = np.array(
        [
            [focal, 0.0, width / 2 + rng.normal(0, 0.004 * width)],
            [
                0.0,
                focal * (1 + rng.normal(0, 1e-3)),
                height / 2 + rng.normal(0, 0.004 * width),
            ],
            [0.0, 0.0, 1.0],
        ]
    )
    lens = np.array(
        [rng.normal(-0.1, 0.05), rng.normal(0.02, 0.05), *rng.normal(0, 5e-4, 2), 0.0]
    )
    shade = np.array([rng.normal(-0.10, 0.01), rng.normal(0.02, 0.003), 0.0])
    return DomeCamera(
        f"c{index:02d}", width, height, k, rotation, -rotation @ eye, lens, shade
    )


def _look_at(eye: Array, target: Array, roll: float) -> Array:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c = np.cos(roll)
    s = np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward])
