"""Stress cases of the surface fit, on surfels with noise-free samples of the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.optimize import nnls

from skindb.bench.case import SCALES, close, expect, stress_cases
from skindb.fit.surface import MIN_SAMPLES, NOISE_FLOOR_SURFACE
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.dictionary import embedded_dictionary
from skindb.reflectance.mixture import Mixture
from skindb.reflectance.model import Block, Comparison, SurfaceFit
from skindb.reflectance.reduction import reduce_dictionary
from skindb.reflectance.tables import lookup
from skindb.schema import FitStatus
from skindb.schema.status import LARGEST_R_D, SMALLEST_R_D
from skindb.types import Array

ETA = 1.3
CHOSEN = [3, 12, 20, 31, 44, 57]  # six of the embedded materials
WEIGHT = np.array([0.2, 0.0, 0.1, 0.0, 0.3, 0.0])
DIFFUSE = np.array([0.5, 0.33, 0.24])
# error for samples in single precision: positions in a table to 1e-6, times the slope
# of its lobes
SINGLE = 1e-4
TOTAL = 1e-6  # relative: rounding of samples in single precision
MODES = ("linear", "perceptual")


def spiral(n: int, top: float) -> Array:
    """(n, 3) directions, evenly spread around +z down to the cosine `top`."""
    z = 1 - (np.arange(n) + 0.5) / n * (1 - top)
    phi = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def unit(v: Array) -> Array:
    """Vectors (..., 3) of length one."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def six() -> Array:
    """Tables (nh, nd, np, 6) without the padding that the kernels need."""
    return six_tables().table[..., : len(CHOSEN)]


@lru_cache(maxsize=1)
def six_tables() -> Mixture:
    """Six of the embedded materials, not reduced."""
    dictionary = embedded_dictionary()
    return Mixture(dictionary.table[..., CHOSEN])


@dataclass(frozen=True)
class Surfels:
    """Three surfels with noise-free samples of the model, all well above the horizon."""

    sample: Array
    position: Array
    light: Array
    camera: Array
    normal: Array
    diffuse: Array

    @property
    def block(self) -> Block:
        """The surfels for the fit of a surface model."""
        return Block(
            self.sample,
            self.position,
            self.light,
            self.camera,
            self.normal,
            self.diffuse,
        )


def surfels(
    lights: int = 40, cameras: int = 6, *, eta: float = ETA, weight: Array = WEIGHT
) -> Surfels:
    """Three surfels with different positions and normals; `weight` (6,) of the six materials."""
    position = np.array([[0.0, 0, 0], [40, 10, -5], [-30, 20, -8]])
    normal = unit(np.array([[0.0, 0, 1], [0.3, 0.1, 1], [-0.2, 0.2, 1]]))
    light = 900 * spiral(lights, 0.6)
    camera = 800 * spiral(cameras, 0.7)
    diffuse = np.tile(DIFFUSE, (3, 1))
    wi = unit(light - position[:, None])
    wo = unit(camera - position[:, None])
    ci = np.einsum("nk,ntk->nt", normal, wi)
    co = np.einsum("nk,ntk->nt", normal, wo)
    a, b, n = np.broadcast_arrays(wi[:, :, None], wo[:, None], normal[:, None, None])
    surface = lookup(six(), *half_difference(a, b, n)) @ weight
    through = (
        fresnel_transmittance(ci, eta)[:, :, None]
        * fresnel_transmittance(co, eta)[:, None]
    )
    value = through[..., None] * diffuse[:, None, None] / np.pi + surface[..., None]
    sample = (ci[:, :, None, None] * value).astype(np.float32)
    return Surfels(sample, position, light, camera, normal, diffuse)


def weights(
    skin: Surfels, mode: str = "linear", model: Mixture | None = None, **options: Any
) -> SurfaceFit:
    """Fit of the six materials, or of `model`, to the surfels."""
    comparison = Comparison(mode, ETA, NOISE_FLOOR_SURFACE, MIN_SAMPLES)
    comparison = comparison._replace(**options)
    return (model or six_tables()).fit(skin.block, comparison)


def spoiled(skin: Surfels, change: Callable[[Array], None]) -> Surfels:
    """Copy of the surfels with the samples of the first one changed."""
    sample = skin.sample.copy()
    change(sample[0])
    return replace(skin, sample=sample)


