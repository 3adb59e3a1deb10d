"""Robust fits per segment against plain NumPy and SciPy, and errors against the scatter of repeated draws."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from skindb.numerics.robust import robust_nonnegative, robust_slopes, shift


def _tukey(residual, scale):
    return np.clip(1 - (residual / (4.685 * scale)) ** 2, 0, 1) ** 2


def _naive_slope(x, y, steps):
    weight = np.ones_like(x)
    for _ in range(steps):
        slope = (weight * x * y).sum() / (weight * x * x).sum()
        residual = y - slope * x
        weight = _tukey(residual, 1.2533 * (weight * abs(residual)).sum() / weight.sum())
    return slope


def _naive_first(shape, lobes, y, floor, steps):
    columns = np.column_stack([shape, lobes])
    level, keep = np.maximum(y, floor), np.ones_like(y)
    for _ in range(steps):
        root = np.sqrt(keep) / level
        x = nnls(columns * root[:, None], y * root)[0]
        level = np.maximum(columns @ x, floor)
        residual = (y - columns @ x) / level
        keep = _tukey(residual, 1.2533 * (keep * abs(residual)).sum() / keep.sum() + 0.005)
    return x[0]


def _samples(rng, counts, m=3, noise=0.03):
    offsets = np.concatenate([[0], np.cumsum(counts)])
    shape, lobes = rng.uniform(0.05, 0.3, offsets[-1]), rng.uniform(0, 1, (offsets[-1], m)).astype(np.float32) ** 4
    y = 0.4 * shape + lobes @ np.linspace(0.05, 0.1, m)
    y *= 1 + noise * rng.normal(size=len(y))
    y[::17] *= 0.4  # shadows
    return offsets, shape, lobes, y


def test_robust_slopes__is_the_plain_loop():
    rng = np.random.default_rng(1)
    offsets, x, _, y = _samples(rng, [40, 0, 12, 300])
    two = np.stack([y, -2 * y], axis=1)
    slope, error = robust_slopes(offsets, x, two)
    for s in (0, 2, 3):
        part = slice(offsets[s], offsets[s + 1])
        expected = [_naive_slope(x[part], two[part, k], 5) for k in range(2)]
        np.testing.assert_allclose(slope[s], expected, rtol=1e-10)  # rounding of sums
    assert np.isnan(slope[1]).all()
    assert np.isnan(error[1]).all()


def test_robust_nonnegative__is_the_plain_loop_with_scipy():
    rng = np.random.default_rng(2)
    offsets, shape, lobes, y = _samples(rng, [40, 0, 12, 300])  # 300: more than one cut of the sums
    fit = robust_nonnegative(offsets, shape, lobes, y, floor=0.01)
    found, error = fit.weight, fit.error
    for s in (0, 2, 3):
        part = slice(offsets[s], offsets[s + 1])
        expected = _naive_first(shape[part], lobes[part], y[part], 0.01, 4)
        np.testing.assert_allclose(found[s], expected, rtol=1e-6)  # normal equations square the condition
    assert np.isnan([found[1], error[1]]).all()


@pytest.mark.parametrize("count", [60, 600])
def test_robust__errors_are_the_scatter_of_repeated_draws(count):
    rng = np.random.default_rng(3)
    draws = 1500
    offsets = count * np.arange(draws + 1)
    shape, lobes = rng.uniform(0.05, 0.3, count), rng.uniform(0, 1, (count, 3)).astype(np.float32) ** 4
    clean = 0.4 * shape + lobes @ np.array([0.05, 0.07, 0.1])
    y = (clean * (1 + 0.03 * rng.normal(size=(draws, count)))).ravel()  # of unequal variance, as photographs are
    fit = robust_nonnegative(offsets, np.tile(shape, draws), np.tile(lobes, (draws, 1)), y, floor=0.01)
    first, first_error = fit.weight, fit.error
    plain = 0.4 * shape * (1 + 0.03 * rng.normal(size=(draws, count)))
    slope, slope_error = robust_slopes(offsets, np.tile(shape, draws), plain.reshape(-1, 1))
    for value, error in ((first, first_error), (slope[:, 0], slope_error[:, 0])):
        # the scatter of 1500 draws is known to 2 %; small samples lose up to a tenth in the sandwich
        assert 0.88 < np.median(error) / value.std() < 1.08


def test_shift__is_what_a_fit_to_samples_of_other_columns_gains():
    rng = np.random.default_rng(4)
    offsets = np.cumsum([0, 60, 0, 300])
    shape, lobes = rng.uniform(0.05, 0.3, offsets[-1]), rng.uniform(0, 1, (offsets[-1], 3)).astype(np.float32) ** 4
    x = np.array([0.05, 0.07, 0.0])  # the last lobe is idle
    first = robust_nonnegative(offsets, shape, lobes, 0.4 * shape + lobes @ x, floor=0.01)
    other = shape * (1 + 1e-4 * rng.normal(size=len(shape))), lobes * (1 + 1e-4 * rng.normal(size=lobes.shape))
    again = robust_nonnegative(offsets, shape, lobes, 0.4 * other[0] + other[1] @ x, floor=0.01)
    gain = shift(first, offsets, *other) - shift(first, offsets, shape, lobes)
    assert gain[1] == 0
    # the idle lobe may take a part of the second fit, and weights differ at second order
    np.testing.assert_allclose(gain[[0, 2]], (again.weight - first.weight)[[0, 2]], rtol=0.02, atol=1e-7)
