"""Helpers of the fits, compared with functions of NumPy and plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.fit.lumitexels import directions
from skindb.reflectance._lumitexel_kernels import (
    MODEL_ERROR,
    Options,
    lumitexel_memory,
    weigh,
)
from skindb.reflectance.block import MODES
from skindb.reflectance.model import UNKNOWN_NOISE, Noise


def test_directions__no_direction_is_nan():
    found = directions(np.zeros((1, 3)), np.array([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(found, [[[0, 0.6, 0.8], [np.nan] * 3]])


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
def test_weigh__noise_over_the_error_of_models_in_plain_numpy(mode):
    rng = np.random.default_rng(7)
    count = 40
    floor = 2e-3
    noise = 1e-3
    shot = 4e-4
    memory = lumitexel_memory(10, 6, 4)
    memory.scattered[:, :count] = rng.uniform(0, 0.3, (3, count))
    weight = memory.weight
    options = Options(1.3, MODES.index(mode), floor, 1, True)
    memory.pairs[:] = 0
    sizes = (1, 10), (1, 6), (6, 1), (6, 1), (6, 1)
    values = 1.0, 1.0, np.inf, noise**2, shot
    known = Noise(*map(np.full, sizes, values, [np.float32] * len(sizes)))
    weigh(0, count, known, options, memory)

    level = memory.scattered[:, :count].mean(axis=0, dtype=np.float64)
    mean = level.mean()

    def root(y):
        return y / np.cbrt(y * y + floor * floor) if mode == "perceptual" else y

    h = 1e-7
    spread = (
        (root(level + h) - root(level - h))
        / (2 * h)
        * np.sqrt((noise**2 + shot * level) / 3)
    )
    own = MODEL_ERROR * mean if mode == "linear" else MODEL_ERROR / 3 * root(mean)
    np.testing.assert_allclose(weight[:count], 1 / (1 + (spread / own) ** 2), rtol=1e-4)
    assert weight[:count].max() > 1.1 * weight[:count].min()

    weigh(0, count, UNKNOWN_NOISE, options, memory)
    assert (weight[:count] == 1).all()
