"""Compiled combination of the estimates of a surfel's normal; the methods are in
`skindb.fit.normals`.
"""

from __future__ import annotations

import math

import numpy as np

from skindb.jit import all_finite, kernel
from skindb.optics._photometric_kernels import (
    NormalEstimates,
    buffers,
    estimate_normal,
    normal_estimates,
)
from skindb.types import AnyArray, Matrix, Vector

# Terms of the total error that cover 91 to 96 % of the normals of six independent
# captures with known truth: shadows, folds and residual highlights affect neighbouring
# lights alike, which increases the angle between the two estimates the second in
# degrees
NOISE_FACTOR_NORMAL = 3.0
MODEL_ERROR_DEGREES = 1.0
# Standard error [rad] beyond which the chromatic estimate is that of noise: of a gray
# sphere under 12 lights, where it is wrong by 67 degrees on average, the combination is
# then wrong by 6.0 degrees instead of 6.6 (photometric alone 5.5).
MAX_ERROR_CHROMATIC = math.radians(5.0)
# Larger ones say that the lights do not determine the normal: lights in a plane and no
# scan give 42.
MAX_ERROR_DEGREES = 30.0


@kernel
def _mean(white: float, normal: Matrix, out: Vector) -> None:
    """Unit mean of the two estimates, the photometric one weighted by `white`; one that
    is NaN is ignored.
    """
    tinted = 1.0 - white
    size = 0.0
    for k in range(3):
        a = normal[0, k]
        b = normal[1, k]
        out[k] = (white * a if a == a else 0.0) + (tinted * b if b == b else 0.0)
        size += out[k] * out[k]
    for k in range(3):
        out[k] = out[k] / math.sqrt(size) if size > 0.0 else math.nan


@kernel
def _variance(white: float, estimates: NormalEstimates, scan_error: float) -> float:
    """Squared RMS angle [rad^2] of a mean: noise, which is partly common to both, and
    error of the scan per axis.
    """
    tinted = 1.0 - white
    noise = 0.0
    scan = 0.0
    for k in range(3):
        a = estimates.covariance[0, k, k]
        b = estimates.covariance[1, k, k]
        c = estimates.cross[k, k]
        noise += white * white * a if a == a else 0.0
        noise += tinted * tinted * b if b == b else 0.0
        noise += 2.0 * white * tinted * c if c == c else 0.0
        for j in range(3):
            p = estimates.pull[0, j, k]
            q = estimates.pull[1, j, k]
            turned = (white * p if p == p else 0.0) + (tinted * q if q == q else 0.0)
            scan += turned * turned
    return noise + scan * scan_error * scan_error / 2.0


@kernel
def _combine(estimates: NormalEstimates, scan_error: float, out: Vector) -> float:
    """Write the mean of both estimates by inverse variance; returns the weight of the
    photometric one.

    The variance is that of the residuals relative to the signal. Without colour, or
    with less than its noise, the photometric estimate has all the weight.
    """
    spread = estimates.spread
    white = 1.0 / spread[0] ** 2 if spread[0] == spread[0] else 0.0
    tinted = 1.0 / spread[1] ** 2 if spread[1] == spread[1] else 0.0
    variance = _variance(0.0, estimates, scan_error)
    if white > 0.0 and variance > MAX_ERROR_CHROMATIC**2:
        tinted = 0.0
    share = white / max(white + tinted, 1e-300)
    if white + tinted > 0.0:
        _mean(share, estimates.normal, out)
    else:
        out[:] = math.nan
    return share


@kernel
def _total_error(error: float, normal: Matrix) -> float:
    """Total error [degree] of the combined normal, whose standard error is given."""
    cosine = 0.0
    for k in range(3):
        cosine += normal[0, k] * normal[1, k]
    # skin without colour has only one of the two estimates
    apart = math.acos(min(max(cosine, -1.0), 1.0)) if cosine == cosine else 0.0
    square = math.degrees(apart) ** 2 + (NOISE_FACTOR_NORMAL * error) ** 2
    return math.sqrt(square + MODEL_ERROR_DEGREES * MODEL_ERROR_DEGREES)


@kernel
def normals_block(
    sample: AnyArray,
    position: Matrix,
    light: Matrix,
    camera: Matrix,
    scan: Matrix,
    eta: float,
    scan_error: float,
    chosen: Matrix,
    error: Vector,
    total: Vector,
) -> None:
    """Normals (n, 3), standard and total error (n,) [degree].

    `scan_error` is an angle [rad].
    """
    b = buffers(light.shape[0], camera.shape[0])
    start = np.empty(3)
    estimates = normal_estimates()
    for s in range(position.shape[0]):
        size = math.sqrt(scan[s, 0] ** 2 + scan[s, 1] ** 2 + scan[s, 2] ** 2)
        for k in range(3):
            start[k] = scan[s, k] / size if size > 0.0 else math.nan
        estimate_normal(
            sample[s],
            position[s],
            light,
            camera,
            start,
            eta,
            scan_error,
            b,
            estimates,
        )
        share = _combine(estimates, scan_error, chosen[s])
        error[s] = math.nan
        total[s] = math.nan
        if all_finite(chosen[s]):
            error[s] = math.degrees(math.sqrt(_variance(share, estimates, scan_error)))
            if error[s] > MAX_ERROR_DEGREES:
                chosen[s] = math.nan
                error[s] = math.nan
            else:
                total[s] = _total_error(error[s], estimates.normal)
