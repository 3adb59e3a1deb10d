"""Curves of methods of population studies."""

from functools import partial
from importlib.util import find_spec

import numpy as np
from scipy.ndimage import gaussian_filter

from benchmarks.curve import Curve, Point, cpu_time
from skindb.numerics.texture import (
    LEVELS,
    build,
    image_parts,
    part_members,
    part_quantiles,
    reconstruct,
    synthesise,
)
from skindb.types import Array


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


def _quantiles(image: Array, levels: int) -> Array:
    parts = image_parts(image, levels)
    return part_quantiles(parts, part_members(np.ones(image.shape), parts))


def _largest(difference: Array) -> float:
    return float(np.abs(difference).max())
