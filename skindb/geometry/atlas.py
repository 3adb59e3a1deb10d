"""Texture coordinates for a surface with one outline: a map to a disc without folds and
with even areas.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from skindb.errors import Fault, InputError
from skindb.geometry.distortion import (
    area_log2_sd,
    flipped,
    stretches,
    symmetric_dirichlet,
)
from skindb.geometry.surfels import face_crosses
from skindb.geometry.topology import (
    boundary_loops,
    edge_table,
    face_components,
    outline_first,
    side_lengths,
)

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
Index = NDArray[np.int64]
EQUALISATION_ROUNDS = 9  # of area equalisation
# exponent of the squared stretch: the published 0.5 needs 13 rounds for the result of 8
# with this; 1 oscillates
STRETCH_EXPONENT = 0.75
# rounds whose symmetric Dirichlet energy is within this of the smallest count as equal,
# and the most even one is taken: round 4 on a complete head, sd of log2 area 0.175 and
# 99 % of the area stretched below 5.0 : 1. Round 2 has the smallest energy (0.295,
# 4.4), later rounds are more even and more stretched (7: 0.083, 5.5)
EQUAL = 1.005
# of conformal and authalic weights: fewer flips on heads (1) than with either alone (5,
# 20)
MIX = 0.5
# of the disc, so that its rim keeps a texel from the border of a map of 1,000 and more
DISC_RADIUS = 0.5 - 1e-3


def disc_atlas(
    vertices: Float, faces: Faces, *, finer: tuple[sp.csr_matrix, Faces] | None = None
) -> tuple[NDArray[np.float32], dict[str, float]]:
    """Map a surface with at least one boundary into the unit square.

    The longest boundary is mapped to a circle by arc length, and every other vertex to
    a weighted average of its neighbours, with the intrinsic weights of Desbrun et al.
    (2002), or, if their negative weights turn a triangle over in any round, with
    mean-value weights (Floater 2003), which cannot do so in a convex outline. In rounds
    the weights are scaled so that areas become even (Yoshizawa et al. 2004), within
    limits on the stretch.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3): one oriented manifold component without handles (as
        `clean_mesh` returns), subject frame.
    finer
        Matrix (n, v) and faces of the subdivided surface, on which the map is returned
        and must be free of flips.

    Returns
    -------
    uv : ndarray
        (v, 2) or (n, 2) in [0, 1], u first; v = 0 is the top row. Seen from outside the
        map is not mirrored, and +y points up.
    report : dict
        `flips`, triangles turned over (0, counted exactly in the coordinates returned),
        `area_log2_sd` of the map of the surface given, and `intrinsic`: 1 if Desbrun's
        weights made it, 0 for mean values.

    Raises
    ------
    InputError
        If the surface is closed, has a handle, is in pieces, or has triangles too small
        for any map.
    """
    points = np.asarray(vertices, np.float64)
    corner = np.asarray(faces, np.int64)
    loops = outline_first(points, boundary_loops(corner))
    _check(len(points), corner, loops)
    surface = Surface(
        *_cap_holes(points, corner, loops[1:]),
        len(corner),
        loops[0],
        _circle(points[loops[0]]),
    )
    matrix, fine = (
        (sp.identity(len(points), format="csr"), corner) if finer is None else finer
    )
    left = len(fine)
    for intrinsic, weights in ((1, _intrinsic_weights), (0, _mean_value_weights)):
        maps = _equalised(surface, weights(surface.points, surface.faces))
        if intrinsic and len(maps) < EQUALISATION_ROUNDS:
            # negative weights that fold in a later round would leave an uneven map
            continue
        for uv, spread in maps:
            upright = _upright(uv[: len(points)], points, corner)
            stored = np.clip(matrix @ upright, 0.0, 1.0).astype(np.float32)
            flips = int(flipped(stored, fine).sum())
            if not flips:
                return stored, {
                    "flips": 0.0,
                    "area_log2_sd": spread,
                    "intrinsic": float(intrinsic),
                }
            left = min(left, flips)
    cure = "remove the smallest triangles from the scan, or choose a wider spacing"
    raise InputError(
        Fault(
            "mesh",
            "no triangle may be turned over in the atlas",
            f"{left} of {len(fine)}",
            cure,
        )
    )


@dataclass(frozen=True)
class Surface:
    """A surface with closed holes, and the target of its outline."""

    points: NDArray[np.float64]  # (v, 3) mm
    faces: Index  # (f, 3), those of the caps last
    real: int  # faces before the caps
    rim: Index  # (r,) vertices of the outline
    rim_uv: NDArray[np.float64]  # (r, 2)


def signed_areas(uv: Float, faces: Faces) -> NDArray[np.float64]:
    """Areas (f,) of triangles in the map; positive if they face outwards (u to the
    right, v down).
    """
    a, b, c = (np.asarray(uv, np.float64)[faces[:, i]] for i in range(3))
    first = b - a
    second = c - a
    return np.asarray(first[:, 1] * second[:, 0] - first[:, 0] * second[:, 1]) / 2


def _check(n: int, faces: Index, loops: list[Index]) -> None:
    where = "mesh"
    cure = "cut the scan so that one open surface remains"
    if not loops:
        raise InputError(
            Fault(
                where,
                "a surface must have a boundary to be flattened",
                "a closed surface",
                cure,
            )
        )
    if len(np.unique(faces)) != n or face_components(faces).max() > 0:
        rule = "a surface must be connected to be flattened"
        found = "several components or unused vertices"
        raise InputError(Fault(where, rule, found, "clean it"))
    handles = (2 - len(loops) - (n - len(edge_table(faces).edges) + len(faces))) // 2
    if handles:
        raise InputError(
            Fault(
                where,
                "a surface must not have handles to be flattened",
                f"{handles} handles",
                cure,
            )
        )


def _cap_holes(
    points: NDArray[np.float64], faces: Index, holes: list[Index]
) -> tuple[NDArray[np.float64], Index]:
    """Close inner holes by a fan around their centre, without which their rims could fold."""
    centres = [points[loop].mean(axis=0, keepdims=True) for loop in holes]
    caps = [
        np.stack([np.roll(loop, -1), loop, np.full(len(loop), len(points) + i)], axis=1)
        for i, loop in enumerate(holes)
    ]
    return np.concatenate([points, *centres]), np.concatenate([faces, *caps])


def _circle(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 2) on the circle, spaced as along the path; counter-clockwise on the
    page, where v runs down.
    """
    step = side_lengths(path)
    angle = 2 * np.pi * (np.cumsum(step) - step) / step.sum()
    return np.asarray(DISC_RADIUS * np.stack([np.cos(angle), -np.sin(angle)], axis=1))


