"""Fits of all measured BRDFs, and of four mixtures of them, compared with loops over
SciPy's solver.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from skindb.bench.curve import Curve, Point, cpu_time
from skindb.fit.surface import MIN_SAMPLES, NOISE_FLOOR_SURFACE
from skindb.numerics.factorise import nmf
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.dictionary import Dictionary, convolve_disc, embedded_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Block, Comparison, SurfaceFit
from skindb.reflectance.reduction import reduce_dictionary
from skindb.reflectance.rows import basis_rows
from skindb.reflectance.tables import lookup
from skindb.types import Array

ETA = 1.3
DISC = float(np.radians(0.8))
MIN_COSINE_SAMPLES = 0.1  # to light and camera, as in `skindb.reflectance.reduction`
LINEAR = "RMS error of the surface's reflectance at the samples over its RMS"
ROOTS = "the same error in cube-root space"
TRUTH = (
    "planted mixtures of the 59 BRDFs under 150 lights and 16 cameras; samples are "
    "half floats with 5 % noise"
)
SCIPY = "SciPy nnls, precomputed rows, three channels"


@dataclass(frozen=True)
class Strip:
    """Samples of a coherent strip of surfels on a head-sized ball, and the inputs of a
    loop over SciPy.
    """

    block: Block
    offsets: NDArray[
        np.int64
    ]  # (n + 1,) index of the first row of each surfel, and the total
    rows: Array  # (total, 59) float64
    target: Array  # (total, 3) samples minus the diffuse term
    true: Array  # (total,) surface term without noise
    directions: tuple[Array, Array, Array]  # wi, wo, normal of each row
    cosine: Array  # (total,)

    def first(self, count: int) -> Block:
        """The first `count` surfels."""
        return self.block._replace(
            sample=self.block.sample[:count],
            position=self.block.position[:count],
            normal=self.block.normal[:count],
            diffuse=self.block.diffuse[:count],
        )


def _spiral(count: int, radius: float, share: float) -> Array:
    """Points (count, 3) spread evenly over the front `share` of a sphere."""
    z = 1 - (np.arange(count) + 0.5) / count * share
    phi = np.pi * (1 + 5**0.5) * np.arange(count)
    s = np.sqrt(1 - z * z)
    return np.asarray(radius * np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1))


def strip(
    surfels: int, dictionary: Dictionary, *, noise: float = 0.05, seed: int = 0
) -> Strip:
    """Samples of surfels with four random materials and a diffuse colour each; some
    samples are hidden.
    """
    rng = np.random.default_rng(seed)
    light = _spiral(150, 1000, 1.0)
    camera = _spiral(16, 1200, 0.8)
    side = int(np.sqrt(surfels))
    a = 0.9 * (np.arange(surfels) // side) / side - 0.45
    b = 0.9 * (np.arange(surfels) % side) / side - 0.45
    normal = np.stack([np.sin(b), np.sin(a) * np.cos(b), np.cos(a) * np.cos(b)], -1)
    normal += 0.01 * rng.normal(size=normal.shape)
    normal = (
        (normal / np.linalg.norm(normal, axis=1, keepdims=True))
        .astype(np.float32)
        .astype(float)
    )
    position = (90 * normal).astype(np.float32).astype(float)
    wi, wo = ((t[None] - position[:, None]) for t in (light, camera))
    wi = wi / np.linalg.norm(wi, axis=-1, keepdims=True)
    wo = wo / np.linalg.norm(wo, axis=-1, keepdims=True)
    ci = np.einsum("nk,ntk->nt", normal, wi)
    co = np.einsum("nk,ntk->nt", normal, wo)
    seen = (rng.random((surfels, 150, 1)) < 0.85) & (rng.random((surfels, 1, 16)) < 0.8)
    seen &= (ci > MIN_COSINE_SAMPLES)[:, :, None] & (co > MIN_COSINE_SAMPLES)[:, None]
    rows, offsets, index = basis_rows(
        dictionary.table, dictionary.grid, normal, wi, wo, seen
    )
    owner, (i, o) = np.repeat(np.arange(surfels), np.diff(offsets)), index.T
    diffuse = rng.uniform(0.2, 0.6, (surfels, 3))
    weight = np.zeros((surfels, rows.shape[1]))
    for w in weight:
        w[rng.choice(len(w), 4, replace=False)] = rng.uniform(0, 0.4, 4)
    c = ci[owner, i]
    d = co[owner, o]
    scattered = (
        c * fresnel_transmittance(c, ETA) * fresnel_transmittance(d, ETA) / np.pi
    )[:, None] * diffuse[owner]
    true = np.einsum("tm,tm->t", rows, weight[owner])
    value = true[:, None] + scattered
    value *= 1 + noise * rng.normal(size=value.shape)
    sample = np.full((surfels, 150, 16, 3), np.nan, np.float16)
    sample[owner, i, o] = value
    target = sample[owner, i, o].astype(float) - scattered
    block = Block(sample, position, light, camera, normal, diffuse)
    away = wi[owner, i], wo[owner, o], normal[owner]
    return Strip(block, offsets, rows.astype(np.float64), target, true, away, c)


@lru_cache(maxsize=1)
def _problem(quick: bool) -> tuple[Dictionary, Strip, int]:
    """Dictionary, samples, and the number of surfels used for SciPy and for the errors."""
    dictionary = convolve_disc(embedded_dictionary(), DISC)
    return dictionary, strip(64 if quick else 400, dictionary), 16 if quick else 60


@lru_cache(maxsize=5)
def _tables(quick: bool, roots: bool, rank: int) -> Mixture:
    """The dictionary, or its cube roots, reduced to `rank` dimensions."""
    dictionary = _problem(quick)[0]
    reduced, lift = reduce_dictionary(
        np.cbrt(dictionary.table) if roots else dictionary.table, rank
    )
    return Mixture(reduced, lift)


def _parts(samples: Strip, count: int) -> list[slice]:
    return [slice(*samples.offsets[s : s + 2]) for s in range(count)]


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
    for part in _parts(samples, count):
        if table is None:
            M = samples.rows[part]
        else:
            angles = half_difference(*(d[part] for d in samples.directions))
            M = lookup(table, *angles) * samples.cosine[part, None]
        M = M if H is None else M @ H.T
        target = samples.target[part]
        solutions.append(
            nnls(np.repeat(M, 3, 0), target.ravel())[0]
            if channels == 3
            else nnls(M, target.mean(1))[0]
        )
    return np.array(solutions)


def _errors(
    samples: Strip, count: int, predict: Callable[[slice, int], Array]
) -> tuple[float, float, float]:
    """Medians over surfels of the true errors, linear and in cube-root space, and of |M
    x - R| / |R|.
    """
    linear = []
    roots = []
    residual = []
    for s, part in enumerate(_parts(samples, count)):
        y = predict(part, s)
        true = samples.true[part]
        target = samples.target[part]
        linear.append(np.linalg.norm(y - true) / np.linalg.norm(true))
        roots.append(
            np.linalg.norm(np.cbrt(y) - np.cbrt(true)) / np.linalg.norm(np.cbrt(true))
        )
        residual.append(np.linalg.norm(y[:, None] - target) / np.linalg.norm(target))
    return float(np.median(linear)), float(np.median(roots)), float(np.median(residual))


def _fit(samples: Strip, model: Mixture, mode: str) -> tuple[float, SurfaceFit]:
    """CPU time per surfel [s], and weights of all surfels."""
    comparison = Comparison(mode, ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES)
    model.fit(samples.first(2), comparison)  # compiles
    n = len(samples.offsets) - 1
    return cpu_time(lambda: model.fit(samples.block, comparison), n)


def _mixed(samples: Strip, weight: Array) -> Callable[[slice, int], Array]:
    return lambda part, s: samples.rows[part] @ weight[s]


def surface_curves(quick: bool) -> list[Curve]:
    """All 59 BRDFs by mode and rank."""
    dictionary, samples, few = _problem(quick)
    measured: list[
        tuple[str, str, float, tuple[float, float, float], str, dict[str, float]]
    ] = []
    for name, channels, table in (
        ("SciPy nnls, precomputed rows, mean of channels", 1, None),
        (SCIPY, 3, None),
        ("SciPy nnls, rows by NumPy, mean of channels", 1, dictionary.table),
        ("SciPy nnls, rows by NumPy, three channels", 3, dictionary.table),
    ):
        took, weight = cpu_time(
            lambda c=channels, t=table: scipy_loop(samples, few, channels=c, table=t),  # type: ignore[misc]
            few,
        )
        measured.append(
            (name, "", took, _errors(samples, few, _mixed(samples, weight)), "", {})
        )
    for mode in ("linear", "perceptual", "paper"):
        table = np.cbrt(dictionary.table) if mode == "paper" else dictionary.table
        for rank in (16, 59) if quick else (8, 12, 16, 24, 59):
            took, fit = _fit(samples, _tables(quick, mode == "paper", rank), mode)
            details = {
                "kkt": float(fit.kkt.max()),
                "not_fitted": float((fit.status != 0).sum()),
            }
            cubes = (
                _cubes(samples, table, fit.parameters)
                if mode == "paper"
                else _mixed(samples, fit.parameters)
            )
            measured.append(
                (
                    f"skindb {mode}",
                    f"rank {rank}",
                    took,
                    _errors(samples, few, cubes),
                    "",
                    details,
                )
            )
            if mode == "paper" and rank == 59:
                failure = (
                    "cbrt(M x) is not cbrt(M) x, so weights of cube roots do not mix "
                    "reflectance"
                )
                errors = _errors(samples, few, _mixed(samples, fit.parameters))
                measured.append(
                    (
                        "paper's weights used as linear weights",
                        "rank 59",
                        took,
                        errors,
                        failure,
                        details,
                    )
                )
    return [
        Curve(
            "surface",
            label,
            TRUTH,
            "a surfel",
            SCIPY,
            tuple(
                Point(
                    name,
                    setting,
                    took,
                    errors[i],
                    failure,
                    details | {"residual": errors[2]},
                )
                for name, setting, took, errors, failure, details in measured
            ),
        )
        for i, label in enumerate((LINEAR, ROOTS))
    ]


def _cubes(
    samples: Strip, roots: Array, weight: Array
) -> Callable[[slice, int], Array]:
    """Prediction of the paper's weights: cos(theta_i) times the cube of the mixed cube roots."""

    def predict(part: slice, s: int) -> Array:
        angles = half_difference(*(d[part] for d in samples.directions))
        return np.asarray(
            (lookup(roots, *angles) @ weight[s]) ** 3 * samples.cosine[part]
        )

    return predict


def refit_curves(quick: bool) -> list[Curve]:
    """Four mixtures of the BRDFs, from the full linear weights."""
    dictionary, samples, few = _problem(quick)
    _, full = _fit(
        samples,
        Mixture(dictionary.table),
        "linear",
    )
    H = nmf(full.parameters, 4, rng=np.random.default_rng(0)).H
    measured = []
    took, weight = cpu_time(lambda: scipy_loop(samples, few, channels=3, H=H), few)
    measured.append((SCIPY, took, weight))
    four = Mixture((dictionary.table @ H.T).astype(np.float32))
    for mode in ("linear", "perceptual"):
        took, fit = _fit(samples, four, mode)
        measured.append((f"skindb {mode}", took, fit.parameters))
    errors = [
        _errors(samples, few, _mixed(samples, weight @ H)) for _, _, weight in measured
    ]
    return [
        Curve(
            "refit",
            label,
            TRUTH + ", which four mixtures cannot represent",
            "a surfel",
            f"{SCIPY}, 4 bases",
            tuple(
                Point(name, "4 bases", took, error[i], "", {"residual": error[2]})
                for (name, took, _), error in zip(measured, errors, strict=True)
            ),
        )
        for i, label in enumerate((LINEAR, ROOTS))
    ]
