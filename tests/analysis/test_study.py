"""Functions of takes receive the same bits on every engine."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from skindb.analysis.study import each_item, each_take


def _misaligned(values):
    """A copy that begins four bytes after a multiple of eight, as a message of the network may."""
    raw = np.empty(values.nbytes + 16, np.uint8)
    start = -raw.ctypes.data % 8 + 4
    found = raw[start : start + values.nbytes].view(values.dtype).reshape(values.shape)
    found[:] = values
    assert not found.flags.aligned
    return found


def _product(take, matrix):
    return take["value"].values @ matrix.T


@pytest.mark.parametrize(
    "change", [_misaligned, np.asfortranarray, lambda a: np.repeat(a, 2, axis=0)[::2]]
)
def test_each_take__gives_the_same_bits_for_any_layout_in_memory(change):
    rng = np.random.default_rng(3)
    value = rng.random((2, 700, 59))
    matrix = rng.random((3, 59))
    cohort = xr.Dataset({"value": (("take", "surfel", "dictionary"), value)})
    changed = xr.Dataset({"value": (("take", "surfel", "dictionary"), change(value))})
    expected = each_take(_product, cohort, ["value"], matrix)
    for one, other in zip(
        expected, each_take(_product, changed, ["value"], change(matrix)), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    [one], [other] = each_item(_squares, [value]), each_item(_squares, [change(value)])
    np.testing.assert_array_equal(one, other)


def _squares(value):
    assert value.flags.c_contiguous
    assert value.flags.aligned
    return value[0].T @ value[0]
