"""The separation of diffuse reflection, compared with NumPy and SciPy in double
precision and with its own scatter.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from skindb.fit import estimate_diffuse_reflectance
from skindb.optics.angles import half_difference
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance._separation_kernels import (
    COLUMNS,
    LOBES,
    MIN_COSINE_ALBEDO,
    MODEL_ERROR,
    SHAPE,
    fit_shape,
    robust_slope,
    separation_memory,
)
from skindb.reflectance.separation import surface_lobes
from skindb.reflectance.tables import lookup
from skindb.schema import label

FLOOR = 0.01  # sr^-1


def _tukey(residual, scale):
    return np.clip(1 - (residual / (4.685 * scale)) ** 2, 0, 1) ** 2


def _naive_slope(x, y):
    weight = np.ones_like(x)
    for _ in range(5):
        slope = (weight * x * y).sum() / (weight * x * x).sum()
        residual = y - slope * x
        weight = _tukey(
            residual, 1.2533 * (weight * abs(residual)).sum() / weight.sum()
        )
    return slope


def _naive_shape(columns, y, noise=(0.0, 0.0)):
    """Weights of the columns, the diffuse shape first."""
    level = np.maximum(y, FLOOR)
    keep = np.ones_like(y)
    for _ in range(4):
        root = np.sqrt(keep) / level
        x = nnls(columns * root[:, None], y * root)[0]
        level = np.maximum(columns @ x, FLOOR)
        level = np.hypot(
            level, np.sqrt((noise[0] + noise[1] * level) / 3) / MODEL_ERROR
        )
        residual = (y - columns @ x) / level
        keep = _tukey(
            residual, 1.2533 * (keep * abs(residual)).sum() / keep.sum() + 0.005
        )
    return x


def _slope(x, y):
    n = len(x)
    work = np.empty((2, n), np.float32)
    return robust_slope(x.astype(np.float32), y.astype(np.float32), work[0], work[1], n)


def _shape(shape, lobes, y, noise=(0.0, 0.0)):
    n = len(y)
    memory = separation_memory(n)
    rows = np.zeros((n, 2 * COLUMNS), np.float32)
    rows[:, : lobes.shape[1]], rows[:, SHAPE] = lobes, shape
    memory.mean[:n] = y
    lines = np.broadcast_to(np.array(noise)[:, None], (2, n)).astype(np.float32)
    return fit_shape(rows, n, lines, memory)


def _samples(rng, count, noise=0.03):
    shape = rng.uniform(0.05, 0.3, count)
    lobes = rng.uniform(0, 1, (count, LOBES)) ** 4
    y = 0.4 * shape + lobes @ np.linspace(0.05, 0.1, LOBES)
    y *= 1 + noise * rng.normal(size=count)
    y[::17] *= 0.4  # shadows
    return shape, lobes, y


@pytest.mark.parametrize("count", [12, 40, 300])
def test_robust_slope__is_the_plain_loop(count):
    shape, _, y = _samples(np.random.default_rng(count), count)
    # single precision
    assert _slope(shape, -2 * y)[0] == pytest.approx(
        _naive_slope(shape, -2 * y), rel=2e-5
    )


@pytest.mark.parametrize("count", [20, 40, 300])
def test_fit_shape__is_the_plain_loop_with_scipy(count):
    shape, lobes, y = _samples(np.random.default_rng(count), count)
    for noise in ((0.0, 0.0), (1e-5, 3e-4)):
        expected = _naive_shape(np.column_stack([shape, lobes]), y, noise)[0]
        # sums in single precision, and normal equations square the condition
        assert _shape(shape, lobes, y, noise)[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("count", [60, 600])
def test_errors__are_the_scatter_of_repeated_draws(count):
    rng = np.random.default_rng(3)
    shape = rng.uniform(0.05, 0.3, count)
    lobes = rng.uniform(0, 1, (count, 3)) ** 4
    clean = 0.4 * shape + lobes @ np.array([0.05, 0.07, 0.1])
    # noise of unequal variance, as photographs have
    slopes = np.array(
        [
            _slope(shape, 0.4 * shape * (1 + 0.03 * rng.normal(size=count)))
            for _ in range(1500)
        ]
    )
    shapes = np.array(
        [
            _shape(shape, lobes, clean * (1 + 0.03 * rng.normal(size=count)))
            for _ in range(1500)
        ]
    )
    for value, error in (slopes.T, shapes.T):
        # the scatter of 1500 draws is known to 2 %; small samples lose up to a tenth in
        # the sandwich
        assert 0.88 < np.median(error) / value.std() < 1.08


def _directions(ds):
    position = ds["surfel_position"].values.astype(float)
    ways = (
        ds[f"{name}_position"].values.astype(float) - position[:, None]
        for name in ("light", "camera")
    )
    return [way / np.linalg.norm(way, axis=-1, keepdims=True) for way in ways]


def _pairs(sample, normal, wi, wo):
    """Lights and cameras of the samples that count."""
    steep = (wi @ normal > MIN_COSINE_ALBEDO)[:, None] & (
        wo @ normal > MIN_COSINE_ALBEDO
    )
    return np.nonzero(steep & np.isfinite(sample).all(-1))


def _plain(sample, normal, wi, wo, pairs):
    """R_d (3,) of one surfel by table lookups and SciPy in double precision."""
    ci = wi @ normal
    co = wo @ normal
    i, o = pairs
    shape = (
        ci[i]
        * fresnel_transmittance(ci[i], 1.3)
        * fresnel_transmittance(co[o], 1.3)
        / np.pi
    )
    table, _ = surface_lobes()
    angles = half_difference(wi[i], wo[o], np.broadcast_to(normal, wi[i].shape))
    lobes = ci[i][:, None] * lookup(table, *angles)
    values = sample[i, o].astype(float)
    mean = values.mean(-1)
    tint = np.array([_naive_slope(shape, values[:, c] - mean) for c in range(3)])
    return tint + _naive_shape(np.column_stack([shape, lobes]), mean)[0]


@pytest.fixture(scope="module")
def separated(new_skin):
    skin = new_skin(surfels=12, lights=60, cameras=8, noise=0.01)
    return skin.lumitexels.assign(shading_normal=label("shading_normal", skin.normal))


def test_separate__is_the_plain_method(separated):
    ds = separated
    found = estimate_diffuse_reflectance(ds)
    wi, wo = _directions(ds)
    normal = ds["shading_normal"].values.astype(float)
    for i in range(12):
        view = ds["reflectance_sample"].values[i], normal[i], wi[i], wo[i]
        expected = _plain(*view, _pairs(*view))
        error = found["diffuse_reflectance_error"].values[i]
        # single precision in sums: a hundredth of the noise
        assert (
            np.abs(found["diffuse_reflectance"].values[i] - expected)
            < 0.02 * error + 1e-5
        ).all()


def test_separate__error_of_the_normal_is_what_turning_it_does(separated):
    """The first-order formula compared with R_d fitted again with the normal turned by
    0.5 degrees about two axes.
    """
    ds = separated
    blind = estimate_diffuse_reflectance(ds)["diffuse_reflectance_error"].values.astype(
        float
    )
    turned = ds.assign(normal_error=label("normal_error", np.full(12, 0.5)))
    error = estimate_diffuse_reflectance(turned)[
        "diffuse_reflectance_error"
    ].values.astype(float)
    part = np.sqrt(error**2 - blind**2)
    wi, wo = _directions(ds)
    expected = np.empty((12, 3))
    for i, n in enumerate(ds["shading_normal"].values.astype(float)):
        first = np.cross(n, np.eye(3)[np.abs(n).argmin()])
        first /= np.linalg.norm(first)
        sample = ds["reflectance_sample"].values[i]
        step = np.radians(0.05)
        square = 0.0
        pairs = _pairs(sample, n, wi[i], wo[i])
        for axis in (first, np.cross(n, first)):
            ends = [(n + s * step * axis) / np.hypot(1, step) for s in (-1, 1)]
            low, high = (_plain(sample, end, wi[i], wo[i], pairs) for end in ends)
            square = (
                square + ((high - low) / 2 * (np.radians(0.5) / np.sqrt(2) / step)) ** 2
            )
        expected[i] = np.sqrt(square)
    # a full fit may also change its active lobes; a stated error needs no more than a
    # tenth in the median
    assert np.median(np.abs(part / expected - 1)) < 0.1