def without_surfels(skin: Surfels) -> Surfels:
    """Arrays of no surfel."""
    names = ("sample", "position", "normal", "diffuse")
    return replace(skin, **{name: getattr(skin, name)[:0] for name in names})


def brightened(skin: Surfels, factor: float) -> Surfels:
    """Copy of the surfels with the samples multiplied by a factor."""
    sample = skin.sample.astype(np.float64) * factor
    return replace(skin, sample=sample.astype(np.float32))


def filled(value: float) -> Callable[[Array], None]:
    """Change for `spoiled` that sets every sample to `value`."""
    return lambda sample: sample.fill(value)


def first(skin: Surfels, value: float) -> Surfels:
    """Copy of the surfels with one channel of one sample of the first one changed."""

    def change(sample: Array) -> None:
        sample[1, 2, 1] = value

    return spoiled(skin, change)


def rows(skin: Surfels, s: int) -> tuple[Array, Array]:
    """Rows and targets of one surfel, computed with NumPy."""
    wi = unit(skin.light - skin.position[s])
    wo = unit(skin.camera - skin.position[s])
    a, b = np.broadcast_arrays(wi[:, None], wo[None])
    ci = wi @ skin.normal[s]
    co = wo @ skin.normal[s]
    M = lookup(six(), *half_difference(a, b, skin.normal[s])) * ci[:, None, None]
    shape = (
        (ci * fresnel_transmittance(ci, ETA))[:, None]
        * fresnel_transmittance(co, ETA)
        / np.pi
    )
    target = skin.sample[s].astype(np.float64) - shape[..., None] * skin.diffuse[s]
    return M.reshape(-1, M.shape[-1]), target.reshape(-1, 3)


# surface


def _recovers(mode: str) -> None:
    skin = surfels(150, 16)
    fit = weights(skin, mode)
    expect(
        (fit.status == FitStatus.FITTED).all() and (fit.samples == 2400).all(),
        (fit.status, fit.samples),
    )
    expect(fit.residual.max() < SINGLE, fit.residual)
    for s in range(3):
        M, _ = rows(skin, s)
        close(M @ fit.parameters[s], M @ WEIGHT, atol=SINGLE * np.abs(M @ WEIGHT).max())


def _few(lights: int, cameras: int) -> None:
    skin = surfels(lights, cameras)
    # channels disagree
    skin = replace(
        skin, sample=skin.sample * np.linspace(0.9, 1.1, 3, dtype=np.float32)
    )
    refused = weights(skin)
    expect(
        (refused.status == FitStatus.TOO_FEW_SAMPLES).all()
        and np.isnan(refused.parameters).all(),
        refused.status,
    )
    fit = weights(skin, min_samples=1)
    for s in range(3):
        M, target = rows(skin, s)
        theirs = nnls(np.repeat(M, 3, 0), target.ravel())[1]
        ours = np.linalg.norm((M @ fit.parameters[s])[:, None] - target)
        expect(ours <= theirs + SINGLE * np.linalg.norm(target), (ours, theirs))


def _unseen_surfel(mode: str) -> None:
    skin = surfels()
    fit = weights(spoiled(skin, filled(np.nan)), mode)
    unchanged = weights(skin, mode)
    expect(
        fit.status.tolist() == [FitStatus.UNSEEN, 0, 0]
        and np.isnan(fit.parameters[0]).all(),
        fit.status,
    )
    np.testing.assert_array_equal(fit.parameters[1:], unchanged.parameters[1:])


def _infinite(bad: float) -> None:
    fit = weights(first(surfels(), bad))
    unchanged = weights(surfels())
    expect(
        fit.status.tolist() == [FitStatus.NOT_FINITE, 0, 0]
        and np.isnan(fit.parameters[0]).all(),
        fit.status,
    )
    np.testing.assert_array_equal(fit.parameters[1:], unchanged.parameters[1:])


def _one_nan() -> None:
    """A sample that lacks one channel is excluded, and the weights are still recovered."""
    fit = weights(first(surfels(), np.nan))
    expect(fit.samples.tolist() == [239, 240, 240], fit.samples)
    expect(fit.residual.max() < SINGLE, fit.residual)


def _geometry_nan(field: str, status: FitStatus) -> None:
    skin = surfels()
    spoiled = getattr(skin, field).copy()
    spoiled[0] = np.nan
    fit = weights(replace(skin, **{field: spoiled}))
    unchanged = weights(skin)
    expect(
        fit.status.tolist() == [status, 0, 0] and np.isnan(fit.parameters[0]).all(),
        fit.status,
    )
    np.testing.assert_array_equal(fit.parameters[1:], unchanged.parameters[1:])


