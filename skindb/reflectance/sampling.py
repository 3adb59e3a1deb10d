"""Importance sampling of mixtures of tabulated BRDFs by their half vectors, with the
exact probability density.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skindb.reflectance.tables import directional_albedo
from skindb.types import Array, Float32, dots, float64, lengths, unit

# fraction of directions drawn by the cosine alone, as tables have tails that do not
# depend on the half vector
COSINE_FRACTION = 0.3
TYPICAL_COSINE = 0.8  # of the view, for the albedo of a basis that weights its lobe
# between view and half vector; the density of the mirrored direction diverges towards 0
MIN_COSINE_HALF = 1e-4


@dataclass(frozen=True)
class TableSampler:
    """Probability densities of half vectors, one for each basis.

    `density` (k, nh - 1) is the density of u = sqrt(theta_h / (pi/2)) in equal cells of
    [0, 1], which resolve narrow lobes as finely as the tables; `albedo` (k,) weights
    the bases.
    """

    density: Array
    albedo: Array

    @classmethod
    def of_tables(cls, tables: Float32) -> TableSampler:
        """Densities in proportion to the mean of each table (nh, nd, np, k) over its
        other angles, times the cosine.
        """
        # grazing difference angles are excluded, because there a table is large for any half vector
        near = tables[:, : max(2 * tables.shape[1] // 3, 1)]
        profile = np.maximum(near.mean(axis=(1, 2), dtype=np.float64), 0.0).T  # (k, nh)
        edge = np.linspace(0.0, 1.0, tables.shape[0])
        u = (edge[1:] + edge[:-1]) / 2
        theta = u**2 * np.pi / 2
        weight = (
            (profile[:, 1:] + profile[:, :-1]) / 2 * np.cos(theta) * np.sin(theta) * u
        )
        total = weight.sum(axis=1, keepdims=True)
        even = np.cos(theta) * np.sin(theta) * u
        density = np.where(
            total > 0, weight / np.where(total > 0, total, 1.0), even / even.sum()
        ) * len(u)
        return cls(
            density,
            np.maximum(directional_albedo(tables, np.array([TYPICAL_COSINE]))[0], 0.0),
        )

    def mix(self, weights: Array) -> Array:
        """Probabilities (n, 1 + k) of the cosine and of each basis at points with these
        weights (n, k).
        """
        if weights.shape[1] == 0:  # without the surface term
            weights = np.zeros((len(weights), len(self.albedo)))
        lobes = np.maximum(float64(weights), 0.0) * self.albedo
        total = lobes.sum(axis=1, keepdims=True)
        shared = np.where(
            total > 0,
            (1 - COSINE_FRACTION) * lobes / np.where(total > 0, total, 1.0),
            0.0,
        )
        return np.concatenate([1 - shared.sum(axis=1, keepdims=True), shared], axis=1)

    def sample(self, mix: Array, normal: Array, view: Array, draw: Array) -> Array:
        """Directions (n, 3) towards the light, one for each point; those below the
        surface carry no light.

        Parameters
        ----------
        mix
            (n, 1 + k) probabilities from `mix`.
        normal, view
            (n, 3) unit normals, and unit directions to the camera.
        draw
            (n, 3) uniform numbers in [0, 1): for the choice of a basis, for the cosine,
            and for the azimuth.
        """
        cells = self.density.shape[1]
        chosen = (draw[:, :1] > np.cumsum(mix, axis=1)[:, :-1]).sum(axis=1)
        turn = 2 * np.pi * draw[:, 2]
        cosine = np.sqrt(1 - draw[:, 1])  # of a direction drawn by its cosine
        lobe = chosen > 0
        if lobe.any():
            rising = np.cumsum(self.density, axis=1) / cells
            start = np.concatenate([np.zeros((len(rising), 1)), rising], axis=1)
            which = chosen[lobe] - 1
            cell = np.minimum((draw[lobe, 1:2] > rising[which]).sum(axis=1), cells - 1)
            rest = (draw[lobe, 1] - start[which, cell]) * cells
            within = rest / np.maximum(self.density[which, cell], 1e-300)
            u = (cell + np.clip(within, 0.0, 1.0)) / cells
            cosine[lobe] = np.cos(u**2 * np.pi / 2)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
        tangent, second = tangents(normal)
        drawn = (
            (sine * np.cos(turn))[:, None] * tangent
            + (sine * np.sin(turn))[:, None] * second
            + cosine[:, None] * normal
        )
        mirror = 2 * dots(view, drawn)[:, None] * drawn - view
        return np.where(lobe[:, None], mirror, drawn)

    def pdf(self, mix: Array, normal: Array, view: Array, towards: Array) -> Array:
        """Density (n,) per steradian with which `sample` draws the directions `towards`
        (n, 3); 0 below the surface.
        """
        cosine = dots(normal, towards)
        half = unit(towards + view)
        cos_h = np.clip(dots(half, normal), -1.0, 1.0)
        cos_d = dots(half, view)
        # from the sine, because an arc cosine is too inaccurate for narrow lobes
        theta = np.arctan2(lengths(np.cross(half, normal)), cos_h)
        u = np.sqrt(np.clip(theta / (np.pi / 2), 1e-12, 1.0))
        cells = self.density.shape[1]
        cell = np.minimum((u * cells).astype(np.int64), cells - 1)
        # p(omega_h) = p(u) / (2 pi sin(theta) dtheta/du), and d omega_i = 4 cos_d d omega_h
        solid = 2 * np.pi * np.maximum(np.sin(theta), 1e-12) * np.pi * u
        lobes = (
            (mix[:, 1:] * self.density[:, cell].T).sum(axis=1)
            / solid
            / (4 * np.maximum(cos_d, MIN_COSINE_HALF))
        )
        return np.where(
            cosine > 0,
            mix[:, 0] * cosine / np.pi + np.where(cos_h > 0, lobes, 0.0),
            0.0,
        )


def tangents(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors (n, 3) perpendicular to unit normals (n, 3) and to each other
    (Duff et al. 2017).
    """
    x, y, z = normal.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return tangent, np.stack([b, sign + y * y * a, -y], axis=1)
