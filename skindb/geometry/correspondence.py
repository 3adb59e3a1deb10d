"""Corresponding points of two surfaces: a non-rigid alignment by shape that starts from
shared landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from skindb.geometry.landmarks import similarity, width
from skindb.geometry.mesh import closest_on_mesh, vertex_areas, vertex_normals
from skindb.geometry.topology import boundary_loops, outline_first
from skindb.types import Array, Float64, Index, Mask, float64

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
        return np.asarray(np.isfinite(self.landmark).all(axis=1))

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
        to_farthest = np.linalg.norm(points - points[farthest], axis=1)
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
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    kernel = DEFORMATION_SD_MM**2 * _matern(distances / DEFORMATION_LENGTH_MM)
    pull = np.concatenate([take.landmark[shared] - points[:n], np.zeros_like(start)])
    error = np.tile(CLICK_SD_MM**2 * np.eye(3), (len(points), 1, 1))
    used = np.arange(len(points)) < n
    same_outline = False
    for i in range(ALIGNMENT_ROUNDS + 1):
        weights = _weights(kernel[np.ix_(used, used)], pull[used], error[used])
        aligned = start + kernel[n:, used] @ weights
        distance, near = tree.query(aligned)
        target_normal = take.normal[near]
        across = target_normal[:, :, None] * target_normal[:, None]
        error[n:] = ACROSS_SD_MM**2 * across + ALONG_SD_MM**2 * (np.eye(3) - across)
        # onto the tangent plane of the nearest vertex, in which the point may slide
        step = np.einsum("nij,nj->ni", across, take.position[near] - aligned)
        pull[n:] = aligned + step - start
        facing = np.einsum("ni,ni->n", normal, target_normal) > MIN_COSINE_NORMALS
        close = distance < MAX_ALIGNING_DISTANCE_MM
        used[n:] = close & facing & ~take.rim[near] & ~on_rim
        if i == OUTLINE_ROUND:
            gap = np.linalg.norm(take.position[outline] - aligned[on_rim], axis=1)
            same_outline = bool(np.quantile(gap, 0.9) < MAX_OUTLINE_DISTANCE_MM)
        if same_outline:
            ends = n + np.flatnonzero(on_rim)
            used[ends] = True
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
