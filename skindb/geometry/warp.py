"""A smooth map of the plane through given points, without folds: thin-plate splines
(Bookstein 1989).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skindb.geometry.landmarks import similarity, width

Float = NDArray[np.floating[Any]]
# of the spread of the points: half a millimetre on a face, less than the error of a
# click
SAME_POINT_FRACTION = 0.01
# for errors of clicks of 1 to 2 mm; the condition number for 20 points of a face is
# then about 50
SMOOTHING = 0.1
WEAK_SMOOTHING_FACTOR = 3.0  # smoothing at a weak point relative to other points
LOOSER = (1.0, 4.0, 16.0, 64.0)  # weak points give way before others do
# width of the points over their length, below which they are treated as a line
MIN_WIDTH_RATIO = 1e-2
MIN_AREA_RATIO = 0.05  # smallest area of the map relative to that of the similarity
# smoothing of folding maps: 1e-3 moves a point by a hundredth of its misfit
SMOOTHEST = 1e4
FIRST = 1e-3
STEP = 4.0
# points per side of the grid that is checked for folds, and its half length in spreads
GRID = 64
MARGIN = 4.0
NEIGHBOURS = 20  # of a centre, to which lines are checked for folds
# points times centres: 2 MB of doubles, which stay in the cache
PRODUCTS_PER_BLOCK = 1 << 18


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
    loose: Float  # (c,) times that
    # (k,) of the points given; False: not finite, or merged with one before
    used: NDArray[np.bool_]


def fit_warp(
    source: Float,
    target: Float,
    *,
    smoothing: float | None = None,
    weak: tuple[Float, Float] | None = None,
) -> Warp:
    """The map of points to other points with the least bending.

    Points that nearly coincide, in the source or in the target, are replaced by their
    mean. Smoothing is increased, first at the weak points, until the map has no fold
    among the points and around them; a map that folds even without bending is replaced
    by a similarity. Three points give an affine map, two (or points on a line) a
    similarity, one a shift, none the identity: see `Warp.kind`.

    Parameters
    ----------
    source, target
        (k, 2) in the same units; points with NaN in either are ignored.
    smoothing
        Diagonal of the system in units of the squared spread of the points, default
        `SMOOTHING`; 0 goes through every point.
    weak
        Source and target (m, 2) of less accurate points, which are used if the others
        determine an affine map.
    """
    x, y = (
        np.asarray(points, np.float64).reshape(-1, 2) for points in (source, target)
    )
    a, b, used = _merged(x, y)
    if len(a) < 2:
        shift = b[0] - a[0] if len(a) else np.zeros(2)
        return _plain(
            "shift" if len(a) else "identity", used, np.zeros(2), 1.0, np.eye(2), shift
        )
    origin = a.mean(axis=0)
    scale = _spread(a)
    a = (a - origin) / scale
    matrix, shift = similarity(a, b)
    fallback = _plain("similarity", used, origin, scale, matrix, shift)
    if len(a) < 3 or width(a) < MIN_WIDTH_RATIO or width(b) < MIN_WIDTH_RATIO:
        return fallback
    least = MIN_AREA_RATIO * np.linalg.det(matrix)
    more, there = (np.zeros((0, 2)),) * 2 if weak is None else _finite(*weak)
    centre = np.concatenate([a, (more - origin) / scale])
    goal = np.concatenate([b, there])
    start = max(0.0, SMOOTHING if smoothing is None else smoothing)
    grown = [v for v in FIRST * STEP ** np.arange(20) if start < v < SMOOTHEST]
    tried = [(start, by) for by in (LOOSER if len(more) else LOOSER[:1])]
    tried += [(value, tried[-1][1]) for value in grown]
    watched = _watched(centre) * scale + origin
    for value, by in tried if len(centre) > 3 else []:
        system = _System.of(
            centre, np.repeat([1.0, by * WEAK_SMOOTHING_FACTOR], [len(a), len(more)])
        )
        weight, affine = system.solve(goal, value)
        found = replace(
            fallback,
            kind="thin plate",
            centre=centre,
            weight=weight,
            affine=affine,
            loose=system.loose,
        )
        if (
            area_factor(found, watched).min() * scale**2
            > least
            < np.linalg.det(affine[1:])
        ):
            return replace(
                found, condition=system.condition(value), smoothing=float(value)
            )
    affine = np.linalg.lstsq(_linear(a), b, rcond=None)[0]
    if np.linalg.det(affine[1:]) <= least:
        return fallback
    return replace(fallback, kind="affine", affine=affine)


def apply_warp(warp: Warp, uv: Float) -> NDArray[np.float64]:
    """Apply the map to points (n, 2)."""
    points = (np.asarray(uv, np.float64) - warp.origin) / warp.scale
    out = _linear(points) @ warp.affine
    if len(warp.centre):
        for block in _blocks(points, warp):
            out[block] += _bending(points[block], warp.centre) @ warp.weight
    return np.asarray(out)


def area_factor(warp: Warp, uv: Float) -> NDArray[np.float64]:
    """Determinant of the Jacobian (n,) at points (n, 2): negative where the map is folded."""
    points = (np.asarray(uv, np.float64) - warp.origin) / warp.scale
    out = np.empty(len(points))
    for block in _blocks(points, warp):
        (a, b), (c, d) = np.moveaxis(
            warp.affine[1:] + _slope(points[block], warp.centre, warp.weight), 0, 2
        )
        out[block] = a * d - b * c
    return out / warp.scale**2


def left_out_error(warp: Warp) -> NDArray[np.float64]:
    """Leave-one-out error (k,): distance of each point from its image by the map of the
    others (Rippa 1999).

    NaN for points that are not used, and if there is no thin-plate map. The others
    include weak points.
    """
    out = np.full(len(warp.used), np.nan)
    if len(warp.centre):
        inverse = _System.of(warp.centre, warp.loose).inverse(warp.smoothing)
        # divided by the root of 1: none is weak
        error = np.linalg.norm(warp.weight, axis=1) / np.diag(inverse)
        out[warp.used] = error[: warp.used.sum()]
    return out


@dataclass(frozen=True)
class _System:
    """Bending energy of centres on the complement of affine maps, where it is positive definite.

    Rows and columns are divided by the square root of `loose`, so that the same is
    added to all of the diagonal.
    """

    centre: Float  # (c, 2)
    loose: Float  # (c,)
    kernel: Float  # (c, c)
    linear: Float  # (c, 3)
    complement: Float  # (c, c - 3) orthonormal, orthogonal to `linear`
    value: Float  # (c - 3,) eigenvalues, ascending
    vector: Float  # (c - 3, c - 3)

    @classmethod
    def of(cls, centre: Float, loose: Float) -> _System:
        root = np.sqrt(loose)[:, None]
        kernel = _bending(centre, centre) / (root * root.T)
        linear = _linear(centre) / root
        complement = np.linalg.qr(linear, mode="complete")[0][:, 3:]
        value, vector = np.linalg.eigh(complement.T @ kernel @ complement)
        return cls(centre, loose, kernel, linear, complement, value, vector)

    def condition(self, smoothing: float) -> float:
        return (
            float((self.value[-1] + smoothing) / (self.value[0] + smoothing))
            if len(self.value)
            else 1.0
        )

    def inverse(self, smoothing: float) -> Float:
        """Matrix that maps targets to weights, both scaled like the rows."""
        vector = self.complement @ self.vector
        return vector / (self.value + smoothing) @ vector.T

    def solve(self, target: Float, smoothing: float) -> tuple[Float, Float]:
        root = np.sqrt(self.loose)[:, None]
        weight = self.inverse(smoothing) @ (target / root)
        left = target / root - self.kernel @ weight - smoothing * weight
        return weight / root, np.linalg.lstsq(self.linear, left, rcond=None)[0]


def _merged(source: Float, target: Float) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Distinct points of both, and mask of the given points that represent them."""
    used: NDArray[np.bool_] = np.isfinite(np.hstack([source, target])).all(axis=1)
    own = np.flatnonzero(used)
    group = np.arange(len(source))
    for points in (source, target):
        near = SAME_POINT_FRACTION * _spread(points[own])
        for n, i in enumerate(own):
            for j in own[:n]:
                if np.linalg.norm(points[i] - points[j]) <= near:
                    group[group == group[i]] = group[j]
    first = [int(i) for i in own if not (group[own[own < i]] == group[i]).any()]
    used[:] = False
    used[first] = True
    members = [own[group[own] == group[i]] for i in first]
    a, b = (
        np.array([points[m].mean(axis=0) for m in members]).reshape(-1, 2)
        for points in (source, target)
    )
    return a, b, used


