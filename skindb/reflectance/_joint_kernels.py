"""Compiled joint fit of the normal, R_d and GGX lobes of graded widths to the samples of a
surfel; `skindb.reflectance.joint` describes the model.

Each step needs only the weighted Gram matrix of one table per surfel, whose columns are
the diffuse shape, its derivatives by the normal, those of the surface, the lobes, and the
samples of the three channels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from skindb.jit import LANES, fast_kernel, inline_fast_kernel, kernel
from skindb.numerics._nnls_kernels import (
    ActiveSetMemory,
    active_set_memory,
    invert,
    solve_scaled,
)
from skindb.reflectance._lumitexel_kernels import (
    FITTED,
    MIN_SAMPLES_LOBES,
    MODEL_ERROR,
    OUTLIER_SPREAD,
    Lumitexel,
    Options,
    RootMemory,
    block_memory,
    lobe_angles,
    prepare,
    root_memory,
    slopes,
    smallest_half_angle,
    split_diffuse,
    weigh,
    weigh_outliers,
    write_cosines,
    write_samples,
)
from skindb.reflectance._mixture_kernels import gram
from skindb.reflectance.model import Block
from skindb.types import IntVector, Matrix, Matrix32, Vector, Vector32

LOBES = LANES  # one vector register
# columns of the table: diffuse shape, its derivatives, those of the surface, lobes, samples
DIFFUSE = 0
TURNED = 1
SURFACE = 3
LOBE = 5
SAMPLE = LOBE + LOBES
WIDTH = SAMPLE + 3
PARAMETERS = 3 + LOBES  # R_d and the strengths of the lobes
TURN = PARAMETERS  # the first of two angles of the normal
UNKNOWNS = PARAMETERS + 2
FEW_UNKNOWNS = 6  # R_d, the factor of the shared lobe and the normal
MAX_STEP = 0.15  # rad
DIFFERENCE = 1e-3  # rad, for derivatives by the normal
KKT_TOLERANCE = 1e-8
# half width at half maximum of a lobe, as an angle of the half vector, over its roughness
HALF_WIDTH = math.sqrt(math.sqrt(2.0) - 1.0)
ZERO, ONE, HALF_PER_PI = (np.float32(c) for c in (0.0, 1.0, 0.5 / math.pi))


class Lobes(NamedTuple):
    """The lobes, from wide to narrow, and the scan's normals."""

    square: Vector32  # (LOBES,) squared roughness
    shared: Matrix32  # (n, LOBES) strengths of the one lobe of surfels with few samples
    gloss: float  # mean factor of the shared lobe, of a prior
    gloss_spread: float  # standard deviation of this factor
    gloss_samples: int  # from which surfels have a lobe
    refractive_index: float  # of their Fresnel factor
    scan: Matrix  # (n, 3) unit normals of the scan
    scan_error: float  # rad, standard error of these about each axis
    steps: int  # of the normal
    step_fraction: float  # of a Gauss-Newton step


class JointFit(NamedTuple):
    """Results for n surfels; NaN where nothing was fitted. Angles are in rad."""

    normal: Matrix  # (n, 3)
    normal_error: Vector  # (n,) RMS angle for independent samples
    normal_shared: Vector  # (n,) and for errors by device
    diffuse: Matrix  # (n, 3)
    diffuse_error: Matrix  # (n, 3)
    diffuse_shared: Matrix  # (n, 3)
    strength: Matrix  # (n, LOBES)
    kkt: Vector  # (n,) of the last non-negative problem
    samples: IntVector  # (n,)


