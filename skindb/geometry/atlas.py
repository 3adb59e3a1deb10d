"""Texture coordinates for a surface with one outline: a disc without folds and with even area."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from skindb.errors import Fault, InputError
from skindb.geometry.surfels import face_crosses
from skindb.geometry.topology import boundary_loops, edge_table, face_components, outline_first, side_lengths

Float = NDArray[np.floating[Any]]
Faces = NDArray[np.integer[Any]]
Index = NDArray[np.int64]
ROUNDS = 20  # of area equalisation; the best one is kept
EVEN = 0.1  # sd of log2 area that is even enough: 7 %
STEP = 0.75  # exponent of the square stretch: 0.5 as published needs 13 rounds for what this does in 8; 1 swings
PATIENCE = 3  # rounds without a gain before it stops
GAIN = 0.9  # factor on the best sd that counts as one
RADIUS = 0.5 - 1e-3  # of the disc, so that its rim keeps a texel from the border of a map of 1,000 and more


def disc_atlas(vertices: Float, faces: Faces) -> tuple[NDArray[np.float64], dict[str, float]]:
    """Map a surface with at least one boundary into the unit square.

    The longest boundary goes onto a circle by arc length and every other vertex to the mean-value average of its
    neighbours (Floater 2003): positive weights in a convex outline cannot fold. Weights are then scaled so that areas
    become even (Yoshizawa et al. 2004), which keeps them positive.

    Parameters
    ----------
    vertices, faces
        (v, 3) mm and (f, 3): one oriented manifold component without handles (as `clean_mesh` returns), subject frame.

    Returns
    -------
    uv : ndarray
        (v, 2) in [0, 1], u first; v = 0 is the top row. Seen from outside the map is not mirrored, and +y points up.
    report : dict
        `flips`, triangles turned over (0), and `area_log2_sd`, the area-weighted standard deviation of the log2 of
        area in the map over area on the surface.

    Raises
    ------
    InputError
        If the surface is closed, has a handle, or is in pieces.
    """
    points, corner = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    loops = outline_first(points, boundary_loops(corner))
    _check(len(points), corner, loops)
    all_points, all_faces = _cap_holes(points, corner, loops[1:])
    rim = _circle(points[loops[0]])
    weights = _mean_value_weights(all_points, all_faces)
    uv, flips, spread = _equalised(weights, all_points, all_faces, loops[0], rim, len(corner))
    upright = _upright(uv[: len(points)], points, corner)
    return upright, {"flips": float(flips), "area_log2_sd": spread}


def signed_areas(uv: Float, faces: Faces) -> NDArray[np.float64]:
    """Areas (f,) of triangles in the map; positive where they are seen from outside (u to the right, v down)."""
    a, b, c = (np.asarray(uv, np.float64)[faces[:, i]] for i in range(3))
    first, second = b - a, c - a
    return np.asarray(first[:, 1] * second[:, 0] - first[:, 0] * second[:, 1]) / 2


def _check(n: int, faces: Index, loops: list[Index]) -> None:
    where, cure = "mesh", "cut the scan so that one open sheet is left"
    if not loops:
        raise InputError(Fault(where, "a surface with a boundary can be flattened", "a closed surface", cure))
    if len(np.unique(faces)) != n or face_components(faces).max() > 0:
        raise InputError(Fault(where, "one piece can be flattened", "several pieces or unused vertices", "clean it"))
    handles = (2 - len(loops) - (n - len(edge_table(faces).edges) + len(faces))) // 2
    if handles:
        raise InputError(Fault(where, "a surface without handles can be flattened", f"{handles} handles", cure))


def _cap_holes(points: NDArray[np.float64], faces: Index, holes: list[Index]) -> tuple[NDArray[np.float64], Index]:
    """Close inner holes by a fan around their middle: without it their rims would be free to fold."""
    centres = [points[loop].mean(axis=0, keepdims=True) for loop in holes]
    caps = [
        np.stack([np.roll(loop, -1), loop, np.full(len(loop), len(points) + i)], axis=1) for i, loop in enumerate(holes)
    ]
    return np.concatenate([points, *centres]), np.concatenate([faces, *caps])


def _circle(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (n, 2) on the circle, apart as the path is; counter-clockwise on the page, where v runs down."""
    step = side_lengths(path)
    angle = 2 * np.pi * (np.cumsum(step) - step) / step.sum()
    return np.asarray(RADIUS * np.stack([np.cos(angle), -np.sin(angle)], axis=1))


