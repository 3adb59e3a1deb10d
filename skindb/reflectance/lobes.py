"""GGX microfacet lobes (Walter et al. 2007, Heitz 2014), and those of graded widths that
joint fits use and that join the embedded dictionary.
"""

from __future__ import annotations

import numpy as np

from skindb.optics.fresnel import fresnel_reflectance
from skindb.types import Array, unit

# below it values continue, as tables have nodes below the horizon
MIN_COSINE_LOBE = 1e-3
# from nearly even to the narrowest that lights of a dome resolve
GRADED_ROUGHNESS = np.geomspace(0.9, 0.04, 8)
# of skin, 1.40 to 1.45 measured (Ding et al. 2006); the strengths adapt to another one
SURFACE_INDEX = 1.4
GRADED_NAMES = tuple(f"ggx {alpha:.2g}" for alpha in GRADED_ROUGHNESS)


def evaluate_lobe(wi: Array, wo: Array, alpha: Array | float, index: float) -> Array:
    """BRDF (...) [sr^-1] of lobes of strength 1, for unit directions (..., 3) in the local
    frame; cosines are clamped to `MIN_COSINE_LOBE`.

    f = F(theta_d) D(theta_h; alpha) G / (4 cos theta_i cos theta_o), with the exact Fresnel
    reflectance F at a refractive index, the GGX distribution D and the height-correlated
    masking G of Smith.
    """
    light = np.maximum(wi[..., 2], MIN_COSINE_LOBE)
    camera = np.maximum(wo[..., 2], MIN_COSINE_LOBE)
    half = unit(wi + wo)
    square = np.asarray(alpha) ** 2
    spread = square / (np.pi * (half[..., 2] ** 2 * (square - 1) + 1) ** 2)
    shadow = camera * np.sqrt(square + (1 - square) * light**2)
    shadow = shadow + light * np.sqrt(square + (1 - square) * camera**2)
    cos_d = np.clip((half * wi).sum(axis=-1), 0.0, 1.0)
    return fresnel_reflectance(cos_d, index) * spread / (2 * shadow)


def evaluate_graded(wi: Array, wo: Array) -> Array:
    """BRDFs (..., 8) [sr^-1] of strength 1 of the lobes of `GRADED_ROUGHNESS`."""
    lobes = [evaluate_lobe(wi, wo, alpha, SURFACE_INDEX) for alpha in GRADED_ROUGHNESS]
    return np.stack(lobes, axis=-1)
