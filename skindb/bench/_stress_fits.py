"""Fits of surfels and of probe profiles under stress: what was planted must come back, or a status must say why not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from skindb.bench.case import SCALES, Case, close, each, expect
from skindb.fit._albedo_kernels import LARGE, SMALL, diffuse_reflectances
from skindb.fit._normal_kernels import normals
from skindb.fit._probe_kernels import MODELS, ProbeFit, fit_profile
from skindb.fit._surface_kernels import Tables, Weights, surface_weights
from skindb.fit.surface import MIN_SAMPLES, NOISE_FLOOR
from skindb.optics.angles import half_difference
from skindb.optics.brdf_table import TableGrid, lookup
from skindb.optics.dictionary import embedded_dictionary
from skindb.optics.dipole import effective_transport
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.rows import reduce_dictionary
from skindb.schema import FitStatus, ProbeStatus

Array = NDArray[Any]
ETA = 1.3
CHOSEN = [3, 12, 20, 31, 44, 57]  # six of the embedded materials
WEIGHT = np.array([0.2, 0.0, 0.1, 0.0, 0.3, 0.0])
DIFFUSE = np.array([0.5, 0.33, 0.24])
SINGLE = 1e-4  # of samples in single precision: places in a table to 1e-6, times the slope of its lobes
TOTAL = 1e-6  # relative: rounding of samples in single precision


def _spiral(n: int, top: float) -> Array:
    z = 1 - (np.arange(n) + 0.5) / n * (1 - top)
    phi, r = np.pi * (3 - np.sqrt(5)) * np.arange(n), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _six() -> Array:
    """(nh, nd, np, 6) without what the kernels want behind them."""
    return _tables().reduced[..., : len(CHOSEN)]


@lru_cache(maxsize=1)
def _tables() -> Tables:
    whole = embedded_dictionary()
    return Tables(whole.table[..., CHOSEN], whole.grid, np.eye(len(CHOSEN)))


@dataclass(frozen=True)
class Surfels:
    """Three surfels whose samples are the model's, without noise, every one well above the horizon."""

    sample: Array
    position: Array
    light: Array
    camera: Array
    normal: Array
    diffuse: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Arguments of `surface_weights`."""
        return self.sample, self.position, self.light, self.camera, self.normal, self.diffuse


def _surfels(lights: int = 40, cameras: int = 6, *, eta: float = ETA, weight: Array = WEIGHT) -> Surfels:
    position = np.array([[0.0, 0, 0], [40, 10, -5], [-30, 20, -8]])
    normal = _unit(np.array([[0.0, 0, 1], [0.3, 0.1, 1], [-0.2, 0.2, 1]]))
    light, camera = 900 * _spiral(lights, 0.6), 800 * _spiral(cameras, 0.7)
    diffuse = np.tile(DIFFUSE, (3, 1))
    wi, wo = _unit(light - position[:, None]), _unit(camera - position[:, None])
    ci, co = np.einsum("nk,ntk->nt", normal, wi), np.einsum("nk,ntk->nt", normal, wo)
    a, b, n = np.broadcast_arrays(wi[:, :, None], wo[:, None], normal[:, None, None])
    surface = lookup(_six(), *half_difference(a, b, n)) @ weight
    through = fresnel_transmittance(ci, eta)[:, :, None] * fresnel_transmittance(co, eta)[:, None]
    value = through[..., None] * diffuse[:, None, None] / np.pi + surface[..., None]
    sample = (ci[:, :, None, None] * value).astype(np.float32)
    return Surfels(sample, position, light, camera, normal, diffuse)


def _weights(skin: Surfels, mode: str = "linear", tables: Tables | None = None, **options: Any) -> Weights:
    ask = {"eta": ETA, "noise_floor": NOISE_FLOOR, "min_samples": MIN_SAMPLES} | options
    return surface_weights(*skin.arrays, tables=tables or _tables(), mode=mode, **ask)


def _spoiled(skin: Surfels, change: Callable[[Array], None]) -> Surfels:
    """With the samples of the first surfel changed."""
    sample = skin.sample.copy()
    change(sample[0])
    return replace(skin, sample=sample)


def _filled(value: float) -> Callable[[Array], None]:
    return lambda sample: sample.fill(value)


def _first(skin: Surfels, value: float) -> Surfels:
    def change(sample: Array) -> None:
        sample[1, 2, 1] = value

    return _spoiled(skin, change)


def _rows(skin: Surfels, s: int) -> tuple[Array, Array]:
    """Rows and targets of one surfel by NumPy."""
    wi, wo = _unit(skin.light - skin.position[s]), _unit(skin.camera - skin.position[s])
    a, b = np.broadcast_arrays(wi[:, None], wo[None])
    ci, co = wi @ skin.normal[s], wo @ skin.normal[s]
    M = lookup(_six(), *half_difference(a, b, skin.normal[s])) * ci[:, None, None]
    shape = (ci * fresnel_transmittance(ci, ETA))[:, None] * fresnel_transmittance(co, ETA) / np.pi
    target = skin.sample[s].astype(np.float64) - shape[..., None] * skin.diffuse[s]
    return M.reshape(-1, M.shape[-1]), target.reshape(-1, 3)


# surface


def _recovers(mode: str) -> None:
    skin = _surfels(150, 16)
    found = _weights(skin, mode)
    expect((found.status == FitStatus.FITTED).all() and (found.samples == 2400).all(), (found.status, found.samples))
    expect(found.residual.max() < SINGLE, found.residual)
    for s in range(3):
        M, _ = _rows(skin, s)
        close(M @ found.weight[s], M @ WEIGHT, atol=SINGLE * np.abs(M @ WEIGHT).max())


def _few(lights: int, cameras: int) -> None:
    skin = _surfels(lights, cameras)
    skin = replace(skin, sample=skin.sample * np.linspace(0.9, 1.1, 3, dtype=np.float32))  # channels disagree
    refused = _weights(skin)
    expect((refused.status == FitStatus.TOO_FEW_SAMPLES).all() and np.isnan(refused.weight).all(), refused.status)
    found = _weights(skin, min_samples=1)
    for s in range(3):
        M, target = _rows(skin, s)
        theirs = nnls(np.repeat(M, 3, 0), target.ravel())[1]
        ours = np.linalg.norm((M @ found.weight[s])[:, None] - target)
        expect(ours <= theirs + SINGLE * np.linalg.norm(target), (ours, theirs))


def _unseen_surfel(mode: str) -> None:
    skin = _surfels()
    found, whole = _weights(_spoiled(skin, _filled(np.nan)), mode), _weights(skin, mode)
    expect(found.status.tolist() == [FitStatus.UNSEEN, 0, 0] and np.isnan(found.weight[0]).all(), found.status)
    np.testing.assert_array_equal(found.weight[1:], whole.weight[1:])


def _infinite(bad: float) -> None:
    found, whole = _weights(_first(_surfels(), bad)), _weights(_surfels())
    expect(found.status.tolist() == [FitStatus.NOT_FINITE, 0, 0] and np.isnan(found.weight[0]).all(), found.status)
    np.testing.assert_array_equal(found.weight[1:], whole.weight[1:])


def _one_nan() -> None:
    """A sample without one channel is no sample: as many as without it, and the truth still."""
    found = _weights(_first(_surfels(), np.nan))
    expect(found.samples.tolist() == [239, 240, 240], found.samples)
    expect(found.residual.max() < SINGLE, found.residual)


def _geometry_nan(field: str, status: FitStatus) -> None:
    skin = _surfels()
    spoiled = getattr(skin, field).copy()
    spoiled[0] = np.nan
    found, whole = _weights(replace(skin, **{field: spoiled})), _weights(skin)
    expect(found.status.tolist() == [status, 0, 0] and np.isnan(found.weight[0]).all(), found.status)
    np.testing.assert_array_equal(found.weight[1:], whole.weight[1:])


def _black_surfel(mode: str) -> None:
    found = _weights(_spoiled(_surfels(), _filled(0.0)), mode)
    expect(found.status[0] == FitStatus.FITTED and (found.weight[0] == 0).all(), (found.status[0], found.weight[0]))


def _matte(eta: float) -> None:
    skin = _surfels(eta=eta, weight=0 * WEIGHT)
    found = _weights(skin, eta=eta)
    expect(found.residual.max() < TOTAL and np.abs(found.weight).max() < SINGLE, (found.residual, found.weight))


def _albedo_bound(value: float) -> None:
    skin = _surfels()
    diffuse = skin.diffuse.astype(np.float32)  # as it is stored
    diffuse[0] = value
    found = _weights(replace(skin, diffuse=diffuse))
    expect(found.status.tolist() == [FitStatus.DIFFUSE_CLAMPED, 0, 0], found.status)
    expect(np.isfinite(found.weight).all() and (found.weight >= 0).all(), found.weight)


def _grazing_lights() -> None:
    """Lights 3 degrees above the horizon with samples of any size change nothing."""
    skin = _surfels()
    low = 900 * np.array([[np.cos(a), np.sin(a), 0.05] for a in (0.1, 2.0, 4.0)])
    wild = np.full((3, 3, *skin.sample.shape[2:]), 50.0, np.float32)
    flat = replace(skin, normal=np.tile([0.0, 0, 1], (3, 1)), position=np.zeros((3, 3)))
    more = replace(flat, light=np.concatenate([skin.light, low]), sample=np.concatenate([skin.sample, wild], axis=1))
    close(_weights(more).weight, _weights(flat).weight, rtol=1e-9, atol=1e-12)


def _behind() -> None:
    """Lights and cameras behind the surfel count for nothing, whatever their samples."""
    skin = _surfels()
    wild = np.full((3, 2, *skin.sample.shape[2:]), 50.0, np.float32)
    behind = np.concatenate([skin.light, [[0.0, 0, -900], [100, 0, -900]]])
    more = replace(skin, light=behind, sample=np.concatenate([skin.sample, wild], axis=1))
    close(_weights(more).weight, _weights(skin).weight, rtol=1e-9, atol=1e-12)


def _precision(dtype: str) -> None:
    skin = _surfels()
    half = skin.sample.astype(np.float16)  # values that every precision holds
    found, want = (_weights(replace(skin, sample=half.astype(t))) for t in (dtype, np.float16))
    for s in range(3):  # what weights of like materials mix, not how they share it, is determined
        M, _ = _rows(skin, s)
        close(M @ found.weight[s], M @ want.weight[s], atol=1e-5 * np.abs(M @ WEIGHT).max())


def _extra_tables(change: str) -> None:
    own = _tables()
    extra = {"zero": 0 * _six()[..., :1], "duplicate": _six()[..., :1]}
    extra["collinear"] = _six()[..., :1] + _six()[..., 1:2]
    both = np.concatenate([extra[change], _six(), extra[change]], axis=-1)
    found = _weights(_surfels(), tables=Tables(both, own.grid, np.eye(8)))
    expect((found.status == FitStatus.FITTED).all() and found.kkt.max() < 1e-9, (found.status, found.kkt))
    expect(found.residual.max() < SINGLE, found.residual)
    if change == "zero":
        expect((found.weight[:, [0, 7]] == 0).all(), found.weight)


def _rank_above() -> None:
    reduced, lift = reduce_dictionary(_six(), 99)
    found = _weights(_surfels(), tables=Tables(reduced, _tables().grid, lift))
    close(found.weight, _weights(_surfels()).weight, rtol=1e-12)


def _rank_of_one_material() -> None:
    """Six tables that are multiples of one: a space of four dimensions holds them, fits are finite and right."""
    one = _six()[..., :1] * np.geomspace(0.5, 4, 6, dtype=np.float32)
    reduced, lift = reduce_dictionary(np.ascontiguousarray(one), 4)
    skin = _surfels(weight=np.array([0.4, 0, 0, 0, 0, 0]))
    found = _weights(skin, tables=Tables(reduced, _tables().grid, lift))
    expect((found.status == FitStatus.FITTED).all() and found.residual.max() < SINGLE, (found.status, found.residual))


def _nobody() -> None:
    skin = _surfels()
    empty = replace(skin, **{f: getattr(skin, f)[:0] for f in ("sample", "position", "normal", "diffuse")})
    expect(_weights(empty).weight.shape == (0, 6), _weights(empty).weight.shape)


# refit


def _basis(*columns: Array) -> Tables:
    table = np.stack([_six() @ c.astype(np.float32) for c in columns], axis=-1)
    return Tables(table, TableGrid(*table.shape[:3]), np.eye(len(columns)))


def _true_mixture(mode: str) -> None:
    found = _weights(_surfels(), mode, _basis(WEIGHT))
    close(found.weight, 1.0, rtol=SINGLE)
    expect(found.residual.max() < SINGLE, found.residual)


def _twins(mode: str) -> None:
    found = _weights(_surfels(), mode, _basis(WEIGHT, WEIGHT, 0 * WEIGHT))
    close(found.weight[:, :2].sum(axis=1), 1.0, rtol=SINGLE)
    expect((found.weight[:, 2] == 0).all() and (found.status == 0).all(), (found.weight, found.status))


def _scaled_basis(scale: float) -> None:
    found = _weights(_surfels(), tables=_basis(WEIGHT * scale))
    close(found.weight * scale, 1.0, rtol=SINGLE)


def _refit_nothing() -> None:
    found = _weights(_spoiled(_surfels(), _filled(np.nan)), tables=_basis(WEIGHT))
    expect(found.status.tolist() == [FitStatus.UNSEEN, 0, 0] and np.isnan(found.residual[0]), found.status)


# normals


def _normals(skin: Surfels, method: str = "combined", eta: float = ETA, scan: Array | None = None) -> Array:
    """(3, 3) normals; the scan is three degrees off."""
    scan = _scan(skin) if scan is None else scan
    geometry = skin.position, skin.light, skin.camera, scan
    return normals(skin.sample, *geometry, method=method, eta=eta, scan_error=3.0)[0]


def _scan(skin: Surfels) -> Array:
    return _unit(skin.normal + np.deg2rad(3.0) * np.array([0.6, 0.8, 0.0]))


def _angle(found: Array, true: Array) -> Array:
    return np.asarray(np.degrees(np.arccos(np.clip(np.einsum("nk,nk->n", found, true), -1, 1))))


def _matte_normals(method: str, eta: float) -> None:
    skin = _surfels(150, 16, eta=eta, weight=0 * WEIGHT)
    off = _angle(_normals(skin, method, eta), skin.normal)
    # half a degree: the prior of a scan three degrees off, which noise-free samples outweigh
    expect(off.max() < 0.5, off)


def _no_normals(method: str, value: float) -> None:
    skin = _surfels()
    spoiled, whole = _normals(_spoiled(skin, _filled(value)), method), _normals(skin, method)
    expect(np.isnan(spoiled[0]).all(), spoiled[0])
    close(spoiled[1:], whole[1:], atol=1e-7)


def _few_normals(method: str, lights: int, cameras: int) -> None:
    """Too little to decide: unknown, or a unit vector that stays near the scan."""
    skin = _surfels(lights, cameras)
    found = _normals(skin, method)
    known = np.isfinite(found).all(axis=1)
    close(np.linalg.norm(found[known], axis=1), 1.0, atol=1e-6)
    off = _angle(found[known], _scan(skin)[known])
    expect((off < (45 if method == "peak" else 10)).all(), off)


def _scaled_normals(method: str, scale: float) -> None:
    skin = _surfels(weight=0 * WEIGHT)
    bright = replace(skin, sample=(skin.sample.astype(np.float64) * scale).astype(np.float32))
    close(_normals(bright, method), _normals(skin, method), atol=1e-5)


def _one_sample_lost(method: str, value: float) -> None:
    skin = _surfels(weight=0 * WEIGHT)
    off = _angle(_normals(_first(skin, value), method), skin.normal)
    expect(off[0] < 0.5, off)


def _even_light() -> None:
    """The same value everywhere holds no shading: a unit vector or unknown, never a number that is none."""
    skin = replace(_surfels(), sample=np.full((3, 40, 6, 3), 0.2, np.float32))
    for method in ("combined", "chromatic", "photometric", "peak"):
        found = _normals(skin, method)
        length = np.linalg.norm(found, axis=1)
        expect((np.isnan(length) | (np.abs(length - 1) < 1e-6)).all(), found)


def _no_scan(method: str) -> None:
    skin = _surfels(weight=0 * WEIGHT)
    found = _normals(skin, method, scan=np.full((3, 3), np.nan))
    expect(np.isnan(found).all(), found)


def _nobodys_normals() -> None:
    skin = _surfels()
    empty = replace(skin, **{f: getattr(skin, f)[:0] for f in ("sample", "position", "normal", "diffuse")})
    expect(_normals(empty).shape == (0, 3), _normals(empty).shape)


# albedo

METHODS = ("separated", "quantile", "minimum")


def _albedo(skin: Surfels, method: str, eta: float = ETA) -> tuple[Array, Array]:
    geometry = skin.position, skin.light, skin.camera, skin.normal
    found, error, _, _ = diffuse_reflectances(skin.sample, *geometry, method=method, eta=eta, discard=2)
    return found, error


def _matte_albedo(method: str, eta: float) -> None:
    skin = _surfels(150, 16, eta=eta, weight=0 * WEIGHT)
    close(_albedo(skin, method, eta)[0], skin.diffuse, rtol=1e-5)


def _few_albedo(method: str, lights: int, cameras: int) -> None:
    found, error = _albedo(_surfels(lights, cameras), method)
    expect(np.isnan(found).all() and np.isnan(error).all(), (found, error))


def _no_albedo(method: str) -> None:
    skin = _surfels()
    found, whole = _albedo(_spoiled(skin, _filled(np.nan)), method)[0], _albedo(skin, method)[0]
    expect(np.isnan(found[0]).all(), found[0])
    close(found[1:], whole[1:], rtol=1e-7)


def _one_albedo_lost(method: str, value: float) -> None:
    skin = _surfels(weight=0 * WEIGHT)
    close(_albedo(_first(skin, value), method)[0], skin.diffuse, rtol=1e-3)


def _clamped_albedo(method: str, factor: float) -> None:
    skin = _surfels(weight=0 * WEIGHT)
    found = _albedo(replace(skin, sample=(skin.sample.astype(np.float64) * factor).astype(np.float32)), method)[0]
    close(found, SMALL if factor < 1 else LARGE, rtol=1e-6)


def _grazing_albedo(method: str) -> None:
    skin = replace(_surfels(weight=0 * WEIGHT), normal=np.tile([0.0, 0, 1], (3, 1)), position=np.zeros((3, 3)))
    low = 900 * np.array([[np.cos(a), np.sin(a), 0.2] for a in (0.1, 2.0, 4.0)])
    wild = np.full((3, 3, *skin.sample.shape[2:]), 1e-3, np.float32)
    more = replace(skin, light=np.concatenate([skin.light, low]), sample=np.concatenate([skin.sample, wild], axis=1))
    close(_albedo(more, method)[0], _albedo(skin, method)[0], rtol=1e-6)


def _precision_albedo(method: str) -> None:
    skin = _surfels()
    half = skin.sample.astype(np.float16)
    found = [_albedo(replace(skin, sample=half.astype(t)), method)[0] for t in ("float16", "float32", "float64")]
    close(found[1:], [found[0]] * 2, rtol=1e-6)


def _nobodys_albedo(method: str) -> None:
    skin = _surfels()
    empty = replace(skin, **{f: getattr(skin, f)[:0] for f in ("sample", "position", "normal", "diffuse")})
    expect(_albedo(empty, method)[0].shape == (0, 3), _albedo(empty, method)[0].shape)


# probe

FIBRES = 1 + 0.5 * np.arange(28)
MEDIUM = (0.17, 2.3)


def _profile(model: str, a: float = MEDIUM[0], s: float = MEDIUM[1], distance: Array = FIBRES) -> Array:
    return MODELS[model].profile(distance, a, s, eta=ETA)


def _probe(
    model: str, value: Array, error: Array | None = None, distance: Array = FIBRES, *, free: bool = False
) -> ProbeFit:
    error = 0.004 * value if error is None else error
    return fit_profile(distance, value, error, radius=0.0, eta=ETA, model=model, free_gain=free)


def _is_truth(fit: ProbeFit, a: float = MEDIUM[0], s: float = MEDIUM[1], rtol: float = 2e-3) -> None:
    expect(fit.status == ProbeStatus.FITTED, fit.status)
    close([fit.sigma_tr, fit.sigma_s_prime], [effective_transport(a, s), s], rtol=rtol)


def _enough_fibres(model: str, count: int) -> None:
    _is_truth(_probe(model, _profile(model)[:count], distance=FIBRES[:count]), rtol=0.01)


def _three_fibres(model: str) -> None:
    fit = _probe(model, _profile(model)[:3], distance=FIBRES[:3])
    if fit.status not in (ProbeStatus.UNIDENTIFIED, ProbeStatus.AMBIGUOUS):
        _is_truth(fit, rtol=0.01)


def _too_few_fibres(model: str, count: int) -> None:
    fit = _probe(model, _profile(model)[:count], distance=FIBRES[:count])
    expect(fit.status == ProbeStatus.TOO_FEW_FIBRES and np.isnan(fit.sigma_tr) and fit.used == count, fit)


def _many_readings(model: str) -> None:
    """2,400 readings of the same fibres: the truth, no other than from one of each."""
    distance = np.repeat(FIBRES, 86)[:2400]
    _is_truth(_probe(model, _profile(model, distance=distance), distance=distance))


def _bad_fibre(model: str, bad: float) -> None:
    value = _profile(model)
    value[[4, 9]] = bad
    fit = _probe(model, value, 0.004 * _profile(model))
    _is_truth(fit)
    expect(fit.used == 26, fit.used)


def _bad_error(model: str, bad: float) -> None:
    error = 0.004 * _profile(model)
    error[[4, 9]] = bad
    fit = _probe(model, _profile(model), error)
    _is_truth(fit)
    expect(fit.used == 26, fit.used)


def _dead_probe(model: str, value: float) -> None:
    fit = _probe(model, np.full(28, value), np.full(28, 1e-9))
    expect(fit.status == ProbeStatus.TOO_FEW_FIBRES and np.isnan(fit.sigma_tr), fit)


def _flagged_or_right(fit: ProbeFit, a: float, s: float) -> None:
    true = float(effective_transport(a, s))
    near = abs(fit.sigma_tr / true - 1) < 0.02 if true > 0 else False
    inside = abs(fit.sigma_tr - true) < 3 * np.hypot(fit.sigma_tr_error, fit.sigma_tr_model_error)
    expect(near or inside or fit.status != ProbeStatus.FITTED, fit)


def _medium(model: str, a: float, s: float) -> None:
    value = _profile(model, a, s)
    _flagged_or_right(_probe(model, value, 0.01 * value + 1e-30), a, s)


def _flat_profile(model: str) -> None:
    """Light that does not fall with distance is no profile: the fit must not look like one."""
    fit = _probe(model, np.full(28, 1e-3))
    expect(fit.status != ProbeStatus.FITTED or fit.residual > 0.3, fit)


def _gain(model: str, gain: float) -> None:
    """A gain in the range of the fit comes back, beyond it the status says so."""
    value = _profile(model) * gain
    fit = _probe(model, value, free=True)
    if 1e-10 < gain < 1e10:
        _is_truth(fit, rtol=0.02)
        close(fit.gain, gain, rtol=0.02)
    else:
        expect(fit.status != ProbeStatus.FITTED, fit)


def _near_and_far(model: str, factor: float) -> None:
    """A probe `factor` times as large on skin as much clearer: the same fit, coefficients over the factor."""
    a, s = MEDIUM[0] / factor, MEDIUM[1] / factor
    fit = _probe(model, _profile(model, a, s, FIBRES * factor), distance=FIBRES * factor)
    _is_truth(fit, a, s, rtol=5e-3)


def _matched_index(model: str) -> None:
    value = MODELS[model].profile(FIBRES, *MEDIUM, eta=1.0)
    fit = fit_profile(FIBRES, value, 0.004 * value, radius=0.0, eta=1.0, model=model, free_gain=False)
    _is_truth(fit)


def _zero_error(model: str) -> None:
    _is_truth(_probe(model, _profile(model), np.zeros(28)))


MODES, NORMALS, PROBES = ("linear", "perceptual"), ("combined", "chromatic", "photometric", "peak"), tuple(MODELS)


def _by(first: tuple[Any, ...], *second: Any) -> list[tuple[Any, ...]]:
    return [(a, *(b if isinstance(b, tuple) else (b,))) for a in first for b in second]


SURFACE = (
    *each("surface", "2400 samples, {}", "What was planted comes back.", _recovers, *MODES),
    *each("surface", "{} light(s), {} camera", "Too few; if asked for nevertheless, no worse than SciPy.",
          _few, (1, 1), (3, 1)),
    *each("surface", "all saturated, {}", "A status and NaN; neighbours keep every bit.", _unseen_surfel, *MODES),
    *each("surface", "a sample is {}", "A status and NaN; neighbours keep every bit.", _infinite, np.inf, -np.inf),
    Case("surface", "a sample is NaN", "It is left out, and nothing else changes.", _one_nan),
    *each("surface", "{} is NaN: {!r}", "The status that says so; neighbours keep every bit.", _geometry_nan,
          ("position", FitStatus.NOT_FINITE), ("normal", FitStatus.TOO_FEW_SAMPLES),
          ("diffuse", FitStatus.NO_DIFFUSE_ESTIMATE)),
    *each("surface", "all black, {}", "Weights of exactly zero.", _black_surfel, *MODES),
    *each("surface", "matte skin, eta {}", "Nothing is left for the surface.", _matte, 1.0, 1.3, 1.5),
    *each("surface", "R_d {:g}", "Flagged as clamped, finite and non-negative.", _albedo_bound, SMALL, LARGE),
    Case("surface", "grazing lights", "Their samples change nothing.", _grazing_lights),
    Case("surface", "lights behind", "Their samples change nothing.", _behind),
    *each("surface", "{} samples", "The same reflectance as from half floats.", _precision, "float32", "float64"),
    *each("surface", "{} tables", "Certified, the truth explained, nothing to empty ones.",
          _extra_tables, "zero", "duplicate", "collinear"),
    Case("surface", "rank above the bases", "The exact tables.", _rank_above),
    Case("surface", "rank above that of the tables", "Finite and right.", _rank_of_one_material),
    Case("surface", "no surfels", "Empty arrays of the right shapes.", _nobody),
    *each("refit", "one component, {}", "A surfel of its own kind has weight one.", _true_mixture, *MODES),
    *each("refit", "k above the rank, {}", "Twins share the weight, a black component has none.", _twins, *MODES),
    *each("refit", "component times {:g}", "Weights are divided by it.", _scaled_basis, *SCALES),
    Case("refit", "all saturated", "A status and NaN.", _refit_nothing),
)  # fmt: skip
NORMAL = (
    *each("normals", "{}: 2400 samples of matte skin, eta {}", "Half a degree, noise-free.", _matte_normals,
          *_by(NORMALS[:3], 1.0, 1.3)),
    *each("normals", "{}: all {}", "Unknown; neighbours keep theirs.", _no_normals, *_by(NORMALS, np.nan, 0.0)),
    *each("normals", "{}: {} light(s), {} camera", "Unknown, or a unit vector near the scan.", _few_normals,
          *_by(NORMALS, (1, 1), (3, 1))),
    *each("normals", "{}: samples times {:g}", "The same normals.", _scaled_normals, *_by(NORMALS, *SCALES)),
    *each("normals", "{}: a sample is {}", "One sample turns nothing.",
          _one_sample_lost, *_by(NORMALS[:3], np.nan, np.inf)),
    Case("normals", "constant", "Unit vectors or unknown.", _even_light),
    *each("normals", "{}: no normal of the scan", "Unknown.", _no_scan, *NORMALS[:3]),
    Case("normals", "no surfels", "Empty arrays of the right shapes.", _nobodys_normals),
)  # fmt: skip
ALBEDO = (
    *each("albedo", "{}: 2400 samples of matte skin, eta {}", "R_d to rounding.",
          _matte_albedo, *_by(METHODS, 1.0, 1.3)),
    *each("albedo", "{}: {} light(s), {} camera", "Unknown, the error too.",
          _few_albedo, *_by(METHODS, (1, 1), (3, 1))),
    *each("albedo", "{}: all saturated", "Unknown; neighbours keep theirs.", _no_albedo, *METHODS),
    *each("albedo", "{}: a sample is {}", "One sample of 240 moves R_d by less than 1e-3.", _one_albedo_lost,
          *_by(METHODS, np.nan, np.inf)),
    *each("albedo", "{}: samples times {:g}", "Clamped to the range of eq. 5.", _clamped_albedo,
          *_by(METHODS, 0.0, 1e-30, 1e3, 1e30)),
    *each("albedo", "{}: grazing lights", "Their samples change nothing.", _grazing_albedo, *METHODS),
    *each("albedo", "{}: any precision", "The same to rounding.", _precision_albedo, *METHODS),
    *each("albedo", "{}: no surfels", "Empty arrays of the right shapes.", _nobodys_albedo, *METHODS),
)  # fmt: skip
PROBE = (
    *each("probe", "{}: {} fibres", "The truth.", _enough_fibres, *_by(PROBES, 5, 28)),
    *each("probe", "{}: 3 fibres", "The truth, or a status: other media may fit three values as well.", _three_fibres,
          *PROBES),
    *each("probe", "{}: only {} fibres", "Refused with a status.", _too_few_fibres, *_by(PROBES, 0, 1, 2)),
    *each("probe", "{}: 2400 readings", "The truth.", _many_readings, *PROBES),
    *each("probe", "{}: two fibres {}", "Left out, the truth from the others.",
          _bad_fibre, *_by(PROBES, np.nan, np.inf, 0.0, -1.0)),
    *each("probe", "{}: two errors {}", "Left out, the truth from the others.",
          _bad_error, *_by(PROBES, np.nan, np.inf)),
    *each("probe", "{}: all {}", "Refused with a status.", _dead_probe, *_by(PROBES, 0.0, np.nan, np.inf, -1.0)),
    *each("probe", "{}: sigma_a {:g}, sigma_s' {:g}", "Within 2 %, within three errors, or flagged.", _medium,
          *_by(PROBES, (0.0, 2.0), (1e-8, 2.0), (0.1, 1e-3), (20.0, 1.0), (1e-3, 50.0))),
    *each("probe", "{}: constant", "Flagged, or its residual says that this is no profile.", _flat_profile, *PROBES),
    *each("probe", "{}: gain {:g}", "The gain comes back, or the status says that it is out of range.", _gain,
          *_by(PROBES, 1e-6, 1e6), ("dipole", 1e-30), ("dipole", 1e30)),
    *each("probe", "{}: distances times {:g}", "Coefficients over the factor.", _near_and_far, *_by(PROBES, 0.2, 3.0)),
    *each("probe", "{}: eta 1", "The truth.", _matched_index, "dipole"),
    *each("probe", "{}: errors of zero", "The truth.", _zero_error, *PROBES),
)  # fmt: skip
FITS = (*SURFACE, *NORMAL, *ALBEDO, *PROBE)