class JointMemory(NamedTuple):
    """Memory for one surfel; each thread needs its own."""

    table: Matrix32  # (rows, WIDTH)
    fresnel: Vector32  # (rows,) of the lobes
    nearness: Vector32  # (rows,) 1 / |w_i + w_o|^2
    weight: Vector32  # (rows,)
    none: Vector32  # (rows,) zeros
    root: RootMemory
    lit: Matrix32  # (lights, LOBES) factors of Smith's masking
    seen: Matrix32  # (cameras, LOBES)
    moments: Matrix  # (WIDTH, WIDTH) Gram matrix of the table
    rest: Vector  # (WIDTH,)
    block: Matrix32  # (LANES + 1, LANES) sums in vector registers
    active_set: ActiveSetMemory
    # (PARAMETERS,) R_d and strengths; for few samples one factor of the shared lobe
    x: Vector
    strength: Vector  # (LOBES,) of the lobes
    target: Vector  # (PARAMETERS,) right side
    gram: Matrix  # (PARAMETERS, PARAMETERS)
    turn: Matrix  # (2, 2) inverse of the equations of the normal
    step: Vector  # (2,) rad
    normal: Vector  # (3,)
    turned: Vector  # (3,)
    axes: Matrix  # (2, 3) tangents
    equations: Matrix  # (UNKNOWNS, UNKNOWNS) of the parameters and the normal
    right: Vector  # (UNKNOWNS,)
    cholesky: Matrix  # (UNKNOWNS, UNKNOWNS)
    inverse: Matrix  # (UNKNOWNS, UNKNOWNS)
    score: Vector  # (UNKNOWNS,)
    by_light: Matrix  # (lights, UNKNOWNS) sums of the scores
    by_camera: Matrix  # (cameras, UNKNOWNS)
    independent: Matrix  # (UNKNOWNS, UNKNOWNS) sums of the products of scores
    shared: Matrix  # (UNKNOWNS, UNKNOWNS)


@kernel
def joint_memory(lights: int, cameras: int) -> JointMemory:
    """Memory for surfels under these lights and cameras."""
    size = lights * cameras
    v = np.zeros((4, size), np.float32)
    square = np.empty((5, UNKNOWNS, UNKNOWNS))
    return JointMemory(
        np.zeros((size, WIDTH), np.float32),
        v[0],
        v[1],
        v[2],
        v[3],
        root_memory(size),
        np.empty((lights, LOBES), np.float32),
        np.empty((cameras, LOBES), np.float32),
        np.empty((WIDTH, WIDTH)),
        np.empty(WIDTH),
        np.empty((LANES + 1, LANES), np.float32),
        active_set_memory(PARAMETERS),
        np.empty(PARAMETERS),
        np.zeros(LOBES),
        np.empty(PARAMETERS),
        np.empty((PARAMETERS, PARAMETERS)),
        np.empty((2, 2)),
        np.empty(2),
        np.empty(3),
        np.empty(3),
        np.empty((2, 3)),
        square[0],
        np.empty(UNKNOWNS),
        square[1],
        square[2],
        np.empty(UNKNOWNS),
        np.empty((lights, UNKNOWNS)),
        np.empty((cameras, UNKNOWNS)),
        square[3],
        square[4],
    )


@kernel
def _write_angles(count: int, index: float, b: Lumitexel, m: JointMemory) -> None:
    """Write what the lobes need of the directions, whatever the normal."""
    for r in range(count):
        square, m.fresnel[r] = lobe_angles(r, index, b)
        m.nearness[r] = 1.0 / max(square, 1e-9)


@kernel
def _face(
    n: Vector, eta: float, square: Vector32, b: Lumitexel, m: JointMemory
) -> None:
    """Write cosines and the factors of the diffuse shape and of masking for a normal."""
    write_cosines(n, eta, 0.0, b)
    for i in range(b.lit.shape[0]):
        for j in range(LOBES):
            m.lit[i, j] = math.sqrt(square[j] + (1.0 - square[j]) * b.lit[i] ** 2)
    for o in range(b.seen.shape[0]):
        for j in range(LOBES):
            m.seen[o, j] = math.sqrt(square[j] + (1.0 - square[j]) * b.seen[o] ** 2)


