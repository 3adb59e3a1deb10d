"""Compiled non-negative least squares of normal equations; `skindb.numerics.nnls`
states the problem.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from skindb.jit import kernel

# a column whose fraction outside the span of the active ones is below this is collinear
# with them
MIN_PIVOT = 1e-11


class ActiveSetMemory(NamedTuple):
    """Memory for `active_set` of m columns; each thread needs its own."""

    factor: Any  # (m, m) Cholesky factor of the active columns
    solution: Any  # (m,) unconstrained minimum on the active columns
    gradient: Any  # (m,) b - G x


@kernel
def active_set_memory(m: int) -> Any:
    """Memory for problems of m columns."""
    return ActiveSetMemory(np.zeros((m, m)), np.zeros(m), np.zeros(m))


@kernel
def factor(G: Any, active: Any, begin: int, k: int, L: Any) -> int:
    """Extend the Cholesky factor of G on `active` from position `begin` to k; returns
    the first bad pivot, or -1.
    """
    for a in range(begin, k):
        for c in range(a):
            t = G[active[a], active[c]]
            for q in range(c):
                t -= L[a, q] * L[c, q]
            L[a, c] = t / L[c, c]
        t = G[active[a], active[a]]
        for q in range(a):
            t -= L[a, q] * L[a, q]
        if t <= MIN_PIVOT:
            return a
        L[a, a] = math.sqrt(t)
    return -1


@kernel
def solve(L: Any, b: Any, active: Any, k: int, z: Any) -> None:
    """Write to z the inverse of the factored matrix times b on the active columns."""
    for a in range(k):
        t = b[active[a]]
        for q in range(a):
            t -= L[a, q] * z[q]
        z[a] = t / L[a, a]
    for a in range(k - 1, -1, -1):
        t = z[a]
        for q in range(a + 1, k):
            t -= L[q, a] * z[q]
        z[a] = t / L[a, a]


@kernel
def _gradient(G: Any, b: Any, x: Any, w: Any) -> None:
    m = b.shape[0]
    for j in range(m):  # a copy of arrays, `w[:] = b`, would take seconds to compile
        w[j] = b[j]
    for i in range(m):
        if x[i] != 0.0:
            f = x[i]
            for j in range(m):
                w[j] -= G[i, j] * f


@kernel
def _exchange(
    G: Any, entering: int, active: Any, k: int, L: Any, x: Any, z: Any
) -> int:
    """Exchange a column that lies in the span of the k active ones for one of them.

    The entering column takes weight from the active ones until one of them is zero;
    along this line the misfit changes only by the gradient of the entering column.
    Returns the position of the removed column, or -1.
    """
    solve(L, G[entering], active, k, z)
    leaving = -1
    step = math.inf
    for a in range(k):
        if z[a] > 0.0 and x[active[a]] < step * z[a]:
            leaving = a
            step = x[active[a]] / z[a]
    if leaving < 0 or step <= 0.0:
        return -1
    for a in range(k):
        x[active[a]] = max(x[active[a]] - step * z[a], 0.0)
    x[active[leaving]] = 0.0
    x[entering] += step
    return leaving


@kernel
def _drop(active: Any, position: int, k: int) -> int:
    for a in range(position, k - 1):
        active[a] = active[a + 1]
    return k - 1


@kernel
def active_set(
    G: Any, b: Any, x: Any, tolerance: float, limit: int, memory: Any
) -> tuple[float, int, bool, float]:
    """Minimise x G x / 2 - b x, x >= 0, for a Gram matrix of unit diagonal (0 for empty
    columns), from a warm x.

    Lawson and Hanson's method on the normal equations (Bro and de Jong 1997), with a
    factor that grows by one row per step; a column that is collinear with the active
    ones replaces one of them. Returns the KKT residual over all columns relative to max
    |b|, the iterations, whether the tolerance was met, and the squared ratio of the
    factor's extreme pivots (a lower bound of the active columns' condition).
    """
    m = b.shape[0]
    scale = 0.0
    for j in range(m):
        scale = max(scale, abs(b[j]))
    if scale == 0.0:
        x[:] = 0.0
        return 0.0, 0, True, 1.0
    L = memory.factor
    z = memory.solution
    w = memory.gradient
    active = np.empty(m, np.int64)
    passive = np.zeros(m, np.bool_)
    barred = np.zeros(m, np.bool_)
    # active columns, those the factor holds, iterations
    k = 0
    valid = 0
    count = 0
    for j in range(m):
        if x[j] > 0.0:
            active[k], passive[j] = j, True
            k += 1
    entering = -1
    warm = k > 0
    while count < limit:
        if not warm:
            _gradient(G, b, x, w)
            entering = -1
            best = tolerance * scale
            for j in range(m):
                if not passive[j] and not barred[j] and G[j, j] > 0.0 and w[j] > best:
                    entering = j
                    best = w[j]
            if entering < 0:
                break
            active[k], passive[entering] = entering, True
            k += 1
        warm = False
        while True:
            count += 1
            bad = factor(G, active, valid, k, L)
            if bad >= 0:
                valid = bad
                j = active[bad]
                if j == entering and bad == k - 1:
                    out = _exchange(G, entering, active, k - 1, L, x, z)
                    if out >= 0:  # of two similar columns, the better one is kept
                        passive[active[out]] = False
                        k = _drop(active, out, k)
                        valid = min(valid, out)
                        if count < limit:
                            continue
                        break
                passive[j], barred[j], x[j] = False, True, 0.0
                k = _drop(active, bad, k)
                if j == entering:
                    break
                continue
            valid = k
            solve(L, b, active, k, z)
            step = 1.0
            leaving = False
            for a in range(k):
                if z[a] <= 0.0:
                    leaving = True
                    xa = x[active[a]]
                    step = min(step, xa / (xa - z[a]) if xa > z[a] else 0.0)
            if not leaving:
                for a in range(k):
                    if x[active[a]] != z[a]:
                        # after progress, barred columns may enter again
                        barred[:] = False
                    x[active[a]] = z[a]
                break
            for a in range(k - 1, -1, -1):
                j = active[a]
                x[j] += step * (z[a] - x[j])
                if z[a] <= 0.0 and x[j] <= 1e-15 * abs(z[a]) + 1e-300:
                    x[j], passive[j] = 0.0, False
                    if j == entering and step == 0.0:
                        # it entered because of rounding and would leave at once
                        barred[j] = True
                    k = _drop(active, a, k)
                    valid = min(valid, a)
            if count >= limit:
                break
        entering = -1
    _gradient(G, b, x, w)
    worst = 0.0
    for j in range(m):
        if G[j, j] > 0.0:
            worst = max(worst, abs(w[j]) if x[j] > 0.0 else w[j])
    low = math.inf
    high = 0.0
    for a in range(min(valid, k)):
        low = min(low, L[a, a])
        high = max(high, L[a, a])
    condition = (high / low) ** 2 if high > 0.0 else 1.0
    return (
        worst / scale,
        count,
        worst <= 10.0 * max(tolerance, 1e-12) * scale and count < limit,
        condition,
    )


@kernel
def solve_scaled(
    G: Any, b: Any, x: Any, tolerance: float, limit: int, memory: Any
) -> tuple[float, int, bool, float]:
    """`active_set` after scaling the columns to unit length; G and b are overwritten, x
    is the warm start.
    """
    m = b.shape[0]
    length = np.zeros(m)
    for j in range(m):
        length[j] = 1.0 / math.sqrt(G[j, j]) if G[j, j] > 0.0 else 0.0
    for i in range(m):
        f = length[i]
        for j in range(m):
            G[i, j] = G[i, j] * f * length[j]
        b[i] *= f
        x[i] = x[i] / f if f > 0.0 else 0.0
    result = active_set(G, b, x, tolerance, limit, memory)
    for i in range(m):
        x[i] *= length[i]
    return result


@kernel
def solve_many(
    G: Any,
    b: Any,
    x: Any,
    finite: Any,
    tolerance: float,
    kkt: Any,
    count: Any,
    met: Any,
) -> None:
    """`solve_scaled` for every problem that is finite."""
    m = b.shape[1]
    memory = active_set_memory(m)
    for i in range(b.shape[0]):
        if finite[i]:
            kkt[i], count[i], met[i], _ = solve_scaled(
                G[i], b[i], x[i], tolerance, 6 * m, memory
            )
