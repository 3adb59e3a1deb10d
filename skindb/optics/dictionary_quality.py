"""Quality of the tables of a dictionary: energy, reciprocity, quadrature, interpolation
and holes.
"""

from __future__ import annotations

import numpy as np

from skindb.optics.abc_low2012 import PARAMETERS
from skindb.optics.angles import half_difference
from skindb.optics.brdf_table import directional_albedo, lookup
from skindb.optics.dictionary import (
    Dictionary,
    average_disc,
    convolve_disc,
    evaluate_abc,
    sample_pairs,
    weighted_error,
)
from skindb.types import Array

INCIDENCE = np.radians(np.arange(0, 86, 5))
# rings, spokes; twice as many points change the worst average of the 59 materials by
# 0.6 %
FINE = (24, 72)


def dictionary_quality(
    dictionary: Dictionary, angular_radius: float, *, pairs: int = 6000
) -> dict[str, Array]:
    """Quality measures (m,) of every material; errors are relative, see `weighted_error`.

    Parameters
    ----------
    dictionary
        Tables for point lights, or already averaged over a disc.
    angular_radius
        Angular radius of the lights' disc [rad], for tables of point lights.
    pairs
        Number of pairs of directions to sample, see `sample_pairs`; two in three are
        above the horizon.

    Returns
    -------
    dict
        Measures by name, NaN where one does not apply:

        - normal_albedo, largest_albedo: fraction of light reflected at normal
          incidence, and its maximum up to 85 degrees.
        - energy_excess: largest albedo minus 1 (at least 0), before or after averaging
          over the disc.
        - reciprocity_error: difference of the fitted tables when both directions are exchanged.
        - one_sided_error: difference of the averages over the disc around either
          direction, whose mean is tabulated.
        - disc_quadrature_error: error of the quadrature of `convolve_disc` against FINE.
        - disc_table_error: error of the interpolated tables against FINE.
        - interpolation_error: error of the tables before averaging against their source.
        - hole_fraction: fraction of unmeasured nodes above the horizon.
    """
    fitted = convolve_disc(dictionary, dictionary.disc_angular_radius or angular_radius)
    wi, wo = sample_pairs(pairs)
    there, back = (
        lookup(fitted.table, *half_difference(a, b)) for a, b in ((wi, wo), (wo, wi))
    )
    albedo = directional_albedo(dictionary.table, np.cos(INCIDENCE))
    after = (
        albedo
        if fitted is dictionary
        else directional_albedo(fitted.table, np.cos(INCIDENCE))
    )
    figures = {
        "normal_albedo": albedo[0],
        "largest_albedo": albedo.max(axis=0),
        "energy_excess": np.maximum(np.maximum(albedo, after).max(axis=0) - 1, 0),
        "reciprocity_error": weighted_error(back, there, wi, wo),
    }
    unknown = np.full(len(dictionary.names), np.nan)
    disc = dict.fromkeys(
        ("one_sided_error", "disc_quadrature_error", "disc_table_error"), unknown
    )
    if fitted is not dictionary:
        disc = _disc_errors(dictionary, angular_radius, there, wi, wo)
    figures |= disc | {"interpolation_error": unknown, "hole_fraction": unknown}
    if dictionary.origins:
        figures["interpolation_error"] = np.array(
            [origin.resampling_error for origin in dictionary.origins]
        )
        figures["hole_fraction"] = np.array(
            [origin.hole_fraction for origin in dictionary.origins]
        )
    elif dictionary.names == tuple(PARAMETERS) and not dictionary.disc_angular_radius:
        exact = evaluate_abc(np.array(list(PARAMETERS.values())), wi, wo)
        found = lookup(dictionary.table, *half_difference(wi, wo))
        figures |= {
            "interpolation_error": weighted_error(found, exact, wi, wo),
            "hole_fraction": np.zeros(len(unknown)),
        }
    return figures


def _disc_errors(
    dictionary: Dictionary, angular_radius: float, found: Array, wi: Array, wo: Array
) -> dict[str, Array]:
    """Errors of averaging over the disc; `found` are interpolated values of the tables
    from `convolve_disc`.
    """
    pairs = (wi, wo), (wo, wi)
    used = np.mean(
        [average_disc(dictionary, *pair, angular_radius) for pair in pairs], axis=0
    )
    one, other = (
        average_disc(dictionary, *pair, angular_radius, far=FINE, near=FINE)
        for pair in pairs
    )
    mean = (one + other) / 2
    return {
        "one_sided_error": weighted_error(mean + one - other, mean, wi, wo),
        "disc_quadrature_error": weighted_error(used, mean, wi, wo),
        "disc_table_error": weighted_error(found, mean, wi, wo),
    }
