"""A smooth map of the plane through given points, without folds: thin-plate splines (Bookstein 1989)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from skindb.geometry.landmarks import similarity

Float = NDArray[np.floating[Any]]
NEAR = 0.01  # of the spread of the points: half a millimetre on a face, less than a click is worth
# the 20 of a face alone have 235; 50 costs nothing where they are right and a fifth of what errors of clicks do
LARGEST_CONDITION = 50.0
FLAT = 1e-2  # width of the points over their length, below which they count as a line
LEAST_AREA = 0.05  # what an area may shrink to, over what the similarity makes of it
SMOOTHEST, FIRST, STEP = 1e4, 1e-3, 4.0  # of what folds: 1e-3 moves a point by a hundredth of its misfit
GRID, MARGIN = 64, 4.0  # points along a side where folds are looked for, and its half length in spreads
BLOCK = 1 << 14  # points at a time: 20 x 16,384 doubles stay in the cache


@dataclass(frozen=True)
class Warp:
    """A map of the plane: `affine` of (1, x), and `weight` of r^2 log r round each centre."""

    kind: str  # "thin plate", "affine", "similarity", "shift" or "identity"
    origin: Float  # (2,)
    scale: float  # x = (uv - origin) / scale
    centre: Float  # (c, 2) in x
    weight: Float  # (c, 2)
    affine: Float  # (3, 2)
    condition: float  # of the regularised system; 1 without one
    smoothing: float  # added to its diagonal, in units of x
    used: NDArray[np.bool_]  # (k,) of the points given; False: not finite, or merged with one before


def fit_warp(source: Float, target: Float, *, smoothing: float | None = None) -> Warp:
    """The map that brings points onto others and bends least.

    Points that nearly coincide, in the source or in the target, become their mean. The system is regularised until its
    condition number is at most `LARGEST_CONDITION`, and further until the map folds nowhere among the points and
    around them; what folds even without bending becomes a similarity. Three points make an affine map, two (or points
    on a line) a similarity, one a shift, none the identity: see `Warp.kind`.

    Parameters
    ----------
    source, target
        (k, 2) in the same units; NaN in either leaves the point out.
    smoothing
        Starting value instead of the one from the condition number, in units of the squared spread of the points;
        0 goes through every point.
    """
    x, y = (np.asarray(points, np.float64).reshape(-1, 2) for points in (source, target))
    a, b, used = _merged(x, y)
    if len(a) < 2:
        shift = b[0] - a[0] if len(a) else np.zeros(2)
        return _plain("shift" if len(a) else "identity", used, np.zeros(2), 1.0, np.eye(2), shift)
    origin, scale = a.mean(axis=0), _spread(a)
    a = (a - origin) / scale
    matrix, shift = similarity(a, b)
    fallback = _plain("similarity", used, origin, scale, matrix, shift)
    if len(a) < 3 or _width(a) < FLAT or _width(b) < FLAT:
        return fallback
    least = LEAST_AREA * np.linalg.det(matrix)
    system = _System.of(a)
    start = max(0.0, system.smoothing_for(LARGEST_CONDITION) if smoothing is None else smoothing)
    grown = [v for v in FIRST * STEP ** np.arange(20) if start < v < SMOOTHEST]
    for value in [start, *grown] if len(a) > 3 else []:
        weight, affine = system.solve(b, value)
        if system.smallest_area(weight, affine) > least:
            kind, condition = "thin plate", system.condition(value)
            return Warp(kind, origin, scale, a, weight, affine, condition, float(value), used)
    affine = np.linalg.lstsq(_linear(a), b, rcond=None)[0]
    if np.linalg.det(affine[1:]) <= least:
        return fallback
    return replace(fallback, kind="affine", affine=affine)


def apply_warp(warp: Warp, uv: Float) -> NDArray[np.float64]:
    """Where the map puts points (n, 2)."""
    points = (np.asarray(uv, np.float64) - warp.origin) / warp.scale
    out = _linear(points) @ warp.affine
    if len(warp.centre):
        for i in range(0, len(points), BLOCK):
            out[i : i + BLOCK] += _bending(points[i : i + BLOCK], warp.centre) @ warp.weight
    return np.asarray(out)


def area_factor(warp: Warp, uv: Float) -> NDArray[np.float64]:
    """Determinant of the Jacobian (n,) at points (n, 2): negative where the map is folded."""
    points = (np.asarray(uv, np.float64) - warp.origin) / warp.scale
    parts = [_slopes(points[i : i + BLOCK], warp.centre) for i in range(0, len(points), BLOCK)]
    slope = [warp.affine[1:] + np.einsum("nca,cb->nab", part, warp.weight) for part in parts]
    return np.asarray(np.linalg.det(np.concatenate(slope)) / warp.scale**2) if slope else np.zeros(0)


def left_out_error(warp: Warp) -> NDArray[np.float64]:
    """How far each point (k,) is from where the map by the others would put it (Rippa 1999, without refitting).

    NaN for points that are not used, and where there is no thin plate.
    """
    out = np.full(len(warp.used), np.nan)
    if len(warp.centre):
        inverse = _System.of(warp.centre).inverse(warp.smoothing)
        out[warp.used] = np.linalg.norm(warp.weight, axis=1) / np.diag(inverse)
    return out


@dataclass(frozen=True)
class _System:
    """Bending energy of centres on the complement of affine maps, where it is positive definite."""

    centre: Float  # (c, 2)
    kernel: Float  # (c, c)
    complement: Float  # (c, c - 3) orthonormal, orthogonal to (1, x)
    value: Float  # (c - 3,) eigenvalues, ascending
    vector: Float  # (c - 3, c - 3)
    slopes: Float  # (m, c, 2) where folds are looked for

    @classmethod
    def of(cls, centre: Float) -> _System:
        kernel = _bending(centre, centre)
        complement = np.linalg.qr(_linear(centre), mode="complete")[0][:, 3:]
        value, vector = np.linalg.eigh(complement.T @ kernel @ complement)
        return cls(centre, kernel, complement, value, vector, _slopes(_watched(centre), centre))

    def condition(self, smoothing: float) -> float:
        return float((self.value[-1] + smoothing) / (self.value[0] + smoothing)) if len(self.value) else 1.0

    def smoothing_for(self, condition: float) -> float:
        """Least diagonal that keeps the condition number."""
        return float((self.value[-1] - condition * self.value[0]) / (condition - 1)) if len(self.value) else 0.0

    def inverse(self, smoothing: float) -> Float:
        """What makes weights of targets."""
        vector = self.complement @ self.vector
        return vector / (self.value + smoothing) @ vector.T

    def solve(self, target: Float, smoothing: float) -> tuple[Float, Float]:
        weight = self.inverse(smoothing) @ target
        left = target - self.kernel @ weight - smoothing * weight
        return weight, np.linalg.lstsq(_linear(self.centre), left, rcond=None)[0]

    def smallest_area(self, weight: Float, affine: Float) -> float:
        bent = np.einsum("nca,cb->nab", self.slopes, weight)
        slope = affine[1:] + np.concatenate([bent, np.zeros((1, 2, 2))])  # far away nothing is bent
        return float((slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]).min())


def _merged(source: Float, target: Float) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Distinct points of both and which of the given ones stand for them."""
    used: NDArray[np.bool_] = np.isfinite(np.hstack([source, target])).all(axis=1)
    own = np.flatnonzero(used)
    group = np.arange(len(source))
    for points in (source, target):
        near = NEAR * _spread(points[own])
        for n, i in enumerate(own):
            for j in own[:n]:
                if np.linalg.norm(points[i] - points[j]) <= near:
                    group[group == group[i]] = group[j]
    first = [int(i) for i in own if not (group[own[own < i]] == group[i]).any()]
    used[:] = False
    used[first] = True
    members = [own[group[own] == group[i]] for i in first]
    a, b = (np.array([points[m].mean(axis=0) for m in members]).reshape(-1, 2) for points in (source, target))
    return a, b, used


