"""Measured BRDFs, each fitted without itself in the dictionary, for `benchmarks/real.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, nnls

from benchmarks.peers import WIDTHS
from skindb.optics.angles import directions
from skindb.optics.fresnel import fresnel_reflectance
from skindb.reflectance.dictionary import abc_parameters, evaluate_embedded

Array = NDArray[np.float64]

MIN_COSINE = 0.2  # of the light and of the camera
EVERY = 3  # cell of the slices in either direction
ROUNDS = 12  # of reweighting towards cube-root space
FLOOR = 1e-4  # sr^-1, below which values are compared linearly
GGX_WIDTHS = np.geomspace(0.01, 1.0, 22)
INDICES = (1.2, 1.5, 2.0, 5.0)  # refractive indices of the lobes


def brdf_rows(path: Path) -> list[list[str]]:
    """Errors of fits to slices at phi_d = 90 degrees, median over the materials."""
    with np.load(path) as archive:
        names = archive["names"].tolist()
        theta_d, theta_h = np.meshgrid(
            archive["theta_d_rad"][::EVERY],
            archive["theta_h_rad"][::EVERY],
            indexing="ij",
        )
        values = archive["f"][:, ::EVERY, ::EVERY].mean(axis=3).astype(np.float64)
    wi, wo = directions(theta_h, theta_d, np.pi / 2)
    above = np.minimum(wi[..., 2], wo[..., 2]) > MIN_COSINE
    measured = {name: values[names.index(name)][above] for name in abc_parameters()}
    fits = {
        "mixture of the other 58 + Lambert": _others(wi[above], wo[above], lobes=False),
        "skindb: the other 58, eight lobes + Lambert": _others(
            wi[above], wo[above], lobes=True
        ),
        "GGX + Lambert": _one_ggx(theta_h[above], theta_d[above], wi[above], wo[above]),
        f"mixture of {GGX_WIDTHS.size * len(INDICES)} GGX lobes + Lambert": _ggx_mixture(
            theta_h[above], theta_d[above], wi[above], wo[above]
        ),
        "Cook-Torrance + Lambert": _cook_torrance(
            theta_h[above], theta_d[above], wi[above], wo[above]
        ),
        "Lafortune + Lambert": _lafortune(wi[above], wo[above]),
    }
    title = "59 measured BRDFs: error [%], median over materials"
    rows = [[title, "median over directions", "RMS in cube-root space"]]
    for name, estimate in fits.items():
        errors = [
            _errors(estimate(material, value), value)
            for material, value in measured.items()
        ]
        rows.append([name, *(f"{100 * e:.1f}" for e in np.median(errors, axis=0))])
    return rows


def _errors(fitted: Array, value: Array) -> tuple[float, float]:
    roots = np.cbrt(value)
    wrong = np.linalg.norm(np.cbrt(fitted) - roots) / np.linalg.norm(roots)
    return float(np.median(np.abs(fitted / np.maximum(value, 1e-5) - 1))), float(wrong)


def _perceptual_nnls(columns: Array, value: Array) -> Array:
    """Prediction of the non-negative mixture that is closest in cube-root space, by
    reweighted least squares.
    """
    level = np.maximum(value, FLOOR)
    for _ in range(ROUNDS):
        slope = level ** (-2 / 3)
        weights, _ = nnls(columns * slope[:, None], value * slope)
        level = np.maximum(columns @ weights, FLOOR)
    return np.asarray(columns @ weights)


def _others(wi: Array, wo: Array, *, lobes: bool):
    order = list(abc_parameters())
    columns = evaluate_embedded(wi, wo)[:, : None if lobes else len(order)]

    def estimate(material: str, value: Array) -> Array:
        without = np.delete(columns, order.index(material), axis=1)
        return _perceptual_nnls(np.column_stack([without, np.ones(len(value))]), value)

    return estimate


def _ggx(roughness: float, theta_h: Array, wi: Array, wo: Array) -> Array:
    square = roughness**4
    distribution = square / (np.pi * (np.cos(theta_h) ** 2 * (square - 1) + 1) ** 2)
    factors = [
        2 / (c + np.sqrt(square + (1 - square) * c * c)) for c in (wi[:, 2], wo[:, 2])
    ]
    return np.asarray(distribution * factors[0] * factors[1] / 4)


def _ggx_mixture(theta_h: Array, theta_d: Array, wi: Array, wo: Array):
    columns = [
        fresnel_reflectance(np.cos(theta_d), index) * _ggx(width, theta_h, wi, wo)
        for width in GGX_WIDTHS
        for index in INDICES
    ]
    rows = np.column_stack([*columns, np.ones(len(theta_h))])
    rows /= np.linalg.norm(rows, axis=0)
    return lambda _, value: _perceptual_nnls(rows, value)


def _best(shade, starts: list[list[float]], value: Array) -> Array:
    """Prediction of the best of several fits in cube-root space."""
    roots = np.cbrt(value)
    results = [
        least_squares(lambda p: np.cbrt(shade(p)) - roots, start, x_scale="jac")
        for start in starts
    ]
    return np.asarray(shade(min(results, key=lambda result: result.cost).x))


def _one_ggx(theta_h: Array, theta_d: Array, wi: Array, wo: Array):
    def shade(p: Array) -> Array:
        fresnel = fresnel_reflectance(np.cos(theta_d), 1.0 + np.exp(p[3]))
        return (
            np.exp(p[0])
            + np.exp(p[1]) * fresnel * _ggx(np.exp(p[2]), theta_h, wi, wo)
            + 1e-9
        )

    starts = [
        [np.log(0.02), 0.0, np.log(width), -0.7]
        for width in (WIDTHS[0], WIDTHS[3], WIDTHS[6])
    ]
    return lambda _, value: _best(shade, starts, value)


def _cook_torrance(theta_h: Array, theta_d: Array, wi: Array, wo: Array):
    """Beckmann distribution with the shadowing of Cook and Torrance (1982)."""
    across = np.cos(theta_h)
    towards = np.maximum(np.cos(theta_d), 1e-3)
    shadowed = np.minimum(1, 2 * across * np.minimum(wi[:, 2], wo[:, 2]) / towards)

    def shade(p: Array) -> Array:
        square = np.exp(2 * p[2])
        tangent = np.tan(theta_h) ** 2
        distribution = np.exp(-np.minimum(tangent / square, 50)) / (
            np.pi * square * across**4
        )
        fresnel = fresnel_reflectance(np.cos(theta_d), 1.0 + np.exp(p[3]))
        lobe = distribution * shadowed * fresnel / (4 * wi[:, 2] * wo[:, 2])
        return np.exp(p[0]) + np.exp(p[1]) * lobe + 1e-9

    starts = [[np.log(0.02), 0.0, np.log(slope), -0.7] for slope in (0.05, 0.2, 0.5)]
    return lambda _, value: _best(shade, starts, value)


def _lafortune(wi: Array, wo: Array):
    flat = (wi[:, :2] * wo[:, :2]).sum(axis=1)
    level = wi[:, 2] * wo[:, 2]

    def shade(p: Array) -> Array:
        p = np.clip(p, -20, 6)
        base = np.maximum(np.exp(p[2]) * level - np.exp(p[1]) * flat, 1e-6)
        return (
            np.exp(p[0]) + np.exp(np.clip(np.exp(p[3]) * np.log(base), -50, 50)) + 1e-9
        )

    starts = [[np.log(0.02), -0.7, -0.7, np.log(exponent)] for exponent in (3, 20, 100)]
    return lambda _, value: _best(shade, starts, value)
