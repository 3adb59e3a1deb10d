"""Texture coordinates for a surface with one outline, and maps in these coordinates.

The coordinates are a map to a disc without folds and with even areas. Maps are rasterised,
their gaps filled, and sampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from skindb.errors import input_error
from skindb.geometry._atlas_kernels import (
    EDGE,
    TINY,
    interpolate,
    pulled,
    pushed,
    rasterise,
)
from skindb.geometry.mesh import (
    boundary_loops,
    edge_table,
    face_components,
    face_crosses,
    outline_first,
    side_lengths,
)
from skindb.types import (
    AnyArray,
    Array,
    Faces,
    Float32,
    Float64,
    Index,
    Index32,
    Mask,
    dots,
    finite_rows,
    float64,
    lengths,
)

# of area equalisation: on complete heads the sd of log2 area is at most 0.193 then, and 99 % of
# the area is stretched below 4.9 : 1; after 3 rounds 0.326 and 4.3, after 4 0.21 and 5.4
EQUALISATION_ROUNDS = 5
# exponent of the squared stretch: the published 0.5 needs more rounds; 1 oscillates
STRETCH_EXPONENT = 0.75
# of the disc, so that its rim keeps a texel from the border of a map of 1,000 and more
DISC_RADIUS = 0.5 - 1e-3
TRIANGLES_PER_BLOCK = 1 << 17  # takes 50 MB
# relative to the summed products: the sign of a larger difference is correct (Shewchuk
# 1997)
CERTAIN = 3.4e-16
Image = Float32


def disc_atlas(
    vertices: Array, faces: Faces, *, finer: tuple[sp.csr_matrix, Faces] | None = None
) -> tuple[Float32, dict[str, float]]:
    """Map a surface with at least one boundary into the unit square.

    The longest boundary is mapped to a circle by arc length, and every other vertex to
    a weighted average of its neighbours, with mean-value weights (Floater 2003), which
    cannot turn a triangle over in a convex outline. In rounds the weights are scaled so
    that areas become even (Yoshizawa et al. 2004), within limits on the stretch.

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
        `flips`, triangles turned over (0, counted in the coordinates returned), and
        `area_log2_sd` of the map of the surface given.

    Raises
    ------
    InputError
        If the surface is closed, has a handle, is in pieces, or has triangles too small
        for any map.
    """
    points = float64(vertices)
    corner = np.asarray(faces, np.int64)
    loops = outline_first(points, boundary_loops(corner))
    _check(len(points), corner, loops)
    capped = _cap_holes(points, corner, loops[1:])
    outline = loops[0]
    surface = Surface(*capped, len(corner), outline, _circle(points[outline]))
    matrix, fine = finer or (sp.identity(len(points), format="csr"), corner)
    fewest_flips = len(fine)
    for uv, spread in _equalised(surface):
        upright = _upright(uv[: len(points)], points, corner)
        stored = np.clip(matrix @ upright, 0.0, 1.0).astype(np.float32)
        flips = int(flipped(stored, fine).sum())
        if not flips:
            return stored, {"flips": 0.0, "area_log2_sd": spread}
        fewest_flips = min(fewest_flips, flips)
    raise input_error(
        "mesh",
        "no triangle may be turned over in the atlas",
        f"{fewest_flips} of {len(fine)}",
        "remove the smallest triangles from the scan, or choose a wider spacing",
    )


@dataclass(frozen=True)
class Surface:
    """A surface with closed holes, and the target of its outline."""

    points: Array  # (v, 3) mm
    faces: Index  # (f, 3), those of the caps last
    real: int  # faces before the caps
    rim: Index  # (r,) vertices of the outline
    rim_uv: Array  # (r, 2)


def signed_areas(uv: Array, faces: Faces) -> Float64:
    """Areas (f,) of triangles in the map; positive if they face outwards (u to the
    right, v down).
    """
    return _double_areas(uv[faces])[0] / 2


def _double_areas(corners: Array) -> tuple[Float64, Float64]:
    """Twice the signed areas (f,) of triangles (f, 3, 2), and the limit of their errors."""
    a, b, c = float64(corners).swapaxes(0, 1)
    plus = (b - a)[:, 1] * (c - a)[:, 0]
    minus = (b - a)[:, 0] * (c - a)[:, 1]
    return plus - minus, CERTAIN * (np.abs(plus) + np.abs(minus))


def _check(n: int, faces: Index, loops: list[Index]) -> None:
    cure = "cut the scan so that one open surface remains"
    if not loops:
        rule = "a surface must have a boundary to be flattened"
        raise input_error("mesh", rule, "a closed surface", cure)
    if len(np.unique(faces)) != n or face_components(faces).max() > 0:
        rule = "a surface must be connected to be flattened"
        raise input_error(
            "mesh", rule, "several components or unused vertices", "clean it"
        )
    handles = (2 - len(loops) - (n - len(edge_table(faces).edges) + len(faces))) // 2
    if handles:
        rule = "a surface must not have handles to be flattened"
        raise input_error("mesh", rule, f"{handles} handles", cure)


def _cap_holes(
    points: Array, faces: Index, holes: list[Index]
) -> tuple[Float64, Index]:
    """Close inner holes by a fan around their centre, without which their rims could fold."""
    centres = [points[loop].mean(axis=0, keepdims=True) for loop in holes]
    caps = [
        np.stack([np.roll(loop, -1), loop, np.full(len(loop), len(points) + i)], axis=1)
        for i, loop in enumerate(holes)
    ]
    return np.concatenate([points, *centres]), np.concatenate([faces, *caps])


def _circle(path: Array) -> Float64:
    """Points (n, 2) on the circle, spaced as along the path; counter-clockwise on the
    page, where v runs down.
    """
    step = side_lengths(path)
    angle = 2 * np.pi * (np.cumsum(step) - step) / step.sum()
    return DISC_RADIUS * np.stack([np.cos(angle), -np.sin(angle)], axis=1)


def _mean_value_weights(points: Array, faces: Index) -> sp.csr_matrix:
    """Row i: (tan(a/2) + tan(b/2)) / |p_j - p_i| of both angles at i beside edge ij
    (Floater 2003, eq. 2.1).
    """
    n = len(points)
    weights = sp.csr_matrix((n, n))
    tiny = 1e-9 * float(np.ptp(points, axis=0).max())
    for k in range(3):
        here, after, before = np.roll(faces, -k, axis=1).T
        to_left = points[after] - points[here]
        to_right = points[before] - points[here]
        a = np.maximum(lengths(to_left), tiny)
        b = np.maximum(lengths(to_right), tiny)
        cosine = dots(to_left, to_right) / (a * b)
        # at least 1e-6 and at most 1e6, so that coinciding or opposite sides have
        # positive, finite weights
        half = np.sqrt(np.clip(1 - cosine, 1e-12, 2) / np.clip(1 + cosine, 1e-12, 2))
        sides = (np.tile(here, 2), np.concatenate([after, before]))
        beside = np.concatenate([half / a, half / b])
        weights = weights + sp.csr_matrix((beside, sides), shape=(n, n))
    return weights


def _solve(weights: sp.csr_matrix, rim: Index, rim_uv: Array) -> Float64 | None:
    """Positions (n, 2) in which every inner vertex is the weighted mean of its
    neighbours; None if singular.
    """
    n = weights.shape[0]
    uv = np.zeros((n, 2))
    uv[rim] = rim_uv
    inner = np.setdiff1d(np.arange(n), rim)
    if len(inner):
        total = np.asarray(weights.sum(axis=1)).ravel()
        laplacian = (sp.diags(total) - weights).tocsr()
        system = laplacian[inner][:, inner].tocsc()
        # positive weights are diagonally dominant and need no pivoting, which allows a
        # symmetric ordering (8 x less fill)
        try:
            solver = splu(
                system,
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:  # singular
            return None
        uv[inner] = solver.solve(weights[inner][:, rim] @ rim_uv)
    return uv if np.isfinite(uv).all() else None


def _equalised(surface: Surface) -> list[tuple[Float64, float]]:
    """Maps without flips and the sd of their log2 area, the last one first.

    In each round the weights of neighbours in stretched areas are reduced (Yoshizawa et al. 2004).
    """
    points = surface.points
    faces = surface.faces
    real = slice(0, surface.real)  # excludes the caps of holes
    weights = _mean_value_weights(points, faces)
    area = lengths(face_crosses(points, faces)) / 2
    around = np.bincount(faces.ravel(), np.repeat(area, 3), minlength=len(points))
    maps = []
    for _ in range(EQUALISATION_ROUNDS):
        uv = _solve(weights, surface.rim, surface.rim_uv)
        if uv is None:
            break
        flat = signed_areas(uv, faces)
        if (flat[real] <= 0).any():
            break
        maps.append((uv, area_log2_sd(*stretches(points, faces[real], uv))))
        # area times squared stretch
        pull = area * area / np.maximum(flat, 1e-12 * np.abs(flat).sum())
        sums = np.bincount(faces.ravel(), np.repeat(pull, 3), minlength=len(points))
        at_vertex = sums / np.maximum(around, 1e-300)
        factor = (at_vertex / at_vertex.mean()) ** -STRETCH_EXPONENT
        weights = weights @ sp.diags(factor)
    return maps[::-1]


def _upright(uv: Array, points: Array, faces: Index) -> Float64:
    """Turn the disc so that height y grows upwards in the map, and move it into the unit square."""
    double_area = lengths(face_crosses(points, faces))
    area = np.bincount(faces.ravel(), np.repeat(double_area, 3))
    height = points[:, 1] - area @ points[:, 1] / area.sum()
    up = (area * height) @ (uv - area @ uv / area.sum())
    angle = np.arctan2(up[0], -up[1])  # of `up` from the top of the page, clockwise
    cosine = np.cos(angle)
    sine = np.sin(angle)
    turned = uv @ np.array([[cosine, -sine], [sine, cosine]])
    return turned + 0.5


def flipped(uv: Array, faces: Faces) -> Mask:
    """Mask (f,) of the triangles that are turned over in the map, v downwards, or so thin that
    rounding hides it.
    """
    double_area, error = _double_areas(uv[faces])
    return double_area <= error


def stretches(
    vertices: Array, faces: Faces, uv: Array
) -> tuple[Float64, Float64, Float64]:
    """Largest and smallest length on the surface of a unit step in the map, and the
    area (Sander et al. 2001).

    Parameters
    ----------
    vertices, faces, uv
        (v, 3) mm, (f, 3), (v, 2).

    Returns
    -------
    largest, smallest, area : ndarray
        (f,) mm, mm and mm2; infinite and 0 where the triangle has no area in the map.
    """
    parts = [
        _stretches(vertices, faces[i : i + TRIANGLES_PER_BLOCK], uv)
        for i in range(0, len(faces), TRIANGLES_PER_BLOCK)
    ]
    largest, smallest, area = (np.concatenate(x) for x in zip(*parts, strict=True))
    return largest, smallest, area


def _stretches(
    vertices: Array, faces: Faces, uv: Array
) -> tuple[Float64, Float64, Float64]:
    p, q, r = float64(vertices[faces.T])
    s, t = float64(uv[faces.T].transpose(2, 0, 1))
    pq = q - p
    pr = r - p
    area = lengths(np.cross(pq, pr)) / 2
    double = (s[1] - s[0]) * (t[2] - t[0]) - (t[1] - t[0]) * (s[2] - s[0])
    flat = double == 0
    safe = np.where(flat, 1.0, double)[:, None]
    along_u = (pq * (t[2] - t[0])[:, None] - pr * (t[1] - t[0])[:, None]) / safe
    along_v = (pr * (s[1] - s[0])[:, None] - pq * (s[2] - s[0])[:, None]) / safe
    a = dots(along_u, along_u)
    b = dots(along_u, along_v)
    c = dots(along_v, along_v)
    largest = np.sqrt((a + c + np.hypot(a - c, 2 * b)) / 2)
    # from their product, 2 area / |double|, as their difference would suffer from cancellation
    smallest = 2 * area / np.abs(safe[:, 0]) / np.where(largest > 0, largest, 1.0)
    smallest = np.where(flat, 0.0, np.minimum(smallest, largest))
    return np.where(flat, np.inf, largest), smallest, area


def area_log2_sd(largest: Array, smallest: Array, area: Array) -> float:
    """Standard deviation over the surface of log2 of area in the map over area on the surface."""
    valid = (area > 0) & (smallest > 0)
    weight = area[valid] / area[valid].sum()
    ratio = np.log2(largest[valid] * smallest[valid])
    return float(np.sqrt(weight @ (ratio - weight @ ratio) ** 2))


def distortion(
    vertices: Array, faces: Faces, uv: Array, member: Mask
) -> dict[str, AnyArray]:
    """Distortion of an atlas, for the entire surface and by region.

    Parameters
    ----------
    vertices, faces, uv
        (v, 3) mm, (f, 3), (v, 2), as stored.
    member
        (v, r) vertices of each region; a triangle with all corners in a region belongs to it.

    Returns
    -------
    dict
        (1 + r,) each, the entire surface first: `area_log2_sd`, `anisotropy_median`,
        `anisotropy_p99` (largest over smallest stretch, quantiles over the area), NaN
        where a region has no triangle, and `flips`.
    """
    largest, smallest, area = stretches(vertices, faces, uv)
    wrong = flipped(uv, faces)
    regions = [column[faces].all(axis=1) for column in member.T]
    masks = [np.ones(len(faces), bool), *regions]
    rows = [_summary(largest[mask], smallest[mask], area[mask]) for mask in masks]
    names = ("area_log2_sd", "anisotropy_median", "anisotropy_p99")
    columns = dict(zip(names, np.array(rows).T, strict=True))
    return {**columns, "flips": np.array([int(wrong[mask].sum()) for mask in masks])}


def _summary(
    largest: Array, smallest: Array, area: Array
) -> tuple[float, float, float]:
    valid = (area > 0) & (smallest > 0)
    if not valid.any():
        return (np.nan,) * 3
    ratio = largest[valid] / smallest[valid]
    order = np.argsort(ratio)
    fraction = np.cumsum(area[valid][order]) / area[valid].sum()
    places = np.minimum(np.searchsorted(fraction, (0.5, 0.99)), len(order) - 1)
    median, high = ratio[order[places]]
    return area_log2_sd(largest, smallest, area), float(median), float(high)


def rasterise_atlas(uv: Array, faces: Faces, size: int) -> tuple[Index32, Image]:
    """Triangle and position at every texel centre of a square map.

    Parameters
    ----------
    uv
        (v, 2), u first; texel (i, j) has its centre at v = (i + 0.5)/size, u = (j + 0.5)/size.
    faces
        (f, 3), of either orientation.
    size
        Texels along each side.

    Returns
    -------
    face : ndarray
        (size, size) index of the triangle, the lowest where several cover the centre; -1 outside.
    barycentric : ndarray
        (size, size, 3) weights of its corners; 0 outside.
    """
    face = np.full((size, size), -1, np.int32)
    weight = np.zeros((size, size, 3), np.float32)
    corner = size * float64(uv)[faces] - 0.5  # texel centres become integers
    low = np.ceil(corner.min(axis=1) - EDGE).clip(0, size).astype(np.int64)
    high = np.floor(corner.max(axis=1) + EDGE).clip(-1, size - 1).astype(np.int64)
    sides = np.maximum(high + 1 - low, 0)
    corner -= low[:, None]
    double_area, error = _double_areas(corner)
    sides[~(np.abs(double_area) > error)] = 0
    rasterise(corner, double_area, low, sides, face, weight)
    return face, weight


def atlas_values(
    values: Array, trust: AnyArray, faces: Faces, raster: tuple[Index32, Image]
) -> tuple[Image, Image]:
    """Values of the vertices, interpolated linearly at the centres of the texels of a map.

    Parameters
    ----------
    values
        (v, c); values without trust are not used.
    trust
        (v,) in [0, 1]: weights of the corners in a texel.
    faces
        (f, 3).
    raster
        `rasterise_atlas(uv, faces, size)`.

    Returns
    -------
    image : ndarray
        (size, size, c); 0 where nothing is known.
    confidence : ndarray
        (size, size): mean trust of the corners, 0 outside.
    """
    face, weight = raster
    finite = float64(np.where(trust[:, None] > 0, values, 0))
    image = np.zeros((*face.shape, values.shape[1]), np.float32)
    confidence = np.zeros(face.shape, np.float32)
    interpolate(finite, float64(trust), faces, face, weight, image, confidence)
    return image, confidence


def push_pull(image: Array, confidence: AnyArray) -> Image:
    """Fill unknown texels from increasingly coarse averages (Gortler et al. 1996, section 3.5).

    Parameters
    ----------
    image
        (h, w, c), any size; NaN counts as unknown.
    confidence
        (h, w) in [0, 1]: 1 keeps a texel exactly, 0 replaces it, and values between blend.

    Returns
    -------
    ndarray
        (h, w, c) filled; NaN only if nothing is known.
    """
    weight = np.nan_to_num(np.clip(float64(confidence), 0, 1))
    weight[~finite_rows(image)] = 0
    if not weight.any():
        return np.full(image.shape, np.nan, np.float32)
    levels = [(np.ascontiguousarray(image, np.float32), weight)]
    while max(weight.shape) > 1:
        means, total = pulled(*levels[-1])
        means /= np.maximum(total, TINY)[..., None]
        weight = np.minimum(total, 1)
        levels.append((means.astype(np.float32), weight))
    filled, _ = levels.pop()
    while levels:
        around = np.pad(filled, ((1, 1), (1, 1), (0, 0)), "edge")
        filled = pushed(around, *levels.pop())
    return filled


def bilinear(image: Array, pixels: Array) -> Float64:
    """Interpolate an image bilinearly between its pixel centres.

    Parameters
    ----------
    image
        (h, w, c).
    pixels
        (..., 2) column and row in px; pixel centres at integer + 0.5.

    Returns
    -------
    ndarray
        (..., c); the nearest edge in the outer half pixel; NaN outside the image, at
        NaN pixels, and wherever one of the pixels that take part is NaN.
    """
    values = np.asarray(image)
    height, width = values.shape[:2]
    place = float64(pixels)
    inside = np.asarray(((place >= 0) & (place <= (width, height))).all(axis=-1))
    column, x = _cell(np.where(inside, place[..., 0], 0.5), width)
    row, y = _cell(np.where(inside, place[..., 1], 0.5), height)
    # a neighbour of weight 0 must not spread its NaN: it is replaced by the pixel itself
    right = column + (x > 0)
    below = row + (y > 0)
    x = x[..., None]
    y = y[..., None]
    top = values[row, column] * (1 - x) + values[row, right] * x
    bottom = values[below, column] * (1 - x) + values[below, right] * x
    return np.where(inside[..., None], top * (1 - y) + bottom * y, np.nan)


def _cell(place: Array, size: int) -> tuple[Index, Float64]:
    """Pixel before a position along one axis, and the weight of the pixel after it."""
    centred = np.clip(place - 0.5, 0.0, size - 1.0)
    index = np.minimum(centred.astype(np.int64), size - 1)
    return index, centred - index
