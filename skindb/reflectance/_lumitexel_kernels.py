"""Compiled work on the samples of one surfel: directions, Fresnel factors, selection,
weights, rows, targets, and the judgement of predictions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skindb.jit import (
    all_finite,
    bits_float,
    fast_kernel,
    float_bits,
    inline_fast_kernel,
    kernel,
    median_of,
    unpack,
)
from skindb.reflectance._row_kernels import (
    RowMemory,
    interpolate_rows,
    list_rows,
    row_memory,
)
from skindb.reflectance._shade_kernels import circular_reversal, transmittance
from skindb.reflectance.model import Block, Noise, SurfaceFit
from skindb.schema import FitStatus
from skindb.schema.declaration import LARGEST_R_D, SMALLEST_R_D
from skindb.types import (
    BoolMatrix,
    BoolVector,
    IntCube,
    IntMatrix,
    IntMatrix32,
    Matrix,
    Matrix32,
    Real,
    Tensor32,
    Vector,
    Vector32,
)

(
    FITTED,
    UNSEEN,
    FEW,
    NO_DIFFUSE,
    CLAMPED,
    NOT_CONVERGED,
    NOT_FINITE,
    _,
    LAMBERT,
    UNDETERMINED,
) = (int(status) for status in FitStatus)
# What the samples of a surfel support: three a normal and R_d by Lambert's law, four the
# gloss too (normal and R_d together with one lobe whose strength is near that of the capture),
# and twelve lobes of eight widths. Chosen on 4 to 24 lights of the cat of DiLiGenT.
MIN_SAMPLES_LAMBERT = 3
MIN_SAMPLES_GLOSS = 4
MIN_SAMPLES_LOBES = 12

# relative error of a model in held-out samples without noise, 2 to 6 %
# (docs/results), with which the noise of a sample is compared
MODEL_ERROR = 0.05
# to light or camera; below it lights are partly hidden, and pixels cover a large area
MIN_COSINE_SURFACE = 0.1
# below it an error of the normal has a larger effect than a motion of the face
MIN_COSINE_OUTLIER = 0.2
# factor of the surface term behind the best polarisers; cube roots need a positive one
MIN_GLOSS = 1e-4
NO_FLOOR = 1e-9  # sr^-1; floor of the cube roots for residuals
LINEAR, PERCEPTUAL = range(2)
# scales of the residuals of the surfel: exceeded by normal noise once in two million,
# and by 1.1 to 2.6 % of samples of six clean captures of another renderer (partly
# hidden lights, lobes outside the basis); with 4 scales twice as many would be
# outliers; halved samples are at 25
OUTLIER_SCALES = 5.0
# scales of the residuals from which samples have no weight
OUTLIER_LIMIT = 6.0
# Variance of a fit with these weights over that from its weighted residuals, for normal
# noise: (E[w] / E[d(w z)/dz])^2 with w = (1 - z^2/36)^2, (0.947 / 0.845)^2.
OUTLIER_SPREAD = 1.255
BINS_PER_SCALE = 16  # of the histograms of scaled residuals
# smallest scale relative to the cube root of the surfel's mean: samples within 1.5 % of
# it are not outliers
MIN_ROOT_SCALE = 1e-3
# of the histograms of residuals; the last one has no upper limit
BINS = int(OUTLIER_SCALES * BINS_PER_SCALE) + 1
SQRT_3 = math.sqrt(3.0)
# bits of s^(-1/3) plus a third of the bits of s; accurate to 4 %
MAGIC = np.float32(1419967116.0)
ZERO, THIRD, ONE, TWO_NINTHS = (np.float32(c) for c in (0, 1 / 3, 1, 2 / 9))


class Options(NamedTuple):
    """Options of the fit of a surfel."""

    eta: float
    mode: int
    floor: float  # sr^-1
    min_samples: int
    solve: bool  # otherwise the given parameters are only evaluated
    min_width: float = 0.0  # as in `Comparison`


class JudgedErrors(NamedTuple):
    """Errors of the input of a judgement, and the samples that are not fitted."""

    diffuse: Matrix  # (n, 3) of R_d
    turn: Vector  # (n,) of the normal about each axis [rad]
    # (lights, cameras) 0 fitted, 1 a held-out light, 2 a held-out camera, 3 both
    held: IntMatrix


class RootMemory(NamedTuple):
    """Memory for cube roots and residuals; one number per sample in single precision."""

    total: Vector32  # sum of the targets over channels
    trial: Vector32  # residuals, or the prediction of a step
    mixed: Vector32  # values in cube-root space, or the prediction of a shorter step
    inverse: Vector32  # squared values plus the squared noise floor, to the power -1/3
    size: Vector32  # of residuals


class Lumitexel(NamedTuple):
    """Buffers for one surfel; one set per thread."""

    values: Vector32  # (lights cameras 3,) samples as single floats
    to_light: Matrix  # (lights, 3) unit directions
    to_camera: Matrix  # (cameras, 3)
    lit: Vector  # (lights,) cosines, 0 below the limit
    seen: Vector  # (cameras,)
    enters: Vector  # (lights,) F_t cos / pi, 0 below the limit
    leaves: Vector  # (cameras,) F_t, 0 below the limit
    finite: BoolMatrix  # (lights, cameras) which samples could be used
    usable: BoolMatrix  # (lights, cameras) which samples are used
    pairs: IntMatrix32  # (rows, 2) light and camera of each row
    row_memory: RowMemory
    rows: Matrix32  # (rows, width) cos(theta_i) b_j
    sample: Matrix32  # (3, rows)
    scattered: Matrix32  # (3, rows) their diffuse part, or a prediction
    target: Matrix32  # (3, rows) samples minus their diffuse part
    noise: Matrix32  # (2, rows) variance of one channel at reflectance 0, and its slope
    weight: Vector32  # (rows,) weights of the samples
    surface: Vector32  # (rows,) predicted surface part
    # (lights, cameras) factor of the surface part by polarisers; (0, cameras) without
    gloss: Matrix32


@kernel
def root_memory(size: int) -> RootMemory:
    """Memory for up to `size` samples."""
    v = np.empty((5, size), np.float32)
    return RootMemory(v[0], v[1], v[2], v[3], v[4])


@kernel
def lumitexel_memory(
    lights: int, cameras: int, width: int, polarised: bool = False
) -> Lumitexel:
    """Buffers for up to `width` columns of rows."""
    size = lights * cameras
    channels = np.zeros((9, size), np.float32)
    return Lumitexel(
        np.empty(size * 3, np.float32),
        np.empty((lights, 3)),
        np.empty((cameras, 3)),
        np.empty(lights),
        np.empty(cameras),
        np.empty(lights),
        np.empty(cameras),
        np.zeros((lights, cameras), np.bool_),
        np.zeros((lights, cameras), np.bool_),
        np.empty((size, 2), np.int32),
        row_memory(lights, cameras),
        np.zeros((size, width), np.float32),
        channels[:3],
        channels[3:6],
        channels[6:],
        np.zeros((2, size), np.float32),
        np.ones(size, np.float32),
        np.empty(size, np.float32),
        np.ones((lights if polarised else 0, cameras), np.float32),
    )


@kernel
def block_memory(block: Block, width: int) -> Lumitexel:
    """Buffers for the surfels of a block."""
    lights = block.light.shape[0]
    polarised = block.polarisation.shape[0] > 0
    return lumitexel_memory(lights, block.camera.shape[0], width, polarised)


@inline_fast_kernel
def inverse_root(s: Real) -> Real:
    """s^(-1/3) of a positive number in single precision.

    A start from a third of the exponent bits, then two iterations of third order:
    accurate to rounding, and unlike `pow` it runs in vector registers.
    """
    x = bits_float(np.int32(MAGIC - np.float32(float_bits(s)) * THIRD))
    for _ in range(2):
        d = ONE - s * x * x * x
        x += x * d * (THIRD + d * TWO_NINTHS)
    return x


@fast_kernel
def to_roots(y: Vector32, floor: np.float32, q: Vector32) -> None:
    """Write q = (y^2 + floor^2)^(-1/3); y q is the value of y in cube-root space."""
    for i in range(y.shape[0]):
        q[i] = inverse_root(y[i] * y[i] + floor * floor)


@fast_kernel
def slopes(y: Vector32, floor: np.float32, out: Vector32) -> None:
    """Write the squared slope of the cube root at y: the weight of a squared difference
    at y in cube-root space.
    """
    for i in range(y.shape[0]):
        inverse = inverse_root(y[i] * y[i] + floor * floor)
        square = inverse * inverse
        slope = (y[i] * y[i] * THIRD + floor * floor) * square * square
        out[i] = slope * slope


@fast_kernel
def sample_status(values: Vector32) -> int:
    """Status of the samples of a surfel: UNSEEN, NOT_FINITE, or FITTED if there are
    finite samples.
    """
    finite = np.int32(0)
    infinite = np.int32(0)
    for i in range(values.shape[0]):
        finite += np.int32(abs(values[i]) < np.inf)
        infinite += np.int32(abs(values[i]) == np.inf)
    return NOT_FINITE if infinite > 0 else FITTED if finite > 0 else UNSEEN


@kernel
def write_directions(
    position: Vector, light: Matrix, camera: Matrix, b: Lumitexel
) -> None:
    """Write the directions from a surfel to every light and camera."""
    _towards(light, position, b.to_light)
    _towards(camera, position, b.to_camera)


@kernel
def _towards(target: Matrix, p: Vector, out: Matrix) -> None:
    for i in range(target.shape[0]):
        x = target[i, 0] - p[0]
        y = target[i, 1] - p[1]
        z = target[i, 2] - p[2]
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = x * scale, y * scale, z * scale


@kernel
def cosine_between(light: int, camera: int, b: Lumitexel) -> float:
    """Cosine of the angle between the directions to a light and to a camera."""
    total = 0.0
    for k in range(3):
        total += b.to_light[light, k] * b.to_camera[camera, k]
    return total


@kernel
def write_gloss(polarisation: Matrix, eta: float, b: Lumitexel) -> None:
    """Write the factor of the surface part of every light and camera: polarisers of the
    same handedness are crossed, as the reflection reverses it.
    """
    for i in range(polarisation.shape[0]):
        for o in range(polarisation.shape[1]):
            both = cosine_between(i, o, b)
            apart = math.sqrt(min(max((1.0 + both) / 2.0, 0.0), 1.0))
            crossed = polarisation[i, o] * circular_reversal(apart, eta)
            b.gloss[i, o] = max(1.0 - crossed, MIN_GLOSS)


@kernel
def surface_factor(r: int, b: Lumitexel) -> float:
    """Factor of the surface part of sample r by polarisers."""
    if b.gloss.shape[0] == 0:
        return 1.0
    return float(b.gloss[b.pairs[r, 0], b.pairs[r, 1]])


@kernel
def lobe_angles(r: int, index: float, b: Lumitexel) -> tuple[float, float]:
    """Squared length of the sum of the directions of sample r, and the Fresnel factor of
    a surface with this refractive index behind polarisers.
    """
    both = cosine_between(b.pairs[r, 0], b.pairs[r, 1], b)
    apart = math.sqrt(max((1.0 + both) / 2.0, 0.0))
    reflected = 1.0 - transmittance(min(apart, 1.0), index)
    return 2.0 + 2.0 * both, reflected * surface_factor(r, b)


@kernel
def write_cosines(n: Vector, eta: float, min_cosine: float, b: Lumitexel) -> None:
    """Write cosines and transmission factors for all directions; 0 below the limit."""
    transmission(n, b.to_light, eta, min_cosine, b.lit, b.enters)
    transmission(n, b.to_camera, eta, min_cosine, b.seen, b.leaves)
    for i in range(b.lit.shape[0]):
        b.enters[i] *= b.lit[i] / np.pi


@kernel
def transmission(
    n: Vector,
    towards: Matrix,
    eta: float,
    min_cosine: float,
    cosine: Vector,
    passed: Vector,
) -> None:
    for i in range(towards.shape[0]):
        c = n[0] * towards[i, 0] + n[1] * towards[i, 1] + n[2] * towards[i, 2]
        above = c > min_cosine and c < 2.0  # also rejects NaN
        cosine[i] = c if above else 0.0
        passed[i] = transmittance(min(c, 1.0), eta) if above else 0.0


@kernel
def choose(b: Lumitexel) -> int:
    """Mark the samples that are finite in all channels and not grazing; returns their number."""
    cameras = b.seen.shape[0]
    count = 0
    for i in range(b.lit.shape[0]):
        above = b.lit[i] > 0.0
        for o in range(cameras):
            at = 3 * (i * cameras + o)
            # abs of inf and NaN is not below inf; a sum of three half floats is finite
            # if all three are
            finite = abs(b.values[at] + b.values[at + 1] + b.values[at + 2]) < np.inf
            b.finite[i, o] = finite & above & (b.seen[o] > 0.0)
            b.usable[i, o] = b.finite[i, o]
            count += int(b.usable[i, o])
    return count


@kernel
def held_kinds(held: IntMatrix) -> BoolVector:
    """(4,) which of the codes 0 to 3 occur in `held`."""
    present = np.zeros(4, np.bool_)
    for i in range(held.shape[0]):
        for o in range(held.shape[1]):
            present[held[i, o]] = True
    return present


@kernel
def choose_kind(kind: int, held: IntMatrix, b: Lumitexel) -> None:
    """Mark the samples of one code of `held` among those that `choose` marked."""
    for i in range(held.shape[0]):
        for o in range(held.shape[1]):
            b.usable[i, o] = b.finite[i, o] and held[i, o] == kind


@kernel
def write_rows(n: Vector, table: Tensor32, b: Lumitexel) -> int:
    """Write the rows of the chosen samples for this normal, and the samples; returns
    their number.
    """
    count = write_samples(n, b)
    interpolate_rows(table, n, count, b.row_memory.way, b.row_memory, b.rows)
    return count


@kernel
def write_samples(n: Vector, b: Lumitexel) -> int:
    """Write the chosen samples, which are above the horizon; returns their number."""
    count = list_rows(
        n, b.to_light, b.to_camera, b.usable, b.gloss, b.row_memory, b.pairs
    )
    cameras = b.seen.shape[0]
    for r in range(count):
        at = 3 * (b.pairs[r, 0] * cameras + b.pairs[r, 1])
        for c in range(3):
            b.sample[c, r] = b.values[at + c]
    return int(count)


@kernel
def smallest_half_angle(count: int, b: Lumitexel) -> float:
    """Smallest angle [rad] between the normal and a half vector of the chosen samples."""
    nearest = 0.0
    for r in range(count):
        i = b.pairs[r, 0]
        o = b.pairs[r, 1]
        both = cosine_between(i, o, b)
        along = (b.lit[i] + b.seen[o]) ** 2
        nearest = max(nearest, along / max(2.0 + 2.0 * both, 1e-12))
    return math.acos(math.sqrt(min(nearest, 1.0)))


@kernel
def write_noise(surfel: int, count: int, noise: Noise, b: Lumitexel) -> bool:
    """Write the variance of one channel of the chosen samples, linear in reflectance;
    returns whether it is known.

    The brightest channel decides which exposures were usable. The variance does not
    depend on the values otherwise, as this would favour low values.
    """
    if noise.per_radiance.shape[0] == 0:
        b.noise[:, :count] = 0.0
        return False
    last = noise.limit.shape[1] - 1
    for r in range(count):
        i = b.pairs[r, 0]
        o = b.pairs[r, 1]
        scale = noise.per_radiance[surfel, i]
        brightest = max(b.sample[0, r], b.sample[1, r], b.sample[2, r])
        e = 0
        while e < last and brightest > noise.limit[o, e] * scale:
            e += 1
        scale_of_mean = scale / noise.pixels[surfel, o]
        b.noise[0, r] = scale_of_mean * scale * noise.read[o, e]
        b.noise[1, r] = scale_of_mean * noise.slope[o, e]
    return True


@kernel
def split_diffuse(d: Vector, count: int, b: Lumitexel) -> None:
    """Write the diffuse part of the samples for R_d (3,), and the remainder."""
    for r in range(count):
        b.scattered[2, r] = b.enters[b.pairs[r, 0]] * b.leaves[b.pairs[r, 1]]
    for c in range(3):
        reflectance = np.float32(d[c])
        for r in range(count):
            b.scattered[c, r] = b.scattered[2, r] * reflectance
            b.target[c, r] = b.sample[c, r] - b.scattered[c, r]


@kernel
def prepare(surfel: int, block: Block, options: Options, b: Lumitexel) -> int:
    """Return the status of a surfel before its fit, and write its chosen samples to `b`."""
    position = block.position[surfel]
    n = block.normal[surfel]
    unpack(block.sample[surfel], b.values)
    status = sample_status(b.values)
    if status != FITTED:
        return status
    if not all_finite(position):
        return NOT_FINITE
    write_directions(position, block.light, block.camera, b)
    write_gloss(block.polarisation, options.eta, b)
    write_cosines(n, options.eta, MIN_COSINE_SURFACE, b)
    if not all_finite(n):
        finite = 0
        for i in range(b.values.shape[0]):
            finite += int(abs(b.values[i]) < np.inf)
        return FEW if finite // 3 < MIN_SAMPLES_LAMBERT else UNDETERMINED
    if choose(b) < MIN_SAMPLES_LAMBERT:
        return FEW
    return FITTED if all_finite(block.diffuse[surfel]) else NO_DIFFUSE


@kernel
def start_fit(
    surfel: int, count: int, options: Options, b: Lumitexel, out: SurfaceFit
) -> tuple[bool, float]:
    """Whether the chosen samples are too few for a surface, or given parameters are
    those of none; and the smallest half angle [rad].
    """
    seen = smallest_half_angle(count, b)
    out.samples[surfel] = count
    out.half_angle[surfel] = math.degrees(seen)
    if options.solve:
        return count < options.min_samples, seen
    return not all_finite(out.parameters[surfel]), seen


@kernel
def fitted_status(matt: bool, converged: bool, d: Vector) -> int:
    """Status of a fitted surfel with R_d (3,)."""
    if not converged:
        return NOT_CONVERGED
    low = min(d[0], d[1], d[2])
    high = max(d[0], d[1], d[2])
    if low <= np.float32(SMALLEST_R_D) or high >= np.float32(LARGEST_R_D):
        return CLAMPED
    return LAMBERT if matt else FITTED


@kernel
def weigh(
    surfel: int, count: int, noise: Noise, options: Options, b: Lumitexel
) -> None:
    """Weights of the samples: 1 where the error of the model dominates, less where the
    noise of the sensor does.

    The noise is that of the diffuse part, as weights by the noisy samples would favour
    some of them.
    """
    if not write_noise(surfel, count, noise, b):
        for r in range(count):
            b.weight[r] = 1.0
        return
    mean = 0.0
    floor_square = options.floor * options.floor
    for r in range(count):
        mean += (b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]) / (
            3.0 * count
        )
    mean = max(mean, options.floor)
    model_error = MODEL_ERROR * mean
    if options.mode == PERCEPTUAL:
        cubed = (mean * mean + floor_square) ** (-1.0 / 3.0)
        model_error = MODEL_ERROR / 3.0 * mean * cubed
    for r in range(count):
        level = max(
            (b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]) / 3.0, 0.0
        )
        # of the mean of three channels
        variance = (b.noise[0, r] + b.noise[1, r] * level) / 3.0
        if options.mode == PERCEPTUAL:
            slope = (level * level / 3.0 + floor_square) * (
                level * level + floor_square
            ) ** (-4.0 / 3.0)
            variance *= slope * slope
        b.weight[r] = 1.0 / (1.0 + variance / (model_error * model_error))


@fast_kernel
def _root_residuals(
    count: int, floor: np.float32, b: Lumitexel, root: RootMemory
) -> float:
    """Write residuals in cube-root space, averaged over channels, to `root.trial`;
    returns the mean sample.
    """
    mean = np.float32(0)
    for r in range(count):
        root.total[r] = (b.sample[0, r] + b.sample[1, r] + b.sample[2, r]) * THIRD
        body = b.scattered[0, r] + b.scattered[1, r] + b.scattered[2, r]
        mixed = body * THIRD + b.surface[r]
        total = root.total[r]
        mean += total
        root.trial[r] = total * inverse_root(total * total + floor * floor)
        root.trial[r] -= mixed * inverse_root(mixed * mixed + floor * floor)
    return np.float64(mean) / max(count, 1)


@kernel
def _root_scale(
    mean: float, floor: float, count: int, finite: int, root: RootMemory
) -> float:
    """Scale of the residuals in `root.size`, for the mean sample."""
    level = max(mean, floor)
    finest = MIN_ROOT_SCALE * level / np.cbrt(level * level + floor * floor)
    return max(1.4826 * median_of(root.size, count, finite), finest)


@kernel
def outliers(
    count: int, options: Options, b: Lumitexel, root: RootMemory, counts: IntCube
) -> float:
    """Fraction of samples that the surface in `b.surface` does not explain, NaN for too
    few samples; adds to the histograms (lights, cameras, bins).
    """
    mean = _root_residuals(count, np.float32(options.floor), b, root)
    steep = 0
    last = counts.shape[2] - 1
    for r in range(count):
        above = (
            b.lit[b.pairs[r, 0]] >= MIN_COSINE_OUTLIER
            and b.seen[b.pairs[r, 1]] >= MIN_COSINE_OUTLIER
        )
        root.size[r] = abs(root.trial[r]) if above else np.float32(np.inf)
        steep += 1 if above else 0
    if steep < options.min_samples:
        return math.nan
    scale = _root_scale(mean, options.floor, count, steep, root)
    beyond = 0
    per_scale = BINS_PER_SCALE / scale
    for r in range(count):
        if root.size[r] < np.inf:
            place = min(int(root.size[r] * per_scale), last)
            counts[b.pairs[r, 0], b.pairs[r, 1], place] += 1
            beyond += place == last
    return beyond / steep


@kernel
def weigh_outliers(
    count: int, options: Options, b: Lumitexel, root: RootMemory
) -> None:
    """Multiply the weights of the samples by Tukey's weights of their residuals in
    cube-root space, for the surface in `b.surface`.
    """
    mean = _root_residuals(count, np.float32(options.floor), b, root)
    for r in range(count):
        root.trial[r] = abs(root.trial[r]) * math.sqrt(b.weight[r])
        root.size[r] = root.trial[r]
    limit = OUTLIER_LIMIT * _root_scale(mean, options.floor, count, count, root)
    for r in range(count):
        z = root.trial[r] / limit
        w = max(1.0 - z * z, 0.0)
        b.weight[r] *= w * w


@fast_kernel
def _add_squares(
    predicted: Vector32, measured: Vector32, floor: np.float32, sums: Vector
) -> None:
    """Add the sums of squared differences and of squared values, linear and in cube-root
    space, to sums (4,). Vector registers hold eight sums each in single precision.
    """
    wrong = ZERO
    total = ZERO
    wrong_root = ZERO
    total_root = ZERO
    for i in range(measured.shape[0]):
        m = measured[i]
        p = predicted[i]
        root = m * inverse_root(m * m + floor * floor)
        d = p - m
        e = p * inverse_root(p * p + floor * floor) - root
        wrong += d * d
        total += m * m
        wrong_root += e * e
        total_root += root * root
    sums[0] += wrong
    sums[1] += total
    sums[2] += wrong_root
    sums[3] += total_root


@kernel
def add_surface(count: int, b: Lumitexel) -> tuple[float, float]:
    """Add the surface in `b.surface` to the diffuse part of the samples; returns RMS error
    over RMS of this prediction, linear and in cube-root space, NaN if samples are zero.
    """
    sums = np.zeros(4)
    floor = np.float32(NO_FLOOR)
    for c in range(3):
        for r in range(count):
            b.scattered[c, r] += b.surface[r]
        _add_squares(b.scattered[c][:count], b.sample[c][:count], floor, sums)
    if sums[1] > 0.0:
        return math.sqrt(sums[0] / sums[1]), math.sqrt(sums[2] / sums[3])
    return math.nan, math.nan


@kernel
def relative_drift(d: Vector, error: Vector, drift: Vector) -> None:
    """Write the fraction (3,) of the diffuse part by which R_d (3,) may be wrong in all
    channels.

    Colour differences do not affect the sum over channels: the common error is at most
    the smallest one.
    """
    shared = min(error[0], error[1], error[2])
    for c in range(3):
        drift[c] = shared / max(d[c], SMALLEST_R_D)


@kernel
def tangents(n: Vector) -> Matrix:
    """Two unit vectors (2, 3) perpendicular to n and to each other."""
    small = 0
    for k in range(3):
        small = k if abs(n[k]) < abs(n[small]) else small
    away = np.zeros(3)
    away[small] = 1.0
    axes = np.empty((2, 3))
    _across(n, away, axes[0])
    _across(n, axes[0], axes[1])
    return axes


@kernel
def turned_normals(n: Vector, turn: float, out: Matrix) -> None:
    """Write the normals (4, 3) that represent an error `turn` [rad] about either axis.

    These are the points of the Gauss-Hermite rule with three points per axis, which is
    correct to second order: a lobe that is sampled at its peak loses weight for a
    rotation in any direction. Each of them has the weight 1/6.
    """
    axes = tangents(n)
    for q in range(4):
        angle = SQRT_3 * turn * (1.0 if q % 2 == 0 else -1.0)
        for k in range(3):
            out[q, k] = math.cos(angle) * n[k] + math.sin(angle) * axes[q // 2, k]


@kernel
def _across(a: Vector, b: Vector, out: Vector) -> None:
    """Unit vector perpendicular to two others; loops, since each array operation takes
    seconds to compile.
    """
    for k in range(3):
        out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]
    size = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    for k in range(3):
        out[k] /= size


@kernel
def add_scatter(moved: Vector, x: Vector, covariance: Matrix) -> None:
    """Add the effect of one of the `turned_normals` on the parameters."""
    for j in range(x.shape[0]):
        for k in range(x.shape[0]):
            covariance[j, k] += (moved[j] - x[j]) * (moved[k] - x[k]) / 6.0
