"""Simple reflectance models with which skindb is compared: fits of pixels under distant
lights and one camera at +z.

Each pixel has a normal and a few parameters, refined together by robust damped least
squares (Levenberg and Marquardt) for all pixels at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
# parameters (n, p), normals (n, 3), lights (l, 3) -> (n, l)
Shading = Callable[[Array, Array, Array], Array]

ROUNDS = 40
MIXTURE_ROUNDS = 5
DIFFERENCE = 1e-4  # of a parameter, for derivatives
TUKEY = 4.685  # 95 % efficiency for normal noise
# of the pixel's brightest prediction; errors of darker samples are not proportional to
# their value
MIN_LEVEL = 0.05
MIN_SCALE = 0.005  # of the level
# weight of the starting values, for pixels with fewer samples than parameters
PRIOR = 0.005
MIN_COSINE = 0.02
VIEW = np.array([0.0, 0.0, 1.0])
WIDTHS = np.geomspace(0.08, 1.0, 8)  # roughness of the lobes of mixtures


@dataclass(frozen=True)
class Peer:
    """A model: its shading and the starting values of its parameters, without the normal."""

    name: str
    shading: Shading
    # the first is the logarithm of the albedo over that of Lambert's law
    start: tuple[float, ...]


@dataclass(frozen=True)
class Fit:
    """Normals (n, 3) of the pixels and predictions (n, light) for all lights."""

    normal: Array
    predicted: Array


def lambert(parameters: Array, normal: Array, light: Array) -> Array:
    """Albedo over pi times the cosine."""
    cosine = np.maximum(normal @ light.T, 0.0)
    return np.exp(parameters[:, :1]) * cosine / np.pi


def ggx_lobe(roughness: Array, normal: Array, light: Array) -> Array:
    """Microfacet lobe times the cosine: GGX distribution, separable Smith shadowing, no
    Fresnel factor.
    """
    half = light + VIEW
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    lit = np.maximum(normal @ light.T, MIN_COSINE)
    seen = np.maximum(normal @ VIEW, MIN_COSINE)[:, None]
    square = roughness**4
    across = np.maximum(normal @ half.T, 0.0) ** 2
    distribution = square / (np.pi * (across * (square - 1.0) + 1.0) ** 2)
    shadowed = _smith(lit, square) * _smith(seen, square)
    facing = (normal @ light.T > 0) & (seen > 0)
    return np.where(facing, distribution * shadowed / (4.0 * seen), 0.0)


def _smith(cosine: Array, square: Array) -> Array:
    return np.asarray(
        2.0 * cosine / (cosine + np.sqrt(square + (1.0 - square) * cosine**2))
    )


def ggx(parameters: Array, normal: Array, light: Array) -> Array:
    """Lambert's law and one GGX lobe: albedo, strength, roughness."""
    lobe = ggx_lobe(_fraction(parameters[:, 2:3]), normal, light)
    return lambert(parameters, normal, light) + np.exp(parameters[:, 1:2]) * lobe


def oren_nayar_ggx(parameters: Array, normal: Array, light: Array) -> Array:
    """Oren and Nayar's (1994) matt surface and one GGX lobe: albedo, strength,
    roughness, roughness of the former.
    """
    lit = np.clip(normal @ light.T, 0.0, 1.0)
    seen = np.clip(normal @ VIEW, MIN_COSINE, 1.0)[:, None]
    variance = _fraction(parameters[:, 3:4]) ** 2
    sines = np.sqrt(1.0 - lit**2) * np.sqrt(1.0 - seen**2)
    # cosine of the difference of azimuth, times both sines
    azimuth = np.maximum(light @ VIEW - lit * seen, 0.0)
    steep = np.where(sines > 0, azimuth / np.maximum(lit, seen), 0.0)
    rough = (
        1.0
        - 0.5 * variance / (variance + 0.33)
        + 0.45 * variance / (variance + 0.09) * steep
    )
    lobe = ggx_lobe(_fraction(parameters[:, 2:3]), normal, light)
    return (
        lambert(parameters, normal, light) * rough + np.exp(parameters[:, 1:2]) * lobe
    )


def lafortune(parameters: Array, normal: Array, light: Array) -> Array:
    """Lambert's law and one isotropic Lafortune lobe (1997): albedo, both coefficients,
    exponent.
    """
    lit = normal @ light.T
    seen = (normal @ VIEW)[:, None]
    level = lit * seen
    flat = light @ VIEW - level
    across = np.exp(parameters[:, 1:2])
    along = np.exp(parameters[:, 2:3])
    base = np.maximum(along * level - across * flat, 1e-6)
    lobe = base ** np.exp(parameters[:, 3:4]) * np.maximum(lit, 0.0)
    return lambert(parameters, normal, light) + lobe


LAMBERT = Peer("Lambert", lambert, (0.0,))
GGX = Peer("GGX + Lambert", ggx, (-0.2, -1.5, 1.0))
OREN_NAYAR_GGX = Peer("Oren-Nayar + GGX", oren_nayar_ggx, (-0.2, -1.5, 1.0, -3.0))
LAFORTUNE = Peer("Lafortune", lafortune, (-0.2, -0.1, -0.1, 1.5))
PEERS = (LAMBERT, GGX, OREN_NAYAR_GGX, LAFORTUNE)


def fit(peer: Peer, observed: Array, usable: Mask, light: Array, training: Mask) -> Fit:
    """Fit `peer` to observations (n, l) at the training lights; the prediction is for
    all lights.
    """
    normal, albedo = _least_squares(
        observed[:, training], usable[:, training], light[training]
    )
    tangent, bitangent = _tangents(normal)
    start = np.tile(np.array([*peer.start, 0.0, 0.0]), (len(observed), 1))
    start[:, 0] += np.log(albedo)

    def shade(parameters: Array, lights: Array) -> Array:
        return peer.shading(
            parameters[:, :-2], _turned(parameters, normal, tangent, bitangent), lights
        )

    seen = usable[:, training]
    solution = _refine(
        lambda p: shade(p, light[training]), start, observed[:, training], seen
    )
    return Fit(_turned(solution, normal, tangent, bitangent), shade(solution, light))


