"""Helpers of the fits, compared with functions of NumPy and plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.fit.albedo import BATCH, block_reflectance, quantile_finite
from skindb.fit.lumitexels import directions
from skindb.reflectance._lumitexel_kernels import (
    MODEL_ERROR,
    Options,
    lumitexel_memory,
    weigh,
)
from skindb.reflectance.block import MODES
from skindb.reflectance.model import typical_noise


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_quantile_finite__is_nanquantile(axis):
    rng = np.random.default_rng(0)
    values = np.where(
        rng.uniform(size=(7, 8, 9)) < 0.3, np.nan, rng.normal(size=(7, 8, 9))
    )
    for share in (0.0, 0.3, 1.0):
        expected = np.nanquantile(values, share, axis=axis, method="nearest")
        np.testing.assert_array_equal(quantile_finite(values, share, axis), expected)


def test_quantile_finite__nothing_finite_is_nan_without_warning():
    values = np.array([[np.nan, np.nan], [np.inf, 2.0], [np.nan, 4.0]])
    np.testing.assert_array_equal(quantile_finite(values, 0.5, 1), [np.nan, 2.0, 4.0])


def test_quantile_finite__counts_ranks():
    values = np.array([[5.0, np.nan, 1.0, 4.0, 2.0, 3.0]])
    assert [quantile_finite(values, q, 1)[0] for q in (0.0, 0.25, 0.5, 1.0)] == [
        1.0,
        2.0,
        3.0,
        5.0,
    ]


def test_directions__no_direction_is_nan():
    found = directions(np.zeros((1, 3)), np.array([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(found, [[[0, 0.6, 0.8], [np.nan] * 3]])


def test_block_reflectance__rules_in_batches_and_without_surfels():
    rng = np.random.default_rng(3)
    n = BATCH + 5
    arrays = {
        "reflectance_sample": rng.uniform(0.1, 0.2, (n, 6, 4, 3)),
        "surfel_position": rng.normal(size=(n, 3)),
        "light_position": rng.normal((0, 0, 900), size=(6, 3)),
        "camera_position": rng.normal((0, 0, 900), size=(4, 3)),
        "shading_normal": np.tile([0.0, 0.0, 1.0], (n, 1)),
    }
    whole = block_reflectance(arrays, method="quantile", eta=1.3)
    for part in (slice(BATCH, None), slice(0, 0)):
        cut = {
            k: v if "_pos" in k and "surfel" not in k else v[part]
            for k, v in arrays.items()
        }
        found = block_reflectance(cut, method="quantile", eta=1.3)
        np.testing.assert_array_equal(found[0], whole[0][part])


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
    weigh(0, count, typical_noise(noise, shot), options, memory)

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

    weigh(0, count, typical_noise(), options, memory)
    assert (weight[:count] == 1).all()
