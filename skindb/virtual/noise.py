"""Seeded smooth random fields over points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def smooth_noise(
    points: Array, wavelength: float, *, rng: np.random.Generator, waves: int = 40
) -> Array:
    """A Gaussian-like field (n,) of zero mean and unit variance over `points` (n, 3)
    mm: a sum of plane waves.

    Wavelengths vary by a factor of two around `wavelength` mm, directions are uniform.
    """
    vector = rng.standard_normal((waves, 3))
    number = 2 * np.pi / (wavelength * rng.uniform(0.7, 1.4, waves))
    vector *= (number / np.linalg.norm(vector, axis=1))[:, None]
    phase = rng.uniform(0, 2 * np.pi, waves)
    # float32 is sufficient, and 40 cosines per vertex dominate the cost of a skin
    wave = np.cos(
        points.astype(np.float32) @ vector.T.astype(np.float32)
        + phase.astype(np.float32)
    )
    return np.asarray(wave.sum(axis=1, dtype=np.float64) * np.sqrt(2 / waves))
