"""Photographs of real objects and faces under known lights, for `benchmarks/real.py`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from skimage.io import imread

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# of 255; darker pixels are in shadow or show little more than ambient light
DARKEST = 8
BRIGHTEST = 250  # of 255; brighter pixels may be clipped
FACE_STEP = 4  # every fourth pixel in either direction
CAT_STEP = 2
SPHERE_STEP = 3
# z of the direction to a light of the faces; others shine from behind
MIN_FRONTAL = 0.2
HELD_OUT_EVERY = 5  # lights


@dataclass(frozen=True)
class Photographs:
    """Pixels of one object under several distant lights, seen by one distant camera in
    the direction +z.
    """

    name: str
    # (pixel, light, channel) value of a white matt facing surface: 1 / pi
    sample: Array
    usable: Mask  # (pixel, light)
    light: Array  # (light, 3) unit directions
    light_name: tuple[str, ...]
    held_out: Mask  # (light,)
    normal: Array | None = None  # (pixel, 3) measured

    @property
    def grey(self) -> Array:
        """Mean of the channels (pixel, light)."""
        return self.sample.mean(axis=2)

    def with_lights(self, chosen: NDArray[np.intp]) -> Photographs:
        """The photographs under some of the lights."""
        return replace(
            self,
            sample=self.sample[:, chosen],
            usable=self.usable[:, chosen],
            light=self.light[chosen],
            light_name=tuple(self.light_name[i] for i in chosen),
            held_out=self.held_out[chosen],
        )

    def divided_by(self, gain: Array) -> Photographs:
        """The photographs divided by a gain (light,) of each light."""
        return replace(self, sample=self.sample / gain[:, None])


def faces(folder: Path) -> list[Photographs]:
    """The faces of Extended Yale B: FOLDER/yaleB<NN>.npz with 8-bit linear pictures and
    angles of the strobes.
    """
    return [_face(path) for path in sorted(folder.glob("yaleB*.npz"))]


def _face(path: Path) -> Photographs:
    with np.load(path) as archive:
        image = archive["image"][:, ::FACE_STEP, ::FACE_STEP]
        azimuth = np.radians(archive["azimuth_degree"])
        elevation = np.radians(archive["elevation_degree"])
        degrees = zip(
            archive["azimuth_degree"], archive["elevation_degree"], strict=True
        )
    names = [f"{a:+.0f}{e:+.0f}" for a, e in degrees]
    across = -np.sin(azimuth) * np.cos(elevation)
    towards = np.cos(azimuth) * np.cos(elevation)
    light = np.stack([across, np.sin(elevation), towards], axis=1)
    frontal = np.flatnonzero(towards >= MIN_FRONTAL)
    value = image[frontal].reshape(len(frontal), -1).T
    return Photographs(
        name=path.stem,
        sample=value[:, :, None] / 255 / np.pi,
        usable=(value > DARKEST) & (value < BRIGHTEST),
        light=light[frontal],
        light_name=tuple(names[i] for i in frontal),
        held_out=_every_fifth(len(frontal)),
    )


def cat(folder: Path) -> Photographs:
    """The cat of DiLiGenT: FOLDER/cat.npz with linear 16-bit pictures, intensities and
    measured normals.
    """
    with np.load(folder / "cat.npz") as archive:
        mask = archive["mask"].copy()
        mask[1::CAT_STEP] = False
        mask[:, 1::CAT_STEP] = False
        value = archive["image"][:, mask].astype(np.float64)
        intensity = archive["light_intensity"].astype(np.float64)
        light = archive["light_direction"].astype(np.float64)
        normal = archive["normal"][mask].astype(np.float64)
    sample = (value / intensity[:, None]).transpose(1, 0, 2)
    grey = sample.mean(axis=2)
    bright = np.quantile(grey, 0.999)
    dark = bright * DARKEST / 255
    clipped = (value >= 65535).any(axis=2).T
    return Photographs(
        name="cat",
        sample=sample / bright / np.pi,
        usable=(grey > dark) & ~clipped,
        light=_unit(light),
        light_name=tuple(str(i) for i in range(len(light))),
        held_out=_every_fifth(len(light)),
        normal=_unit(normal),
    )


def gray_sphere(folder: Path) -> Photographs:
    """The gray sphere of the UW set; its normals follow from its outline, and its
    pictures are taken as linear.
    """
    light = _unit(np.loadtxt(folder / "light_directions_chrome.csv", delimiter=","))
    mask = imread(folder / "gray" / "gray.mask.png")[..., :3].max(axis=2) > 127
    pictures = [
        imread(folder / "gray" / f"gray.{k}.png")[..., :3][mask]
        for k in range(len(light))
    ]
    value = np.stack(pictures, axis=1)
    row, column = np.nonzero(mask)
    radius = np.sqrt(mask.sum() / np.pi)
    x = (column - column.mean()) / radius
    y = (row.mean() - row) / radius
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=1)
    chosen = np.flatnonzero((row % SPHERE_STEP == 0) & (column % SPHERE_STEP == 0))
    usable = (value.min(axis=2) > DARKEST) & (value.max(axis=2) < BRIGHTEST)
    return Photographs(
        name="gray sphere",
        sample=value[chosen] / 255 / np.pi,
        usable=usable[chosen],
        light=light,
        light_name=tuple(str(i) for i in range(len(light))),
        held_out=np.zeros(len(light), np.bool_),
        normal=normal[chosen],
    )


def spread_lights(light: Array, count: int) -> NDArray[np.intp]:
    """Indices of `count` lights that are far apart, beginning with the most frontal one."""
    chosen = [int(light[:, 2].argmax())]
    while len(chosen) < count:
        nearest = (light @ light[chosen].T).max(axis=1)
        chosen.append(int(nearest.argmin()))
    return np.sort(np.array(chosen))


def _every_fifth(count: int) -> Mask:
    return np.arange(count) % HELD_OUT_EVERY == 0


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
