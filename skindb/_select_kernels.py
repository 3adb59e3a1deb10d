"""Compiled order statistics without branches, so that the loops over values run in
vector registers.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from skindb._compiled import fast_kernel, kernel

# bits of +inf; the bits of non-negative floats have the order of their values
INFINITE = np.int32(0x7F800000)
WINDOW = np.int32(256)  # units in the last place: a relative 3e-5


@kernel
def median_of(values: Any, bits: Any, n: int, count: int) -> float:
    """Median of n non-negative float32 of which `count` are finite and the others inf,
    to a relative error of 3e-5.

    `bits` is the same memory as int32. The bits are bisected by counting; values within
    WINDOW count as equal.
    """
    if count == 0:
        return 0.0
    low = INFINITE
    high = np.int32(0)
    for i in range(n):
        low = min(low, bits[i])
        high = max(high, bits[i] if bits[i] < INFINITE else np.int32(0))
    k = np.int32((count - 1) // 2)
    low = np.int32(low - 1)
    # at most k values are below or at `low`, more than k below or at `high`
    while high - low > WINDOW:
        middle = np.int32(low + (high - low) // 2)
        below = np.int32(0)
        for i in range(n):
            below += np.int32(bits[i] <= middle)
        if below > k:
            high = middle
        else:
            low = middle
    below = np.int32(0)
    first = np.float32(np.inf)
    second = np.float32(np.inf)
    for i in range(n):
        below += np.int32(bits[i] <= high)
        first = min(first, values[i] if bits[i] > low else np.float32(np.inf))
        second = min(second, values[i] if bits[i] > high else np.float32(np.inf))
    if count % 2 or below > k + 1:
        second = first
    return 0.5 * (np.float64(first) + np.float64(second))


@fast_kernel
def _exchange(first: Any, second: Any, n: int) -> None:
    for i in range(n):
        a = first[i]
        b = second[i]
        first[i] = a if a < b else b
        second[i] = b if a < b else a


@kernel
def sort_columns(x: Any, rows: int, n: int) -> None:
    """Sort the first n columns of `x` along its first `rows` rows, all columns at once.

    Batcher's merge exchange (Knuth, volume 3, algorithm 5.2.2M). Values are finite or +inf.
    """
    top = 1
    while 2 * top < rows:
        top *= 2
    p = top
    while p > 0 and rows > 1:
        q = top
        r = 0
        d = p
        while True:
            for i in range(rows - d):
                if i & p == r:
                    _exchange(x[i], x[i + d], n)
            if q == p:
                break
            d = q - p
            q = q // 2
            r = p
        p //= 2
