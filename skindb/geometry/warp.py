"""Smooth maps of the plane through points, without folds (thin-plate splines, Bookstein 1989),
and corresponding points of two surfaces by a non-rigid alignment that starts from landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
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
# for errors of clicks of 1 to 2 mm; the condition number for 20 points of a face is
# then about 50
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
# points times centres: 2 MB of doubles, which stay in the cache
PRODUCTS_PER_BLOCK = 1 << 18
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
    """A map of the plane: `affine` of (1, x), and `weight` of r^2 log r round each centre."""

    kind: str  # "thin plate", "affine", "similarity", "shift" or "identity"
    origin: Array  # (2,)
    scale: float  # x = (uv - origin) / scale
    centre: Array  # (c, 2) in x
    weight: Array  # (c, 2)
    affine: Array  # (3, 2)
    condition: float  # of the regularised system; 1 without one
    smoothing: float  # added to its diagonal, in units of x
    loose: Array  # (c,) times that
    # (k,) of the points; False: not finite, or merged with one before
    used: Mask


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
        weak_source, weak_target = _finite(*weak)
        centre = np.concatenate([a, (weak_source - origin) / scale])
        goal = np.concatenate([b, weak_target])
    is_weak = np.arange(len(centre)) >= len(a)
    if len(centre) > 3:
        attempts = _attempts(smoothing, len(centre) > len(a))
        warp = _without_folds(fallback, centre, goal, is_weak, attempts, min_area)
        if warp is not None:
            return warp
    affine = np.linalg.lstsq(_linear(a), b, rcond=None)[0]
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
        system = _System.of(centre, loose)
        weight, affine = system.solve(goal, smoothing)
        warp = replace(
            base,
            kind="thin plate",
            centre=centre,
            weight=weight,
            affine=affine,
            condition=system.condition(smoothing),
            smoothing=smoothing,
            loose=loose,
        )
        if np.linalg.det(affine[1:]) <= min_area:
            continue
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
    out = _linear(points) @ warp.affine
    if len(warp.centre):
        for block in _blocks(points, warp):
            out[block] += _bending(points[block], warp.centre) @ warp.weight
    return out


def area_factor(warp: Warp, uv: Array) -> Float64:
    """Determinant of the Jacobian (n,) at points (n, 2): negative where the map is folded."""
    points = (float64(uv) - warp.origin) / warp.scale
    out = np.empty(len(points))
    for block in _blocks(points, warp):
        slope = _slope(points[block], warp.centre, warp.weight)
        (a, b), (c, d) = np.moveaxis(warp.affine[1:] + slope, 0, 2)
        out[block] = a * d - b * c
    return out / warp.scale**2


def left_out_error(warp: Warp) -> Float64:
    """Leave-one-out error (k,): distance of each point from its image by the map of the
    others (Rippa 1999).

    NaN for points that are not used, and if there is no thin-plate map. The others
    include weak points.
    """
    out = np.full(len(warp.used), np.nan)
    if len(warp.centre):
        inverse = _System.of(warp.centre, warp.loose).inverse(warp.smoothing)
        # divided by the root of 1: none is weak
        error = lengths(warp.weight) / np.diag(inverse)
        out[warp.used] = error[: warp.used.sum()]
    return out


@dataclass(frozen=True)
class _System:
    """Bending energy of centres on the complement of affine maps, where it is positive definite.

    Rows and columns are divided by the square root of `loose`, so that the same is
    added to all of the diagonal.
    """

    centre: Array  # (c, 2)
    loose: Array  # (c,)
    kernel: Array  # (c, c)
    linear: Array  # (c, 3)
    complement: Array  # (c, c - 3) orthonormal, orthogonal to `linear`
    value: Array  # (c - 3,) eigenvalues, ascending
    vector: Array  # (c - 3, c - 3)

    @classmethod
    def of(cls, centre: Array, loose: Array) -> _System:
        root = np.sqrt(loose)[:, None]
        kernel = _bending(centre, centre) / (root * root.T)
        linear = _linear(centre) / root
        complement = np.linalg.qr(linear, mode="complete")[0][:, 3:]
        value, vector = np.linalg.eigh(complement.T @ kernel @ complement)
        return cls(centre, loose, kernel, linear, complement, value, vector)

    def condition(self, smoothing: float) -> float:
        if not len(self.value):
            return 1.0
        return float((self.value[-1] + smoothing) / (self.value[0] + smoothing))

    def inverse(self, smoothing: float) -> Float64:
        """Matrix that maps targets to weights, both scaled like the rows."""
        vector = self.complement @ self.vector
        return vector / (self.value + smoothing) @ vector.T

    def solve(self, target: Array, smoothing: float) -> tuple[Array, Array]:
        root = np.sqrt(self.loose)[:, None]
        weight = self.inverse(smoothing) @ (target / root)
        residual = target / root - self.kernel @ weight - smoothing * weight
        affine = np.linalg.lstsq(self.linear, residual, rcond=None)[0]
        return weight / root, affine


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


def _finite(source: Array, target: Array) -> tuple[Float64, Float64]:
    """Points that are finite in both."""
    finite = finite_rows(np.hstack([source, target]))
    return float64(source)[finite], float64(target)[finite]


def _plain(
    kind: str,
    is_used: Mask,
    origin: Array,
    scale: float,
    matrix: Array,
    shift: Array,
) -> Warp:
    return Warp(
        kind,
        origin,
        scale,
        centre=np.zeros((0, 2)),
        weight=np.zeros((0, 2)),
        affine=np.vstack([shift, matrix]),
        condition=1.0,
        smoothing=0.0,
        loose=np.zeros(0),
        used=is_used,
    )


def _linear(points: Array) -> Float64:
    return np.concatenate([np.ones((len(points), 1)), points], axis=1)


def _bending(points: Array, centre: Array) -> Float64:
    """r^2 log r (n, c)."""
    squared = (points[:, :1] - centre[:, 0]) ** 2 + (points[:, 1:] - centre[:, 1]) ** 2
    logarithm = np.log(np.maximum(squared, np.finfo(np.float64).tiny))
    return 0.5 * squared * logarithm


def _slope(points: Array, centre: Array, weight: Array) -> Float64:
    """Gradient (n, 2, 2) of the weighted sum of r^2 log r: (2 log r + 1) times the
    vector from each centre.
    """
    x = points[:, :1] - centre[:, 0]
    y = points[:, 1:] - centre[:, 1]
    factor = np.log(np.maximum(x * x + y * y, np.finfo(np.float64).tiny)) + 1
    return np.stack([(factor * x) @ weight, (factor * y) @ weight], axis=1)


def _blocks(points: Array, warp: Warp) -> list[slice]:
    size = max(1, PRODUCTS_PER_BLOCK // max(1, len(warp.centre)))
    return [slice(i, i + size) for i in range(0, len(points), size)]


def _check_points(centre: Array) -> Float64:
    """Points that are checked for folds: an even grid, the centres, and points between
    neighbouring centres.
    """
    side = np.linspace(-MARGIN, MARGIN, GRID)
    even = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    count = min(NEIGHBOURS, len(centre))
    i = np.repeat(np.arange(len(centre)), count)
    j = cKDTree(centre).query(centre, count)[1].ravel()
    between = [t * centre[i] + (1 - t) * centre[j] for t in (0.1, 0.5)]
    return np.concatenate([even, centre, *between])


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
    uv = np.einsum("nk,nkc->nc", weight, take.uv[corners].astype(np.float64))
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
    distances = lengths(points[:, None] - points)
    kernel = DEFORMATION_SD_MM**2 * _matern(distances / DEFORMATION_LENGTH_MM)
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


def _matern(distance: Array) -> Float64:
    """Covariance of a once differentiable field, over its length."""
    r = np.sqrt(3) * distance
    return np.asarray((1 + r) * np.exp(-r))
