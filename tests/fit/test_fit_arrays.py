"""Helpers of the fits, compared with functions of NumPy and plain loops."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from skindb.fit._arrays import BATCH, in_batches, quantile_finite, unit
from skindb.fit._lumitexel_kernels import MODEL_ERROR, lumitexel_memory
from skindb.fit._segments import Segments
from skindb.fit._surface_arrays import MODES
from skindb.fit._surface_kernels import Options, weigh
from skindb.fit.sample_noise import NO_NOISE, TypicalNoise, noise_of


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


def test_unit__no_direction_is_nan():
    np.testing.assert_array_equal(
        unit(np.array([[0.0, 3.0, 4.0], [0.0, 0.0, 0.0]])),
        [[0, 0.6, 0.8], [np.nan] * 3],
    )


def test_in_batches__joins_slices_and_takes_none():
    x = np.arange(2 * BATCH + 3.0)
    (out,) = in_batches(lambda a: (a * 2,), (x,))
    np.testing.assert_array_equal(out, 2 * x)
    assert in_batches(lambda a: (a, a), (x[:0],))[1].shape == (0,)


def test_segments__sums_spread_and_scatter_as_loops_do():
    rng = np.random.default_rng(1)
    sizes = np.array([0, 3, 0, 1, 5, 0])
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    values = rng.normal(size=offsets[-1])
    segments = Segments(offsets)
    sums = [values[a:b].sum() for a, b in pairwise(offsets) if b > a]
    np.testing.assert_allclose(segments.sum(values), sums, rtol=1e-14)
    np.testing.assert_array_equal(segments.owner, np.repeat(np.arange(6), sizes))
    np.testing.assert_array_equal(
        segments.spread(np.array([1.0, 2.0, 3.0])), [1, 1, 1, 2, 3, 3, 3, 3, 3]
    )
    np.testing.assert_array_equal(
        np.isnan(segments.scatter(np.ones((3, 2)))[:, 0]), sizes == 0
    )


def test_segments__without_any_sample():
    segments = Segments(np.zeros(4, np.int64))
    assert segments.sum(np.zeros(0)).shape == (0,)
    assert np.isnan(segments.scatter(np.zeros(0))).sum() == 3


@pytest.mark.parametrize("mode", ["linear", "perceptual"])
def test_weigh__noise_over_the_error_of_models_in_plain_numpy(mode):
    rng = np.random.default_rng(7)
    count = 40
    floor = 2e-3
    noise = 1e-3
    shot = 4e-4
    memory = lumitexel_memory(10, 6, 4)
    memory.scattered[:, :count] = rng.uniform(0, 0.3, (3, count))
    weight = np.zeros(60, np.float32)
    options = Options(1.3, MODES.index(mode), floor, 1, True)
    typical = TypicalNoise(noise, shot)
    weigh(0, count, noise_of((), typical), options, memory, weight)

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

    weigh(0, count, noise_of((), NO_NOISE), options, memory, weight)
    assert (weight[:count] == 1).all()
