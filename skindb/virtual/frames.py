"""Frames of the virtual cameras: exposure behind the lens, noise, saturation, quantisation
and black level; and the white target.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from skindb.files import make_private, private_file
from skindb.geometry.camera import pixel_rays
from skindb.geometry.rays import RayScene
from skindb.render.direct import render_view
from skindb.render.scene import Camera, Lights, Surface
from skindb.render.subsurface import exitances
from skindb.virtual.dome import CENTRE, Dome, DomeCamera, DomeLight

Image = NDArray[np.float32]
SECONDS = (0.040, 0.005)
EXPOSURES = ("e0", "e1")
FRAMES = "dome/frames/{exposure}/{light}_{camera}.png"
DARK = "dome/dark/{exposure}_{camera}.png"
WHITE = "dome/white/{exposure}/{light}_{camera}.png"
DARK_AVERAGE = 16
TARGET_REFLECTANCE = 0.99
TARGET_HALF_SIZE = 60.0
TARGET_NORMAL = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Sensor:
    """Levels are values of the 16-bit file; exposure 1 (radiance times seconds) reaches
    the white level.
    """

    black: int = 1024
    white: int = 65520
    step: int = 16  # a 12-bit converter, left-justified in 16 bits
    full_well: float = 20000.0  # electrons
    read_noise: float = 6.0  # electrons
    pattern_noise: float = 2.0  # electrons, the same in every frame of a camera
    noisy: bool = True

    @property
    def electrons_per_dn(self) -> float:
        """Electrons per value of the file."""
        return self.full_well / (self.white - self.black)

    def pattern(self, shape: tuple[int, ...], *, rng: np.random.Generator) -> Image:
        """Fixed offset of every photosite, electrons."""
        return rng.standard_normal(shape, np.float32) * np.float32(
            self.pattern_noise if self.noisy else 0.0
        )

    def expose(
        self,
        exposure: Image,
        pattern: Image,
        *,
        averaged: int = 1,
        rng: np.random.Generator,
    ) -> NDArray[np.uint16]:
        """File values of an image of exposures; with `averaged` > 1 the mean of that
        many frames (finer steps).
        """
        electrons = exposure * np.float32(self.full_well)
        if self.noisy:
            sigma = np.sqrt(
                (np.maximum(electrons, 0) + np.float32(self.read_noise**2))
                / np.float32(averaged)
            )
            electrons = (
                electrons
                + pattern
                + sigma * rng.standard_normal(exposure.shape, np.float32)
            )
        step = self.step if averaged == 1 else 1
        value = np.float32(self.black) + electrons / np.float32(self.electrons_per_dn)
        return np.asarray(
            np.clip(np.rint(value / step) * step, 0, self.white).astype(np.uint16)
        )


def write_png(path: Path, frame: NDArray[np.uint16]) -> None:
    """Write a 16-bit RGB PNG quickly: sensor noise does not compress, so Huffman codes
    of differences are enough.
    """
    png = imagecodecs.PNG
    data = imagecodecs.png_encode(
        frame, level=1, strategy=png.STRATEGY.HUFFMAN_ONLY, filter=png.FILTER.SUB
    )
    private_file(path).write_bytes(data)


def photograph(
    folder: Path,
    surface: Surface,
    dome: Dome,
    *,
    sensor: Sensor,
    device_rng: np.random.Generator,
    rng: np.random.Generator,
    subsurface: bool = False,
    step: Callable[[], None],
) -> None:
    """Write every frame of every camera and light, dark frames of all cameras, white
    frames of the frontal camera.

    Parameters
    ----------
    folder
        Capture folder.
    surface, dome
        The photographed surface, and the dome.
    sensor
        Sensor of all cameras.
    device_rng, rng
        Random generators of the fixed pattern of the cameras and of the noise of this
        take, with a stream per frame.
    subsurface
        Transport diffuse light through the skin by the dipole.
    step
        Called after each camera.
    """
    scene = RayScene(surface.vertices, surface.faces)
    lights = render_lights(dome)
    white = frontal_camera(dome)
    for exposure in EXPOSURES:
        for template in (FRAMES, DARK, WHITE):
            make_private(
                (
                    folder / template.format(exposure=exposure, light="l", camera="c")
                ).parent
            )

    glow = exitances(surface, lights, scene) if subsurface else None

    def shoot(
        camera: DomeCamera, camera_rng: np.random.Generator, stream: np.random.Generator
    ) -> None:
        pattern = sensor.pattern((camera.height, camera.width, 3), rng=camera_rng)
        images = render_view(
            surface,
            _render_camera(camera),
            lights,
            samples=1,
            disc_samples=1,
            subsurface=subsurface,
            scene=scene,
            glow=glow,
        )
        writer = _FrameWriter(folder, camera, sensor, pattern, stream)
        for light, image in zip(dome.lights, images, strict=True):
            writer.write(FRAMES, light.name, image)
        writer.write(DARK, "", np.zeros_like(pattern), averaged=DARK_AVERAGE)
        if camera is white:
            for light, image in zip(
                dome.lights, _target_radiances(camera, dome.lights), strict=True
            ):
                writer.write(WHITE, light.name, image)

    # a camera at a time on each of two threads: rays, kernels and compression release
    # the interpreter
    with ThreadPoolExecutor(2) as pool:
        streams = device_rng.spawn(len(dome.cameras)), rng.spawn(len(dome.cameras))
        for _ in pool.map(shoot, dome.cameras, *streams):
            step()


class _FrameWriter:
    """Exposes radiance images with one camera and writes the files."""

    def __init__(
        self,
        folder: Path,
        camera: DomeCamera,
        sensor: Sensor,
        pattern: Image,
        rng: np.random.Generator,
    ) -> None:
        self.folder = folder
        self.camera = camera
        self.sensor = sensor
        self.pattern = pattern
        self.rng = rng
        self.gain = _vignette(camera)

    def write(
        self, template: str, light: str, radiance: Image, *, averaged: int = 1
    ) -> None:
        for exposure, seconds in zip(EXPOSURES, SECONDS, strict=True):
            image = radiance * self.gain * np.float32(seconds)
            frame = self.sensor.expose(
                image, self.pattern, averaged=averaged, rng=self.rng
            )
            path = template.format(
                exposure=exposure, light=light, camera=self.camera.name
            )
            write_png(self.folder / path, frame)


def render_lights(dome: Dome) -> Lights:
    """Convert the dome's lights for the renderer."""
    return Lights(
        np.array([light.position for light in dome.lights]),
        np.array([light.intensity for light in dome.lights]),
        np.array([light.disc_radius for light in dome.lights]),
        np.array([light.axis for light in dome.lights]),
        np.zeros(len(dome.lights)),
    )


