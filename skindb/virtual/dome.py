"""The virtual dome: lights and cameras on a sphere around the head, one device for all takes;
its frames, with exposure behind the lens, noise, saturation, quantisation and black level;
and the white target.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import cycle, product
from pathlib import Path

import imagecodecs
import numpy as np
from scipy.spatial.transform import Rotation

from skindb.files import make_private, private_file
from skindb.geometry.rays import RayScene
from skindb.parameters import require_sizes
from skindb.render.scene import Camera, Lights, Surface
from skindb.render.shading import exitances, polariser_factor, shade_view, trace_view
from skindb.types import Float32, Float64, Values16, lengths, unit

CENTRE = np.array([0.0, -8.0, 45.0])  # of the dome in the subject frame, mm
# mm
LIGHT_RADIUS = 880.0
CAMERA_RADIUS = 830.0
DISC_RADIUS = 12.5  # mm
LEAK = 0.005  # of the polarisers: light of the other handedness over all that passes
INTENSITY = 6.0e7  # radiance mm2
DEGREES = {None: 0.0, "left": 2 * LEAK - 1, "right": 1 - 2 * LEAK}
# half axes of the ellipsoid that every camera frames, mm
HEAD = np.array([96.0, 138.0, 92.0])
EXPOSURES = ("e0", "e1")  # of every view
FRONT = 78.0  # degrees: lights farther from the front would not reach the white target
Image = Float32
SECONDS = (0.040, 0.005)
FRAMES = "dome/frames/{exposure}/{light}_{camera}.png"
DARK = "dome/dark/{exposure}_{camera}.png"
WHITE = "dome/white/{exposure}/{light}_{camera}.png"
DARK_AVERAGE = 16
TARGET_REFLECTANCE = 0.99
TARGET_HALF_SIZE = 60.0
TARGET_NORMAL = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class DomeCamera(Camera):
    """A camera of the dome."""

    name: str
    vignette: Float64  # (3,) a2 a4 a6
    polariser: str | None = None  # "left" or "right", circular

    @property
    def polarisation(self) -> float:
        """Degree of circular polarisation of the light that it sees, 1 right-handed."""
        return DEGREES[self.polariser]


@dataclass(frozen=True)
class DomeLight:
    """A disc light that faces the centre, with equal intensity in all directions."""

    name: str
    position: Float64  # (3,) mm
    axis: Float64  # (3,) unit, the direction it shines along
    intensity: Float64  # (3,) radiance mm2
    disc_radius: float = DISC_RADIUS
    falloff: float = 0.0
    polariser: str | None = None

    @property
    def polarisation(self) -> float:
        """As of a camera, of the light that it sends."""
        return DEGREES[self.polariser]


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
    polarised: bool = False,
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
    polarised
        Circular polarisers: left before all lights and every other camera, which sees no
        highlights, right before the other cameras, which see twice as bright ones.
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
    eyes = unit(eyes)
    dome = Dome(
        tuple(
            _camera(i, e, width, height, rng) for i, e in enumerate(_apart(eyes, lamps))
        ),
        tuple(_light(i, d, rng) for i, d in enumerate(lamps)),
    )
    if not polarised:
        return dome
    hands = cycle(("left", "right"))
    return Dome(
        tuple(replace(camera, polariser=next(hands)) for camera in dome.cameras),
        tuple(replace(light, polariser="left") for light in dome.lights),
    )


def _spiral(count: int, reach: float, *, turn: float) -> Float64:
    """`count` unit directions spread evenly over the cap within `reach` of +z
    (golden-angle spiral).
    """
    k = np.arange(count)
    cosine = 1 - (k + 0.5) / count * (1 - np.cos(reach)) if count > 1 else np.ones(1)
    angle = k * np.pi * (3 - 5**0.5) + turn
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=1)


def _apart(eyes: Float64, lamps: Float64) -> Float64:
    """Rotate cameras about +z if a light obstructs their view (a light's disc is 1.6
    degrees wide).
    """
    spin, lift = (
        Rotation.from_euler(axis, 1.5, degrees=True).as_matrix() for axis in "zx"
    )
    out = eyes.copy()
    for i in range(len(out)):
        for step in range(60):
            if (lamps @ out[i]).max() < np.cos(np.radians(3.0)):
                break
            out[i] = (spin if step % 2 else lift) @ out[i]
    return out


def _light(index: int, direction: Float64, rng: np.random.Generator) -> DomeLight:
    position = (
        CENTRE + direction * (LIGHT_RADIUS + rng.normal(0, 3)) + rng.normal(0, 1.5, 3)
    )
    axis = (CENTRE - position) / np.linalg.norm(CENTRE - position)
    level = rng.uniform(0.85, 1.15) * (
        np.array([1.0, 0.97, 1.03]) + 0.02 * rng.standard_normal(3)
    )
    return DomeLight(f"l{index:03d}", position, axis, INTENSITY * level)


def _camera(
    index: int, direction: Float64, width: int, height: int, rng: np.random.Generator
) -> DomeCamera:
    eye = CENTRE + direction * (CAMERA_RADIUS + rng.normal(0, 5))
    rotation = _look_at(
        eye, CENTRE + rng.normal(0, 1.5, 3), np.radians(rng.normal(0, 1.0))
    )
    # half extents of the framed ellipsoid as this camera sees it (small-angle: the head
    # is a tenth of the distance)
    extent = lengths(rotation[:2] * HEAD) / np.linalg.norm(eye - CENTRE)
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
    name = f"c{index:02d}"
    return DomeCamera(k, rotation, -rotation @ eye, lens, width, height, name, shade)


def _look_at(eye: Float64, target: Float64, roll: float) -> Float64:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c = np.cos(roll)
    s = np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward])


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
    ) -> Values16:
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
        return np.clip(np.rint(value / step) * step, 0, self.white).astype(np.uint16)


def write_png(path: Path, frame: Values16) -> None:
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
    names = ("position", "intensity", "disc_radius", "axis", "falloff")
    columns = (np.array([getattr(x, name) for x in dome.lights]) for name in names)
    lights = Lights(*columns)
    white = frontal_camera(dome)
    for exposure, template in product(EXPOSURES, (FRAMES, DARK, WHITE)):
        file = folder / template.format(exposure=exposure, light="l", camera="c")
        make_private(file.parent)
    glow = exitances(surface, lights, scene) if subsurface else None

    def shoot(
        camera: DomeCamera, camera_rng: np.random.Generator, stream: np.random.Generator
    ) -> None:
        pattern = sensor.pattern((camera.height, camera.width, 3), rng=camera_rng)
        view = trace_view(surface, camera, scene=scene)
        terms = partial(shade_view, view, surface, lights, scene, disc_samples=1)
        if camera.polariser is None:
            images = terms(subsurface=subsurface, glow=glow)
        else:
            images = terms(subsurface=subsurface, glow=glow, terms=["diffuse"])
            gloss = terms(terms=["surface"])
            for i, light in enumerate(dome.lights):
                both = camera.polarisation * light.polarisation
                images[i] += gloss[i] * polariser_factor(
                    view, light.position, both, surface.eta
                )
        writer = FrameWriter(folder, camera, sensor, pattern, stream)
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


@dataclass(frozen=True)
class FrameWriter:
    """Exposes radiance images with one camera and writes the files."""

    folder: Path
    camera: DomeCamera
    sensor: Sensor
    pattern: Image
    rng: np.random.Generator

    @cached_property
    def gain(self) -> Image:
        """Loss of light (h, w, 1) towards the corners, 1 at the principal point."""
        camera = self.camera
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        half = np.hypot(camera.width, camera.height) / 2
        r2 = ((x - camera.K[0, 2]) ** 2 + (y - camera.K[1, 2]) ** 2) / half**2
        a2, a4, a6 = camera.vignette
        return np.asarray(1 + r2 * (a2 + r2 * (a4 + r2 * a6)), np.float32)[..., None]

    def exposed(
        self, radiance: Image, seconds: float, *, averaged: int = 1
    ) -> Values16:
        """A frame of a radiance image."""
        image = radiance * self.gain * np.float32(seconds)
        return self.sensor.expose(image, self.pattern, averaged=averaged, rng=self.rng)

    def write(
        self, template: str, light: str, radiance: Image, *, averaged: int = 1
    ) -> None:
        """Write the exposures of one view."""
        for exposure, seconds in zip(EXPOSURES, SECONDS, strict=True):
            frame = self.exposed(radiance, seconds, averaged=averaged)
            names = {"exposure": exposure, "light": light, "camera": self.camera.name}
            write_png(self.folder / template.format(**names), frame)


def frontal_camera(dome: Dome) -> DomeCamera:
    """The camera that sees the white target most frontally."""
    return max(
        dome.cameras,
        key=lambda c: float((c.centre - CENTRE)[2] / np.linalg.norm(c.centre - CENTRE)),
    )


def _target_radiances(
    camera: DomeCamera, lights: Iterable[DomeLight]
) -> Iterator[Image]:
    """A Lambertian white square in the middle of the dome, alone, under each light."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    ray = camera.rays(pixels)
    reach = ((CENTRE - camera.centre) @ TARGET_NORMAL) / (ray @ TARGET_NORMAL)
    point = camera.centre + reach[:, None] * ray
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
