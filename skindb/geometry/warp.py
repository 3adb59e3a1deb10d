"""Smooth maps of the plane through points, without folds (thin-plate splines, Bookstein 1989),
and corresponding points of two surfaces by a non-rigid alignment that starts from landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from skindb.geometry.landmarks import similarity, width
from skindb.geometry.mesh import (
    boundary_loops,
    closest_on_mesh,
    outline_first,
    vertex_areas,
    vertex_normals,
)
from skindb.types import (
    Array,
    Float64,
    Index,
    Mask,
    dots,
    finite_rows,
    float64,
    lengths,
)

# of the spread of the points: half a millimetre on a face, less than the error of a
# click
SAME_POINT_FRACTION = 0.01
# for errors of clicks of 1 to 2 mm
SMOOTHING = 0.1
WEAK_SMOOTHING_FACTOR = 3.0  # smoothing at a weak point relative to other points
LOOSENING = (1.0, 4.0, 16.0, 64.0)  # weak points give way before others do
# width of the points over their length, below which they are treated as a line
MIN_WIDTH_RATIO = 1e-2
MIN_AREA_RATIO = 0.05  # smallest area of the map relative to that of the similarity
# smoothing of folding maps: 1e-3 moves a point by a hundredth of its misfit
MAX_SMOOTHING = 1e4
MIN_SMOOTHING = 1e-3
SMOOTHING_STEP = 4.0
# points per side of the grid that is checked for folds, and its half length in spreads
GRID = 64
MARGIN = 4.0
NEIGHBOURS = 20  # of a centre, to which lines are checked for folds
FAR = 100.0  # half length in spreads of the grid where the map is nearly affine
SLOPE_STEP = 1e-5  # of differences, in spreads
ALIGNED = 3  # number of shared landmarks that an alignment requires
# width of the landmarks over their length, below which the rotation is undetermined
MIN_LANDMARK_WIDTH_RATIO = 0.05
# points inside the surface (17 mm apart on a head) and along its outline
INNER_POINTS = 200
OUTLINE_POINTS = 48
SAMPLED_VERTICES = 20_000  # vertices from which these points are chosen
# rounds of alignment; round from which matching outlines are used
ALIGNMENT_ROUNDS = 8
OUTLINE_ROUND = 4
# mm: amplitude and correlation length of differences of faces after a similarity
DEFORMATION_SD_MM = 10.0
DEFORMATION_LENGTH_MM = 60.0
# mm, standard deviations: of a click; across the surface; along the surface; of the outline
CLICK_SD_MM = 1.0
ACROSS_SD_MM = 0.5
ALONG_SD_MM = 6.0
OUTLINE_SD_MM = 4.0
# mm from the surface: during alignment, and at the end
MAX_ALIGNING_DISTANCE_MM = 20.0
MAX_FOUND_DISTANCE_MM = 8.0
# mm from the nearest landmark: within it, clicks are more accurate than shape (lips and
# nose by 0.3 mm)
MIN_LANDMARK_DISTANCE_MM = 20.0
MIN_COSINE_NORMALS = 0.5  # between the normals of points that may correspond
# mm, 90 % quantile of the distance between outlines at the same angle of the atlas: 9
# to 23 on ten heads with similar outlines, 38 to 85 on heads with different outlines
MAX_OUTLINE_DISTANCE_MM = 30.0


@dataclass(frozen=True)
class Warp:
    """A map of the plane: a thin-plate spline, or else `affine` of (1, x)."""

    kind: str  # "thin plate", "affine", "similarity", "shift" or "identity"
    origin: Array  # (2,)
    scale: float  # x = (uv - origin) / scale
    affine: Array  # (3, 2)
    # (k,) of the points; False: not finite, or merged with one before
    used: Mask
    spline: Spline | None = None

    @property
    def smoothing(self) -> float:
        """Added to the diagonal of the system of the spline, in units of x."""
        return 0.0 if self.spline is None else self.spline.smoothing


@dataclass(frozen=True)
class Spline:
    """Points of a thin-plate spline in x, and their images."""

    centre: Array  # (c, 2)
    goal: Array  # (c, 2)
    smoothing: float  # added to the diagonal of its system, in units of x
    loose: Array  # (c,) times that

    @cached_property
    def map(self) -> RBFInterpolator:
        """The spline through these points."""
        smoothing = self.smoothing * self.loose
        return RBFInterpolator(
            self.centre, self.goal, smoothing=smoothing, kernel="thin_plate_spline"
        )

    def without(self, i: int) -> Spline:
        """The spline without one of its points."""
        parts = (self.centre, self.goal, self.loose)
        centre, goal, loose = (np.delete(part, i, axis=0) for part in parts)
        return Spline(centre, goal, self.smoothing, loose)


def fit_warp(
    source: Array,
    target: Array,
    *,
    smoothing: float | None = None,
    weak: tuple[Array, Array] | None = None,
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
    x, y = (float64(points).reshape(-1, 2) for points in (source, target))
    a, b, is_used = _merged(x, y)
    if not len(a):
        return _plain("identity", is_used, np.zeros(2), 1.0, np.eye(2), np.zeros(2))
    if len(a) == 1:
        return _plain("shift", is_used, np.zeros(2), 1.0, np.eye(2), b[0] - a[0])
    origin = a.mean(axis=0)
    scale = _spread(a)
    a = (a - origin) / scale
    matrix, shift = similarity(a, b)
    fallback = _plain("similarity", is_used, origin, scale, matrix, shift)
    if len(a) < 3 or width(a) < MIN_WIDTH_RATIO or width(b) < MIN_WIDTH_RATIO:
        return fallback
    min_area = MIN_AREA_RATIO * np.linalg.det(matrix)
    centre = a
    goal = b
    if weak is not None:
        weak_source, weak_target = np.stack(weak)[:, finite_rows(np.hstack(weak))]
        centre = np.concatenate([a, (weak_source - origin) / scale])
        goal = np.concatenate([b, weak_target])
    is_weak = np.arange(len(centre)) >= len(a)
    if len(centre) > 3:
        attempts = _attempts(smoothing, len(centre) > len(a))
        warp = _without_folds(fallback, centre, goal, is_weak, attempts, min_area)
        if warp is not None:
            return warp
    affine = np.linalg.lstsq(_linear(a), b)[0]
    if np.linalg.det(affine[1:]) <= min_area:
        return fallback
    return replace(fallback, kind="affine", affine=affine)


def _without_folds(
    base: Warp,
    centre: Array,
    goal: Array,
    is_weak: Mask,
    attempts: list[tuple[float, float]],
    min_area: float,
) -> Warp | None:
    """The thin-plate map of the first attempt that is nowhere folded; None if all are."""
    checked = _check_points(centre) * base.scale + base.origin
    for smoothing, loosening in attempts:
        loose = np.where(is_weak, loosening * WEAK_SMOOTHING_FACTOR, 1.0)
        spline = Spline(centre, goal, smoothing, loose)
        warp = replace(base, kind="thin plate", spline=spline)
        if area_factor(warp, checked).min() * base.scale**2 > min_area:
            return warp
    return None


def _attempts(smoothing: float | None, has_weak: bool) -> list[tuple[float, float]]:
    """Smoothing and loosening of the weak points, in the order in which they are tried."""
    start = max(0.0, SMOOTHING if smoothing is None else smoothing)
    loosening = LOOSENING if has_weak else LOOSENING[:1]
    steps = (MIN_SMOOTHING * SMOOTHING_STEP ** np.arange(20)).tolist()
    larger = [value for value in steps if start < value < MAX_SMOOTHING]
    return [
        *((start, factor) for factor in loosening),
        *((value, loosening[-1]) for value in larger),
    ]


def apply_warp(warp: Warp, uv: Array) -> Float64:
    """Apply the map to points (n, 2)."""
    points = (float64(uv) - warp.origin) / warp.scale
    if warp.spline is not None:
        return float64(warp.spline.map(points))
    return _linear(points) @ warp.affine


def area_factor(warp: Warp, uv: Array) -> Float64:
    """Determinant of the Jacobian (n,) at points (n, 2): negative where the map is folded."""
    step = SLOPE_STEP * warp.scale * np.eye(2)
    points = float64(uv)
    (a, b), (c, d) = (
        ((apply_warp(warp, points + h) - apply_warp(warp, points - h)) / 2).T
        for h in step
    )
    return float64((a * d - b * c) / (SLOPE_STEP * warp.scale) ** 2)


def left_out_error(warp: Warp) -> Float64:
    """Leave-one-out error (k,): distance of each point from its image by the map of the others.

    NaN for points that are not used or without which the others lie on a line, and if
    there is no thin-plate map. The others include weak points.
    """
    out = np.full(len(warp.used), np.nan)
    if warp.spline is not None:
        spline = warp.spline
        for i, place in enumerate(np.flatnonzero(warp.used)):
            others = spline.without(i)
            if width(others.centre) >= MIN_WIDTH_RATIO:
                image = others.map(spline.centre[i : i + 1])[0]
                out[place] = np.linalg.norm(image - spline.goal[i])
    return out


def _merged(source: Array, target: Array) -> tuple[Float64, Float64, Mask]:
    """Distinct points of both, and mask of the points that represent them."""
    is_used = finite_rows(np.hstack([source, target]))
    finite = np.flatnonzero(is_used)
    group = np.arange(len(source))
    for points in (source, target):
        near = SAME_POINT_FRACTION * _spread(points[finite])
        for n, i in enumerate(finite):
            for j in finite[:n]:
                if np.linalg.norm(points[i] - points[j]) <= near:
                    group[group == group[i]] = group[j]
    _, places = np.unique(group[finite], return_index=True)
    leaders = finite[np.sort(places)]
    is_used[:] = False
    is_used[leaders] = True
    members = [finite[group[finite] == group[i]] for i in leaders]
    a, b = (
        np.array([points[rows].mean(axis=0) for rows in members]).reshape(-1, 2)
        for points in (source, target)
    )
    return a, b, is_used


def _spread(points: Array) -> float:
    """Root mean square distance from the centroid; 0 for coinciding points or none."""
    return float(np.sqrt(points.var(axis=0).sum())) if len(points) else 0.0


def _plain(
    kind: str,
    is_used: Mask,
    origin: Array,
    scale: float,
    matrix: Array,
    shift: Array,
) -> Warp:
    return Warp(kind, origin, scale, np.vstack([shift, matrix]), is_used)


def _linear(points: Array) -> Float64:
    return np.concatenate([np.ones((len(points), 1)), points], axis=1)


def _check_points(centre: Array) -> Float64:
    """Points that are checked for folds: an even grid, far ones, where the map is nearly
    affine, the centres, and points between neighbouring centres.
    """
    side = np.linspace(-MARGIN, MARGIN, GRID)
    even = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    count = min(NEIGHBOURS, len(centre))
    i = np.repeat(np.arange(len(centre)), count)
    j = cKDTree(centre).query(centre, count)[1].ravel()
    between = [t * centre[i] + (1 - t) * centre[j] for t in (0.1, 0.5)]
    return np.concatenate([even, FAR / MARGIN * even, centre, *between])


@dataclass(frozen=True)
class Sheet:
    """A surface with an outline, texture coordinates and landmarks."""

    position: Array  # (n, 3) mm
    uv: Array  # (n, 2), the outline on a circle
    faces: Index  # (f, 3)
    landmark: Array  # (k, 3) mm; NaN if missing
    normal: Array  # (n, 3)
    rim: Mask  # (n,) whether on any boundary
    outline: Index  # (r,) the longest boundary

    @classmethod
    def of(cls, position: Array, uv: Array, faces: Index, landmark: Array) -> Sheet:
        """Normals and boundaries of a mesh."""
        loops = outline_first(float64(position), boundary_loops(faces))
        rim = np.zeros(len(position), np.bool_)
        rim[np.concatenate(loops)] = True
        normal = vertex_normals(position, faces)
        return cls(position, uv, faces, landmark, normal, rim, loops[0])

    def known(self) -> Mask:
        """Which landmarks (k,) it has."""
        return finite_rows(self.landmark)

    def area(self) -> float:
        """In mm2."""
        return float(vertex_areas(self.position, self.faces).sum())

    def alignable(self, chosen: Mask | None = None) -> bool:
        """Whether its landmarks, or chosen ones of them, determine its rotation."""
        landmark = self.landmark[self.known() if chosen is None else chosen]
        return len(landmark) >= ALIGNED and width(landmark) >= MIN_LANDMARK_WIDTH_RATIO


def anchor_vertices(sheet: Sheet) -> Index:
    """INNER_POINTS vertices far from each other and the landmarks, then OUTLINE_POINTS
    along the outline.
    """
    step = max(1, len(sheet.position) // SAMPLED_VERTICES)
    vertices = np.flatnonzero(~sheet.rim)[::step]
    points = sheet.position[vertices]
    distance = cKDTree(sheet.landmark[sheet.known()]).query(points)[0]
    inner = list[int]()
    for _ in range(min(INNER_POINTS, len(vertices))):
        farthest = int(distance.argmax())
        inner.append(farthest)
        to_farthest = lengths(points - points[farthest])
        distance = np.minimum(distance, to_farthest)
    along = np.linspace(0, len(sheet.outline), OUTLINE_POINTS, endpoint=False)
    outline = sheet.outline[along.astype(np.int64)]
    return np.concatenate([vertices[inner], outline])


def corresponding_uv(template: Sheet, chosen: Index, take: Sheet) -> Float64:
    """Texture coordinates (n, 2) on a take that correspond to vertices of the template;
    NaN where there are none.

    The template is rotated, scaled, and deformed by a Gaussian process onto the take's
    landmarks and, in rounds, onto the nearest points of its surface, along which it may
    slide (Amberg et al. 2007 with another smoothness). If both have similar outlines,
    these are matched by their angle in the atlas.
    """
    shared = template.known() & take.known()
    if not (template.alignable(shared) and take.alignable(shared)):
        return np.full((len(chosen), 2), np.nan)
    aligned, on_rim, same_outline = _aligned(template, chosen, take, shared)
    face, weight, distance = closest_on_mesh(take.position, take.faces, aligned)
    corners = take.faces[face]
    uv = np.einsum("nk,nkc->nc", weight, float64(take.uv[corners]))
    at_rim = (take.rim[corners] & (weight > 0)).any(axis=1)
    landmarks = cKDTree(template.landmark[shared])
    to_landmark = landmarks.query(template.position[chosen])[0]
    corresponds = (
        (distance <= MAX_FOUND_DISTANCE_MM)
        & (to_landmark >= MIN_LANDMARK_DISTANCE_MM)
        & ~at_rim
        & ~on_rim
    )
    uv = np.where(corresponds[:, None], uv, np.nan)
    return np.where((on_rim & same_outline)[:, None], template.uv[chosen], uv)


def _aligned(
    template: Sheet, chosen: Index, take: Sheet, shared: Mask
) -> tuple[Float64, Mask, bool]:
    """Positions (n, 3) of chosen points on the take, mask of outline points, and
    whether the outlines match.
    """
    clicks = template.landmark[shared]
    on_rim = template.rim[chosen]
    matrix, shift = similarity(clicks, take.landmark[shared])
    turn = matrix / np.cbrt(np.linalg.det(matrix))
    start = template.position[chosen] @ matrix + shift
    normal = template.normal[chosen] @ turn
    tree = cKDTree(take.position)
    outline_uv = cKDTree(take.uv[take.outline])
    outline = take.outline[outline_uv.query(template.uv[chosen[on_rim]])[1]]
    n = len(clicks)
    # the landmarks first, then the chosen points
    points = np.concatenate([clicks @ matrix + shift, start])
    # covariance of a once differentiable field (Matern)
    r = np.sqrt(3) * lengths(points[:, None] - points) / DEFORMATION_LENGTH_MM
    kernel = DEFORMATION_SD_MM**2 * (1 + r) * np.exp(-r)
    pull = np.concatenate([take.landmark[shared] - points[:n], np.zeros_like(start)])
    error = np.tile(CLICK_SD_MM**2 * np.eye(3), (len(points), 1, 1))
    is_used = np.arange(len(points)) < n
    same_outline = False
    for i in range(ALIGNMENT_ROUNDS + 1):
        weights = _weights(
            kernel[np.ix_(is_used, is_used)], pull[is_used], error[is_used]
        )
        aligned = start + kernel[n:, is_used] @ weights
        distance, near = tree.query(aligned)
        target_normal = take.normal[near]
        across = target_normal[:, :, None] * target_normal[:, None]
        error[n:] = ACROSS_SD_MM**2 * across + ALONG_SD_MM**2 * (np.eye(3) - across)
        # onto the tangent plane of the nearest vertex, in which the point may slide
        step = np.einsum("nij,nj->ni", across, take.position[near] - aligned)
        pull[n:] = aligned + step - start
        facing = dots(normal, target_normal) > MIN_COSINE_NORMALS
        close = distance < MAX_ALIGNING_DISTANCE_MM
        is_used[n:] = close & facing & ~take.rim[near] & ~on_rim
        if i == OUTLINE_ROUND:
            gap = lengths(take.position[outline] - aligned[on_rim])
            same_outline = bool(np.quantile(gap, 0.9) < MAX_OUTLINE_DISTANCE_MM)
        if same_outline:
            ends = n + np.flatnonzero(on_rim)
            is_used[ends] = True
            error[ends] = OUTLINE_SD_MM**2 * np.eye(3)
            pull[ends] = take.position[outline] - start[on_rim]
    return aligned, on_rim, same_outline


def _weights(kernel: Array, pull: Array, error: Array) -> Float64:
    """Kriging weights (m, 3) of displacements whose errors have covariances `error` (m, 3, 3)."""
    m = len(pull)
    system = np.kron(kernel, np.eye(3)).reshape(m, 3, m, 3)
    system[np.arange(m), :, np.arange(m)] += error
    weights = np.linalg.solve(system.reshape(3 * m, 3 * m), pull.ravel())
    return weights.reshape(m, 3)
