"""Methods of population studies: curves and stress cases."""

from __future__ import annotations

import numpy as np
from scipy import stats
from scipy.ndimage import gaussian_filter
from sklearn.decomposition import PCA

from skindb.bench.case import SCALES, close, expect, stress_cases
from skindb.bench.curve import Curve, Point, cpu_time
from skindb.numerics.factorise import principal_axes
from skindb.numerics.inference import effects, permutation_p
from skindb.numerics.texture import (
    QUANTILES,
    build,
    image_parts,
    level_fractions,
    part_quantiles,
    reconstruct,
    synthesise,
    valid_quantiles,
)
from skindb.types import Array

TAKES = 87


def pyramid_curves(quick: bool) -> list[Curve]:
    """Round trip of images of several sizes in both precisions, relative to a Fourier
    transform and its inverse.
    """
    points = []
    base = ""
    for size in (256, 512) if quick else (512, 1024, 2048):
        image = np.random.default_rng(size).standard_normal((size, size))
        took, back = cpu_time(
            lambda x=image: np.fft.irfft2(np.fft.rfft2(x), x.shape),  # type: ignore[misc]
            size**2,
        )
        points.append(
            Point(
                "Fourier transform and inverse",
                f"{size} x {size}",
                took,
                _largest(back - image),
            )
        )
        base = base or points[-1].name
        for dtype in (np.float64, np.float32):
            typed = image.astype(dtype)
            took, again = cpu_time(lambda x=typed: reconstruct(build(x)), size**2)  # type: ignore[misc]
            points.append(
                Point(
                    "skindb",
                    f"{size} x {size}, {dtype.__name__}",
                    took,
                    _largest(again - image),
                )
            )
    return [
        Curve(
            "pyramid",
            "largest error of a round trip",
            "the image",
            "an entry",
            base,
            tuple(points),
        )
    ]


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

    def made(iterations: int) -> Array:
        every = [np.ones(image.shape)]
        own = np.random.default_rng(1)
        return synthesise(
            image, every, shift, iterations=iterations, levels=levels, rng=own
        ).image

    points = []
    for iterations in (1, 5) if quick else (1, 2, 5, 10, 20):
        took, result = cpu_time(lambda n=iterations: made(n), size**2)  # type: ignore[misc]
        error = float(
            np.sqrt(
                ((_quantiles(result, levels) - goal) ** 2).mean() / (shift**2).mean()
            )
        )
        points.append(Point("skindb", f"{iterations} iterations", took, error))
    name = "RMS difference of quantiles over that of the source"
    return [
        Curve(
            "textures",
            name,
            "a planted texture",
            "an entry",
            "skindb, 5 iterations",
            tuple(points),
        )
    ]


def components_curves(quick: bool) -> list[Curve]:
    """Principal axes of a few long vectors, compared with scikit-learn."""
    length = 10_000 if quick else 300_000
    rng = np.random.default_rng(0)
    vectors = rng.standard_normal((TAKES, 5)) @ rng.standard_normal(
        (5, length)
    ) + 0.1 * rng.standard_normal((TAKES, length))
    exact = PCA(5, svd_solver="full").fit(vectors)
    points = []
    for name, solver in (("scikit-learn", "full"), ("scikit-learn", "randomized")):
        took, axes = cpu_time(
            lambda s=solver: PCA(5, svd_solver=s, random_state=0).fit(vectors)  # type: ignore[misc]
        )
        points.append(
            Point(name, solver, took, _axes_off(axes.components_, exact.components_))
        )
    took, axes_of_skindb = cpu_time(lambda: principal_axes(vectors, 5))
    points.append(
        Point("skindb", "", took, _axes_off(axes_of_skindb.axes, exact.components_))
    )
    single = vectors.astype(np.float32)
    took, axes_of_skindb = cpu_time(lambda: principal_axes(single, 5))
    points.append(
        Point(
            "skindb",
            "vectors in single precision",
            took,
            _axes_off(axes_of_skindb.axes, exact.components_),
        )
    )
    label = f"largest difference of 5 axes of {TAKES} vectors of {length:,}"
    return [
        Curve(
            "components",
            label,
            "scikit-learn, full",
            "an analysis",
            "scikit-learn, full",
            tuple(points),
        )
    ]


