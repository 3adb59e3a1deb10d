"""Three surfels with samples of the model without noise, all well above the horizon."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from skindb.optics.angles import half_difference
from skindb.optics.fresnel import circular_reversal, fresnel_transmittance
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Block
from skindb.reflectance.tables import lookup

ETA = 1.3
MATERIALS = [3, 12, 20, 31, 44, 57]
WEIGHT = np.array([0.2, 0.0, 0.1, 0.0, 0.3, 0.0])  # of the six materials
MATTE = 0 * WEIGHT
SCALES = (1e-30, 1e-12, 1e12, 1e30)


def unit(v):
    """Vectors (..., 3) of length one."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _spiral(n, lowest):
    """(n, 3) directions, evenly spread around +z down to the cosine `lowest`."""
    z = 1 - (np.arange(n) + 0.5) / n * (1 - lowest)
    phi = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


@lru_cache(maxsize=1)
def six_tables():
    """Tables (nh, nd, np, 6) of six of the embedded materials."""
    return np.ascontiguousarray(embedded_dictionary().table[..., MATERIALS])


@lru_cache(maxsize=1)
def six_materials():
    """The surface model of the six materials, not reduced."""
    return Mixture(six_tables())


@dataclass(frozen=True)
class Surfels:
    """Samples (3, light, camera, channel) and the geometry of three surfels."""

    sample: np.ndarray
    position: np.ndarray
    light: np.ndarray
    camera: np.ndarray
    normal: np.ndarray
    diffuse: np.ndarray

    @property
    def block(self):
        """The surfels for the fit of a surface model."""
        return Block(*vars(self).values())

    @property
    def empty(self):
        """The same arrays of no surfel."""
        names = ("sample", "position", "normal", "diffuse")
        return replace(self, **{name: getattr(self, name)[:0] for name in names})

    def filled(self, value):
        """Copy in which every sample of the first surfel is `value`."""
        return self.with_sample(np.s_[0], value)

    def spoiled(self, value):
        """Copy in which one channel of one sample of the first surfel is `value`."""
        return self.with_sample(np.s_[0, 1, 2, 1], value)

    def with_sample(self, place, value):
        """Copy with other samples at `place`."""
        sample = self.sample.copy()
        sample[place] = value
        return replace(self, sample=sample)

    def scaled(self, factor):
        """Copy in single precision with the samples multiplied by `factor`."""
        sample = self.sample.astype(np.float64) * factor
        return replace(self, sample=sample.astype(np.float32))

    def with_lights(self, light, value):
        """Copy with further lights, whose samples are all `value`."""
        shape = (3, len(light), *self.sample.shape[2:])
        sample = np.full(shape, value, self.sample.dtype)
        return replace(
            self,
            light=np.concatenate([self.light, light]),
            sample=np.concatenate([self.sample, sample], axis=1),
        )


def surfels(lights=40, cameras=6, *, eta=ETA, weight=WEIGHT, dtype=np.float16):
    """Three surfels with different positions and normals.

    Samples are half floats as in a database; other types compile further kernels.
    """
    position = np.array([[0.0, 0, 0], [40, 10, -5], [-30, 20, -8]])
    normal = unit(np.array([[0.0, 0, 1], [0.3, 0.1, 1], [-0.2, 0.2, 1]]))
    light = 900 * _spiral(lights, 0.6)
    camera = 800 * _spiral(cameras, 0.7)
    diffuse = np.tile([0.5, 0.33, 0.24], (3, 1))
    wi = unit(light - position[:, None])
    wo = unit(camera - position[:, None])
    ci = np.einsum("nk,ntk->nt", normal, wi)
    co = np.einsum("nk,ntk->nt", normal, wo)
    a, b, n = np.broadcast_arrays(wi[:, :, None], wo[:, None], normal[:, None, None])
    surface = lookup(six_tables(), *half_difference(a, b, n)) @ weight
    transmitted = (
        fresnel_transmittance(ci, eta)[:, :, None]
        * (fresnel_transmittance(co, eta)[:, None])
    )
    value = transmitted[..., None] * diffuse[:, None, None] / np.pi + surface[..., None]
    sample = (ci[:, :, None, None] * value).astype(dtype)
    return Surfels(sample, position, light, camera, normal, diffuse)


def rows_and_targets(skin, s):
    """Rows (samples, 6) and targets (samples, 3) of one surfel, computed with NumPy."""
    wi = unit(skin.light - skin.position[s])
    wo = unit(skin.camera - skin.position[s])
    a, b = np.broadcast_arrays(wi[:, None], wo[None])
    ci = wi @ skin.normal[s]
    co = wo @ skin.normal[s]
    table = lookup(six_tables(), *half_difference(a, b, skin.normal[s]))
    M = table * ci[:, None, None]
    shape = (ci * fresnel_transmittance(ci, ETA))[:, None] * (
        fresnel_transmittance(co, ETA) / np.pi
    )
    target = skin.sample[s].astype(np.float64) - shape[..., None] * skin.diffuse[s]
    return M.reshape(-1, M.shape[-1]), target.reshape(-1, 3)


def polariser_factors(position, light, camera, polarisation, eta=ETA):
    """Factors (n, lights, cameras) of the surface term by circular polarisers, for products
    (lights, cameras) of the degrees of polarisation.
    """
    wi = unit(light - position[:, None])[:, :, None]
    wo = unit(camera - position[:, None])[:, None]
    cosine = np.linalg.norm(wi + wo, axis=-1) / 2
    return 1 - polarisation * circular_reversal(cosine, eta)
