"""Corresponding points of two surfaces: a non-rigid alignment by shape that starts from
shared landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from skindb.geometry.landmarks import similarity, width
from skindb.geometry.nearest import closest_on_mesh
from skindb.geometry.surfels import vertex_areas, vertex_normals
from skindb.geometry.topology import boundary_loops, outline_first
from skindb.types import Mask

Float = NDArray[np.floating[Any]]
Index = NDArray[np.int64]
ALIGNED = 3  # number of shared landmarks that an alignment requires
# width of the landmarks over their length, below which the rotation is undetermined
MIN_LANDMARK_WIDTH_RATIO = 0.05
# points inside the surface (17 mm apart on a head) and along its outline
INNER = 200
RIM = 48
SAMPLED_VERTICES = 20_000  # vertices from which these points are chosen
# rounds of alignment; round from which matching outlines are used
ALIGNMENT_ROUNDS = 8
RIM_FROM = 4
# mm: amplitude and correlation length of differences of faces after a similarity
AMPLITUDE = 10.0
LENGTH = 60.0
# mm, standard deviations: of a click; across the surface; along the surface; of the outline
CLICK = 1.0
ACROSS = 0.5
ALONG = 6.0
OUTLINE = 4.0
# mm from the surface: during alignment, and at the end
MAX_ALIGNING_DISTANCE_MM = 20.0
MAX_FOUND_DISTANCE_MM = 8.0
# mm from the nearest landmark: within it, clicks are more accurate than shape (lips and
# nose by 0.3 mm)
MIN_LANDMARK_DISTANCE_MM = 20.0
MIN_COSINE_NORMALS = 0.5  # between the normals of points that may correspond
# mm, 90 % quantile of the distance between outlines at the same angle of the atlas: 9
# to 23 on ten heads with similar outlines, 38 to 85 on heads with different outlines
SAME_OUTLINE = 30.0


@dataclass(frozen=True)
class Sheet:
    """A surface with an outline, texture coordinates and landmarks."""

    position: Float  # (n, 3) mm
    uv: Float  # (n, 2), the outline on a circle
    faces: Index  # (f, 3)
    landmark: Float  # (k, 3) mm; NaN where unknown
    normal: Float  # (n, 3)
    rim: Mask  # (n,) whether on any boundary
    outline: Index  # (r,) the longest boundary

    @classmethod
    def of(cls, position: Float, uv: Float, faces: Index, landmark: Float) -> Sheet:
        """Normals and boundaries of a mesh."""
        loops = outline_first(np.asarray(position, np.float64), boundary_loops(faces))
        rim = np.zeros(len(position), np.bool_)
        rim[np.concatenate(loops)] = True
        return cls(
            position,
            uv,
            faces,
            landmark,
            vertex_normals(position, faces),
            rim,
            loops[0],
        )

    def known(self) -> Mask:
        """Which landmarks (k,) it has."""
        return np.asarray(np.isfinite(self.landmark).all(axis=1))

    def area(self) -> float:
        """In mm2."""
        return float(vertex_areas(self.position, self.faces).sum())

    def alignable(self) -> bool:
        """Whether its landmarks determine its rotation."""
        known = self.known()
        return bool(
            known.sum() >= ALIGNED
            and width(self.landmark[known]) >= MIN_LANDMARK_WIDTH_RATIO
        )


def anchor_vertices(sheet: Sheet) -> Index:
    """`INNER` vertices far from each other and the landmarks, then `RIM` along the outline."""
    among = np.flatnonzero(~sheet.rim)[
        :: max(1, len(sheet.position) // SAMPLED_VERTICES)
    ]
    points = sheet.position[among]
    away = cKDTree(sheet.landmark[sheet.known()]).query(points)[0]
    inner = list[int]()
    for _ in range(min(INNER, len(among))):
        inner.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[inner[-1]], axis=1))
    along = np.linspace(0, len(sheet.outline), RIM, endpoint=False).astype(np.int64)
    return np.concatenate([among[inner], sheet.outline[along]])


def corresponding_uv(
    template: Sheet, chosen: Index, take: Sheet
) -> NDArray[np.float64]:
    """Texture coordinates (n, 2) on a take that correspond to vertices of the template;
    NaN where there are none.

    The template is rotated, scaled, and deformed by a Gaussian process onto the take's
    landmarks and, in rounds, onto the nearest points of its surface, along which it may
    slide (Amberg et al. 2007 with another smoothness). If both have similar outlines,
    these are matched by their angle in the atlas.
    """
    known = template.known() & take.known()
    nothing = np.full((len(chosen), 2), np.nan)
    if (
        known.sum() < ALIGNED
        or min(width(sheet.landmark[known]) for sheet in (template, take))
        < MIN_LANDMARK_WIDTH_RATIO
    ):
        return nothing
    bent, on_rim, same = _aligned(template, chosen, take, known)
    face, corner, distance = closest_on_mesh(take.position, take.faces, bent)
    at_rim = (take.rim[take.faces[face]] & (corner > 0)).any(axis=1)
    found = np.einsum(
        "nk,nkc->nc", corner, take.uv[take.faces[face]].astype(np.float64)
    )
    alone = (
        cKDTree(template.landmark[known]).query(template.position[chosen])[0]
        >= MIN_LANDMARK_DISTANCE_MM
    )
    found = np.where(
        ((distance <= MAX_FOUND_DISTANCE_MM) & alone & ~at_rim & ~on_rim)[:, None],
        found,
        np.nan,
    )
    return np.where((on_rim & same)[:, None], template.uv[chosen], found)


def _aligned(
    template: Sheet, chosen: Index, take: Sheet, known: Mask
) -> tuple[NDArray[np.float64], Mask, bool]:
    """Positions (n, 3) of chosen points on the take, mask of outline points, and
    whether the outlines match.
    """
    clicks = template.landmark[known]
    on_rim = template.rim[chosen]
    matrix, shift = similarity(clicks, take.landmark[known])
    turn = matrix / np.cbrt(np.linalg.det(matrix))
    start = template.position[chosen] @ matrix + shift
    normal = template.normal[chosen] @ turn
    tree = cKDTree(take.position)
    outline = take.outline[
        cKDTree(take.uv[take.outline]).query(template.uv[chosen[on_rim]])[1]
    ]
    n = len(clicks)
    every = np.concatenate([clicks @ matrix + shift, start])
    kernel = AMPLITUDE**2 * _matern(
        np.linalg.norm(every[:, None] - every, axis=2) / LENGTH
    )
    pull = np.concatenate([take.landmark[known] - every[:n], np.zeros_like(start)])
    spread = np.tile(CLICK**2 * np.eye(3), (len(every), 1, 1))
    used = np.arange(len(every)) < n
    same = False
    for i in range(ALIGNMENT_ROUNDS + 1):
        now = start + kernel[n:, used] @ _weights(
            kernel[np.ix_(used, used)], pull[used], spread[used]
        )
        distance, near = tree.query(now)
        along = take.normal[near]
        across = along[:, :, None] * along[:, None]
        spread[n:] = ACROSS**2 * across + ALONG**2 * (np.eye(3) - across)
        # onto the tangent plane of the nearest vertex, in which the point may slide
        pull[n:] = (
            now + np.einsum("nij,nj->ni", across, take.position[near] - now) - start
        )
        alike = np.einsum("ni,ni->n", normal, along) > MIN_COSINE_NORMALS
        used[n:] = (
            (distance < MAX_ALIGNING_DISTANCE_MM) & alike & ~take.rim[near] & ~on_rim
        )
        if i == RIM_FROM:
            apart = np.linalg.norm(take.position[outline] - now[on_rim], axis=1)
            same = bool(np.quantile(apart, 0.9) < SAME_OUTLINE)
        if same:
            ends = n + np.flatnonzero(on_rim)
            used[ends], spread[ends] = True, OUTLINE**2 * np.eye(3)
            pull[ends] = take.position[outline] - start[on_rim]
    return now, on_rim, same


def _weights(kernel: Float, pull: Float, spread: Float) -> NDArray[np.float64]:
    """Kriging weights (m, 3) of displacements whose errors have covariances `spread` (m, 3, 3)."""
    m = len(pull)
    system = np.kron(kernel, np.eye(3)).reshape(m, 3, m, 3)
    system[np.arange(m), :, np.arange(m)] += spread
    return np.asarray(
        np.linalg.solve(system.reshape(3 * m, 3 * m), pull.ravel()).reshape(m, 3)
    )


def _matern(distance: Float) -> NDArray[np.float64]:
    """Covariance of a once differentiable field, over its length."""
    r = np.sqrt(3) * distance
    return np.asarray((1 + r) * np.exp(-r))
