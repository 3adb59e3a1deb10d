"""Stress cases of kernels of populations: no texture, one texel, few subjects, values
of any size.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from skindb.bench.case import SCALES, Case, close, each, expect
from skindb.numerics.factorise import principal_axes
from skindb.numerics.inference import effects, permutation_p
from skindb.numerics.texture import (
    QUANTILES,
    build,
    image_parts,
    part_quantiles,
    reconstruct,
    synthesise,
    valid_quantiles,
)


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
    wanted = gaussian_filter(image.T, 2)
    every = [
        [np.ones(part.shape) for part in image_parts(x, 3)] for x in (image, wanted)
    ]
    before, after = (
        part_quantiles(image_parts(x, 3), one)
        for x, one in zip((image, wanted), every, strict=True)
    )
    image = scale * image
    shift = scale * (after - before)[None]
    found = synthesise(
        image,
        [np.ones((64, 64))],
        shift,
        levels=3,
        iterations=2,
        rng=np.random.default_rng(0),
    )
    expect(
        np.isfinite(found.image).all() and found.trace[-1] < found.trace[0], found.trace
    )


def _flat_texture() -> None:
    shift = np.sort(_noise(1, 15, QUANTILES))
    blank = np.zeros((64, 64))
    rng = np.random.default_rng(0)
    found = synthesise(
        blank, [np.ones((64, 64))], shift, levels=3, iterations=3, rng=rng
    )
    expect(
        np.isfinite(found.image).all() and found.image.std() > 0.1, found.image.std()
    )


def _no_texture_asked() -> None:
    image = _noise(64, 64)
    found = synthesise(
        image,
        [np.ones((64, 64))],
        np.zeros((1, 15, QUANTILES)),
        levels=3,
        rng=np.random.default_rng(0),
    )
    close(found.image, image)


def _quantiles(scale: float) -> None:
    found = valid_quantiles(scale * _noise(3, QUANTILES))
    expect((np.diff(found) >= 0).all(), "a decreasing quantile function")
    close(
        found.mean(axis=1),
        scale * _noise(3, QUANTILES).mean(axis=1),
        atol=1e-12 * scale,
    )


def _alike(count: int) -> None:
    found = principal_axes(np.ones((count, 50)), 3)
    expect(len(found.axes) == 0 and found.total <= 1e-20, found.total)


def _vectors(scale: float) -> None:
    x = scale * _noise(6, 500)
    found = principal_axes(x, 5)
    close(found.mean + found.score @ found.axes, x, atol=1e-10 * scale)
    close(found.axes @ found.axes.T, np.eye(5), atol=1e-10)


def _scaled(scale: float) -> None:
    values = _noise(20, 4)
    group = (np.arange(20) % 2).astype(float)
    one = effects(values, group)
    other = effects(scale * values, group)
    close(other.slope, scale * one.slope, rtol=1e-9)
    close(other.statistic, one.statistic, rtol=1e-9)


def _equal_values() -> None:
    values = np.ones((10, 2))
    group = (np.arange(10) % 2).astype(float)
    found = effects(values, group)
    close(found.slope, [0.0, 0.0], atol=1e-15)
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


POPULATION: tuple[Case, ...] = (
    Case(
        "pyramid", "constant image", "No band has any detail.", lambda: _constant(1e6)
    ),
    *(
        Case(
            "pyramid",
            f"{height} x {width}, values of {scale:g}",
            "A round trip returns the image.",
            lambda h=height, w=width, s=scale: _round_trip(h, w, s),  # type: ignore[misc]
        )
        for height, width, scale in [(64, 64, s) for s in SCALES]
        + [(63, 50, 1.0), (1, 17, 1.0), (2, 300, 1.0)]
    ),
    *each(
        "textures",
        "values of {:g}",
        "The distributions converge, and stay finite.",
        _texture,
        *SCALES[1:3],
    ),
    Case(
        "textures",
        "image without texture",
        "The added noise creates texture.",
        _flat_texture,
    ),
    Case(
        "textures", "no change requested", "The image is unchanged.", _no_texture_asked
    ),
    *each(
        "textures",
        "decreasing quantiles of {:g}",
        "They become monotone and keep their mean.",
        _quantiles,
        *SCALES,
    ),
    *each("components", "{} equal vectors", "There is no component.", _alike, 2, 10),
    *each(
        "components",
        "values of {:g}",
        "The vectors are rebuilt from the components.",
        _vectors,
        *SCALES,
    ),
    *each(
        "permutations",
        "values of {:g}",
        "Effects scale, statistics do not.",
        _scaled,
        *SCALES,
    ),
    Case(
        "permutations", "equal subjects", "The effect is 0 and p is 1.", _equal_values
    ),
    Case(
        "permutations",
        "groups a million apart",
        "p is small, and not below 1 / (n + 1).",
        _far_apart,
    ),
)
