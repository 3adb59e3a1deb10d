"""Compiled computation of basis rows; see
`skindb.reflectance.mixture` for shapes and sources.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from skindb.jit import fast_kernel, inline_fast_kernel, kernel, vector_blend
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
CHUNK = 64  # rows whose cells are found together
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


@inline_fast_kernel
def cells(n: Triple, wi: Triple, wo: Triple, shape: tuple[int, ...]) -> Triple:
    """Coordinates [cells] of two directions in a table of `shape`."""
    theta_h, theta_d, phi = _angles(n, wi, wo)
    return (
        math.sqrt(theta_h * 2.0 / math.pi) * (shape[0] - 1),
        theta_d * 2.0 / math.pi * (shape[1] - 1),
        phi / math.pi * shape[2],
    )


@fast_kernel
def _write_places(
    wi: Triple, wo: Matrix, count: int, shape: tuple[int, ...], out: Matrix
) -> None:
    """Write the `cells` of a direction with those in the columns of wo (3, count)."""
    for q in range(count):
        place = cells((0.0, 0.0, 1.0), wi, (wo[0, q], wo[1, q], wo[2, q]), shape)
        out[0, q], out[1, q], out[2, q] = place


@inline_fast_kernel
def interpolate(
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
def arctangent(y: Real, x: Real) -> Real:
    """atan2 for x, y >= 0 in single precision."""
    large = max(max(x, y), MIN_SQUARE)
    t = min(x, y) / large
    q = t * t
    total = SINGLE[6]
    for k in range(5, -1, -1):
        total = total * q + SINGLE[k]
    return HALF_PI - t * total if y > x else t * total


class RowMemory(NamedTuple):
    """Memory for the rows of one surfel; each thread needs its own.

    `way` holds CHUNK rows in each of its own, and `share` and `corner` have one dimension:
    for constant distances LLVM needs no tests whether addresses overlap.
    """

    camera: Matrix32  # (cameras, 3) directions
    above: IntVector32  # (cameras,) indices of cameras above the horizon
    # (cameras + 1,) indices into `above` of cameras with a usable sample of a light
    chosen: IntVector32
    # (chunks, 7 CHUNK) directions to light and camera, and a factor, of every row
    way: Matrix32
    share: Vector32  # (8 CHUNK,) weights of the corners of the cells of some rows
    corner: IntVector32  # (2 CHUNK,) addresses in the table of their first two corners


@kernel
def row_memory(lights: int, cameras: int) -> RowMemory:
    """Memory for a sample of every light and camera."""
    return RowMemory(
        np.empty((cameras, 3), np.float32),
        np.empty(cameras, np.int32),
        np.empty(cameras + 1, np.int32),
        ways(lights * cameras),
        np.empty(8 * CHUNK, np.float32),
        np.empty(2 * CHUNK, np.int32),
    )


@kernel
def ways(rows: int) -> Matrix32:
    """`RowMemory.way` for a number of rows."""
    return np.zeros(((rows + CHUNK - 1) // CHUNK, 7 * CHUNK), np.float32)


@fast_kernel
def _write_cells(
    n: SingleTriple,
    way: Vector32,
    count: int,
    shape: tuple[int, ...],
    share: Vector32,
    corner: IntVector32,
) -> None:
    """Write addresses and weights, cosine to the light included, of the corners of the
    cells of up to CHUNK rows in a table of `shape`; 0 below the horizon.

    With h = wi + wo unnormalised: tan(theta_h) = |n x h| / n h, tan^2(theta_d) = (1 -
    wi wo) / (1 + wi wo), and phi_d is the angle between n (wo x wi) / |h| and (cos_o -
    cos_i) / 2. Single precision has an error of 0.02 cells.
    """
    nd = np.int32(shape[1])
    last_h = np.int32(shape[0] - 2)
    last_d = np.int32(shape[1] - 2)
    n_phi = np.int32(shape[2])
    width = np.int32(shape[3])  # a table has fewer than 2^31 values
    # cells per unit of sqrt(theta_h), theta_d and phi_d
    per_h = np.float32(math.sqrt(2.0 / math.pi) * (shape[0] - 1))
    per_d = np.float32(2.0 / math.pi * (shape[1] - 1))
    per_phi = np.float32(shape[2] / math.pi)
    for q in range(count):
        ix = way[q]
        iy = way[CHUNK + q]
        iz = way[2 * CHUNK + q]
        ox = way[3 * CHUNK + q]
        oy = way[4 * CHUNK + q]
        oz = way[5 * CHUNK + q]
        hx = ix + ox
        hy = iy + oy
        hz = iz + oz
        bx = n[1] * hz - n[2] * hy
        by = n[2] * hx - n[0] * hz
        bz = n[0] * hy - n[1] * hx
        sin_h = math.sqrt(bx * bx + by * by + bz * bz)
        lit = n[0] * ix + n[1] * iy + n[2] * iz
        seen = n[0] * ox + n[1] * oy + n[2] * oz
        theta_h = arctangent(sin_h, max(lit + seen, ZERO))
        both = ix * ox + iy * oy + iz * oz
        near = math.sqrt(max(ONE + both, MIN_SQUARE))
        far = math.sqrt(max(ONE - both, ZERO))
        theta_d = arctangent(far, near)
        side = (
            n[0] * (oy * iz - oz * iy)
            + n[1] * (oz * ix - ox * iz)
            + n[2] * (ox * iy - oy * ix)
        ) / near
        along = (seen - lit) * ROOT_HALF
        # phi_d has period pi, so phi_d < 0 is the pair with both signs reversed
        along = along if side >= ZERO else -along
        phi = arctangent(abs(side), abs(along))
        phi = PI - phi if along < ZERO else phi
        x = math.sqrt(theta_h) * per_h
        y = theta_d * per_d
        z = phi * per_phi if sin_h > SMALLEST_SINE else ZERO
        i = np.int32(min(np.int32(x), last_h))
        j = np.int32(min(np.int32(y), last_d))
        k = np.int32(z)
        fx = x - np.float32(i)
        fy = y - np.float32(j)
        fz = z - np.float32(k)
        # Numba adds and multiplies in 64 bits, which are slow in vector registers
        first = np.int32(np.int32(np.int32(i * nd) + j) * n_phi)
        after = np.int32(k + STEP)
        k = k if k < n_phi else NONE
        after = after if after < n_phi else NONE
        corner[q] = np.int32(np.int32(first + k) * width)
        corner[CHUNK + q] = np.int32(np.int32(first + after) * width)
        cosine = lit * way[6 * CHUNK + q] if min(lit, seen) > ZERO else ZERO
        gx = (ONE - fx) * cosine
        fx = fx * cosine
        gy = ONE - fy
        gz = ONE - fz
        share[q] = gx * gy * gz
        share[CHUNK + q] = gx * gy * fz
        share[2 * CHUNK + q] = gx * fy * gz
        share[3 * CHUNK + q] = gx * fy * fz
        share[4 * CHUNK + q] = fx * gy * gz
        share[5 * CHUNK + q] = fx * gy * fz
        share[6 * CHUNK + q] = fx * fy * gz
        share[7 * CHUNK + q] = fx * fy * fz


@fast_kernel
def interpolate_rows(
    table: Tensor32,
    n: Vector,
    count: int,
    way: Matrix32,
    memory: RowMemory,
    rows: Matrix32,
) -> None:
    """Write the rows of the directions in `way`: cosine to the light times the trilinear
    sum of the eight corners of the cell; zeros below the horizon.

    The cells of some rows are found in vector registers, then they are read. Neighbouring
    surfels use the same cells, so surfels in spatial order keep this part of the table in
    the cache. The width of `table` and `rows` must be a multiple of LANES.
    """
    flat = table.reshape(-1, table.shape[3])
    share = memory.share
    corner = memory.corner
    # to the next theta_d, theta_h
    along = np.int64(table.shape[2] * table.shape[3])
    across = table.shape[1] * along
    normal = (np.float32(n[0]), np.float32(n[1]), np.float32(n[2]))
    for begin in range(0, count, CHUNK):
        size = min(count - begin, CHUNK)
        _write_cells(normal, way[begin // CHUNK], size, table.shape, share, corner)
        for q in range(size):
            a = np.int64(corner[q])
            b = np.int64(corner[CHUNK + q])
            vector_blend(
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
                    share[q],
                    share[CHUNK + q],
                    share[2 * CHUNK + q],
                    share[3 * CHUNK + q],
                    share[4 * CHUNK + q],
                    share[5 * CHUNK + q],
                    share[6 * CHUNK + q],
                    share[7 * CHUNK + q],
                ),
                rows,
                begin + q,
            )


@fast_kernel
def list_rows(
    n: Vector,
    to_light: Matrix,
    to_camera: Matrix,
    usable: BoolMatrix,
    gloss: Matrix32,
    memory: RowMemory,
    index: IntMatrix32,
) -> int:
    """Write light and camera, directions, and the factor `gloss` (lights, cameras), 1 for
    (0, cameras), of the rows of one surfel, by light and then by camera; returns their
    number.
    """
    cameras = memory.above
    chosen = memory.chosen
    camera = memory.camera
    polarised = gloss.shape[0] > 0
    above = 0
    for o in range(to_camera.shape[0]):
        if _is_above(n, to_camera[o]):
            cameras[above] = o
            above += 1
        for k in range(3):
            memory.camera[o, k] = to_camera[o, k]
    count = 0
    for i in range(to_light.shape[0]):
        if not _is_above(n, to_light[i]):
            continue
        used = np.int64(0)
        for q in range(above):  # without branches, as usable samples are unpredictable
            chosen[used] = cameras[q]
            used += np.int64(usable[i, cameras[q]])
        x = np.float32(to_light[i, 0])
        y = np.float32(to_light[i, 1])
        z = np.float32(to_light[i, 2])
        for c in range(used):
            o = chosen[c]
            way = memory.way[count // CHUNK]
            q = count % CHUNK
            way[q] = x
            way[CHUNK + q] = y
            way[2 * CHUNK + q] = z
            way[3 * CHUNK + q] = camera[o, 0]
            way[4 * CHUNK + q] = camera[o, 1]
            way[5 * CHUNK + q] = camera[o, 2]
            way[6 * CHUNK + q] = gloss[i, o] if polarised else ONE
            index[count, 0], index[count, 1] = i, o
            count += 1
    return count


@kernel
def _is_above(n: Vector, towards: Vector) -> bool:
    """Whether a direction is above the horizon; false for NaN and inf."""
    cosine = n[0] * towards[0] + n[1] * towards[1] + n[2] * towards[2]
    return bool(cosine > 0.0 and cosine < 2.0)


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
    memory = row_memory(to_light.shape[1], to_camera.shape[1])
    gloss = np.empty((0, to_camera.shape[1]), np.float32)
    for s in range(normal.shape[0]):
        lo = offsets[s]
        count = list_rows(
            normal[s],
            to_light[s],
            to_camera[s],
            usable[s],
            gloss,
            memory,
            index[lo : offsets[s + 1]],
        )
        interpolate_rows(table, normal[s], count, memory.way, memory, rows[lo:])


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
        towards = (wo[s, 0], wo[s, 1], wo[s, 2])
        _write_places(towards, disc, count, table.shape, place)
        for q in range(count):
            interpolate(
                table,
                place[0, q],
                place[1, q],
                place[2, q],
                weights[q],
                value,
            )
            for m in range(out.shape[1]):
                out[s, m] += value[m]
