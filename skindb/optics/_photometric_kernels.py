"""Compiled estimates of the normal of a surfel from its reflectance samples (Weyrich et
al. 2005, section 6).

Arrays over lights are rows of single precision, so that loops over lights run in vector
registers; 3 x 3 sums are in double precision. Order statistics come from sorting
networks and from counting, which have no branches.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skindb.jit import (
    fast_kernel,
    inline_fast_kernel,
    inline_kernel,
    kernel,
    median_of,
    scale_to_one,
    sort_columns,
    unpack,
)
from skindb.types import (
    Cube,
    Cube32,
    IntVector,
    Matrix,
    Matrix32,
    Real,
    Vector,
    Vector32,
)

# below it, a pixel may include the background behind the silhouette
MIN_COSINE_CAMERA = np.float32(0.2)
# below it, the linear model fails (half-hidden disc, terminator)
MIN_COSINE_LIGHT = np.float32(0.1)
SHADE_QUANTILE = 0.25  # over cameras; below the highlights, above the darkest outliers
# number of lights that count as independent; with all 150, the prior of the scan would
# be ineffective. It lowers the 95 % quantile of errors from 7.4 to 4.3 degrees
INDEPENDENT_LIGHTS = 8
# 95 % efficiency for normal noise; converges in 6 to 10 iterations
TUKEY = 4.685
MAX_ITERATIONS = 12
# squared change of the normal that ends the iteration: 0.002 degrees, a hundredth of
# the smallest error
MIN_SQUARED_CHANGE = 1e-9
ZERO = np.float32(0)
ONE = np.float32(1)
HALF = np.float32(0.5)


class NormalEstimates(NamedTuple):
    """Estimates for a surfel; NaN where the samples do not determine them.

    They are from robust photometric stereo of two signals. The first signal is a
    low quantile over cameras of the mean channel, below the highlights; the second is
    the median of the colour difference that is zero for white light (Zickler et al.
    2008). The spread is the residual over the signal. The covariance describes the noise
    of the samples, estimated from the residuals. A small rotation t of the scan's normal
    rotates an estimate by `pull` t.
    """

    normal: Matrix  # (2, 3)
    spread: Vector  # (2,)
    covariance: Cube  # (2, 3, 3) [rad^2]
    cross: Matrix  # (3, 3) covariance of the first normal with the second
    pull: Cube  # (2, 3, 3)


class Buffers(NamedTuple):
    """Memory for one surfel; each thread has its own."""

    values: Vector32  # (lights cameras 3,) samples
    light: Matrix32  # (3, lights) unit directions, one row per axis
    through: Vector32  # (cameras,) F_t towards the camera, 0 for unused cameras
    cameras: IntVector  # (cameras,) indices of the cameras that are used
    white: Matrix32  # (cameras, lights) mean channel over F_t, inf without a sample
    tinted: Matrix32  # (cameras, lights) the part along the skin's colour
    samples: IntVector  # (lights,) number of samples
    shade: Matrix32  # (2, lights) signals that the normal explains
    present: Vector32  # (lights,) 1 where there is a signal, else 0
    weight: Vector32  # (lights,)
    passed: Vector32  # (lights,) F_t of the light
    residual: Vector32  # (lights,)
    size: Vector32  # (lights,) absolute values of the residuals
    score: Matrix  # (2, lights)
    turn: Cube  # (2, 3, 3) from a sum of score times direction to a rotation


@kernel
def normal_estimates() -> NormalEstimates:
    """Memory for the result of `estimate_normal`."""
    return NormalEstimates(
        np.empty((2, 3)),
        np.empty(2),
        np.empty((2, 3, 3)),
        np.empty((3, 3)),
        np.empty((2, 3, 3)),
    )


@kernel
def buffers(lights: int, cameras: int) -> Buffers:
    """Memory for `estimate_normal`."""
    single = np.zeros((10 + 2 * cameras, lights), np.float32)
    return Buffers(
        np.empty(lights * cameras * 3, np.float32),
        single[0:3],
        np.zeros(cameras, np.float32),
        np.zeros(cameras, np.int64),
        single[10 : 10 + cameras],
        single[10 + cameras :],
        np.zeros(lights, np.int64),
        single[3:5],
        single[5],
        single[6],
        single[7],
        single[8],
        single[9],
        np.zeros((2, lights)),
        np.empty((2, 3, 3)),
    )


@inline_kernel
def _finite(value: float) -> bool:
    """Whether a number is finite; math.isfinite is x - x == x - x, which fast math
    optimises to True.
    """
    return abs(value) < np.inf


@inline_fast_kernel
def _transmittance(cosine: Real, square: Real) -> Real:
    """F_t of a cosine in single or double precision; `square` is eta^2 - 1, which must
    not be negative.
    """
    g = math.sqrt(square + cosine * cosine)
    minus = g - cosine
    plus = g + cosine
    p = cosine * minus + ONE
    q = cosine * plus - ONE
    # a single division, as divisions dominate the time
    return ONE - HALF * minus * minus * (p * p + q * q) / (plus * plus * p * p)


@inline_fast_kernel
def _direction(position: Vector, target: Vector) -> tuple[float, float, float]:
    """Unit direction from a position to a target."""
    x = target[0] - position[0]
    y = target[1] - position[1]
    z = target[2] - position[2]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@fast_kernel
def _point(
    position: Vector,
    light: Matrix,
    camera: Matrix,
    scan: Vector,
    square: np.float32,
    b: Buffers,
) -> int:
    """Set directions from a surfel, and F_t towards cameras above MIN_COSINE_CAMERA;
    returns their number.
    """
    for i in range(light.shape[0]):
        x, y, z = _direction(position, light[i])
        b.light[0, i], b.light[1, i], b.light[2, i] = x, y, z
    count = 0
    for o in range(camera.shape[0]):
        x, y, z = _direction(position, camera[o])
        cosine = np.float32(scan[0] * x + scan[1] * y + scan[2] * z)
        b.through[o] = ZERO
        if cosine > MIN_COSINE_CAMERA:
            b.through[o] = _transmittance(min(cosine, ONE), square)
            b.cameras[count] = o
            count += 1
    return count


@inline_fast_kernel
def _colour_axis(
    n_cameras: int, cameras: int, b: Buffers
) -> tuple[np.float32, np.float32, np.float32]:
    """Unit vector of the colour difference of the mean sample from grey; also counts the
    samples of each light.
    """
    lights = b.present.shape[0]
    red = green = blue = count = 0.0
    for i in range(lights):
        b.samples[i] = 0
        for q in range(n_cameras):
            place = 3 * (i * cameras + b.cameras[q])
            r = b.values[place]
            g = b.values[place + 1]
            v = b.values[place + 2]
            if _finite(r + g + v):
                red = red + r
                green = green + g
                blue = blue + v
                count = count + 1.0
                b.samples[i] += 1
    grey = (red + green + blue) / 3.0
    red = red - grey
    green = green - grey
    blue = blue - grey
    size = math.sqrt(red * red + green * green + blue * blue)
    scale = 1.0 / size if size > 0.0 else 0.0
    return np.float32(red * scale), np.float32(green * scale), np.float32(blue * scale)


@fast_kernel
def _shades(n_cameras: int, cameras: int, b: Buffers) -> None:
    """For each light, low quantile over cameras of the mean channel, and median of the
    part along the skin's colour.
    """
    lights = b.present.shape[0]
    along_red, along_green, along_blue = _colour_axis(n_cameras, cameras, b)
    missing = np.float32(np.inf)
    for q in range(n_cameras):
        o = b.cameras[q]
        inverse = ONE / b.through[o]
        third = inverse / np.float32(3)
        for i in range(lights):
            place = 3 * (i * cameras + o)
            r = b.values[place]
            g = b.values[place + 1]
            v = b.values[place + 2]
            valid = _finite(r + g + v)
            tint = (r * along_red + g * along_green + v * along_blue) * inverse
            b.white[q, i] = (r + g + v) * third if valid else missing
            b.tinted[q, i] = tint if valid else missing
    sort_columns(b.white, n_cameras, lights)
    sort_columns(b.tinted, n_cameras, lights)
    for i in range(lights):
        n = b.samples[i]
        b.present[i] = ONE if n > 0 else ZERO
        b.shade[0, i] = b.shade[1, i] = ZERO
        if n > 0:
            b.shade[0, i] = b.white[int(np.rint(SHADE_QUANTILE * (n - 1))), i]
            b.shade[1, i] = HALF * (b.tinted[(n - 1) // 2, i] + b.tinted[n // 2, i])


@fast_kernel
def _normal_equations(
    n: Vector,
    shade: Vector32,
    square: np.float32,
    b: Buffers,
    data: Matrix,
    right: Vector,
) -> int:
    """F_t of the lights at the normal n and weighted sums of their directions; returns
    the number of lights used.
    """
    nx = np.float32(n[0])
    ny = np.float32(n[1])
    nz = np.float32(n[2])
    x = b.light[0]
    y = b.light[1]
    z = b.light[2]
    weight = b.weight
    xx = xy = xz = yy = yz = zz = ZERO
    rx = ry = rz = ZERO
    count = ZERO
    for i in range(x.shape[0]):
        cosine = nx * x[i] + ny * y[i] + nz * z[i]
        above = b.present[i] if cosine > MIN_COSINE_LIGHT else ZERO
        passed = above * _transmittance(min(max(cosine, MIN_COSINE_LIGHT), ONE), square)
        b.passed[i] = passed
        a = weight[i] * passed
        s = a * shade[i]
        a = a * passed
        xx += a * x[i] * x[i]
        xy += a * x[i] * y[i]
        xz += a * x[i] * z[i]
        yy += a * y[i] * y[i]
        yz += a * y[i] * z[i]
        zz += a * z[i] * z[i]
        rx += s * x[i]
        ry += s * y[i]
        rz += s * z[i]
        count += above
    data[0, 0], data[0, 1], data[0, 2] = xx, xy, xz
    data[1, 0], data[1, 1], data[1, 2] = xy, yy, yz
    data[2, 0], data[2, 1], data[2, 2] = xz, yz, zz
    right[0], right[1], right[2] = rx, ry, rz
    return int(count)


@fast_kernel
def _residuals(g: Vector, shade: Vector32, b: Buffers) -> None:
    gx = np.float32(g[0])
    gy = np.float32(g[1])
    gz = np.float32(g[2])
    x = b.light[0]
    y = b.light[1]
    z = b.light[2]
    for i in range(x.shape[0]):
        passed = b.passed[i]
        residual = shade[i] - passed * (gx * x[i] + gy * y[i] + gz * z[i])
        b.residual[i] = residual
        b.size[i] = abs(residual) if passed > ZERO else np.float32(np.inf)


@fast_kernel
def _tukey(spread: float, b: Buffers) -> None:
    inverse = np.float32(1.0 / (TUKEY * spread) ** 2)
    for i in range(b.weight.shape[0]):
        u = ONE - b.residual[i] * b.residual[i] * inverse
        b.weight[i] = u * u if u > ZERO else ZERO


@fast_kernel
def _inverse(a: Matrix, out: Matrix) -> None:
    """Inverse of a 3 x 3 matrix by cofactors; with a ridge of 1e-6 of its trace, 9
    digits are accurate.
    """
    for j in range(3):
        p = (j + 1) % 3
        q = (j + 2) % 3
        for k in range(3):
            u = (k + 1) % 3
            v = (k + 2) % 3
            out[k, j] = a[p, u] * a[q, v] - a[p, v] * a[q, u]
    f = 1.0 / (a[0, 0] * out[0, 0] + a[0, 1] * out[1, 0] + a[0, 2] * out[2, 0])
    for j in range(3):
        for k in range(3):
            out[k, j] *= f


@fast_kernel
def _sandwich(left: Matrix, meat: Matrix, right: Matrix, out: Matrix) -> None:
    """Write left meat right^T of 3 x 3 matrices."""
    for j in range(3):
        for k in range(3):
            total = 0.0
            for p in range(3):
                for q in range(3):
                    total += left[j, p] * meat[p, q] * right[k, q]
            out[j, k] = total


@fast_kernel
def _photometric(
    signal: int,
    scan: Vector,
    square: np.float32,
    prior: float,
    b: Buffers,
    out: NormalEstimates,
) -> float:
    """Robust photometric stereo: shade = F_t(n.l) g.l for one g; writes g/|g| of a signal
    and its covariance, returns residual/|g|.

    Tukey weights exclude shadows and remaining highlights. The scan's normal is a prior
    on the direction of g, which matters where few lights or mixed pixels do not
    determine the direction.
    """
    shade = b.shade[signal]
    normal = out.normal[signal]
    data = np.empty((3, 3))
    matrix = np.empty((3, 3))
    inverse = np.empty((3, 3))
    right = np.empty(3)
    g = np.empty(3)
    b.weight[:] = ONE
    for k in range(3):
        normal[k] = scan[k]
    spread = 0.0
    size = 1.0
    hold = 0.0  # weight of the scan's normal
    for step in range(MAX_ITERATIONS):
        count = _normal_equations(normal, shade, square, b, data, right)
        if step > 0:
            # errors of neighbouring lights are correlated, so any number counts as at
            # most INDEPENDENT_LIGHTS
            repeats = max(count / INDEPENDENT_LIGHTS, 1.0)
            hold = repeats * (spread / (size * max(prior, 1e-9))) ** 2
        # a ridge far below the data, so that surfels without light have the solution
        # zero and hence a NaN normal
        ridge = 1e-6 * (data[0, 0] + data[1, 1] + data[2, 2] + 2.0 * hold) + 1e-12
        for j in range(3):
            for k in range(3):
                matrix[j, k] = data[j, k] - hold * scan[j] * scan[k]
            matrix[j, j] += hold + ridge
        _inverse(matrix, inverse)
        for k in range(3):
            g[k] = (
                inverse[k, 0] * right[0]
                + inverse[k, 1] * right[1]
                + inverse[k, 2] * right[2]
            )
        size = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if not size > 0.0:
            normal[:] = np.nan
            out.covariance[signal] = np.nan
            out.pull[signal] = np.nan
            b.turn[signal] = np.nan
            return np.nan
        moved = 0.0
        for k in range(3):
            moved += (g[k] / size - normal[k]) ** 2
            normal[k] = g[k] / size
        _residuals(g, shade, b)
        middle = median_of(b.size, b.size.shape[0], count)
        spread = 1.4826 * middle + 0.01 * size
        if moved < MIN_SQUARED_CHANGE or step == MAX_ITERATIONS - 1:
            break
        _tukey(spread, b)
    _covariance(signal, square, spread, hold, size, data, matrix, b, out)
    return spread / size


@fast_kernel
def _write_scores(
    normal: Vector,
    score: Vector,
    square: np.float32,
    spread: float,
    b: Buffers,
    bent: Matrix,
    meat: Matrix,
) -> bool:
    """Write the scores of the lights, the sum of their squares (3, 3), and the derivative
    (3, 3) of their sum; returns whether the slope of the influence function is reliable.
    """
    slope = 0.0
    total = 0.0
    count = 0
    meat[:] = 0.0
    bent[:] = 0.0
    way = np.empty(3)
    for i in range(score.shape[0]):
        score[i] = 0.0
        passed = np.float64(b.passed[i])
        if not (passed > 0.0 and b.weight[i] > ZERO):
            continue
        way[0], way[1], way[2] = b.light[0, i], b.light[1, i], b.light[2, i]
        u = (b.residual[i] / (TUKEY * spread)) ** 2
        bend = (1.0 - u) * (1.0 - 5.0 * u) if u < 1.0 else 0.0
        slope += bend * passed * passed
        total += b.weight[i] * passed * passed
        count += 1
        # a rotation of the normal also changes F_t, which matters at grazing angles
        c = normal[0] * way[0] + normal[1] * way[1] + normal[2] * way[2]
        above = _transmittance(c + 1e-4, np.float64(square))
        below = _transmittance(c - 1e-4, np.float64(square))
        steep = (above - below) / 2e-4
        score[i] = b.weight[i] * passed * b.residual[i]
        for j in range(3):
            for k in range(3):
                change = passed * way[k] + c * steep * (way[k] - c * normal[k])
                bent[j, k] += bend * passed * way[j] * change
                meat[j, k] += score[i] * score[i] * way[j] * way[k]
    # correction for three fitted unknowns; the slope of the influence function is below its weights
    correction = count / max(count - 3.0, 1.0)
    for i in range(score.shape[0]):
        score[i] *= math.sqrt(correction)
    for j in range(3):
        for k in range(3):
            meat[j, k] *= correction
    return bool(slope > 0.5 * total)


@fast_kernel
def _covariance(
    signal: int,
    square: np.float32,
    spread: float,
    hold: float,
    size: float,
    data: Matrix,
    matrix: Matrix,
    b: Buffers,
    out: NormalEstimates,
) -> None:
    """Covariance of the normal from the residuals (Huber's sandwich), and its
    derivative by the scan's normal; also the scores of the lights and `turn`.
    """
    normal = out.normal[signal]
    turn = b.turn[signal]
    meat = np.empty((3, 3))
    bent = np.empty((3, 3))
    inverse = np.empty((3, 3))
    reliable = _write_scores(normal, b.score[signal], square, spread, b, bent, meat)
    for j in range(3):
        for k in range(3):
            matrix[j, k] += bent[j, k] - data[j, k] if reliable else -0.5 * data[j, k]
    _inverse(matrix, inverse)
    for j in range(3):  # only the part perpendicular to the normal rotates it
        along = (
            inverse[0, j] * normal[0]
            + inverse[1, j] * normal[1]
            + inverse[2, j] * normal[2]
        )
        for k in range(3):
            turn[k, j] = (inverse[k, j] - along * normal[k]) / size
    _sandwich(turn, meat, turn, out.covariance[signal])
    for k in range(3):  # a rotation of the scan's normal is perpendicular to it
        along = turn[k, 0] * normal[0] + turn[k, 1] * normal[1] + turn[k, 2] * normal[2]
        for j in range(3):
            out.pull[signal, k, j] = (turn[k, j] - along * normal[j]) * hold * size


@fast_kernel
def estimate_normal(
    sample: Cube32,
    position: Vector,
    light: Matrix,
    camera: Matrix,
    scan: Vector,
    eta: float,
    prior: float,
    b: Buffers,
    out: NormalEstimates,
) -> None:
    """Estimate the normal of a surfel by all methods.

    Parameters
    ----------
    sample
        (lights, cameras, 3) f_r cos(theta_i) [sr^-1] or bits of half floats, see
        `skindb.jit.sample_bits`; NaN where unusable.
    position, light, camera
        (3,), (lights, 3) and (cameras, 3) positions [mm].
    scan
        (3,) unit normal of the scan.
    eta
        Refractive index of the Fresnel factors.
    prior
        Standard deviation of the scan's normals [rad].
    b, out
        Buffers and result, which are overwritten.
    """
    square = np.float32(max(eta * eta - 1.0, 0.0))
    unpack(sample, b.values)
    # normals do not depend on brightness, and squares must neither underflow nor
    # overflow
    scale_to_one(b.values)
    n_cameras = _point(position, light, camera, scan, square, b)
    _shades(n_cameras, camera.shape[0], b)
    meat = np.zeros((3, 3))
    for signal in range(2):
        out.spread[signal] = _photometric(signal, scan, square, prior, b, out)
    # noise that grows with the signal differs between channels, so both signals have
    # part of it in common
    for i in range(b.score.shape[1]):
        both = b.score[0, i] * b.score[1, i]
        for j in range(3):
            for k in range(3):
                meat[j, k] += both * b.light[j, i] * b.light[k, i]
    _sandwich(b.turn[0], meat, b.turn[1], out.cross)