def permutations_curves(quick: bool) -> list[Curve]:
    """P values of 30 quantities of 87 subjects by number of permutations, and of
    scipy.stats.permutation_test.
    """
    rng = np.random.default_rng(0)
    group = (np.arange(TAKES) % 4 == 0).astype(float)
    values = rng.standard_normal((TAKES, 30)) + 0.4 * group[:, None] * np.linspace(
        0, 1, 30
    )
    exact, _, _ = permutation_p(
        values,
        group,
        max_draws=20_000 if quick else 200_000,
        rng=np.random.default_rng(7),
    )
    points = []
    for draws in (100, 1000) if quick else (100, 1000, 10_000):
        took, (p, _, _) = cpu_time(
            lambda n=draws: permutation_p(  # type: ignore[misc]
                values, group, max_draws=n, rng=np.random.default_rng(1)
            )
        )
        points.append(
            Point("skindb", f"{draws} permutations", took, _largest(p - exact))
        )
    draws = 100 if quick else 1000

    def welch(x: Array, y: Array, axis: int = 0) -> Array:
        return np.asarray(stats.ttest_ind(x, y, equal_var=False, axis=axis).statistic)

    took, scipy_test = cpu_time(
        lambda: stats.permutation_test(
            (values[group == 1], values[group == 0]),
            welch,
            n_resamples=draws,
            vectorized=True,
            axis=0,
            rng=np.random.default_rng(1),
        )
    )
    name = "SciPy permutation_test of Welch's statistic, which differs from HC3's"
    points.append(
        Point(name, f"{draws} permutations", took, _largest(scipy_test.pvalue - exact))
    )
    count = "20,000" if quick else "200,000"
    base = f"skindb, {1000} permutations"
    return [
        Curve(
            "permutations",
            "largest error of a p value",
            f"{count} permutations",
            "a test",
            base,
            tuple(points),
        )
    ]


def _quantiles(image: Array, levels: int) -> Array:
    parts = image_parts(image, levels)
    return part_quantiles(
        parts, level_fractions(np.ones(image.shape), [part.shape for part in parts])
    )


def _axes_off(axes: Array, exact: Array) -> float:
    sign = np.sign((axes * exact).sum(axis=1, keepdims=True))
    return _largest(axes * sign - exact)


def _largest(difference: Array) -> float:
    return float(np.abs(difference).max())


