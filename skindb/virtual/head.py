"""Heads: the skin's surface as an open disc of triangles, with landmarks and regions."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import RectBivariateSpline

from skindb.types import Float64, Index, Mask, lengths
from skindb.virtual.face import (
    STEP,
    FaceShape,
    field,
    landmark_directions,
    normals,
    region_membership,
)

CENTRE = np.array([0.0, -38.0, 0.0])  # the skin is star-shaped about this point
COARSE = (76, 80)  # grid that is relaxed and then interpolated
# of the field, which is 1 on even skin; with less, a step could leave the head
LEAST_SLOPE = 0.1
SETTLED_MM = 0.01
SETTLE_ROUNDS = 20
RELAX = 8  # rounds that even out the triangles under nose and chin


@dataclass(frozen=True)
class Head:
    """A head: triangles, true normals, landmarks, and membership of each vertex in each region."""

    vertices: Float64  # (n, 3) mm
    faces: Index  # (m, 3), counter-clockwise from outside
    normals: Float64  # (n, 3)
    landmarks: Mapping[str, Float64]  # name -> (3,) mm
    membership: Mapping[str, Float64]  # region -> (n,) in [0, 1]

    def region(self, name: str) -> Mask:
        """Mask (n,) of the vertices with a membership above one half."""
        return self.membership[name] > 0.5


def parametric_head(
    shape: FaceShape, *, spacing_mm: float = 1.6, jitter: float = 0.0, seed: int = 0
) -> Head:
    """The face of `shape`, sampled about every `spacing_mm`.

    Parameters
    ----------
    shape
        Shape of the face.
    spacing_mm
        Typical edge length, mm.
    jitter, seed
        Random displacement of inner grid directions as a fraction of a cell, so that
        two samplings share no vertices.

    Returns
    -------
    Head
        Vertices lie on the true surface; one boundary loop, the topology of a disc.
    """
    rows = max(round(270 / spacing_mm), 8)
    columns = max(round(285 / spacing_mm), 8)
    near = _project(
        _resample(_relaxed_grid(shape), rows, columns, jitter, seed), shape, rounds=2
    )
    vertices = _project(near, shape, rounds=3)
    marks = landmark_directions(shape, CENTRE)
    points = _shoot(np.array(list(marks.values())), shape)
    return Head(
        vertices,
        _grid_faces(rows, columns),
        normals(vertices, shape),
        dict(zip(marks, points, strict=True)),
        region_membership(vertices, shape),
    )


@lru_cache(maxsize=2)
def _relaxed_grid(shape: FaceShape) -> Float64:
    """A coarse grid (rows, columns, 3) on the skin, from the top down and from the
    subject's right to the left.
    """
    vertices = _shoot(_directions(*COARSE).reshape(-1, 3), shape)
    # Laplacian smoothing within the surface; the boundary keeps its place
    for _ in range(RELAX):
        grid = vertices.reshape(*COARSE, 3).copy()
        mean = (grid[:-2, 1:-1] + grid[2:, 1:-1] + grid[1:-1, :-2] + grid[1:-1, 2:]) / 4
        grid[1:-1, 1:-1] += 0.7 * (mean - grid[1:-1, 1:-1])
        vertices = _project(grid.reshape(-1, 3), shape)
    return vertices.reshape(*COARSE, 3)


def _resample(
    grid: Float64, rows: int, columns: int, jitter: float, seed: int
) -> Float64:
    """Bicubic interpolation of the coarse grid at rows x columns parameters, as (n, 3)."""
    v, u = np.meshgrid(
        np.arange(rows) / (rows - 1), np.arange(columns) / (columns - 1), indexing="ij"
    )
    if jitter:
        move = np.random.default_rng(seed).uniform(-jitter, jitter, (2, rows, columns))
        move[:, [0, -1]] = move[:, :, [0, -1]] = 0
        v = v + move[0] / rows
        u = u + move[1] / columns
    axes = np.linspace(0, 1, COARSE[0]), np.linspace(0, 1, COARSE[1])
    spline = (RectBivariateSpline(*axes, grid[..., k]) for k in range(3))
    return np.stack([f.ev(v.ravel(), u.ravel()) for f in spline], axis=1)


def _directions(rows: int, columns: int) -> Float64:
    """Unit directions (rows, columns, 3) from the top row down, from the subject's
    right to the left.
    """
    v, u = np.meshgrid(
        np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij"
    )
    elevation = np.radians(1.0 - 63.0 * v)
    side = 96.0 - 40.0 * np.clip(-v, 0, 1) ** 3 - 30.0 * np.clip(v, 0, 1) ** 2.5
    azimuth = np.radians(side) * u
    cosine = np.cos(elevation)
    return np.stack(
        [cosine * np.sin(azimuth), np.sin(elevation), cosine * np.cos(azimuth)], axis=-1
    )


def _shoot(direction: Float64, shape: FaceShape) -> Float64:
    """Points (n, 3) on the skin along rays from the centre: a search from outside, then
    a few secant steps.
    """
    far = np.full(len(direction), 185.0)
    value = field(CENTRE + far[:, None] * direction, shape)
    open_ = np.arange(len(direction))
    for _ in range(60):
        step = 0.6 * value[open_]
        far[open_] -= step
        value[open_] = field(CENTRE + far[open_, None] * direction[open_], shape)
        open_ = open_[np.abs(value[open_]) > 1e-3]
        if not len(open_):
            break
    points = CENTRE + far[:, None] * direction
    return _project(points, shape, rounds=4)


def _project(points: Float64, shape: FaceShape, *, rounds: int = 1) -> Float64:
    """Move points near the skin onto it, along the field's gradient (Newton's method
    with a constant slope).
    """
    value = field(points, shape)
    slope = _slope(points, value, shape)
    slope /= np.maximum((slope**2).sum(axis=1, keepdims=True), LEAST_SLOPE**2)
    points = points - value[:, None] * slope
    for _ in range(rounds - 1):
        points = points - field(points, shape)[:, None] * slope
    return points if rounds == 1 else _settle(points, shape)


def _slope(points: Float64, value: Float64, shape: FaceShape) -> Float64:
    """Gradient (n, 3) of the field at points where its value is known."""
    moved = [field(points + step, shape) for step in STEP * np.eye(3)]
    return (np.stack(moved, axis=1) - value[:, None]) / STEP


def _settle(points: Float64, shape: FaceShape) -> Float64:
    """Move the remaining points onto the skin, those in creases, for which a constant
    slope fails.
    """
    value = field(points, shape)
    for _ in range(SETTLE_ROUNDS):
        far = np.flatnonzero(np.abs(value) > SETTLED_MM)
        if not len(far):
            break
        near = points[far]
        slope = _slope(near, value[far], shape)
        steepness = np.maximum(lengths(slope)[..., None], LEAST_SLOPE)
        # mm: the range in which the slope is valid
        step = np.clip(value[far, None] / steepness, -0.5, 0.5)
        points[far] = near - step * slope / steepness
        value[far] = field(points[far], shape)
    return points


def _grid_faces(rows: int, columns: int) -> Index:
    """Two triangles per cell, diagonals alternating."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a = index[:-1, :-1]
    b = index[:-1, 1:]
    c = index[1:, 1:]
    d = index[1:, :-1]
    even = ((np.arange(rows - 1)[:, None] + np.arange(columns - 1)) % 2 == 0)[..., None]
    lower = np.where(even, np.stack([a, d, c], -1), np.stack([a, d, b], -1))
    second = np.where(even, np.stack([a, c, b], -1), np.stack([d, c, b], -1))
    return np.stack([lower, second], axis=2).reshape(-1, 3).astype(int)
