"""Compiled computation of basis rows; see
`skindb.reflectance.mixture` for shapes and sources.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from skindb.jit import LANES, blend, fast_kernel, inline_fast_kernel, kernel
from skindb.types import (
    BoolCube,
    BoolMatrix,
    Cube,
    IntMatrix32,
    IntVector,
    IntVector32,
    Matrix,
    Matrix32,
    Real,
    Tensor32,
    Vector,
    Vector32,
)

Triple = tuple[float, float, float]
SingleTriple = tuple[np.float32, np.float32, np.float32]

# arctan(t) = t sum c_k t^2k on [0, 1], minimax fit with error 5.3e-11; unlike atan2 it
# runs in vector registers
ARCTAN = (
    0.9999999999476555,
    -0.3333333172329439,
    0.1999991812672282,
    -0.1428407563003924,
    0.1109400135133806,
    -0.08983791592027021,
    0.07256067657628158,
    -0.05447270115554298,
    0.03444219805422348,
    -0.01628516998556444,
    0.004924053342038083,
    -0.0006980987612493564,
)
# the same with error 2.5e-7, for single precision
SINGLE = tuple(
    np.float32(c)
    for c in (
        0.9999961115845969,
        -0.3331736810442645,
        0.19807815771352963,
        -0.1323334239985408,
        0.07962367280685324,
        -0.03360421818567151,
        0.00681179190956116,
    )
)
ZERO, ONE, MIN_SQUARE, HALF_PI, PI = (
    np.float32(c) for c in (0.0, 1.0, 1e-30, math.pi / 2, math.pi)
)
NONE, STEP, TWO = (np.int32(c) for c in (0, 1, 2))
X, Y, Z, ACROSS_X, ACROSS_Y, ACROSS_Z, COSINE = range(7)  # rows of `RowMemory.faces`
THETA_H, THETA_D, PHI_D = range(3)  # rows of `RowMemory.place`
ROOT_HALF = np.float32(math.sqrt(0.5))
SMALLEST_SINE = np.float32(1e-6)


@inline_fast_kernel
def _arctangent(y: float, x: float) -> float:
    """atan2 for y >= 0, without branches."""
    size = abs(x)
    t = min(size, y) / max(max(size, y), 1e-300)
    q = t * t
    total = ARCTAN[11]
    for k in range(10, -1, -1):
        total = total * q + ARCTAN[k]
    angle = 0.5 * math.pi - total * t if y > size else total * t
    return math.pi - angle if x < 0.0 else angle


@inline_fast_kernel
def _angles(n: Triple, wi: Triple, wo: Triple) -> Triple:
    """theta_h, theta_d, phi_d of unit 3-tuples; sines from cross products are accurate
    for narrow lobes.
    """
    hx = wi[0] + wo[0]
    hy = wi[1] + wo[1]
    hz = wi[2] + wo[2]
    scale = 1.0 / max(math.sqrt(hx * hx + hy * hy + hz * hz), 1e-12)
    hx = hx * scale
    hy = hy * scale
    hz = hz * scale
    bx = n[1] * hz - n[2] * hy
    by = n[2] * hx - n[0] * hz
    bz = n[0] * hy - n[1] * hx
    cx = hy * wi[2] - hz * wi[1]
    cy = hz * wi[0] - hx * wi[2]
    cz = hx * wi[1] - hy * wi[0]
    tx = by * hz - bz * hy
    ty = bz * hx - bx * hz
    tz = bx * hy - by * hx
    sin_h = math.sqrt(bx * bx + by * by + bz * bz)
    theta_h = _arctangent(sin_h, max(n[0] * hx + n[1] * hy + n[2] * hz, 0.0))
    theta_d = _arctangent(
        math.sqrt(cx * cx + cy * cy + cz * cz),
        max(hx * wi[0] + hy * wi[1] + hz * wi[2], 0.0),
    )
    across = bx * wi[0] + by * wi[1] + bz * wi[2]
    along = tx * wi[0] + ty * wi[1] + tz * wi[2]
    # phi_d has period pi, so a pair with phi_d < 0 is the pair with both signs reversed
    phi = _arctangent(abs(across), along if across >= 0.0 else -along)
    return theta_h, theta_d, phi if sin_h > 1e-7 else 0.0


@fast_kernel
def _coordinates(
    n: Triple, wi: Triple, wo: Matrix, count: int, shape: tuple[int, ...], out: Matrix
) -> None:
    """Coordinates [cells] in a table of `shape`, out (3, count), of wi with the columns
    of wo (3, count).
    """
    per_h = 2.0 / math.pi
    per_d = (shape[1] - 1) * 2.0 / math.pi
    per_phi = shape[2] / math.pi
    for q in range(count):
        theta_h, theta_d, phi = _angles(n, wi, (wo[0, q], wo[1, q], wo[2, q]))
        out[0, q] = math.sqrt(theta_h * per_h) * (shape[0] - 1)
        out[1, q] = theta_d * per_d
        out[2, q] = phi * per_phi


@inline_fast_kernel
def _interpolate(
    table: Tensor32, x: float, y: float, z: float, factor: float, out: Vector32
) -> None:
    """out[:] = factor * trilinear table value at x, y, z in cells; NaN reads cell 0 and
    gives NaN.
    """
    nh, nd, n_phi, size = table.shape
    i = max(min(int(x), nh - 2), 0)
    j = max(min(int(y), nd - 2), 0)
    k = max(int(z), 0)
    fx = x - i
    fy = y - j
    fz = z - k
    k = k if k < n_phi else 0
    k1 = k + 1 if k + 1 < n_phi else 0
    w00 = nb.float32(factor * (1 - fx) * (1 - fy) * (1 - fz))
    w01 = nb.float32(factor * (1 - fx) * (1 - fy) * fz)
    w10 = nb.float32(factor * (1 - fx) * fy * (1 - fz))
    w11 = nb.float32(factor * (1 - fx) * fy * fz)
    v00 = nb.float32(factor * fx * (1 - fy) * (1 - fz))
    v01 = nb.float32(factor * fx * (1 - fy) * fz)
    v10 = nb.float32(factor * fx * fy * (1 - fz))
    v11 = nb.float32(factor * fx * fy * fz)
    for m in range(size):
        out[m] = (
            w00 * table[i, j, k, m]
            + w01 * table[i, j, k1, m]
            + w10 * table[i, j + 1, k, m]
            + w11 * table[i, j + 1, k1, m]
            + v00 * table[i + 1, j, k, m]
            + v01 * table[i + 1, j, k1, m]
            + v10 * table[i + 1, j + 1, k, m]
            + v11 * table[i + 1, j + 1, k1, m]
        )


@inline_fast_kernel
def _arctangent_single(y: Real, x: Real) -> Real:
    """atan2 for x, y >= 0 in single precision."""
    large = max(max(x, y), MIN_SQUARE)
    t = min(x, y) / large
    q = t * t
    total = SINGLE[6]
    for k in range(5, -1, -1):
        total = total * q + SINGLE[k]
    return HALF_PI - t * total if y > x else t * total


@kernel
def _face_cameras(
    n: Vector, to_camera: Matrix, faces: Matrix32, cameras: IntVector32
) -> int:
    """Write the input of `_cells`, faces (7, padded), and the indices of cameras above
    the horizon; returns the number.

    The last camera is repeated to complete the last vector.
    """
    count = 0
    for o in range(to_camera.shape[0]):
        x = to_camera[o, 0]
        y = to_camera[o, 1]
        z = to_camera[o, 2]
        cosine = n[0] * x + n[1] * y + n[2] * z
        if cosine > 0.0 and cosine < 2.0:  # false for NaN and inf
            faces[X, count], faces[Y, count], faces[Z, count] = x, y, z
            faces[ACROSS_X, count] = n[1] * z - n[2] * y
            faces[ACROSS_Y, count] = n[2] * x - n[0] * z
            faces[ACROSS_Z, count] = n[0] * y - n[1] * x
            faces[COSINE, count] = cosine
            cameras[count] = o
            count += 1
    for q in range(count, faces.shape[1]):
        for k in range(faces.shape[0]):
            faces[k, q] = faces[k, count - 1]
    return count


@inline_fast_kernel
def _cells_per_angle(table: Tensor32) -> SingleTriple:
    """Number of cells per unit of sqrt(theta_h), theta_d and phi_d."""
    nh, nd, n_phi, _ = table.shape
    return (
        np.float32(math.sqrt(2.0 / math.pi) * (nh - 1)),
        np.float32(2.0 / math.pi * (nd - 1)),
        np.float32(n_phi / math.pi),
    )


@inline_fast_kernel
def _nodes(table: Tensor32) -> tuple[np.int32, np.int32, np.int32]:
    nh, nd, n_phi, _ = table.shape
    return np.int32(nh), np.int32(nd), np.int32(n_phi)


@inline_fast_kernel
def _cross(n: Vector, x: float, y: float, z: float) -> SingleTriple:
    """N x (x, y, z)."""
    return (
        np.float32(n[1] * z - n[2] * y),
        np.float32(n[2] * x - n[0] * z),
        np.float32(n[0] * y - n[1] * x),
    )


@inline_fast_kernel
def _cells(
    wi: SingleTriple,
    across: SingleTriple,
    cosine: np.float32,
    faces: Matrix32,
    count: int,
    size: SingleTriple,
    place: Matrix32,
) -> None:
    """Coordinates in the table [cells], `place` (3, count), of one light with `count`
    cameras; `across` is n x wi.

    With h = wi + wo unnormalised: tan(theta_h) = |n x h| / n h, tan^2(theta_d) = (1 -
    wi wo) / (1 + wi wo), and phi_d is the angle between n (wo x wi) / |h| and (cos_o -
    cos_i) / 2. Single precision has an error of 0.02 cells. `size` is the number of
    cells per unit of sqrt(theta_h), theta_d and phi_d.
    """
    for q in range(count):
        x = faces[X, q]
        y = faces[Y, q]
        z = faces[Z, q]
        bx = faces[ACROSS_X, q] + across[0]
        by = faces[ACROSS_Y, q] + across[1]
        bz = faces[ACROSS_Z, q] + across[2]
        both = wi[0] * x + wi[1] * y + wi[2] * z
        near = math.sqrt(max(ONE + both, MIN_SQUARE))
        far = math.sqrt(max(ONE - both, ZERO))
        sin_h = math.sqrt(bx * bx + by * by + bz * bz)
        theta_h = _arctangent_single(sin_h, cosine + faces[COSINE, q])
        theta_d = _arctangent_single(far, near)
        side = (
            wi[0] * faces[ACROSS_X, q]
            + wi[1] * faces[ACROSS_Y, q]
            + wi[2] * faces[ACROSS_Z, q]
        ) / near
        along = (faces[COSINE, q] - cosine) * ROOT_HALF
        # phi_d has period pi, so phi_d < 0 is the pair with both signs reversed
        along = along if side >= ZERO else -along
        phi = _arctangent_single(abs(side), abs(along))
        phi = PI - phi if along < ZERO else phi
        place[THETA_H, q] = math.sqrt(theta_h) * size[0]
        place[THETA_D, q] = theta_d * size[1]
        place[PHI_D, q] = phi * size[2] if sin_h > SMALLEST_SINE else ZERO


@inline_fast_kernel
def _row(
    flat: Matrix32,
    shape: tuple[np.int32, np.int32, np.int32],
    place: Matrix32,
    q: int,
    cosine: np.float32,
    rows: Matrix32,
    row: int,
) -> None:
    """One row: cosine times the trilinear sum of the eight corners of the cell around
    place[:, q].
    """
    x = place[THETA_H, q]
    y = place[THETA_D, q]
    z = place[PHI_D, q]
    i = min(np.int32(x), shape[0] - TWO)
    j = min(np.int32(y), shape[1] - TWO)
    k = np.int32(z)
    fx = x - np.float32(i)
    fy = y - np.float32(j)
    fz = z - np.float32(k)
    corner = np.int64((i * shape[1] + j) * shape[2])
    a = corner + (k if k < shape[2] else NONE)
    b = corner + (k + STEP if k + STEP < shape[2] else NONE)
    # to the next theta_d, theta_h
    along = np.int64(shape[2])
    across = np.int64(shape[1] * shape[2])
    gx = (ONE - fx) * cosine
    fx = fx * cosine
    gy = ONE - fy
    gz = ONE - fz
    low = gx * gy
    high = gx * fy
    low_far = fx * gy
    high_far = fx * fy
    blend(
        flat,
        (
            a,
            b,
            a + along,
            b + along,
            a + across,
            b + across,
            a + across + along,
            b + across + along,
        ),
        (
            low * gz,
            low * fz,
            high * gz,
            high * fz,
            low_far * gz,
            low_far * fz,
            high_far * gz,
            high_far * fz,
        ),
        rows,
        row,
    )


class RowMemory(NamedTuple):
    """Memory for `form_rows` and `turn_rows`, one per thread; arrays over cameras are
    padded to multiples of LANES.
    """

    # (7, cameras) direction X, Y, Z, normal x direction ACROSS_X, ACROSS_Y, ACROSS_Z,
    # and COSINE
    faces: Matrix32
    place: Matrix32  # (3, cameras) coordinates THETA_H, THETA_D, PHI_D in the table [cells]
    above: IntVector32  # (cameras,) indices of cameras above the horizon
    # (cameras + 1,) indices into `above` of cameras with a usable sample of a light
    chosen: IntVector32


@kernel
def row_memory(cameras: int) -> RowMemory:
    """Memory for up to `cameras` cameras."""
    padded = (cameras + LANES - 1) // LANES * LANES
    # one block, for which LLVM checks fewer addresses for aliasing
    single = np.empty((10, padded), np.float32)
    return RowMemory(
        single[:7],
        single[7:],
        np.empty(padded, np.int32),
        np.empty(padded + 1, np.int32),
    )


@fast_kernel
def form_rows(
    table: Tensor32,
    n: Vector,
    to_light: Matrix,
    to_camera: Matrix,
    usable: BoolMatrix,
    memory: RowMemory,
    rows: Matrix32,
    index: IntMatrix32,
) -> int:
    """Write the rows of one surfel, by light and then by camera; returns their number.

    For each light, the coordinates of all cameras are computed in vector registers,
    then the rows are interpolated. Neighbouring surfels use the same cells, so surfels
    in spatial order keep this part of the table in the cache. The width of `table` and
    `rows` must be a multiple of LANES.
    """
    faces = memory.faces
    place = memory.place
    cameras = memory.above
    chosen = memory.chosen
    seen = _face_cameras(n, to_camera, faces, cameras)
    if seen == 0:
        return 0
    size = _cells_per_angle(table)
    shape = _nodes(table)
    flat = table.reshape(-1, table.shape[3])
    padded = (seen + LANES - 1) // LANES * LANES
    count = 0
    for i in range(to_light.shape[0]):
        x = to_light[i, 0]
        y = to_light[i, 1]
        z = to_light[i, 2]
        cosine = n[0] * x + n[1] * y + n[2] * z
        if not (cosine > 0.0 and cosine < 2.0):  # also NaN and inf
            continue
        wi = (np.float32(x), np.float32(y), np.float32(z))
        across = _cross(n, x, y, z)
        _cells(wi, across, np.float32(cosine), faces, padded, size, place)
        used = np.int64(0)
        for q in range(seen):  # without branches, as usable samples are unpredictable
            chosen[used] = q
            used += np.int64(usable[i, cameras[q]])
        for c in range(used):
            q = chosen[c]
            index[count, 0], index[count, 1] = i, cameras[q]
            _row(flat, shape, place, q, np.float32(cosine), rows, count)
            count += 1
    return count


@fast_kernel
def turn_rows(
    table: Tensor32,
    n: Vector,
    to_light: Matrix,
    to_camera: Matrix,
    index: IntMatrix32,
    count: int,
    memory: RowMemory,
    rows: Matrix32,
) -> None:
    """Rows of the samples `index` (count, 2) as from `form_rows`, with another normal.

    Samples below the horizon of this normal have rows of zeros.
    """
    faces = memory.faces
    place = memory.place
    size = _cells_per_angle(table)
    shape = _nodes(table)
    flat = table.reshape(-1, table.shape[3])
    begin = 0
    while begin < count:
        i = index[begin, 0]
        end = begin
        while end < count and index[end, 0] == i:
            end += 1
        x = to_light[i, 0]
        y = to_light[i, 1]
        z = to_light[i, 2]
        cosine = max(n[0] * x + n[1] * y + n[2] * z, 0.0)
        _face_samples(n, to_camera, index, begin, end, faces)
        across = _cross(n, x, y, z)
        padded = (end - begin + LANES - 1) // LANES * LANES
        _cells(
            (np.float32(x), np.float32(y), np.float32(z)),
            across,
            np.float32(cosine),
            faces,
            padded,
            size,
            place,
        )
        for r in range(begin, end):
            above = faces[COSINE, r - begin] > ZERO
            _row(
                flat,
                shape,
                place,
                r - begin,
                np.float32(cosine) if above else ZERO,
                rows,
                r,
            )
        begin = end


@kernel
def _face_samples(
    n: Vector,
    to_camera: Matrix,
    index: IntMatrix32,
    begin: int,
    end: int,
    faces: Matrix32,
) -> None:
    """Write the input of `_cells` for the cameras of samples begin to end; the cosine
    is 0 below the horizon.
    """
    for q in range(end - begin):
        o = index[begin + q, 1]
        x = to_camera[o, 0]
        y = to_camera[o, 1]
        z = to_camera[o, 2]
        faces[X, q], faces[Y, q], faces[Z, q] = x, y, z
        faces[ACROSS_X, q] = n[1] * z - n[2] * y
        faces[ACROSS_Y, q] = n[2] * x - n[0] * z
        faces[ACROSS_Z, q] = n[0] * y - n[1] * x
        faces[COSINE, q] = max(n[0] * x + n[1] * y + n[2] * z, 0.0)
    for q in range(
        end - begin, min((end - begin + LANES - 1) // LANES * LANES, faces.shape[1])
    ):
        for k in range(faces.shape[0]):
            faces[k, q] = faces[k, end - begin - 1]


@kernel
def fill_rows(
    table: Tensor32,
    normal: Matrix,
    to_light: Cube,
    to_camera: Cube,
    usable: BoolCube,
    offsets: IntVector,
    rows: Matrix32,
    index: IntMatrix32,
) -> None:
    """Write the rows of every surfel, starting at its offset."""
    memory = row_memory(to_camera.shape[1])
    for s in range(normal.shape[0]):
        lo = offsets[s]
        hi = offsets[s + 1]
        form_rows(
            table,
            normal[s],
            to_light[s],
            to_camera[s],
            usable[s],
            memory,
            rows[lo:hi],
            index[lo:hi],
        )


@fast_kernel
def average_disc(
    table: Tensor32,
    wi: Matrix,
    wo: Matrix,
    points: Matrix,
    weights: Vector,
    out: Matrix32,
) -> None:
    """Add to `out` (n, m) the weighted mean of the table over directions around wi."""
    count = points.shape[0]
    disc = np.empty((3, count))
    place = np.empty((3, count))
    value = np.empty(out.shape[1], out.dtype)
    for s in range(wi.shape[0]):
        x = wi[s, 0]
        y = wi[s, 1]
        z = wi[s, 2]
        sign = 1.0 if z >= 0.0 else -1.0
        a = -1.0 / (sign + z)
        b = x * y * a
        for q in range(count):
            u = points[q, 0]
            v = points[q, 1]
            px = x + u * (1.0 + sign * x * x * a) + v * b
            py = y + u * sign * b + v * (sign + y * y * a)
            pz = z - u * sign * x - v * y
            scale = 1.0 / math.sqrt(px * px + py * py + pz * pz)
            disc[0, q], disc[1, q], disc[2, q] = px * scale, py * scale, pz * scale
        # the angles are the same if the two directions are exchanged
        _coordinates(
            (0.0, 0.0, 1.0),
            (wo[s, 0], wo[s, 1], wo[s, 2]),
            disc,
            count,
            table.shape,
            place,
        )
        for q in range(count):
            _interpolate(
                table,
                place[THETA_H, q],
                place[THETA_D, q],
                place[PHI_D, q],
                weights[q],
                value,
            )
            for m in range(out.shape[1]):
                out[s, m] += value[m]