def _render_camera(camera: DomeCamera) -> Camera:
    c = camera
    return Camera(c.matrix, c.rotation, c.translation, c.distortion, c.width, c.height)


def frontal_camera(dome: Dome) -> DomeCamera:
    """The camera that sees the white target most frontally."""
    return max(
        dome.cameras,
        key=lambda c: float(
            (c.position - CENTRE)[2] / np.linalg.norm(c.position - CENTRE)
        ),
    )


def _vignette(camera: DomeCamera) -> Image:
    """Loss of light (h, w, 1) towards the corners, 1 at the principal point."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    half = np.hypot(camera.width, camera.height) / 2
    r2 = ((x - camera.matrix[0, 2]) ** 2 + (y - camera.matrix[1, 2]) ** 2) / half**2
    a2, a4, a6 = camera.vignette
    return np.asarray(1 + r2 * (a2 + r2 * (a4 + r2 * a6)), np.float32)[..., None]


def _target_radiances(
    camera: DomeCamera, lights: Iterable[DomeLight]
) -> Iterator[Image]:
    """A Lambertian white square in the middle of the dome, alone, under each light."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    ray = pixel_rays(pixels, camera.matrix, camera.rotation, camera.distortion)
    reach = ((CENTRE - camera.position) @ TARGET_NORMAL) / (ray @ TARGET_NORMAL)
    point = camera.position + reach[:, None] * ray
    inside = np.flatnonzero(
        (np.abs((point - CENTRE)[:, :2]) <= TARGET_HALF_SIZE).all(axis=1)
    )
    for light in lights:
        towards = light.position - point[inside]
        irradiance = (
            np.maximum(towards @ TARGET_NORMAL, 0) / (towards**2).sum(axis=1) ** 1.5
        )
        radiance = np.zeros((len(point), 3), np.float32)
        radiance[inside] = (
            TARGET_REFLECTANCE / np.pi * irradiance[:, None] * light.intensity
        )
        yield radiance.reshape(camera.height, camera.width, 3)