def _black_surfel(mode: str) -> None:
    fit = weights(spoiled(surfels(), filled(0.0)), mode)
    expect(
        fit.status[0] == FitStatus.FITTED and (fit.parameters[0] == 0).all(),
        (fit.status[0], fit.parameters[0]),
    )


def _matte(eta: float) -> None:
    skin = surfels(eta=eta, weight=0 * WEIGHT)
    fit = weights(skin, eta=eta)
    expect(
        fit.residual.max() < TOTAL and np.abs(fit.parameters).max() < SINGLE,
        (fit.residual, fit.parameters),
    )


def _albedo_bound(value: float) -> None:
    skin = surfels()
    diffuse = skin.diffuse.astype(np.float32)  # as it is stored
    diffuse[0] = value
    fit = weights(replace(skin, diffuse=diffuse))
    expect(fit.status.tolist() == [FitStatus.DIFFUSE_CLAMPED, 0, 0], fit.status)
    expect(
        np.isfinite(fit.parameters).all() and (fit.parameters >= 0).all(),
        fit.parameters,
    )


def _grazing_lights() -> None:
    """Lights 3 degrees above the horizon are ignored, whatever their samples."""
    skin = surfels()
    low = 900 * np.array([[np.cos(a), np.sin(a), 0.05] for a in (0.1, 2.0, 4.0)])
    wild = np.full((3, 3, *skin.sample.shape[2:]), 50.0, np.float32)
    flat = replace(skin, normal=np.tile([0.0, 0, 1], (3, 1)), position=np.zeros((3, 3)))
    extended = replace(
        flat,
        light=np.concatenate([skin.light, low]),
        sample=np.concatenate([skin.sample, wild], axis=1),
    )
    close(weights(extended).parameters, weights(flat).parameters, rtol=1e-9, atol=1e-12)


def _behind() -> None:
    """Lights and cameras behind the surfel are ignored, whatever their samples."""
    skin = surfels()
    wild = np.full((3, 2, *skin.sample.shape[2:]), 50.0, np.float32)
    behind = np.concatenate([skin.light, [[0.0, 0, -900], [100, 0, -900]]])
    extended = replace(
        skin, light=behind, sample=np.concatenate([skin.sample, wild], axis=1)
    )
    close(weights(extended).parameters, weights(skin).parameters, rtol=1e-9, atol=1e-12)


def _precision(dtype: str) -> None:
    skin = surfels()
    half = skin.sample.astype(np.float16)  # values that are exact in every precision
    fit, want = (
        weights(replace(skin, sample=half.astype(t))) for t in (dtype, np.float16)
    )
    # only the mixed reflectance is determined, not the weights of similar materials
    for s in range(3):
        M, _ = rows(skin, s)
        close(
            M @ fit.parameters[s],
            M @ want.parameters[s],
            atol=1e-5 * np.abs(M @ WEIGHT).max(),
        )


def _extra_tables(change: str) -> None:
    extra = {"zero": 0 * six()[..., :1], "duplicate": six()[..., :1]}
    extra["collinear"] = six()[..., :1] + six()[..., 1:2]
    both = np.concatenate([extra[change], six(), extra[change]], axis=-1)
    fit = weights(surfels(), model=Mixture(both))
    expect(
        (fit.status == FitStatus.FITTED).all() and fit.kkt.max() < 1e-9,
        (fit.status, fit.kkt),
    )
    expect(fit.residual.max() < SINGLE, fit.residual)
    if change == "zero":
        expect((fit.parameters[:, [0, 7]] == 0).all(), fit.parameters)


def _rank_above() -> None:
    reduced, lift = reduce_dictionary(six(), 99)
    fit = weights(surfels(), model=Mixture(reduced, lift))
    close(fit.parameters, weights(surfels()).parameters, rtol=1e-12)


def _rank_of_one_material() -> None:
    """Six tables that are multiples of one lie in a space of four dimensions, and fits
    are finite and correct.
    """
    tables = six()[..., :1] * np.geomspace(0.5, 4, 6, dtype=np.float32)
    reduced, lift = reduce_dictionary(np.ascontiguousarray(tables), 4)
    skin = surfels(weight=np.array([0.4, 0, 0, 0, 0, 0]))
    fit = weights(skin, model=Mixture(reduced, lift))
    expect(
        (fit.status == FitStatus.FITTED).all() and fit.residual.max() < SINGLE,
        (fit.status, fit.residual),
    )