def _intrinsic_weights(points: NDArray[np.float64], faces: Index) -> sp.csr_matrix:
    """Row i: cot of the angles across edge ij, and of those at j beside it over |p_j -
    p_i|^2 times the area around i.

    Conformal and authalic weights of Desbrun et al. (2002), made comparable by the area.
    """
    n = len(points)
    weights = sp.csr_matrix((n, n))
    area = np.linalg.norm(face_crosses(points, faces), axis=1) / 2
    around = np.bincount(faces.ravel(), np.repeat(area, 3), minlength=n) / 3
    # across corner k
    sides = [
        points[faces[:, (k + 2) % 3]] - points[faces[:, (k + 1) % 3]] for k in range(3)
    ]
    tiny = 1e-9 * area.max()
    cot = [
        -np.einsum("ni,ni->n", sides[k - 2], sides[k - 1]) / np.maximum(2 * area, tiny)
        for k in range(3)
    ]
    for k in range(3):
        i = faces[:, (k + 1) % 3]
        j = faces[:, (k + 2) % 3]
        square = np.maximum(np.einsum("ni,ni->n", sides[k], sides[k]), tiny)
        forth = MIX * cot[k] + (1 - MIX) * around[i] * cot[(k + 2) % 3] / square
        back = MIX * cot[k] + (1 - MIX) * around[j] * cot[(k + 1) % 3] / square
        rows = np.concatenate([i, j])
        columns = np.concatenate([j, i])
        weights = weights + sp.csr_matrix(
            (np.concatenate([forth, back]), (rows, columns)), shape=(n, n)
        )
    return weights