def _spread(points: Float) -> float:
    """Root mean square distance from the middle; 0 of coinciding points or none."""
    return float(np.sqrt(points.var(axis=0).sum())) if len(points) else 0.0


def _width(points: Float) -> float:
    """Extent across over extent along."""
    value = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(value[1] / value[0])


def _plain(kind: str, used: NDArray[np.bool_], origin: Float, scale: float, matrix: Float, shift: Float) -> Warp:
    none = np.zeros((0, 2))
    return Warp(kind, origin, scale, none, none, np.vstack([shift, matrix]), 1.0, 0.0, used)


def _linear(points: Float) -> Float:
    return np.concatenate([np.ones((len(points), 1)), points], axis=1)


def _bending(points: Float, centre: Float) -> Float:
    """r^2 log r (n, c)."""
    squared = ((points[:, None] - centre) ** 2).sum(axis=2)
    return np.asarray(0.5 * squared * np.log(np.maximum(squared, np.finfo(np.float64).tiny)))


def _slopes(points: Float, centre: Float) -> Float:
    """Gradient (n, c, 2) of r^2 log r: (2 log r + 1) times the way from the centre."""
    way = points[:, None] - centre
    squared = (way**2).sum(axis=2, keepdims=True)
    return np.asarray(way * (np.log(np.maximum(squared, np.finfo(np.float64).tiny)) + 1))


def _watched(centre: Float) -> Float:
    """Where folds are looked for: an even grid, the centres, and on the way between every two of them."""
    side = np.linspace(-MARGIN, MARGIN, GRID)
    even = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    i, j = np.triu_indices(len(centre), 1)
    between = [t * centre[i] + (1 - t) * centre[j] for t in (0.1, 0.5, 0.9)]
    return np.concatenate([even, centre, *between])
