"""Random numbers of a batch: strata over the rays of a pixel, lights of a dome, and
points on their discs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.reflectance.sampling import tangents
from skindb.render.direct import View
from skindb.render.scene import Lights

Float = NDArray[np.floating[Any]]
LIGHTS_PER_RAY = 4  # lights drawn for each ray; with fewer lights, all are used
CELLS = 16  # of normals along each axis
# in probabilities, because normals of a cell differ by up to 0.1, and for the discs of
# lights
MIN_COSINE = 0.02


@dataclass(frozen=True)
class LightChoice:
    """Probabilities of lights for each cell of normals: the power that arrives on a
    surface with the cell's normal.

    Lights below the horizon of a place are therefore rarely drawn there, and never have
    a probability of zero.
    """

    lights: Lights
    probability: Float  # (cells, l)
    # (cells * l,) cumulative probability within a cell, plus the index of the cell
    rising: Float

    @classmethod
    def of_lights(cls, lights: Lights, centre: Float) -> LightChoice:
        """Probabilities for surfaces near `centre` (3,) [mm]."""
        towards = lights.position - centre
        distance = np.linalg.norm(towards, axis=1)
        axis = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1
        normal = np.stack(
            np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1
        ).reshape(-1, 3)
        cosine = (
            normal
            @ (towards / distance[:, None]).T
            / np.linalg.norm(normal, axis=1, keepdims=True)
        )
        power = (
            lights.intensity.sum(axis=1)
            / distance**2
            * (np.maximum(cosine, 0) + MIN_COSINE)
        )
        power[:, :] += power.sum() == 0  # lights that are all off
        probability = power / power.sum(axis=1, keepdims=True)
        rising: Float = np.cumsum(probability, axis=1)
        rising /= rising[:, -1:]
        return cls(
            lights,
            probability,
            np.ravel(rising + np.arange(float(len(rising)))[:, None]),
        )

    def draw(
        self, view: View, rng: np.random.Generator
    ) -> list[tuple[NDArray[np.int64], Float]]:
        """Indices (n,) and inverse probabilities (n,) of the lights of each hit;
        LIGHTS_PER_RAY such pairs.
        """
        n = len(view.pixel)
        count = self.probability.shape[1]
        if count <= LIGHTS_PER_RAY:
            return [(np.full(n, i), np.ones(n)) for i in range(count)]
        x, y, z = np.clip((view.normal.T + 1) * (CELLS / 2), 0, CELLS - 1).astype(
            np.int64
        )
        cell = (x * CELLS + y) * CELLS + z
        # one offset for the lights of a hit, which spreads them over the sum
        start = stratified(view, 1, rng)[:, 0]
        drawn = []
        for i in range(LIGHTS_PER_RAY):
            place = cell + (start + i) / LIGHTS_PER_RAY
            at = np.clip(
                np.searchsorted(self.rising, place, side="right") - cell * count,
                0,
                count - 1,
            )
            drawn.append((at, 1 / (LIGHTS_PER_RAY * self.probability[cell, at])))
        return drawn


def stratified(view: View, dimensions: int, rng: np.random.Generator) -> Float:
    """Uniform numbers (n, dimensions), stratified over the rays of each pixel (Latin
    hypercube, McKay et al. 1979).
    """
    rays = view.samples**2
    which, row = np.unique(view.pixel, return_inverse=True)
    out = np.empty((len(view.pixel), dimensions))
    for k in range(dimensions):
        order = rng.random((len(which), rays), np.float32).argsort(axis=1)
        out[:, k] = (order[row, view.ray] + rng.random(len(view.pixel))) / rays
    return out


def points_on_discs(
    lights: Lights, chosen: NDArray[np.int64], rng: np.random.Generator
) -> Float:
    """Points (n, 3) drawn uniformly on the discs of the chosen lights (n,)."""
    first, second = tangents(np.asarray(lights.axis, np.float64))
    radius = lights.disc_radius[chosen] * np.sqrt(rng.random(len(chosen)))
    turn = 2 * np.pi * rng.random(len(chosen))
    across = (
        np.cos(turn)[:, None] * first[chosen] + np.sin(turn)[:, None] * second[chosen]
    )
    return np.asarray(lights.position[chosen] + radius[:, None] * across)
