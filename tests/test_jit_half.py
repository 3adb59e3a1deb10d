"""Conversion of half floats in kernels."""

from __future__ import annotations

import numpy as np
import pytest

from skindb.jit import sample_bits, unpack


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_unpack__every_half_float_is_read_by_its_bits(dtype):
    """All 65,536 values, as half floats and as the same numbers in single precision."""
    every = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    sample = np.stack([every, every[::-1], every], axis=-1).astype(dtype)[:, None]
    out = np.empty(sample.size, np.float32)
    unpack(sample_bits(sample), out)
    np.testing.assert_array_equal(out, sample.astype(np.float32).ravel())
