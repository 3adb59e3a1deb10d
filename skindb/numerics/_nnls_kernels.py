"""Compiled non-negative least squares of normal equations; `skindb.numerics.nnls`
states the problem.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skindb.jit import kernel
from skindb.types import BoolVector, Cube, IntVector, IntVector32, Matrix, Vector

# a column whose fraction outside the span of the active ones is below this is collinear
# with them
MIN_PIVOT = 1e-11


class ActiveSetMemory(NamedTuple):
    """Memory for `active_set` of m columns; each thread needs its own."""

    factor: Matrix  # (m, m) Cholesky factor of the active columns
    forward: Vector  # (m,) inverse of the factor times b
    solution: Vector  # (m,) unconstrained minimum on the active columns
    gradient: Vector  # (m,) b - G x
    active: IntVector  # (m,) the active columns, in the order of the factor
    is_active: BoolVector  # (m,)
    # (m,) columns that may not enter, as they are collinear or entered by rounding
    barred: BoolVector


@kernel
def active_set_memory(m: int) -> ActiveSetMemory:
    """Memory for problems of m columns."""
    return ActiveSetMemory(
        np.zeros((m, m)),
        np.zeros(m),
        np.zeros(m),
        np.zeros(m),
        np.empty(m, np.int64),
        np.zeros(m, np.bool_),
        np.zeros(m, np.bool_),
    )


@kernel
def factor(G: Matrix, active: IntVector, begin: int, k: int, L: Matrix) -> int:
    """Extend the Cholesky factor of G on `active` from position `begin` to k; returns
    the first bad pivot, or -1. The diagonal holds the reciprocals of the pivots.
    """
    for a in range(begin, k):
        i = active[a]
        pivot = G[i, i]
        for c in range(a):
            L[a, c] = G[i, active[c]]
        for q in range(a):
            t = L[a, q] * L[q, q]
            L[a, q] = t
            pivot -= t * t
            # independent, unlike the terms of a scalar product
            for c in range(q + 1, a):
                L[a, c] -= t * L[c, q]
        if pivot <= MIN_PIVOT:
            return a
        L[a, a] = 1.0 / math.sqrt(pivot)
    return -1


@kernel
def _solve_forward(
    L: Matrix, b: Vector, active: IntVector, begin: int, k: int, y: Vector
) -> None:
    """Extend L^-1 b on the active columns from position `begin` to k."""
    for a in range(begin, k):
        t = b[active[a]]
        for q in range(a):
            t -= L[a, q] * y[q]
        y[a] = t * L[a, a]


@kernel
def _solve_backward(L: Matrix, y: Vector, k: int, z: Vector) -> None:
    """Write L'^-1 y to z."""
    for a in range(k):
        z[a] = y[a]
    for a in range(k - 1, -1, -1):
        z[a] *= L[a, a]
        for q in range(a):
            z[q] -= L[a, q] * z[a]


@kernel
def solve(L: Matrix, b: Vector, active: IntVector, k: int, z: Vector) -> None:
    """Write to z the inverse of the factored matrix times b on the active columns."""
    _solve_forward(L, b, active, 0, k, z)
    _solve_backward(L, z, k, z)


@kernel
def invert(
    G: Matrix, active: IntVector, k: int, scaled: Matrix, L: Matrix, out: Matrix
) -> bool:
    """Write to out (k, k) the inverse of G on its k active columns, scaled to unit length
    in between; returns whether they are independent.
    """
    m = scaled.shape[0]
    length = np.zeros(m)
    unit = np.zeros(m)
    z = np.empty(m)
    for p in range(k):
        i = active[p]
        length[i] = 1.0 / math.sqrt(G[i, i]) if G[i, i] > 0.0 else 0.0
    for p in range(k):
        for c in range(k):
            i = active[p]
            j = active[c]
            scaled[i, j] = G[i, j] * length[i] * length[j]
    if factor(scaled, active, 0, k, L) >= 0:
        return False
    for p in range(k):
        unit[:] = 0.0
        unit[active[p]] = 1.0
        solve(L, unit, active, k, z)
        for c in range(k):
            out[p, c] = z[c] * length[active[p]] * length[active[c]]
    return True


@kernel
def _gradient(G: Matrix, b: Vector, x: Vector, w: Vector) -> None:
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
    G: Matrix,
    entering: int,
    active: IntVector,
    k: int,
    L: Matrix,
    x: Vector,
    z: Vector,
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
def _drop(active: IntVector, position: int, k: int) -> int:
    """Remove a position of the k active columns, and return their number."""
    for a in range(position, k - 1):
        active[a] = active[a + 1]
    return k - 1


@kernel
def _first_columns(x: Vector, memory: ActiveSetMemory) -> int:
    """Mark the columns of a warm start as active; returns their number."""
    k = 0
    for j in range(x.shape[0]):
        memory.barred[j] = False
        memory.is_active[j] = x[j] > 0.0
        if x[j] > 0.0:
            memory.active[k] = j
            k += 1
    return k


@kernel
def _entering_column(G: Matrix, threshold: float, memory: ActiveSetMemory) -> int:
    """The column with the largest gradient above the threshold, or -1."""
    w = memory.gradient
    entering = -1
    best = threshold
    for j in range(w.shape[0]):
        free = not memory.is_active[j] and not memory.barred[j]
        if free and G[j, j] > 0.0 and w[j] > best:
            entering = j
            best = w[j]
    return entering