def _no_surfels() -> None:
    empty = without_surfels(surfels())
    expect(weights(empty).parameters.shape == (0, 6), weights(empty).parameters.shape)


# refit


def _basis(*columns: Array) -> Mixture:
    table = np.stack([six() @ c.astype(np.float32) for c in columns], axis=-1)
    return Mixture(table)


def _true_mixture(mode: str) -> None:
    fit = weights(surfels(), mode, _basis(WEIGHT))
    close(fit.parameters, 1.0, rtol=SINGLE)
    expect(fit.residual.max() < SINGLE, fit.residual)


def _twins(mode: str) -> None:
    fit = weights(surfels(), mode, _basis(WEIGHT, WEIGHT, 0 * WEIGHT))
    close(fit.parameters[:, :2].sum(axis=1), 1.0, rtol=SINGLE)
    expect(
        (fit.parameters[:, 2] == 0).all() and (fit.status == 0).all(),
        (fit.parameters, fit.status),
    )


def _scaled_basis(scale: float) -> None:
    fit = weights(surfels(), model=_basis(WEIGHT * scale))
    close(fit.parameters * scale, 1.0, rtol=SINGLE)


def _refit_nothing() -> None:
    fit = weights(spoiled(surfels(), filled(np.nan)), model=_basis(WEIGHT))
    expect(
        fit.status.tolist() == [FitStatus.UNSEEN, 0, 0] and np.isnan(fit.residual[0]),
        fit.status,
    )


SURFACE = (
    *stress_cases(
        "surface",
        ("2400 samples, {}", "The planted weights are recovered.", _recovers, MODES),
        (
            "{} light(s), {} camera",
            "Too few samples are refused; with a lower limit, no worse than SciPy.",
            _few,
            (
                (1, 1),
                (3, 1),
            ),
        ),
        (
            "all saturated, {}",
            "Weights are NaN with a status; neighbours are identical.",
            _unseen_surfel,
            MODES,
        ),
        (
            "a sample is {}",
            "Weights are NaN with a status; neighbours are identical.",
            _infinite,
            (
                np.inf,
                -np.inf,
            ),
        ),
        (
            "a sample is NaN",
            "The sample is excluded, and nothing else changes.",
            _one_nan,
        ),
        (
            "{} is NaN: {!r}",
            "The status gives the reason; neighbours are identical.",
            _geometry_nan,
            (
                ("position", FitStatus.NOT_FINITE),
                ("normal", FitStatus.TOO_FEW_SAMPLES),
                ("diffuse", FitStatus.NO_DIFFUSE_ESTIMATE),
            ),
        ),
        ("all black, {}", "Weights are exactly zero.", _black_surfel, MODES),
        (
            "matte skin, eta {}",
            "Weights of the surface are zero.",
            _matte,
            (
                1.0,
                1.3,
                1.5,
            ),
        ),
        (
            "R_d {:g}",
            "Weights are flagged as clamped, finite and not negative.",
            _albedo_bound,
            (
                SMALLEST_R_D,
                LARGEST_R_D,
            ),
        ),
        ("grazing lights", "Their samples are ignored.", _grazing_lights),
        ("lights behind", "Their samples are ignored.", _behind),
        (
            "{} samples",
            "Reflectance is the same as from half floats.",
            _precision,
            (
                "float32",
                "float64",
            ),
        ),
        (
            "{} tables",
            "The fit is certified and exact, and zero tables have zero weight.",
            _extra_tables,
            (
                "zero",
                "duplicate",
                "collinear",
            ),
        ),
        (
            "rank above the bases",
            "The weights are those of the exact tables.",
            _rank_above,
        ),
        (
            "rank above that of the tables",
            "The fit is finite and correct.",
            _rank_of_one_material,
        ),
        ("no surfels", "Arrays are empty and have the right shapes.", _no_surfels),
    ),
    *stress_cases(
        "refit",
        (
            "one component, {}",
            "A surfel made from the component has weight one.",
            _true_mixture,
            MODES,
        ),
        (
            "k above the rank, {}",
            "Duplicates divide the weight, a black component has none.",
            _twins,
            MODES,
        ),
        ("component times {:g}", "Weights are divided by it.", _scaled_basis, SCALES),
        ("all saturated", "Weights are NaN with a status.", _refit_nothing),
    ),
)