def _mean_value_weights(points: NDArray[np.float64], faces: Index) -> sp.csr_matrix:
    """Row i: (tan(a/2) + tan(b/2)) / |p_j - p_i| of both angles at i beside edge ij
    (Floater 2003, eq. 2.1).
    """
    n = len(points)
    weights = sp.csr_matrix((n, n))
    tiny = 1e-9 * float(np.ptp(points, axis=0).max())
    for k in range(3):
        i, j, l = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]  # noqa: E741
        first = points[j] - points[i]
        second = points[l] - points[i]
        a, b = (np.maximum(np.linalg.norm(x, axis=1), tiny) for x in (first, second))
        cosine = np.einsum("ni,ni->n", first, second) / (a * b)
        # at least 1e-6 and at most 1e6, so that coinciding or opposite sides have
        # positive, finite weights
        half = np.sqrt(np.clip(1 - cosine, 1e-12, 2) / np.clip(1 + cosine, 1e-12, 2))
        rows = np.concatenate([i, i])
        columns = np.concatenate([j, l])
        weights = weights + sp.csr_matrix(
            (np.concatenate([half / a, half / b]), (rows, columns)), shape=(n, n)
        )
    return weights


def _solve(
    weights: sp.csr_matrix, rim: Index, rim_uv: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Positions (n, 2) in which every inner vertex is the weighted mean of its
    neighbours; None if singular.
    """
    n = weights.shape[0]
    uv = np.zeros((n, 2))
    uv[rim] = rim_uv
    inner = np.setdiff1d(np.arange(n), rim)
    if len(inner):
        system = (
            (sp.diags(np.asarray(weights.sum(axis=1)).ravel()) - weights)
            .tocsr()[inner][:, inner]
            .tocsc()
        )
        # positive weights are diagonally dominant and need no pivoting, which allows a
        # symmetric ordering (8 x less fill); errors with negative weights are detected
        # as flips
        try:
            solver = splu(
                system,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:  # singular
            return None
        uv[inner] = solver.solve(np.asarray(weights[inner][:, rim] @ rim_uv))
    return uv if np.isfinite(uv).all() else None


def _equalised(
    surface: Surface, weights: sp.csr_matrix
) -> list[tuple[NDArray[np.float64], float]]:
    """Maps without flips and the sd of their log2 area, the best first.

    In each round the weights of neighbours in stretched areas are reduced (Yoshizawa et al. 2004).
    """
    # excludes the caps of holes
    points = surface.points
    faces = surface.faces
    real = slice(0, surface.real)
    area = np.linalg.norm(face_crosses(points, faces), axis=1) / 2
    share = np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(points))
    found: list[tuple[float, float, NDArray[np.float64]]] = []
    for _ in range(EQUALISATION_ROUNDS):
        uv = _solve(weights, surface.rim, surface.rim_uv)
        if uv is None:
            break
        flat = signed_areas(uv, faces)
        if (flat[real] <= 0).any():
            break
        stretch = stretches(points, faces[real], uv)
        found.append((symmetric_dirichlet(*stretch), area_log2_sd(*stretch), uv))
        # area times squared stretch
        pull = area * area / np.maximum(flat, 1e-12 * np.abs(flat).sum())
        at_vertex = np.bincount(
            faces.ravel(), np.repeat(pull, 3), minlength=len(points)
        ) / np.maximum(share, 1e-300)
        weights = weights @ sp.diags(
            (at_vertex / at_vertex.mean()) ** -STRETCH_EXPONENT
        )
    least = min((energy for energy, _, _ in found), default=0.0)
    # the most even of the best, then the others by their energy
    order = sorted(
        found,
        key=lambda one: (
            one[0] > EQUAL * least,
            one[1] if one[0] <= EQUAL * least else one[0],
        ),
    )
    return [(uv, spread) for _, spread, uv in order]


def _upright(
    uv: NDArray[np.float64], points: NDArray[np.float64], faces: Index
) -> NDArray[np.float64]:
    """Turn the disc so that height y grows upwards in the map, and move it into the unit square."""
    area = np.bincount(
        faces.ravel(), np.repeat(np.linalg.norm(face_crosses(points, faces), axis=1), 3)
    )
    height = points[:, 1] - area @ points[:, 1] / area.sum()
    up = (area * height) @ (uv - area @ uv / area.sum())
    angle = np.arctan2(up[0], -up[1])  # of `up` from the top of the page, clockwise
    cosine = np.cos(angle)
    sine = np.sin(angle)
    turned = uv @ np.array([[cosine, -sine], [sine, cosine]])
    return np.asarray(turned + 0.5)