@kernel
def _drop_collinear(
    G: Matrix,
    entering: int,
    position: int,
    k: int,
    x: Vector,
    memory: ActiveSetMemory,
) -> tuple[int, int, int]:
    """Remove a collinear column, or the one that it is exchanged for.

    Of two similar columns, the better one stays. Returns the number of active columns,
    of those the factor holds, and the column that was removed, -1 after an exchange.
    """
    active = memory.active
    j = active[position]
    if j == entering and position == k - 1:
        replaced = _exchange(
            G, entering, active, k - 1, memory.factor, x, memory.solution
        )
        if replaced >= 0:
            memory.is_active[active[replaced]] = False
            return _drop(active, replaced, k), min(position, replaced), -1
    memory.is_active[j] = False
    memory.barred[j] = True
    x[j] = 0.0
    return _drop(active, position, k), position, j


@kernel
def _move_to_minimum(k: int, x: Vector, memory: ActiveSetMemory) -> None:
    """Set the active columns to their unconstrained minimum."""
    for a in range(k):
        j = memory.active[a]
        if x[j] != memory.solution[a]:
            # after progress, barred columns may enter again
            memory.barred[:] = False
        x[j] = memory.solution[a]


@kernel
def _move_to_bound(
    entering: int, step: float, k: int, x: Vector, memory: ActiveSetMemory
) -> tuple[int, int]:
    """Move the active columns by a fraction of the way to their minimum, where some of
    them reach 0 and leave; returns the number of columns left, and of those the factor
    holds.
    """
    z = memory.solution
    valid = k
    for a in range(k - 1, -1, -1):
        j = memory.active[a]
        x[j] += step * (z[a] - x[j])
        if z[a] <= 0.0 and x[j] <= 1e-15 * abs(z[a]) + 1e-300:
            x[j] = 0.0
            memory.is_active[j] = False
            if j == entering and step == 0.0:
                # it entered because of rounding and would leave at once
                memory.barred[j] = True
            k = _drop(memory.active, a, k)
            valid = min(valid, a)
    return k, valid


@kernel
def active_set(
    G: Matrix,
    b: Vector,
    x: Vector,
    tolerance: float,
    limit: int,
    memory: ActiveSetMemory,
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
    active = memory.active
    # active columns, those the factor holds, those that `forward` holds, iterations
    k = _first_columns(x, memory)
    valid = 0
    solved = 0
    count = 0
    entering = -1
    warm = k > 0
    while count < limit:
        if not warm:
            _gradient(G, b, x, memory.gradient)
            entering = _entering_column(G, tolerance * scale, memory)
            if entering < 0:
                break
            active[k] = entering
            memory.is_active[entering] = True
            k += 1
        warm = False
        while True:
            count += 1
            solved = min(solved, valid)
            collinear = factor(G, active, valid, k, L)
            if collinear >= 0:
                k, valid, dropped = _drop_collinear(
                    G, entering, collinear, k, x, memory
                )
                if dropped == entering or (dropped < 0 and count >= limit):
                    break
                continue
            valid = k
            _solve_forward(L, b, active, solved, k, memory.forward)
            _solve_backward(L, memory.forward, k, z)
            solved = k
            step = _feasible_step(active, k, x, z)
            if step == math.inf:
                _move_to_minimum(k, x, memory)
                break
            k, valid = _move_to_bound(entering, step, k, x, memory)
            if count >= limit:
                break
        entering = -1
    _gradient(G, b, x, memory.gradient)
    worst = _worst_gradient(G, x, memory.gradient)
    converged = worst <= 10.0 * max(tolerance, 1e-12) * scale and count < limit
    return worst / scale, count, converged, _pivot_ratio(L, min(valid, k))


@kernel
def _feasible_step(active: IntVector, k: int, x: Vector, z: Vector) -> float:
    """Largest fraction of the way from x to z that keeps x >= 0; inf if z is positive."""
    step = math.inf
    for a in range(k):
        if z[a] <= 0.0:
            xa = x[active[a]]
            step = min(step, 1.0, xa / (xa - z[a]) if xa > z[a] else 0.0)
    return step


@kernel
def _worst_gradient(G: Matrix, x: Vector, w: Vector) -> float:
    """Largest violation of the KKT conditions by the gradient w."""
    worst = 0.0
    for j in range(x.shape[0]):
        if G[j, j] > 0.0:
            worst = max(worst, abs(w[j]) if x[j] > 0.0 else w[j])
    return worst


@kernel
def _pivot_ratio(L: Matrix, k: int) -> float:
    """Squared ratio of the extreme pivots of a factor of k columns."""
    low = math.inf
    high = 0.0
    for a in range(k):
        low = min(low, L[a, a])
        high = max(high, L[a, a])
    return (high / low) ** 2 if high > 0.0 else 1.0


@kernel
def solve_scaled(
    G: Matrix,
    b: Vector,
    x: Vector,
    tolerance: float,
    limit: int,
    memory: ActiveSetMemory,
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
    G: Cube,
    b: Matrix,
    x: Matrix,
    finite: BoolVector,
    tolerance: float,
    kkt: Vector,
    count: IntVector32,
    converged: BoolVector,
) -> None:
    """`solve_scaled` for every problem that is finite."""
    m = b.shape[1]
    memory = active_set_memory(m)
    for i in range(b.shape[0]):
        if finite[i]:
            kkt[i], count[i], converged[i], _ = solve_scaled(
                G[i], b[i], x[i], tolerance, 6 * m, memory
            )