def _noise(*shape: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.random.default_rng(0).standard_normal(shape)


def _round_trip(height: int, width: int, scale: float) -> None:
    image = scale * _noise(height, width)
    close(
        reconstruct(build(image, levels=min(4, max(height, width).bit_length() - 1))),
        image,
        atol=1e-12 * scale,
    )


def _constant(value: float) -> None:
    pyramid = build(np.full((64, 64), value), levels=4)
    expect(
        all(np.abs(part).max() <= 1e-12 * value for part in pyramid.parts()[:-1]),
        "detail in a constant image",
    )


def _texture(scale: float) -> None:
    image = _noise(64, 64)
    target = gaussian_filter(image.T, 2)
    distributions = [
        [np.ones(part.shape) for part in image_parts(x, 3)] for x in (image, target)
    ]
    before, after = (
        part_quantiles(image_parts(x, 3), distribution)
        for x, distribution in zip((image, target), distributions, strict=True)
    )
    image = scale * image
    shift = scale * (after - before)[None]
    result = synthesise(
        image,
        [np.ones((64, 64))],
        shift,
        levels=3,
        iterations=2,
        rng=np.random.default_rng(0),
    )
    expect(
        np.isfinite(result.image).all() and result.trace[-1] < result.trace[0],
        result.trace,
    )


def _flat_texture() -> None:
    shift = np.sort(_noise(1, 15, QUANTILES))
    blank = np.zeros((64, 64))
    rng = np.random.default_rng(0)
    result = synthesise(
        blank, [np.ones((64, 64))], shift, levels=3, iterations=3, rng=rng
    )
    expect(
        np.isfinite(result.image).all() and result.image.std() > 0.1, result.image.std()
    )


def _no_texture_asked() -> None:
    image = _noise(64, 64)
    result = synthesise(
        image,
        [np.ones((64, 64))],
        np.zeros((1, 15, QUANTILES)),
        levels=3,
        rng=np.random.default_rng(0),
    )
    close(result.image, image)


def _falling_quantiles(scale: float) -> None:
    quantiles = valid_quantiles(scale * _noise(3, QUANTILES))
    expect((np.diff(quantiles) >= 0).all(), "a decreasing quantile function")
    close(
        quantiles.mean(axis=1),
        scale * _noise(3, QUANTILES).mean(axis=1),
        atol=1e-12 * scale,
    )


def _alike(count: int) -> None:
    axes = principal_axes(np.ones((count, 50)), 3)
    expect(len(axes.axes) == 0 and axes.total <= 1e-20, axes.total)


def _vectors(scale: float) -> None:
    x = scale * _noise(6, 500)
    axes = principal_axes(x, 5)
    close(axes.mean + axes.score @ axes.axes, x, atol=1e-10 * scale)
    close(axes.axes @ axes.axes.T, np.eye(5), atol=1e-10)


def _scaled(scale: float) -> None:
    values = _noise(20, 4)
    group = (np.arange(20) % 2).astype(float)
    plain = effects(values, group)
    scaled = effects(scale * values, group)
    close(scaled.slope, scale * plain.slope, rtol=1e-9)
    close(scaled.statistic, plain.statistic, rtol=1e-9)


def _equal_values() -> None:
    values = np.ones((10, 2))
    group = (np.arange(10) % 2).astype(float)
    result = effects(values, group)
    close(result.slope, [0.0, 0.0], atol=1e-15)
    p, adjusted, _ = permutation_p(
        values, group, max_draws=200, rng=np.random.default_rng(0)
    )
    expect((p == 1).all() and (adjusted == 1).all(), p)


def _far_apart() -> None:
    group = (np.arange(12) % 2).astype(float)
    values = group[:, None] * 1e6 + _noise(12, 1)
    p, _, count = permutation_p(
        values, group, max_draws=999, rng=np.random.default_rng(0)
    )
    expect(p[0] < 0.02 and p[0] >= 1 / (count + 1), p)


POPULATION = (
    *stress_cases(
        "pyramid",
        ("constant image", "No band has any detail.", _constant, [1e6]),
        (
            "{} x {}, values of {:g}",
            "A round trip returns the image.",
            _round_trip,
            [(64, 64, scale) for scale in SCALES]
            + [(63, 50, 1.0), (1, 17, 1.0), (2, 300, 1.0)],
        ),
    ),
    *stress_cases(
        "textures",
        (
            "values of {:g}",
            "The distributions converge, and stay finite.",
            _texture,
            SCALES[1:3],
        ),
        ("image without texture", "The added noise creates texture.", _flat_texture),
        ("no change requested", "The image is unchanged.", _no_texture_asked),
        (
            "decreasing quantiles of {:g}",
            "They become monotone and keep their mean.",
            _falling_quantiles,
            SCALES,
        ),
    ),
    *stress_cases(
        "components",
        ("{} equal vectors", "There is no component.", _alike, (2, 10)),
        (
            "values of {:g}",
            "The vectors are rebuilt from the components.",
            _vectors,
            SCALES,
        ),
    ),
    *stress_cases(
        "permutations",
        ("values of {:g}", "Effects scale, statistics do not.", _scaled, SCALES),
        ("equal subjects", "The effect is 0 and p is 1.", _equal_values),
        (
            "groups a million apart",
            "p is small, and not below 1 / (n + 1).",
            _far_apart,
        ),
    ),
)