def mixture(observed: Array, usable: Mask, light: Array, training: Mask) -> Fit:
    """Non-negative mixture of Lambert's law and GGX lobes of fixed widths, with the
    normals of `GGX`.
    """
    normal = fit(GGX, observed, usable, light, training).normal
    count = len(observed)
    columns = [lambert(np.zeros((count, 1)), normal, light)]
    columns += [ggx_lobe(np.full((count, 1), width), normal, light) for width in WIDTHS]
    rows = np.stack(columns, axis=2)
    predicted = np.maximum(observed, 0.0)
    chosen = usable & training
    for _ in range(MIXTURE_ROUNDS):
        root = np.sqrt(_robust_weights(observed, predicted, chosen))
        for i in np.flatnonzero(chosen.any(axis=1)):
            weights, _ = nnls(rows[i] * root[i, :, None], observed[i] * root[i])
            predicted[i] = rows[i] @ weights
    return Fit(normal, predicted)


def _least_squares(observed: Array, usable: Mask, light: Array) -> tuple[Array, Array]:
    """Normals (n, 3) and albedos (n,) by robust photometric stereo (Woodham 1980), the
    start of every fit.
    """
    weight = usable.astype(np.float64)
    scaled = np.zeros((len(observed), 3))
    for _ in range(10):
        matrix = np.einsum("nl,li,lj->nij", weight, light, light)
        matrix += 1e-9 * np.eye(3)
        right = np.einsum("nl,nl,li->ni", weight, observed, light)
        scaled = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
        predicted = np.maximum(scaled @ light.T, 0.0)
        weight = _robust_weights(observed, predicted, usable)
    length = np.maximum(np.linalg.norm(scaled, axis=1), 1e-9)
    normal = scaled / length[:, None]
    normal[:, 2] = np.maximum(normal[:, 2], MIN_COSINE)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True), np.pi * length


def _robust_weights(observed: Array, predicted: Array, usable: Mask) -> Array:
    """Tukey weights of the errors relative to the prediction, over the squared level."""
    level = np.maximum(
        predicted, MIN_LEVEL * predicted.max(axis=1, keepdims=True) + 1e-9
    )
    error = (observed - predicted) / level
    size = np.where(usable, np.abs(error), np.nan)
    scale = 1.4826 * _median_rows(size)[:, None] + MIN_SCALE
    inside = np.maximum(1.0 - (error / (TUKEY * scale)) ** 2, 0.0)
    return np.where(usable, inside**2 / level**2, 0.0)


def _median_rows(values: Array) -> Array:
    """Median of the finite values of each row; 0 for a row without any."""
    ordered = np.sort(values, axis=1)
    count = np.isfinite(values).sum(axis=1)
    middle = np.maximum(count - 1, 0) // 2
    median = ordered[np.arange(len(values)), middle]
    return np.where(count > 0, median, 0.0)


def _refine(
    shade: Callable[[Array], Array], start: Array, observed: Array, usable: Mask
) -> Array:
    """Damped Gauss-Newton steps for every row of parameters (n, p) by itself."""
    solution = start.copy()
    predicted = shade(solution)
    damping = np.full(len(start), 1e-2)
    for _ in range(ROUNDS):
        weight = _robust_weights(observed, predicted, usable)
        strength = weight.sum(axis=1) * observed.max(axis=1) ** 2 + 1e-12
        prior = PRIOR**2 * strength
        slope = _derivatives(shade, solution, predicted)
        gram = np.einsum("nl,nlp,nlq->npq", weight, slope, slope)
        right = np.einsum("nl,nlp,nl->np", weight, slope, observed - predicted)
        right -= prior[:, None] * (solution - start)
        diagonal = np.einsum("npp->np", gram)
        diagonal += prior[:, None] + damping[:, None] * (
            diagonal + 1e-9 * strength[:, None]
        )
        step = np.clip(np.linalg.solve(gram, right[:, :, None])[:, :, 0], -0.5, 0.5)
        trial = shade(solution + step)
        before = (weight * (observed - predicted) ** 2).sum(axis=1) + prior * (
            (solution - start) ** 2
        ).sum(axis=1)
        after = (weight * (observed - trial) ** 2).sum(axis=1) + prior * (
            (solution + step - start) ** 2
        ).sum(axis=1)
        better = after < before
        solution[better] += step[better]
        predicted[better] = trial[better]
        damping = np.where(
            better, np.maximum(damping / 3, 1e-6), np.minimum(damping * 4, 1e4)
        )
    return solution


def _derivatives(
    shade: Callable[[Array], Array], parameters: Array, value: Array
) -> Array:
    columns = []
    for p in range(parameters.shape[1]):
        moved = parameters.copy()
        moved[:, p] += DIFFERENCE
        columns.append((shade(moved) - value) / DIFFERENCE)
    return np.stack(columns, axis=2)


def _tangents(normal: Array) -> tuple[Array, Array]:
    away = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    tangent = np.cross(normal, away)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent, np.cross(normal, tangent)


def _turned(
    parameters: Array, normal: Array, tangent: Array, bitangent: Array
) -> Array:
    moved = normal + parameters[:, -2:-1] * tangent + parameters[:, -1:] * bitangent
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def _fraction(value: Array) -> Array:
    """A number in (0.03, 1) from any real one."""
    return np.asarray(0.03 + 0.97 / (1.0 + np.exp(-value)))