def _spread(points: Float) -> float:
    """Root mean square distance from the centroid; 0 for coinciding points or none."""
    return float(np.sqrt(points.var(axis=0).sum())) if len(points) else 0.0


def _finite(source: Float, target: Float) -> tuple[Float, Float]:
    """Points that are known in both."""
    known = np.isfinite(np.hstack([source, target])).all(axis=1)
    return np.asarray(source, np.float64)[known], np.asarray(target, np.float64)[known]


def _plain(
    kind: str,
    used: NDArray[np.bool_],
    origin: Float,
    scale: float,
    matrix: Float,
    shift: Float,
) -> Warp:
    none = np.zeros((0, 2))
    return Warp(
        kind,
        origin,
        scale,
        none,
        none,
        np.vstack([shift, matrix]),
        1.0,
        0.0,
        np.zeros(0),
        used,
    )


def _linear(points: Float) -> Float:
    return np.concatenate([np.ones((len(points), 1)), points], axis=1)


def _bending(points: Float, centre: Float) -> Float:
    """r^2 log r (n, c)."""
    squared = (points[:, :1] - centre[:, 0]) ** 2 + (points[:, 1:] - centre[:, 1]) ** 2
    return np.asarray(
        0.5 * squared * np.log(np.maximum(squared, np.finfo(np.float64).tiny))
    )


def _slope(points: Float, centre: Float, weight: Float) -> Float:
    """Gradient (n, 2, 2) of the weighted sum of r^2 log r: (2 log r + 1) times the
    vector from each centre.
    """
    x = points[:, :1] - centre[:, 0]
    y = points[:, 1:] - centre[:, 1]
    factor = np.log(np.maximum(x * x + y * y, np.finfo(np.float64).tiny)) + 1
    return np.stack([(factor * x) @ weight, (factor * y) @ weight], axis=1)


def _blocks(points: Float, warp: Warp) -> list[slice]:
    size = max(1, PRODUCTS_PER_BLOCK // max(1, len(warp.centre)))
    return [slice(i, i + size) for i in range(0, len(points), size)]


def _watched(centre: Float) -> Float:
    """Points that are checked for folds: an even grid, the centres, and points between
    neighbouring centres.
    """
    side = np.linspace(-MARGIN, MARGIN, GRID)
    even = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    near = (
        cKDTree(centre)
        .query(centre, min(NEIGHBOURS, len(centre)))[1]
        .reshape(len(centre), -1)
    )
    i = np.repeat(np.arange(len(centre)), near.shape[1])
    j = near.ravel()
    between = [t * centre[i] + (1 - t) * centre[j] for t in (0.1, 0.5)]
    return np.concatenate([even, centre, *between])
