"""Compiled work on the samples of one surfel: directions, Fresnel factors, selection,
weights, rows, targets, and the judgement of predictions.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from skindb.jit import fast_kernel, kernel, median_of
from skindb.reflectance._mixture_kernels import to_roots
from skindb.reflectance._row_kernels import form_rows, row_memory
from skindb.reflectance._shade_kernels import transmittance
from skindb.schema import FitStatus
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D
from skindb.types import Integer

FITTED, UNSEEN, FEW, NO_DIFFUSE, CLAMPED, NOT_CONVERGED, NOT_FINITE, _ = (
    int(status) for status in FitStatus
)


# relative error of a model in held-out samples without noise, 2 to 6 %
# (docs/validation.md), with which the noise of a sample is compared
MODEL_ERROR = 0.05
# to light or camera; below it lights are partly hidden, and pixels cover a large area
MIN_COSINE_SURFACE = 0.1
# below it an error of the normal has a larger effect than a motion of the face
MIN_COSINE_OUTLIER = 0.2
NO_FLOOR = 1e-9  # sr^-1; floor of the cube roots for residuals
LINEAR, PERCEPTUAL, PAPER = range(3)
# scales of the residuals of the surfel: exceeded by normal noise once in two million,
# and by 1.1 to 2.6 % of samples of six clean captures of another renderer (partly
# hidden lights, lobes outside the basis); with 4 scales twice as many would be
# outliers; halved samples are at 25
OUTLIER_SCALES = 5.0
BINS_PER_SCALE = 16  # of the histograms of scaled residuals
# smallest scale relative to the cube root of the surfel's mean: samples within 1.5 % of
# it are not outliers
MIN_ROOT_SCALE = 1e-3
# of the histograms of residuals; the last one has no upper limit
BINS = int(OUTLIER_SCALES * BINS_PER_SCALE) + 1


class Options(NamedTuple):
    """Options of the fit of a surfel."""

    eta: float
    mode: int
    floor: float  # sr^-1
    least: int  # minimum number of samples
    solve: bool  # otherwise the given weights are only evaluated


class Lumitexel(NamedTuple):
    """Buffers for one surfel; one set per thread."""

    values: Any  # (lights cameras 3,) samples as single floats
    to_light: Any  # (lights, 3) unit directions
    to_camera: Any  # (cameras, 3)
    lit: Any  # (lights,) cosines, 0 below the limit
    seen: Any  # (cameras,)
    enters: Any  # (lights,) F_t cos / pi, 0 below the limit
    leaves: Any  # (cameras,) F_t, 0 below the limit
    usable: Any  # (lights, cameras) which samples are used
    index: Any  # (rows, 2) light and camera of each row
    row_memory: Any
    rows: Any  # (rows, width) cos(theta_i) b_j
    given: Any  # (3, rows) samples
    scattered: Any  # (3, rows) their diffuse part
    target: Any  # (3, rows) samples minus their diffuse part
    noise: Any  # (2, rows) variance of one channel at reflectance 0, and its slope


@kernel
def lumitexel_memory(lights: int, cameras: int, width: int) -> Any:
    """Buffers for `write_rows`."""
    most = lights * cameras
    channels = np.zeros((9, most), np.float32)
    return Lumitexel(
        np.empty(most * 3, np.float32),
        np.empty((lights, 3)),
        np.empty((cameras, 3)),
        np.empty(lights),
        np.empty(cameras),
        np.empty(lights),
        np.empty(cameras),
        np.zeros((lights, cameras), np.bool_),
        np.empty((most, 2), np.int32),
        row_memory(cameras),
        np.zeros((most, width), np.float32),
        channels[:3],
        channels[3:6],
        channels[6:],
        np.zeros((2, most), np.float32),
    )


@fast_kernel
def sample_status(values: Any) -> int:
    """Status of the samples of a surfel: UNSEEN, NOT_FINITE, or FITTED if there are
    finite samples.
    """
    known = np.int32(0)
    infinite = np.int32(0)
    for i in range(values.shape[0]):
        known += np.int32(abs(values[i]) < np.inf)
        infinite += np.int32(abs(values[i]) == np.inf)
    return NOT_FINITE if infinite > 0 else FITTED if known > 0 else UNSEEN


@kernel
def write_directions(position: Any, light: Any, camera: Any, b: Any) -> None:
    """Write the directions from a surfel to every light and camera."""
    _towards(light, position, b.to_light)
    _towards(camera, position, b.to_camera)


@kernel
def _towards(target: Any, p: Any, out: Any) -> None:
    for i in range(target.shape[0]):
        x = target[i, 0] - p[0]
        y = target[i, 1] - p[1]
        z = target[i, 2] - p[2]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x * scale, y * scale, z * scale


@kernel
def write_cosines(n: Any, eta: float, min_cosine: float, b: Any) -> None:
    """Write cosines and transmission factors for all directions; 0 below the limit."""
    _transmission(n, b.to_light, eta, min_cosine, b.lit, b.enters)
    _transmission(n, b.to_camera, eta, min_cosine, b.seen, b.leaves)
    for i in range(b.lit.shape[0]):
        b.enters[i] *= b.lit[i] / np.pi


@kernel
def _transmission(
    n: Any, towards: Any, eta: float, min_cosine: float, cosine: Any, passed: Any
) -> None:
    for i in range(towards.shape[0]):
        c = n[0] * towards[i, 0] + n[1] * towards[i, 1] + n[2] * towards[i, 2]
        above = c > min_cosine and c < 2.0  # also rejects NaN
        cosine[i] = c if above else 0.0
        passed[i] = transmittance(min(c, 1.0), eta) if above else 0.0


@kernel
def choose(b: Any) -> int:
    """Mark the samples that are finite in all channels and not grazing; returns their number."""
    cameras = b.seen.shape[0]
    count = 0
    for i in range(b.lit.shape[0]):
        above = b.lit[i] > 0.0
        for o in range(cameras):
            at = 3 * (i * cameras + o)
            # abs of inf and NaN is not below inf; a sum of three half floats is finite
            # if all three are
            known = abs(b.values[at] + b.values[at + 1] + b.values[at + 2]) < np.inf
            b.usable[i, o] = known & above & (b.seen[o] > 0.0)
            count += int(b.usable[i, o])
    return count


@kernel
def write_rows(n: Any, table: Any, b: Any) -> int:
    """Write the rows of the chosen samples for this normal, and the samples; returns
    their number.
    """
    count = form_rows(
        table, n, b.to_light, b.to_camera, b.usable, b.row_memory, b.rows, b.index
    )
    cameras = b.seen.shape[0]
    for r in range(count):
        at = 3 * (b.index[r, 0] * cameras + b.index[r, 1])
        for c in range(3):
            b.given[c, r] = b.values[at + c]
    return int(count)


@kernel
def write_noise(surfel: int, count: int, noise: Any, b: Any) -> bool:
    """Write the variance of one channel of the chosen samples, linear in reflectance;
    returns whether it is known.

    The brightest channel decides which exposures were usable. The variance does not
    depend on the values otherwise, as this would favour low values.
    """
    if noise.per_radiance.shape[0] == 0:
        b.noise[:, :count] = noise.floor * noise.floor if noise.shot > 0.0 else 0.0
        b.noise[1, :count] = noise.shot
        return bool(noise.shot > 0.0)
    last = noise.limit.shape[1] - 1
    for r in range(count):
        i = b.index[r, 0]
        o = b.index[r, 1]
        scale = noise.per_radiance[surfel, i]
        brightest = max(b.given[0, r], b.given[1, r], b.given[2, r])
        e = 0
        while e < last and brightest > noise.limit[o, e] * scale:
            e += 1
        scale_of_mean = scale / noise.pixels[surfel, o]
        b.noise[0, r] = scale_of_mean * scale * noise.read[o, e]
        b.noise[1, r] = scale_of_mean * noise.slope[o, e]
    return True


@kernel
def split_diffuse(d: Any, count: int, b: Any) -> None:
    """Write the diffuse part of the samples for R_d (3,), and the remainder."""
    for r in range(count):
        b.scattered[2, r] = b.enters[b.index[r, 0]] * b.leaves[b.index[r, 1]]
    for c in range(3):
        reflectance = np.float32(d[c])
        for r in range(count):
            b.scattered[c, r] = b.scattered[2, r] * reflectance
            b.target[c, r] = b.given[c, r] - b.scattered[c, r]


@kernel
def prepare(position: Any, n: Any, d: Any, block: Any, options: Any, b: Any) -> int:
    """Return the status of a surfel before its fit, and write its chosen samples to `b`."""
    status = sample_status(b.values)
    if status != FITTED:
        return status
    if not np.isfinite(position).all():
        return NOT_FINITE
    write_directions(position, block.light, block.camera, b)
    write_cosines(n, options.eta, MIN_COSINE_SURFACE, b)
    if not np.isfinite(n).all():
        return FEW  # no normal: it needs light that is not grazing
    if not np.isfinite(d).all():
        return NO_DIFFUSE
    choose(b)
    return FITTED


@kernel
def clamped(d: Any) -> bool:
    low = min(d[0], d[1], d[2])
    high = max(d[0], d[1], d[2])
    return bool(low <= np.float32(SMALLEST_R_D) or high >= np.float32(LARGEST_R_D))


@kernel
def weigh(
    surfel: int, count: int, noise: Any, options: Any, b: Any, weight: Any
) -> None:
    """Weights of the rows: 1 where the error of the model dominates, less where the
    noise of the sensor does.

    The noise is that of the diffuse part, as weights by the noisy samples would favour
    some of them.
    """
    if options.mode == PAPER or not write_noise(surfel, count, noise, b):
        for r in range(count):
            weight[r] = 1.0
        return
    mean = 0.0
    least = options.floor * options.floor
    for r in range(count):
        mean += (b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]) / (
            3.0 * count
        )
    mean = max(mean, options.floor)
    own = MODEL_ERROR * mean
    if options.mode == PERCEPTUAL:
        own = MODEL_ERROR / 3.0 * mean * (mean * mean + least) ** (-1.0 / 3.0)
    for r in range(count):
        level = max(
            (b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]) / 3.0, 0.0
        )
        # of the mean of three channels
        variance = (b.noise[0, r] + b.noise[1, r] * level) / 3.0
        if options.mode == PERCEPTUAL:
            slope = (level * level / 3.0 + least) * (level * level + least) ** (
                -4.0 / 3.0
            )
            variance *= slope * slope
        weight[r] = 1.0 / (1.0 + variance / (own * own))


@fast_kernel
def _root_residuals(
    count: int, begin: int, floor: Any, y: Any, b: Any, work: Any
) -> float:
    """Write residuals in cube-root space, averaged over channels, to `work.trial`;
    returns the mean sample.
    """
    third = np.float32(1.0 / 3.0)
    mean = np.float32(0)
    for r in range(count):
        work.total[r] = (
            b.given[0, begin + r] + b.given[1, begin + r] + b.given[2, begin + r]
        ) * third
        body = (
            b.scattered[0, begin + r]
            + b.scattered[1, begin + r]
            + b.scattered[2, begin + r]
        )
        work.mixed[r] = body * third + y[begin + r]
        mean += work.total[r]
    square = work.square[:count]
    inverse = work.inverse[:count]
    to_roots(
        work.total[:count], floor, square, inverse, work.square_bits, work.inverse_bits
    )
    for r in range(count):
        work.trial[r] = work.total[r] * inverse[r]
    to_roots(
        work.mixed[:count], floor, square, inverse, work.square_bits, work.inverse_bits
    )
    for r in range(count):
        work.trial[r] -= work.mixed[r] * inverse[r]
    return np.float64(mean) / max(count, 1)


@kernel
def outliers(count: int, options: Any, y: Any, b: Any, work: Any, counts: Any) -> float:
    """Fraction of outlying samples, NaN for too few samples; adds to the histograms
    (lights, cameras, bins).
    """
    mean = _root_residuals(count, 0, np.float32(options.floor), y, b, work)
    steep = 0
    last = counts.shape[2] - 1
    for r in range(count):
        above = (
            b.lit[b.index[r, 0]] >= MIN_COSINE_OUTLIER
            and b.seen[b.index[r, 1]] >= MIN_COSINE_OUTLIER
        )
        work.square[r] = abs(work.trial[r]) if above else np.float32(np.inf)
        steep += 1 if above else 0
    if steep < options.least:
        return math.nan
    level = max(mean, options.floor)
    finest = (
        MIN_ROOT_SCALE * level / np.cbrt(level * level + options.floor * options.floor)
    )
    scale = max(1.4826 * median_of(work.square, work.square_bits, count, steep), finest)
    beyond = 0
    per_scale = BINS_PER_SCALE / scale
    for r in range(count):
        if work.square[r] < np.inf:
            place = min(int(work.square[r] * per_scale), last)
            counts[b.index[r, 0], b.index[r, 1], place] += 1
            beyond += place == last
    return beyond / steep


@kernel
def mark(held: Any, kind: Integer, finite: Any, b: Any) -> None:
    """Choose the finite samples of one kind."""
    for i in range(held.shape[0]):
        for o in range(held.shape[1]):
            b.usable[i, o] = finite[i, o] and held[i, o] == kind
