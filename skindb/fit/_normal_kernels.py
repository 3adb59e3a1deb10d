"""Compiled combination of the estimates of a surfel's normal; the methods are in
`skindb.fit.normals`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from skindb.jit import kernel
from skindb.optics._photometric_kernels import (
    NormalEstimates,
    buffers,
    estimate_normal,
    normal_estimates,
)

COMBINED, CHROMATIC, PHOTOMETRIC, PEAK = range(4)
# Terms of the total error that cover 91 to 96 % of the normals of six independent
# captures with known truth: shadows, folds and residual highlights affect neighbouring
# lights alike, which increases the angle between the two estimates the second in
# degrees
NOISE_FACTOR_NORMAL = 3.0
MODEL_ERROR_DEGREES = 1.0


@kernel
def _angle(a: Any, b: Any) -> float:
    """Angle in degrees between unit vectors; NaN for NaN."""
    cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if math.isnan(cosine):
        return math.nan
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))


@kernel
def _mean(first: float, normal: Any, out: Any) -> None:
    """Unit mean of two normals, the first weighted by `first`; a normal that is NaN is ignored."""
    second = 1.0 - first
    size = 0.0
    for k in range(3):
        a = normal[0, k]
        b = normal[1, k]
        out[k] = (first * a if a == a else 0.0) + (second * b if b == b else 0.0)
        size += out[k] * out[k]
    for k in range(3):
        out[k] = out[k] / math.sqrt(size) if size > 0.0 else math.nan


@kernel
def _variance(first: float, estimates: NormalEstimates, scan_error: float) -> float:
    """Squared RMS angle [rad^2] of a mean: noise, which is partly common to both, and
    error of the scan per axis.
    """
    second = 1.0 - first
    noise = 0.0
    scan = 0.0
    for k in range(3):
        a = estimates.covariance[0, k, k]
        b = estimates.covariance[1, k, k]
        c = estimates.cross[k, k]
        noise += first * first * a if a == a else 0.0
        noise += second * second * b if b == b else 0.0
        noise += 2.0 * first * second * c if c == c else 0.0
        for j in range(3):
            p = estimates.pull[0, j, k]
            q = estimates.pull[1, j, k]
            turned = (first * p if p == p else 0.0) + (second * q if q == q else 0.0)
            scan += turned * turned
    return noise + scan * scan_error * scan_error / 2.0


@kernel
def normals_block(
    sample: Any,
    position: Any,
    light: Any,
    camera: Any,
    scan: Any,
    method: int,
    eta: float,
    scan_error: float,
    chosen: Any,
    disagreement: Any,
    error: Any,
    total: Any,
) -> None:
    """Normals (n, 3) by the method, angle (n,) of peak and combined, standard and total
    error (n,) [degree].

    `scan_error` is an angle [rad].
    """
    b = buffers(light.shape[0], camera.shape[0])
    first = np.empty(3)
    estimates = normal_estimates()
    peak = estimates.peak
    normal = estimates.normal
    spread = estimates.spread
    combined = np.empty(3)
    for s in range(position.shape[0]):
        size = math.sqrt(scan[s, 0] ** 2 + scan[s, 1] ** 2 + scan[s, 2] ** 2)
        for k in range(3):
            first[k] = scan[s, k] / size if size > 0.0 else math.nan
        estimate_normal(
            sample[s],
            position[s],
            light,
            camera,
            first,
            eta,
            scan_error,
            b,
            estimates,
        )
        # inverse variance: each residual relative to the signal; for skin without
        # colour the first has all the weight
        white = 1.0 / spread[0] ** 2 if spread[0] == spread[0] else 0.0
        tinted = 1.0 / spread[1] ** 2 if spread[1] == spread[1] else 0.0
        share = white / max(white + tinted, 1e-300)
        if white + tinted > 0.0:
            _mean(share, normal, combined)
        else:
            combined[:] = math.nan
        share = 1.0 if method == PHOTOMETRIC else 0.0 if method == CHROMATIC else share
        for k in range(3):
            chosen[s, k] = (
                peak[k]
                if method == PEAK
                else combined[k]
                if method == COMBINED
                else normal[0 if method == PHOTOMETRIC else 1, k]
            )
        disagreement[s] = _angle(peak, combined)
        error[s], total[s] = math.nan, math.nan
        if method != PEAK and np.isfinite(chosen[s]).all():
            error[s] = math.degrees(math.sqrt(_variance(share, estimates, scan_error)))
            # skin without colour has only one of the two
            apart = _angle(normal[0], normal[1])
            apart = apart if apart == apart else 0.0
            if method == COMBINED:
                total[s] = math.sqrt(
                    (NOISE_FACTOR_NORMAL * error[s]) ** 2
                    + apart * apart
                    + MODEL_ERROR_DEGREES * MODEL_ERROR_DEGREES
                )
