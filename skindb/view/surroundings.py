"""Approximation of an environment by distant lights, whose light the page adds up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.render.environment import LUMINANCE, Environment

Float = NDArray[np.floating[Any]]
COUNT = 256  # lights, in 64 passes of four
SKY_ROWS = 32  # rows of the image of the default sky
GROUND = 0.2  # radiance below the horizon, relative to that of the zenith


@dataclass(frozen=True)
class DistantLights:
    """Directions of distant lights, and the irradiance of each on a surface that faces it."""

    direction: Float  # (n, 3) unit vectors towards the lights
    irradiance: Float  # (n, 3)


def overcast_sky() -> Environment:
    """The CIE standard overcast sky, (1 + 2 sin(elevation)) / 3, above a dark ground."""
    elevation = np.pi / 2 - np.pi * (np.arange(SKY_ROWS) + 0.5) / SKY_ROWS
    sky = np.where(elevation > 0, (1 + 2 * np.sin(elevation)) / 3, GROUND)
    return Environment(np.tile(sky[:, None, None], (1, 2 * SKY_ROWS, 3)))


def distant_lights(environment: Environment, count: int = COUNT) -> DistantLights:
    """Distant lights that approximate an environment, by the median cut algorithm of
    Debevec (2005).

    The region of the image with the most light is repeatedly divided across its longer
    side into two equally bright parts. Every region becomes one light at its centre of
    brightness.

    Parameters
    ----------
    environment
        Light from all directions.
    count
        Maximum number of lights.

    Returns
    -------
    DistantLights
        The sum of their irradiance is that of the environment, in each channel.
    """
    height, width, _ = environment.radiance.shape
    polar = np.pi * np.arange(height + 1) / height
    solid = np.repeat(
        (np.cos(polar[:-1]) - np.cos(polar[1:]))[:, None] * 2 * np.pi / width,
        width,
        axis=1,
    )
    energy = environment.radiance * solid[..., None]
    bright = energy @ LUMINANCE
    regions = [(0, height, 0, width)]
    while len(regions) < count:
        totals = [
            float(bright[a:b, c:d].sum()) if (b - a) * (d - c) > 1 else -1.0
            for a, b, c, d in regions
        ]
        most = int(np.argmax(totals))
        if totals[most] <= 0:
            break
        regions += _halves(bright, regions.pop(most))
    mean = (polar[:-1] + polar[1:]) / 2
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    towards = np.stack(
        [
            np.sin(mean)[:, None] * np.sin(azimuth),
            np.repeat(np.cos(mean)[:, None], width, axis=1),
            np.sin(mean)[:, None] * np.cos(azimuth),
        ],
        axis=-1,
    )
    lit = [
        region
        for region in regions
        if bright[region[0] : region[1], region[2] : region[3]].sum() > 0
    ]
    direction = np.array(
        [
            (bright[a:b, c:d, None] * towards[a:b, c:d]).sum(axis=(0, 1))
            for a, b, c, d in lit
        ]
    )
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    irradiance = np.array([energy[a:b, c:d].sum(axis=(0, 1)) for a, b, c, d in lit])
    # so that the first lights already come from all directions
    order = np.random.default_rng(0).permutation(len(lit))
    return DistantLights(direction[order], irradiance[order])


def _halves(
    bright: Float, region: tuple[int, int, int, int]
) -> list[tuple[int, int, int, int]]:
    """A region (rows a to b, columns c to d), divided into two parts of equal brightness."""
    a, b, c, d = region
    part = bright[a:b, c:d]
    across = np.pi * ((a + b) / 2) / bright.shape[0]
    high = (b - a) / bright.shape[0]
    wide = 2 * (d - c) / bright.shape[1] * np.sin(across)
    if b - a > 1 and (high >= wide or d - c == 1):
        rising = np.cumsum(part.sum(axis=1))
        cut = a + 1 + min(int(np.searchsorted(rising, rising[-1] / 2)), b - a - 2)
        return [(a, cut, c, d), (cut, b, c, d)]
    rising = np.cumsum(part.sum(axis=0))
    cut = c + 1 + min(int(np.searchsorted(rising, rising[-1] / 2)), d - c - 2)
    return [(a, b, c, cut), (a, b, cut, d)]