@inline_fast_kernel
def _facing(
    r: int, b: Lumitexel, m: JointMemory
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Cosines to light and camera of a sample, 1 below the horizon, where the strength of
    the lobes is 0; squared cosine of the half vector, and that strength.
    """
    light = np.float32(b.lit[b.pairs[r, 0]])
    camera = np.float32(b.seen[b.pairs[r, 1]])
    half = min((light + camera) * (light + camera) * m.nearness[r], ONE)
    above = light > 0 and camera > 0
    strength = m.fresnel[r] * light * HALF_PER_PI if above else ZERO
    return light if above else ONE, camera if above else ONE, half, strength


@fast_kernel
def _write_columns(count: int, square: Vector32, b: Lumitexel, m: JointMemory) -> None:
    """Write the diffuse shape and the lobes, D F G / (4 cos_o) of GGX with the
    height-correlated masking of Smith (Heitz 2014, eq. 71 and 99).
    """
    for r in range(count):
        i = b.pairs[r, 0]
        o = b.pairs[r, 1]
        light, camera, half, strength = _facing(r, b, m)
        m.table[r, DIFFUSE] = b.enters[i] * b.leaves[o]
        for j in range(LOBES):
            q = half * (square[j] - ONE) + ONE
            shadow = camera * m.lit[i, j] + light * m.seen[o, j]
            m.table[r, LOBE + j] = strength * square[j] / (q * q * shadow)


@fast_kernel
def _write_turned(
    count: int, k: int, square: Vector32, b: Lumitexel, m: JointMemory
) -> None:
    """Write the derivatives of the diffuse shape and of the surface by angle k of the
    normal, which `_face` has turned by DIFFERENCE.
    """
    per_angle = np.float32(1.0 / DIFFERENCE)
    for r in range(count):
        i = b.pairs[r, 0]
        o = b.pairs[r, 1]
        light, camera, half, strength = _facing(r, b, m)
        shape = np.float32(b.enters[i] * b.leaves[o])
        change = ZERO
        for j in range(LOBES):
            q = half * (square[j] - ONE) + ONE
            shadow = camera * m.lit[i, j] + light * m.seen[o, j]
            lobe = strength * square[j] / (q * q * shadow)
            change += np.float32(m.strength[j]) * lobe
            change -= np.float32(m.x[3 + j]) * m.table[r, LOBE + j]
        m.table[r, TURNED + k] = (shape - m.table[r, DIFFUSE]) * per_angle
        m.table[r, SURFACE + k] = change * per_angle


@kernel
def _turn(first: float, second: float, m: JointMemory) -> None:
    """Write to `m.turned` the normal, turned by small angles."""
    square = 0.0
    for k in range(3):
        m.turned[k] = m.normal[k] + first * m.axes[0, k] + second * m.axes[1, k]
        square += m.turned[k] ** 2
    for k in range(3):
        m.turned[k] /= math.sqrt(square)


@kernel
def _write_derivatives(
    count: int, eta: float, square: Vector32, b: Lumitexel, m: JointMemory
) -> None:
    """Write the derivatives by the normal for the parameters `m.x`."""
    n = m.normal
    sign = 1.0 if n[2] >= 0.0 else -1.0  # two unit tangents (Duff et al. 2017)
    a = -1.0 / (sign + n[2])
    both = n[0] * n[1] * a
    m.axes[0, 0] = 1.0 + sign * n[0] * n[0] * a
    m.axes[0, 1] = sign * both
    m.axes[0, 2] = -sign * n[0]
    m.axes[1, 0] = both
    m.axes[1, 1] = sign + n[1] * n[1] * a
    m.axes[1, 2] = -n[1]
    for k in range(2):
        _turn(DIFFERENCE * (1 - k), DIFFERENCE * k, m)
        _face(m.turned, eta, square, b, m)
        _write_turned(count, k, square, b, m)
    _face(n, eta, square, b, m)


@kernel
def _write_weights(
    s: int, count: int, block: Block, o: Options, b: Lumitexel, m: JointMemory
) -> None:
    """Weights of the samples by the slope of the cube root at the prediction, by their
    noise, and by their residuals.
    """
    split_diffuse(m.x, count, b)
    weigh(s, count, block.noise, o, b)
    mean = np.float32((m.x[0] + m.x[1] + m.x[2]) / 3.0)
    for r in range(count):
        surface = np.float32(0)
        for j in range(LOBES):
            surface += np.float32(m.x[3 + j]) * m.table[r, LOBE + j]
        b.surface[r] = surface
    weigh_outliers(count, o, b, m.root)
    for r in range(count):
        b.surface[r] += mean * m.table[r, DIFFUSE]
    slopes(b.surface[:count], np.float32(o.floor), m.weight)
    for r in range(count):
        m.weight[r] *= b.weight[r]


@kernel
def _least_variance(count: int, b: Lumitexel, m: JointMemory) -> float:
    """Weighted mean square of the error of models, which few samples do not show; 0 for
    others.
    """
    if count >= MIN_SAMPLES_LOBES:
        return 0.0
    total = 0.0
    for r in range(count):
        total += m.weight[r] * b.surface[r] ** 2
    return 3.0 * MODEL_ERROR**2 * total / count


@kernel
def _write_equations(
    count: int, wide: int, lobes: Lobes, b: Lumitexel, m: JointMemory
) -> None:
    """Write the normal equations of R_d, of the first lobes and of the normal, from the
    Gram matrix of the table, with the prior of the shared lobe.
    """
    M = m.moments
    G = m.equations
    right = m.right
    G[:] = 0.0
    right[:] = 0.0
    for c in range(3):
        d = m.x[c]
        G[c, c] = M[DIFFUSE, DIFFUSE]
        right[c] = M[DIFFUSE, SAMPLE + c]
        for i in range(wide):
            G[c, 3 + i] = M[DIFFUSE, LOBE + i]
            right[3 + i] += M[LOBE + i, SAMPLE + c]
            for j in range(wide):
                G[3 + i, 3 + j] += M[LOBE + i, LOBE + j]
        for k in range(2):
            turned = TURNED + k
            surface = SURFACE + k
            G[c, TURN + k] = d * M[DIFFUSE, turned] + M[DIFFUSE, surface]
            right[TURN + k] += d * M[turned, SAMPLE + c] + M[surface, SAMPLE + c]
            for i in range(wide):
                G[3 + i, TURN + k] += d * M[LOBE + i, turned] + M[LOBE + i, surface]
            for q in range(2):
                mixed = M[turned, SURFACE + q] + M[surface, TURNED + q]
                both = d * d * M[turned, TURNED + q] + d * mixed
                G[TURN + k, TURN + q] += both + M[surface, SURFACE + q]
    if wide > 0:
        precision = _least_variance(count, b, m) / lobes.gloss_spread**2
        G[3, 3] += precision
        right[3] += precision * lobes.gloss
    for i in range(PARAMETERS):
        m.target[i] = right[i]
        for j in range(UNKNOWNS):
            G[max(i, j), min(i, j)] = G[min(i, j), max(i, j)]
        for j in range(PARAMETERS):
            m.gram[i, j] = G[i, j]


@kernel
def _variance(count: int, b: Lumitexel, m: JointMemory) -> float:
    """Weighted mean square of the residuals at `m.x`."""
    rest = m.rest
    total = 0.0
    for c in range(3):
        rest[:] = 0.0
        rest[SAMPLE + c] = 1.0
        rest[DIFFUSE] = -m.x[c]
        for j in range(LOBES):
            rest[LOBE + j] = -m.x[3 + j]
        for i in range(WIDTH):
            for j in range(WIDTH):
                total += rest[i] * m.moments[i, j] * rest[j]
    unknowns = UNKNOWNS if count >= MIN_SAMPLES_LOBES else FEW_UNKNOWNS
    mean = total / max(3.0 * count - unknowns, 1.0)
    return max(mean, _least_variance(count, b, m), 0.0)


@kernel
def _add_scan(s: int, variance: float, lobes: Lobes, m: JointMemory) -> None:
    """Add the prior that the normal is that of the scan."""
    precision = variance / (lobes.scan_error * lobes.scan_error)
    for k in range(2):
        m.equations[TURN + k, TURN + k] += precision
        for q in range(3):
            m.right[TURN + k] += precision * m.axes[k, q] * lobes.scan[s, q]


@kernel
def _eliminate_normal(m: JointMemory) -> bool:
    """Write the equations of the other parameters for the best normal (Schur complement),
    and the inverse of those of the normal; returns whether it is determined.
    """
    G = m.equations
    a = G[TURN, TURN]
    d = G[TURN + 1, TURN + 1]
    both = G[TURN, TURN + 1]
    det = a * d - both * both
    if not det > 1e-9 * a * d:
        return False
    m.turn[0, 0] = d / det
    m.turn[1, 1] = a / det
    m.turn[0, 1] = -both / det
    m.turn[1, 0] = -both / det
    for i in range(PARAMETERS):
        for k in range(2):
            lean = G[i, TURN] * m.turn[0, k] + G[i, TURN + 1] * m.turn[1, k]
            m.target[i] -= lean * m.right[TURN + k]
            for j in range(PARAMETERS):
                m.gram[i, j] -= lean * G[j, TURN + k]
        m.gram[i, i] = max(m.gram[i, i], 0.0)
    return True


@kernel
def _solve_parameters(s: int, count: int, lobes: Lobes, m: JointMemory) -> float:
    """Write `m.x` and `m.strength`; returns the KKT residual."""
    limit = 6 * PARAMETERS
    kkt, _, _, _ = solve_scaled(
        m.gram, m.target, m.x, KKT_TOLERANCE, limit, m.active_set
    )
    for j in range(LOBES):
        together = m.x[3] * lobes.shared[s, j]
        m.strength[j] = together if count < MIN_SAMPLES_LOBES else m.x[3 + j]
    return kkt


@kernel
def _write_lobes(
    s: int, count: int, lobes: Lobes, b: Lumitexel, m: JointMemory
) -> None:
    """Write the columns of the diffuse shape and of the lobes, or of the shared one."""
    _write_columns(count, lobes.square, b, m)
    if count >= MIN_SAMPLES_LOBES:
        return
    for r in range(count):
        shared = ZERO
        for j in range(LOBES):
            shared += lobes.shared[s, j] * m.table[r, LOBE + j]
            m.table[r, LOBE + j] = ZERO
        m.table[r, LOBE] = shared


@kernel
def _turn_normal(
    s: int, count: int, lobes: Lobes, eta: float, b: Lumitexel, m: JointMemory
) -> None:
    """A Gauss-Newton step of the normal together with the other parameters."""
    _add_scan(s, _variance(count, b, m), lobes, m)
    if not _eliminate_normal(m):
        return
    _solve_parameters(s, count, lobes, m)
    for k in range(2):
        m.step[k] = 0.0
        for q in range(2):
            rest = m.right[TURN + q]
            for i in range(PARAMETERS):
                rest -= m.equations[i, TURN + q] * m.x[i]
            m.step[k] += m.turn[k, q] * rest
    size = math.sqrt(m.step[0] ** 2 + m.step[1] ** 2)
    shrink = min(lobes.step_fraction, MAX_STEP / max(size, 1e-12))
    _turn(shrink * m.step[0], shrink * m.step[1], m)
    for k in range(3):
        m.normal[k] = m.turned[k]
    _face(m.normal, eta, lobes.square, b, m)
    _write_lobes(s, count, lobes, b, m)


@kernel
def _write_scores(
    count: int, k: int, active: IntVector, b: Lumitexel, m: JointMemory
) -> None:
    """Write the products of the gradients of single samples and channels, and their sums by
    device.
    """
    size = k + 2
    m.independent[:] = 0.0
    m.by_light[:] = 0.0
    m.by_camera[:] = 0.0
    error = np.empty(3)
    for r in range(count):
        surface = 0.0
        for j in range(LOBES):
            surface += m.x[3 + j] * m.table[r, LOBE + j]
        total = 0.0
        shaded = 0.0
        for c in range(3):
            rest = m.table[r, SAMPLE + c] - surface - m.x[c] * m.table[r, DIFFUSE]
            error[c] = m.weight[r] * rest
            total += error[c]
            shaded += error[c] * m.x[c]
        for c in range(3):
            m.score[c] = m.table[r, DIFFUSE] * error[c]
        for i in range(3, k):
            m.score[i] = m.table[r, LOBE + active[i] - 3] * total
        for q in range(2):
            turned = m.table[r, TURNED + q] * shaded
            m.score[k + q] = turned + m.table[r, SURFACE + q] * total
        for p in range(size):
            m.by_light[b.pairs[r, 0], p] += m.score[p]
            m.by_camera[b.pairs[r, 1], p] += m.score[p]
            for q in range(p + 1):
                m.independent[p, q] += m.score[p] * m.score[q]


@kernel
def _add_products(sums: Matrix, size: int, out: Matrix) -> None:
    """Add the products of the rows of devices with samples, scaled for their number."""
    used = 0
    for i in range(sums.shape[0]):
        used += 1 if sums[i, 0] != 0.0 else 0
    if used < 2:  # the sum over one device is the gradient, not an error
        return
    scale = used / (used - 1.0)
    for i in range(sums.shape[0]):
        if sums[i, 0] != 0.0:
            for p in range(size):
                for q in range(p + 1):
                    out[p, q] += scale * sums[i, p] * sums[i, q]


@kernel
def _variance_of(p: int, size: int, scores: Matrix, inverse: Matrix) -> float:
    """Variance of unknown p by a sandwich of the lower half of the products of scores."""
    total = 0.0
    for i in range(size):
        total += inverse[p, i] ** 2 * scores[i, i]
        for j in range(i):
            total += 2.0 * inverse[p, i] * scores[i, j] * inverse[p, j]
    return max(total, 0.0)


@kernel
def _write_errors(
    s: int, count: int, b: Lumitexel, m: JointMemory, out: JointFit
) -> None:
    """Standard errors of R_d and of the normal together with the positive strengths: for
    independent samples (White 1980), and for errors by light and by camera (Cameron,
    Gelbach and Miller 2011).
    """
    active = np.arange(UNKNOWNS)
    k = 3
    for j in range(3, PARAMETERS):
        if m.x[j] > 0.0:
            active[k] = j
            k += 1
    size = k + 2
    for q in range(2):
        active[k + q] = TURN + q
    if not invert(m.equations, active, size, m.shared, m.cholesky, m.inverse):
        return
    _write_scores(count, k, active, b, m)
    for p in range(size):
        for q in range(p + 1):
            m.shared[p, q] = -m.independent[p, q]
    _add_products(m.by_light, size, m.shared)
    _add_products(m.by_camera, size, m.shared)
    few = OUTLIER_SPREAD * count / max(count - size, 1.0)
    least = _least_variance(count, b, m)
    normal = 0.0
    normal_shared = 0.0
    for p in range(size):
        alone = few * _variance_of(p, size, m.independent, m.inverse)
        alone = max(alone, least * m.inverse[p, p])
        together = max(
            OUTLIER_SPREAD * _variance_of(p, size, m.shared, m.inverse), alone
        )
        if p < 3:
            out.diffuse_error[s, p] = math.sqrt(alone)
            out.diffuse_shared[s, p] = math.sqrt(together)
        elif p >= k:
            normal += alone
            normal_shared += together
    out.normal_error[s] = math.sqrt(normal)
    out.normal_shared[s] = math.sqrt(normal_shared)


@kernel
def _linearise(
    s: int,
    count: int,
    wide: int,
    block: Block,
    lobes: Lobes,
    o: Options,
    b: Lumitexel,
    m: JointMemory,
    turned: bool,
) -> None:
    """Write the normal equations at `m.x`, those of the normal if it is turned."""
    _write_weights(s, count, block, o, b, m)
    if turned:
        _write_derivatives(count, o.eta, lobes.square, b, m)
    gram(m.table, count, m.weight, m.none, m.moments, m.rest, m.block)
    _write_equations(count, wide, lobes, b, m)


@kernel
def _start(
    s: int,
    count: int,
    block: Block,
    lobes: Lobes,
    eta: float,
    b: Lumitexel,
    m: JointMemory,
) -> None:
    """Write the table and the parameters for the given normal and R_d."""
    m.x[:] = 0.0
    for k in range(3):
        m.normal[k] = block.normal[s, k]
        m.x[k] = block.diffuse[s, k]
    for r in range(count):
        for k in range(TURNED, LOBE):
            m.table[r, k] = 0.0
        for c in range(3):
            m.table[r, SAMPLE + c] = b.sample[c, r]
    _write_angles(count, lobes.refractive_index, b, m)
    _face(m.normal, eta, lobes.square, b, m)
    _write_lobes(s, count, lobes, b, m)


@kernel
def _fit(
    s: int,
    count: int,
    block: Block,
    lobes: Lobes,
    o: Options,
    b: Lumitexel,
    m: JointMemory,
    out: JointFit,
) -> None:
    """Fit the chosen samples of surfel s."""
    _start(s, count, block, lobes, o.eta, b, m)
    narrowest = o.min_width * smallest_half_angle(count, b)
    limit = LOBES if count >= MIN_SAMPLES_LOBES else 1
    wide = 1 if count >= lobes.gloss_samples else 0
    while 0 < wide < limit:
        if HALF_WIDTH * math.sqrt(lobes.square[wide]) < narrowest:
            break
        wide += 1
    _linearise(s, count, wide, block, lobes, o, b, m, False)
    _solve_parameters(s, count, lobes, m)
    for _ in range(lobes.steps):
        _linearise(s, count, wide, block, lobes, o, b, m, True)
        _turn_normal(s, count, lobes, o.eta, b, m)
    _linearise(s, count, wide, block, lobes, o, b, m, False)
    out.samples[s] = count
    out.kkt[s] = _solve_parameters(s, count, lobes, m)
    _write_equations(count, wide, lobes, b, m)
    _add_scan(s, _variance(count, b, m), lobes, m)
    _write_errors(s, count, b, m, out)
    for k in range(3):
        out.normal[s, k] = m.normal[k]
        out.diffuse[s, k] = m.x[k]
    for j in range(LOBES):
        out.strength[s, j] = m.strength[j]


@kernel
def fit_jointly(block: Block, lobes: Lobes, o: Options, out: JointFit) -> None:
    """Fit every surfel of a block that has a normal, R_d and three samples."""
    b = block_memory(block, 0)
    m = joint_memory(block.light.shape[0], block.camera.shape[0])
    for s in range(block.position.shape[0]):
        if prepare(s, block, o, b) == FITTED:
            _fit(s, write_samples(block.normal[s], b), block, lobes, o, b, m, out)
