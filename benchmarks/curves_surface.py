"""Curves of the surface: fits of all measured BRDFs and of four mixtures compared with
SciPy's solver, factorisations with scikit-learn, and tables averaged over a disc light.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from sklearn.decomposition import NMF
from sklearn.exceptions import ConvergenceWarning

from benchmarks.curve import Curve, Point, cpu_time
from skindb.fit.surface import NOISE_FLOOR_SURFACE
from skindb.numerics.factorise import nmf, relative_error
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance._lumitexel_kernels import MIN_SAMPLES_GLOSS
from skindb.reflectance.dictionary import (
    Dictionary,
    convolve_disc,
    embedded_dictionary,
)
from skindb.reflectance.mixture import Mixture, basis_rows
from skindb.reflectance.model import Block, Comparison, Judgement, SurfaceFit
from skindb.reflectance.reduction import reduce_dictionary
from skindb.reflectance.tables import brdf_metric, lookup
from skindb.types import Array, dots, lengths, unit

ETA = 1.3
DISC = float(np.radians(0.8))
MIN_COSINE_SAMPLES = 0.1  # to light and camera, as in `skindb.reflectance.reduction`
LINEAR = "RMS error of the surface's reflectance at the samples over its RMS"
ROOTS = "the same error in cube-root space"
TRUTH = (
    "planted mixtures of the embedded BRDFs under 150 lights and 16 cameras; samples are "
    "half floats with 5 % noise"
)
SCIPY = "SciPy nnls, precomputed rows, three channels"
COMPONENTS = 6  # of the planted factorisation


@dataclass(frozen=True)
class Strip:
    """Samples of a coherent strip of surfels on a head-sized ball, and the inputs of a
    loop over SciPy.
    """

    block: Block
    offsets: NDArray[
        np.int64
    ]  # (n + 1,) index of the first row of each surfel, and the total
    rows: Array  # (total, m) float64
    target: Array  # (total, 3) samples minus the diffuse term
    true: Array  # (total,) surface term without noise
    directions: tuple[Array, Array, Array]  # wi, wo, normal of each row
    cosine: Array  # (total,)

    def start(self, count: int) -> Block:
        """The first `count` surfels."""
        return self.block._replace(
            sample=self.block.sample[:count],
            position=self.block.position[:count],
            normal=self.block.normal[:count],
            diffuse=self.block.diffuse[:count],
        )

    def parts(self, count: int) -> list[slice]:
        """The rows of each of the first `count` surfels."""
        return [slice(*self.offsets[s : s + 2]) for s in range(count)]

    def looked_up(self, table: Array, part: slice) -> Array:
        """Values (rows, materials) of a table at the directions of rows."""
        return lookup(table, *half_difference(*(d[part] for d in self.directions)))


def spiral(count: int, radius: float, fraction: float) -> Array:
    """Points (count, 3) spread evenly over the front `fraction` of a sphere."""
    z = 1 - (np.arange(count) + 0.5) / count * fraction
    phi = np.pi * (1 + 5**0.5) * np.arange(count)
    s = np.sqrt(1 - z * z)
    return np.asarray(radius * np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1))


def _single(values: Array) -> Array:
    """Values rounded to single precision, as they are stored."""
    return values.astype(np.float32).astype(float)


def strip(
    surfels: int, dictionary: Dictionary, *, noise: float = 0.05, seed: int = 0
) -> Strip:
    """Samples of surfels with four random materials and a diffuse colour each; some
    samples are hidden.
    """
    rng = np.random.default_rng(seed)
    light = spiral(150, 1000, 1.0)
    camera = spiral(16, 1200, 0.8)
    side = int(np.sqrt(surfels))
    a = 0.9 * (np.arange(surfels) // side) / side - 0.45
    b = 0.9 * (np.arange(surfels) % side) / side - 0.45
    normal = np.stack([np.sin(b), np.sin(a) * np.cos(b), np.cos(a) * np.cos(b)], -1)
    normal += 0.01 * rng.normal(size=normal.shape)
    normal = _single(unit(normal))
    position = _single(90 * normal)
    wi = unit(light[None] - position[:, None])
    wo = unit(camera[None] - position[:, None])
    ci = np.einsum("nk,ntk->nt", normal, wi)
    co = np.einsum("nk,ntk->nt", normal, wo)
    seen = (rng.random((surfels, 150, 1)) < 0.85) & (rng.random((surfels, 1, 16)) < 0.8)
    seen &= (ci > MIN_COSINE_SAMPLES)[:, :, None] & (co > MIN_COSINE_SAMPLES)[:, None]
    rows, offsets, index = basis_rows(
        dictionary.table, dictionary.grid, normal, wi, wo, seen
    )
    surfel = np.repeat(np.arange(surfels), np.diff(offsets))
    i, o = index.T
    diffuse = rng.uniform(0.2, 0.6, (surfels, 3))
    weight = np.zeros((surfels, rows.shape[1]))
    for w in weight:
        w[rng.choice(len(w), 4, replace=False)] = rng.uniform(0, 0.4, 4)
    c = ci[surfel, i]
    transmitted = fresnel_transmittance(c, ETA)
    transmitted = c * transmitted * fresnel_transmittance(co[surfel, o], ETA)
    scattered = (transmitted / np.pi)[:, None] * diffuse[surfel]
    true = dots(rows, weight[surfel])
    value = true[:, None] + scattered
    value *= 1 + noise * rng.normal(size=value.shape)
    sample = np.full((surfels, 150, 16, 3), np.nan, np.float16)
    sample[surfel, i, o] = value
    target = sample[surfel, i, o].astype(float) - scattered
    block = Block(sample, position, light, camera, normal, diffuse)
    away = wi[surfel, i], wo[surfel, o], normal[surfel]
    return Strip(block, offsets, rows.astype(float), target, true, away, c)


@lru_cache(maxsize=1)
def _problem(quick: bool) -> tuple[Dictionary, Strip, int]:
    """Dictionary, samples, and the number of surfels used for SciPy and for the errors."""
    dictionary = convolve_disc(embedded_dictionary(), DISC)
    return dictionary, strip(64 if quick else 400, dictionary), 16 if quick else 60


def scipy_loop(
    samples: Strip,
    count: int,
    *,
    channels: int,
    table: Array | None = None,
    H: Array | None = None,
) -> Array:
    """Weights of `count` surfels, from the mean of the channels or all three.

    Rows are precomputed, or interpolated in `table` by NumPy.
    """
    solutions = []
    for part in samples.parts(count):
        M = samples.rows[part]
        if table is not None:
            M = samples.looked_up(table, part) * samples.cosine[part, None]
        M = M if H is None else M @ H.T
        target = samples.target[part]
        if channels == 3:
            solution, _ = nnls(np.repeat(M, 3, 0), target.ravel())
        else:
            solution, _ = nnls(M, target.mean(1))
        solutions.append(solution)
    return np.array(solutions)


def _errors(samples: Strip, count: int, weight: Array) -> list[float]:
    """Medians over surfels of the true errors of mixtures, linear and in cube-root space."""
    errors = []
    for s, part in enumerate(samples.parts(count)):
        y = samples.rows[part] @ weight[s]
        true = samples.true[part]
        pairs = ((y, true), (np.cbrt(y), np.cbrt(true)))
        errors.append([lengths(a - b) / lengths(b) for a, b in pairs])
    medians: list[float] = np.median(errors, axis=0).tolist()
    return medians


def _fit(samples: Strip, model: Mixture, mode: str) -> tuple[float, SurfaceFit]:
    """CPU time per surfel [s], and weights of all surfels."""
    comparison = Comparison(mode, ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES_GLOSS)
    model.fit(samples.start(2), comparison)  # compiles
    surfels = len(samples.offsets) - 1
    return cpu_time(partial(model.fit, samples.block, comparison), surfels)


def _both_spaces(
    kernel: str,
    reference: str,
    base: str,
    results: Sequence[tuple[str, str, float, list[float]]],
) -> list[Curve]:
    """Curves of the errors in linear and in cube-root space, from method, setting, CPU time and
    both errors of each result.
    """
    curves = []
    for i, label in enumerate((LINEAR, ROOTS)):
        points = [
            Point(method, setting, seconds, errors[i])
            for method, setting, seconds, errors in results
        ]
        curves.append(Curve(kernel, label, reference, "a surfel", base, points))
    return curves


def surface_curves(quick: bool) -> list[Curve]:
    """All embedded BRDFs by mode and rank."""
    dictionary, samples, few = _problem(quick)
    results = []
    for rows, table in (
        ("precomputed rows", None),
        ("rows by NumPy", dictionary.table),
    ):
        for name, channels in (("mean of channels", 1), ("three channels", 3)):
            work = partial(scipy_loop, samples, few, channels=channels, table=table)
            seconds, weight = cpu_time(work, few)
            errors = _errors(samples, few, weight)
            results.append((f"SciPy nnls, {rows}, {name}", "", seconds, errors))
    for mode in ("linear", "perceptual"):
        for rank in (16, 59) if quick else (8, 12, 16, 24, 59):
            table = dictionary.table
            model = Mixture(*reduce_dictionary(table, rank, exact=dictionary.exact))
            seconds, fit = _fit(samples, model, mode)
            errors = _errors(samples, few, fit.parameters)
            results.append((f"skindb {mode}", f"rank {rank}", seconds, errors))
    return _both_spaces("surface", TRUTH, SCIPY, results)


def refit_curves(quick: bool) -> list[Curve]:
    """Four mixtures of the BRDFs, from the full linear weights."""
    dictionary, samples, few = _problem(quick)
    _, full = _fit(samples, Mixture(dictionary.table), "linear")
    H = nmf(full.parameters, 4, rng=np.random.default_rng(0)).H
    four = Mixture((dictionary.table @ H.T).astype(np.float32))
    work = partial(scipy_loop, samples, few, channels=3, H=H)
    measured = [(SCIPY, *cpu_time(work, few))]
    for mode in ("linear", "perceptual"):
        seconds, fit = _fit(samples, four, mode)
        measured.append((f"skindb {mode}", seconds, fit.parameters))
    surfels = len(samples.offsets) - 1
    comparison = Comparison("linear", ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES_GLOSS)
    errors = Judgement(np.full((surfels, 3), 0.01), np.full(surfels, 0.5))
    judge = partial(four.fit, samples.block, comparison, errors)
    judge()  # compiles
    seconds, judged = cpu_time(judge, surfels)
    measured.append(("skindb with errors, linear", seconds, judged.parameters))
    results = [
        (name, "4 bases", seconds, _errors(samples, few, weight @ H))
        for name, seconds, weight in measured
    ]
    reference = f"{TRUTH}, which four mixtures cannot represent"
    return _both_spaces("refit", reference, f"{SCIPY}, 4 bases", results)


def nmf_curves(quick: bool) -> list[Curve]:
    """Skindb by number of starts, scikit-learn by iterations; each H is rated in both
    metrics with the best W.
    """
    X, H = _planted_weights(300 if quick else 2000)
    gram = brdf_metric(embedded_dictionary().table)
    gram /= np.trace(gram)
    results = [("planted", "", np.nan, H)]
    nmf(X[:20], 2, metric=gram, seeds=0, rng=np.random.default_rng(1))  # compiles
    for name, metric in (("weights", None), ("BRDFs", gram)):
        for seeds in (0,) if quick else (0, 3, 8):
            seconds, factors = cpu_time(partial(_by_skindb, X, metric, seeds))
            method = f"skindb between {name}"
            results.append((method, f"{1 + seeds} starts", seconds, factors))
    for solver in ("cd", "mu"):
        for steps in (10, 200) if quick else (10, 50, 200, 1000):
            seconds, factors = cpu_time(partial(_by_scikit, X, solver, steps))
            method = f"scikit-learn {solver}"
            results.append((method, f"{steps} iterations", seconds, factors))
    reference = (
        f"{len(X)} planted mixtures of {COMPONENTS} with 20 % scatter, so that the error "
        "cannot be zero"
    )
    curves = []
    for name, metric in (("weights", np.eye(len(gram))), ("BRDFs", gram)):
        points = [
            Point(method, setting, seconds, relative_error(X, factors, metric))
            for method, setting, seconds, factors in results
        ]
        error = f"|X - W H| / |X| between {name}"
        base = "scikit-learn cd, 200 iterations"
        curves.append(Curve("nmf", error, reference, "a factorisation", base, points))
    return curves


def _planted_weights(n: int) -> tuple[Array, Array]:
    """Weights (n, m), mixtures of sparse rows H with scatter like that of similar
    BRDFs, and H.
    """
    rng = np.random.default_rng(0)
    shape = (COMPONENTS, len(embedded_dictionary().names))
    H = np.where(rng.random(shape) < 0.2, rng.uniform(0.2, 1, shape), 0)
    H[:, :COMPONENTS] += np.eye(COMPONENTS)
    X = rng.gamma(0.7, 1.0, (n, COMPONENTS)) @ H
    return X * rng.lognormal(0, 0.2, X.shape), H


def _by_skindb(X: Array, metric: Array | None, seeds: int) -> Array:
    rng = np.random.default_rng(1)
    return nmf(X, COMPONENTS, metric=metric, seeds=seeds, rng=rng).H


def _by_scikit(X: Array, solver: str, steps: int) -> Array:
    options = {"init": "nndsvda", "tol": 1e-6, "random_state": 0}
    model = NMF(COMPONENTS, solver=solver, max_iter=steps, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        model.fit(X)
    return np.asarray(model.components_)
