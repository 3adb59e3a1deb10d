"""Curves of methods of population studies."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec

import numpy as np
from scipy import stats
from scipy.ndimage import gaussian_filter
from sklearn.decomposition import PCA

from skindb.bench.curve import Curve, Point, cpu_time
from skindb.numerics.factorise import principal_axes
from skindb.numerics.inference import permutation_p
from skindb.numerics.texture import (
    LEVELS,
    build,
    image_parts,
    level_fractions,
    part_quantiles,
    reconstruct,
    synthesise,
)
from skindb.types import Array

TAKES = 87
AXES = 5


def pyramid_curves(quick: bool) -> list[Curve]:
    """Round trip of images of several sizes in both precisions, relative to a Fourier
    transform and its inverse, and of pyrtools if it is installed.
    """
    points = []
    for size in (256, 512) if quick else (512, 1024, 2048):
        image = np.random.default_rng(size).standard_normal((size, size))
        setting = f"{size} x {size}"
        seconds, back = cpu_time(partial(_fourier_round_trip, image), size**2)
        name = "Fourier transform and inverse"
        points.append(Point(name, setting, seconds, _largest(back - image)))
        for dtype in (np.float64, np.float32):
            work = partial(_pyramid_round_trip, image.astype(dtype))
            seconds, back = cpu_time(work, size**2)
            typed = f"{setting}, {dtype.__name__}"
            points.append(Point("skindb", typed, seconds, _largest(back - image)))
        if find_spec("pyrtools"):
            seconds, back = cpu_time(partial(_round_trip_of_pyrtools, image), size**2)
            points.append(Point("pyrtools", setting, seconds, _largest(back - image)))
    return [
        Curve(
            kernel="pyramid",
            error_of="largest error of a round trip",
            reference="the image",
            seconds_of="an entry",
            base=points[0].name,
            points=points,
        )
    ]


def _fourier_round_trip(image: Array) -> Array:
    return np.fft.irfft2(np.fft.rfft2(image), image.shape)


def _pyramid_round_trip(image: Array) -> Array:
    return reconstruct(build(image))


def _round_trip_of_pyrtools(image: Array) -> Array:
    from pyrtools.pyramids import (  # type: ignore[import-untyped]
        SteerablePyramidFreq,
    )

    height = min(LEVELS, int(np.log2(len(image))) - 2)  # it takes no more
    pyramid = SteerablePyramidFreq(image, height=height, order=3)
    return np.asarray(pyramid.recon_pyr())


def textures_curves(quick: bool) -> list[Curve]:
    """White noise that is matched to the distributions of streaks: distance from them
    by number of iterations.
    """
    size, levels = (128, 4) if quick else (512, 7)
    rng = np.random.default_rng(0)
    target = gaussian_filter(rng.standard_normal((size, size)), (1, 4), mode="wrap")
    image = target.std() * rng.standard_normal((size, size))
    goal = _quantiles(target, levels)
    shift = (goal - _quantiles(image, levels))[None]

    def texture(iterations: int) -> Array:
        region = [np.ones(image.shape)]
        rng = np.random.default_rng(1)
        synthesis = synthesise(
            image, region, shift, iterations=iterations, levels=levels, rng=rng
        )
        return synthesis.image

    points = []
    for iterations in (1, 5) if quick else (1, 2, 5, 10, 20):
        seconds, result = cpu_time(partial(texture, iterations), size**2)
        off = (_quantiles(result, levels) - goal) ** 2
        error = float(np.sqrt(off.mean() / (shift**2).mean()))
        points.append(Point("skindb", f"{iterations} iterations", seconds, error))
    return [
        Curve(
            kernel="textures",
            error_of="RMS difference of quantiles over that of the source",
            reference="a planted texture",
            seconds_of="an entry",
            base="skindb, 5 iterations",
            points=points,
        )
    ]


def components_curves(quick: bool) -> list[Curve]:
    """Principal axes of a few long vectors, compared with scikit-learn."""
    length = 10_000 if quick else 300_000
    rng = np.random.default_rng(0)
    vectors = rng.standard_normal((TAKES, AXES)) @ rng.standard_normal((AXES, length))
    vectors += 0.1 * rng.standard_normal((TAKES, length))
    exact = PCA(AXES, svd_solver="full").fit(vectors).components_
    points = []
    for solver in ("full", "randomized"):
        fit = partial(PCA(AXES, svd_solver=solver, random_state=0).fit, vectors)
        seconds, axes = cpu_time(fit)
        error = _axes_off(axes.components_, exact)
        points.append(Point("scikit-learn", solver, seconds, error))
    for setting, dtype in (
        ("", np.float64),
        ("vectors in single precision", np.float32),
    ):
        work = partial(principal_axes, vectors.astype(dtype), AXES)
        seconds, principal = cpu_time(work)
        error = _axes_off(principal.axes, exact)
        points.append(Point("skindb", setting, seconds, error))
    base = "scikit-learn, full"
    return [
        Curve(
            kernel="components",
            error_of=f"largest difference of {AXES} axes of {TAKES} vectors of {length:,}",
            reference=base,
            seconds_of="an analysis",
            base=base,
            points=points,
        )
    ]


def permutations_curves(quick: bool) -> list[Curve]:
    """P values of 30 quantities of 87 subjects by number of permutations, and of
    scipy.stats.permutation_test.
    """
    rng = np.random.default_rng(0)
    group = (np.arange(TAKES) % 4 == 0).astype(float)
    values = rng.standard_normal((TAKES, 30))
    values += 0.4 * group[:, None] * np.linspace(0, 1, 30)

    def p_values(draws: int, seed: int = 1) -> Array:
        rng = np.random.default_rng(seed)
        return permutation_p(values, group, max_draws=draws, rng=rng)[0]

    exact_draws = 20_000 if quick else 200_000
    exact = p_values(exact_draws, 7)
    points = []
    for draws in (100, 1000) if quick else (100, 1000, 10_000):
        seconds, p = cpu_time(partial(p_values, draws))
        setting = f"{draws} permutations"
        points.append(Point("skindb", setting, seconds, _largest(p - exact)))
    draws = 100 if quick else 1000
    seconds, p = cpu_time(partial(_p_values_of_scipy, values, group, draws))
    name = "SciPy permutation_test of Welch's statistic, which differs from HC3's"
    setting = f"{draws} permutations"
    points.append(Point(name, setting, seconds, _largest(p - exact)))
    return [
        Curve(
            kernel="permutations",
            error_of="largest error of a p value",
            reference=f"{exact_draws:,} permutations",
            seconds_of="a test",
            base="skindb, 1000 permutations",
            points=points,
        )
    ]


def _p_values_of_scipy(values: Array, group: Array, draws: int) -> Array:
    def welch(x: Array, y: Array, axis: int = 0) -> Array:
        return np.asarray(stats.ttest_ind(x, y, equal_var=False, axis=axis).statistic)

    test = stats.permutation_test(
        (values[group == 1], values[group == 0]),
        welch,
        n_resamples=draws,
        vectorized=True,
        axis=0,
        rng=np.random.default_rng(1),
    )
    return np.asarray(test.pvalue)


def _quantiles(image: Array, levels: int) -> Array:
    parts = image_parts(image, levels)
    shapes = [part.shape for part in parts]
    return part_quantiles(parts, level_fractions(np.ones(image.shape), shapes))


def _axes_off(axes: Array, exact: Array) -> float:
    sign = np.sign((axes * exact).sum(axis=1, keepdims=True))
    return _largest(axes * sign - exact)


def _largest(difference: Array) -> float:
    return float(np.abs(difference).max())