def _mean_value_weights(points: NDArray[np.float64], faces: Index) -> sp.csr_matrix:
    """Row i: (tan(a/2) + tan(b/2)) / |p_j - p_i| of both angles at i beside edge ij (Floater 2003, eq. 2.1)."""
    n = len(points)
    weights = sp.csr_matrix((n, n))
    tiny = 1e-9 * float(np.ptp(points, axis=0).max())
    for k in range(3):
        i, j, l = faces[:, k], faces[:, (k + 1) % 3], faces[:, (k + 2) % 3]  # noqa: E741
        first, second = points[j] - points[i], points[l] - points[i]
        a, b = (np.maximum(np.linalg.norm(x, axis=1), tiny) for x in (first, second))
        cosine = np.einsum("ni,ni->n", first, second) / (a * b)
        # at least 1e-6 and at most 1e6: coinciding or opposite sides keep a positive, finite weight
        half = np.sqrt(np.clip(1 - cosine, 1e-12, 2) / np.clip(1 + cosine, 1e-12, 2))
        rows, columns = np.concatenate([i, i]), np.concatenate([j, l])
        weights = weights + sp.csr_matrix((np.concatenate([half / a, half / b]), (rows, columns)), shape=(n, n))
    return weights


def _solve(weights: sp.csr_matrix, rim: Index, rim_uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (n, 2) where every vertex off the rim is the weighted mean of its neighbours."""
    n = weights.shape[0]
    uv = np.zeros((n, 2))
    uv[rim] = rim_uv
    inner = np.setdiff1d(np.arange(n), rim)
    if len(inner):
        mean = sp.diags(1 / np.asarray(weights.sum(axis=1)).ravel()) @ weights
        system = (sp.identity(n, format="csr") - mean)[inner][:, inner].tocsc()
        # diagonally dominant: no pivoting, so the symmetric ordering of the mesh may be used (8 x less fill)
        solver = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        uv[inner] = solver.solve(np.asarray(mean[inner][:, rim] @ rim_uv))
    return uv


def _equalised(
    weights: sp.csr_matrix,
    points: NDArray[np.float64],
    faces: Index,
    rim: Index,
    rim_uv: NDArray[np.float64],
    n_faces: int,
) -> tuple[NDArray[np.float64], int, float]:
    """Best of some rounds in which neighbours that lie in stretched places are pulled less (Yoshizawa et al. 2004)."""
    area = np.linalg.norm(face_crosses(points, faces), axis=1) / 2
    real = slice(0, n_faces)  # the caps of holes do not count
    share = np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(points))
    best = (len(faces) + 1, np.inf, np.zeros((len(points), 2)))
    waited = 0
    for _ in range(ROUNDS):
        uv = _solve(weights, rim, rim_uv)
        flat = signed_areas(uv, faces)
        found = (int((flat[real] <= 0).sum()), _log2_sd(flat[real], area[real]), uv)
        gained = found[0] < best[0] or (found[0] == best[0] and found[1] < GAIN * best[1])
        waited = 0 if gained else waited + 1
        best = min(best, found, key=lambda result: result[:2])
        if waited == PATIENCE or (best[0] == 0 and best[1] < EVEN):
            break
        stretch = area * area / np.maximum(flat, 1e-12 * flat.sum())  # area times squared stretch
        at_vertex = np.bincount(faces.ravel(), np.repeat(stretch, 3), minlength=len(points)) / np.maximum(share, 1e-300)
        weights = weights @ sp.diags((at_vertex / at_vertex.mean()) ** -STEP)
    return best[2], best[0], best[1]


def _log2_sd(flat: NDArray[np.float64], area: NDArray[np.float64]) -> float:
    used = (area > 0) & (flat > 0)
    weight = area[used] / area[used].sum()
    ratio = np.log2(flat[used] / area[used])
    return float(np.sqrt(weight @ (ratio - weight @ ratio) ** 2))


def _upright(uv: NDArray[np.float64], points: NDArray[np.float64], faces: Index) -> NDArray[np.float64]:
    """Turn the disc so that height y grows upwards in the map, and move it into the unit square."""
    area = np.bincount(faces.ravel(), np.repeat(np.linalg.norm(face_crosses(points, faces), axis=1), 3))
    height = points[:, 1] - area @ points[:, 1] / area.sum()
    up = (area * height) @ (uv - area @ uv / area.sum())
    angle = np.arctan2(up[0], -up[1])  # of `up` from the top of the page, clockwise
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = uv @ np.array([[cosine, -sine], [sine, cosine]])
    return np.asarray(turned + 0.5)
