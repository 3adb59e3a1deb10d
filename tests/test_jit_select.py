"""Order statistics without branches, compared with NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.jit import median_of, sort_columns

RELATIVE = 3e-5  # 256 units in the last place of single precision


def _median(values):
    values = np.asarray(values, np.float32)
    return median_of(values, len(values), int(np.isfinite(values).sum()))


def test_median_of__is_that_of_numpy():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        values = np.exp(
            rng.normal(0, rng.choice([0.0, 0.1, 3.0]), rng.integers(1, 400))
        ).astype(np.float32)
        values[rng.random(len(values)) < 0.2] = 0.0
        known = rng.random(len(values)) < rng.choice([0.3, 1.0])
        known[rng.integers(len(values))] = True
        expected = np.median(values[known].astype(float))
        assert _median(np.where(known, values, np.inf)) == pytest.approx(
            expected, rel=RELATIVE, abs=0
        )


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([np.inf], 0.0),
        ([0.0], 0.0),
        ([1e-30, 1e30], 5e29),
        ([1.0, 2.0], 1.5),
        ([3.0, np.inf], 3.0),
        ([2.0] * 7, 2.0),
    ],
)
def test_median_of__extremes(values, expected):
    assert _median(values) == pytest.approx(expected, rel=RELATIVE)


def test_sort_columns__is_that_of_numpy():
    for rows in [*range(9), 16, 17, 31]:
        rng = np.random.default_rng(rows)
        x = rng.integers(0, 9, (rows + 1, 13)).astype(np.float32)  # includes ties
        x[rng.random(x.shape) < 0.1] = np.inf
        expected = x.copy()
        expected[:rows, :11] = np.sort(x[:rows, :11], axis=0)
        sort_columns(x, rows, 11)
        np.testing.assert_array_equal(x, expected)
