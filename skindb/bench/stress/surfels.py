"""Surfels with samples of the model, shared by the stress cases of the fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.fit.surface import MIN_SAMPLES, NOISE_FLOOR_SURFACE
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Block, Comparison, SurfaceFit
from skindb.reflectance.tables import lookup

Array = NDArray[Any]
ETA = 1.3
CHOSEN = [3, 12, 20, 31, 44, 57]  # six of the embedded materials
WEIGHT = np.array([0.2, 0.0, 0.1, 0.0, 0.3, 0.0])
DIFFUSE = np.array([0.5, 0.33, 0.24])


def spiral(n: int, top: float) -> Array:
    """(n, 3) directions, evenly spread around +z down to the cosine `top`."""
    z = 1 - (np.arange(n) + 0.5) / n * (1 - top)
    phi = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def unit(v: Array) -> Array:
    """Vectors (..., 3) of length one."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def six() -> Array:
    """Tables (nh, nd, np, 6) without the padding that the kernels need."""
    return six_tables().table[..., : len(CHOSEN)]


@lru_cache(maxsize=1)
def six_tables() -> Mixture:
    """Six of the embedded materials, not reduced."""
    whole = embedded_dictionary()
    return Mixture(whole.table[..., CHOSEN])


@dataclass(frozen=True)
class Surfels:
    """Three surfels with noise-free samples of the model, all well above the horizon."""

    sample: Array
    position: Array
    light: Array
    camera: Array
    normal: Array
    diffuse: Array

    @property
    def block(self) -> Block:
        """The surfels for the fit of a surface model."""
        return Block(
            self.sample,
            self.position,
            self.light,
            self.camera,
            self.normal,
            self.diffuse,
        )


def surfels(
    lights: int = 40, cameras: int = 6, *, eta: float = ETA, weight: Array = WEIGHT
) -> Surfels:
    """Three surfels with different positions and normals; `weight` (6,) of the six materials."""
    position = np.array([[0.0, 0, 0], [40, 10, -5], [-30, 20, -8]])
    normal = unit(np.array([[0.0, 0, 1], [0.3, 0.1, 1], [-0.2, 0.2, 1]]))
    light = 900 * spiral(lights, 0.6)
    camera = 800 * spiral(cameras, 0.7)
    diffuse = np.tile(DIFFUSE, (3, 1))
    wi = unit(light - position[:, None])
    wo = unit(camera - position[:, None])
    ci = np.einsum("nk,ntk->nt", normal, wi)
    co = np.einsum("nk,ntk->nt", normal, wo)
    a, b, n = np.broadcast_arrays(wi[:, :, None], wo[:, None], normal[:, None, None])
    surface = lookup(six(), *half_difference(a, b, n)) @ weight
    through = (
        fresnel_transmittance(ci, eta)[:, :, None]
        * fresnel_transmittance(co, eta)[:, None]
    )
    value = through[..., None] * diffuse[:, None, None] / np.pi + surface[..., None]
    sample = (ci[:, :, None, None] * value).astype(np.float32)
    return Surfels(sample, position, light, camera, normal, diffuse)


def weights(
    skin: Surfels, mode: str = "linear", model: Mixture | None = None, **options: Any
) -> SurfaceFit:
    """Fit of the six materials, or of `model`, to the surfels."""
    comparison = Comparison(mode, ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES)
    comparison = comparison._replace(**options)
    return (model or six_tables()).fit(skin.block, comparison)


def spoiled(skin: Surfels, change: Callable[[Array], None]) -> Surfels:
    """Copy of the surfels with the samples of the first one changed."""
    sample = skin.sample.copy()
    change(sample[0])
    return replace(skin, sample=sample)


def filled(value: float) -> Callable[[Array], None]:
    """Change for `spoiled` that sets every sample to `value`."""
    return lambda sample: sample.fill(value)


def first(skin: Surfels, value: float) -> Surfels:
    """Copy of the surfels with one channel of one sample of the first one changed."""

    def change(sample: Array) -> None:
        sample[1, 2, 1] = value

    return spoiled(skin, change)


def rows(skin: Surfels, s: int) -> tuple[Array, Array]:
    """Rows and targets of one surfel, computed with NumPy."""
    wi = unit(skin.light - skin.position[s])
    wo = unit(skin.camera - skin.position[s])
    a, b = np.broadcast_arrays(wi[:, None], wo[None])
    ci = wi @ skin.normal[s]
    co = wo @ skin.normal[s]
    M = lookup(six(), *half_difference(a, b, skin.normal[s])) * ci[:, None, None]
    shape = (
        (ci * fresnel_transmittance(ci, ETA))[:, None]
        * fresnel_transmittance(co, ETA)
        / np.pi
    )
    target = skin.sample[s].astype(np.float64) - shape[..., None] * skin.diffuse[s]
    return M.reshape(-1, M.shape[-1]), target.reshape(-1, 3)
