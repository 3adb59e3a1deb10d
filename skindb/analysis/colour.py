"""Colour of skin in the units of dermatology, from diffuse reflectance R_d.

R_d is linear RGB with the primaries of Rec. 709, and R_d = 1 in all channels is the white
point: tristimulus values are those under the illuminant D65 for the 2 degree observer, as
pictures of `skindb.render` have them.
"""

from collections.abc import Callable

import numpy as np

from skindb.types import Array, float64

STEP = 1e-3  # of derivatives, relative to R_d
MIN_YELLOW = 1.0  # b*, which is 5 to 30 of skin and 0 of grey captures
# lower limit of the individual typology angle [degree], class (Del Bino and Bernerd 2013),
# and the phototype of Fitzpatrick that usually has it
ITA_CLASSES = (
    (55.0, "very light (I)"),
    (41.0, "light (II)"),
    (28.0, "intermediate (III)"),
    (10.0, "tan (IV)"),
    (-30.0, "brown (V)"),
    (-90.0, "dark (VI)"),
)


def cielab(reflectance: Array) -> Array:
    """CIE 1976 L*, a*, b* (..., 3) of R_d (..., 3) under D65; NaN where R_d is."""
    # takes longer to import than most commands of the package to run
    import colour

    reflectance = float64(reflectance)
    is_known = np.isfinite(reflectance).all(axis=-1, keepdims=True)
    xyz = colour.RGB_to_XYZ(np.where(is_known, reflectance, 0.5), "sRGB")
    return np.where(is_known, colour.XYZ_to_Lab(xyz), np.nan)


def typology_angle(reflectance: Array) -> Array:
    """Individual typology angle (...) of R_d (..., 3) [degree]: arctan((L* - 50) / b*)
    (Chardon et al. 1991, International Journal of Cosmetic Science 13, 191); NaN for
    what is as little yellow as no skin.
    """
    lab = cielab(reflectance)
    yellow = np.where(lab[..., 2] > MIN_YELLOW, lab[..., 2], np.nan)
    return np.degrees(np.arctan((lab[..., 0] - 50) / yellow))


def melanin_index(reflectance: Array) -> Array:
    """100 log10(1 / R_red) (...) of R_d (..., 3) (Takiwaki 1998, Journal of Medical
    Investigation 44, 121). Instruments with narrow bands have other values.
    """
    return 100 * _log10(1 / _positive(reflectance)[..., 0])


def erythema_index(reflectance: Array) -> Array:
    """100 log10(R_red / R_green) (...) of R_d (..., 3) (Diffey et al. 1984, British
    Journal of Dermatology 111, 663). Instruments with narrow bands have other values.
    """
    positive = _positive(reflectance)
    return 100 * _log10(positive[..., 0] / positive[..., 1])


def colour_difference(reflectance: Array, baseline: Array) -> Array:
    """CIEDE2000 (...) between R_d (..., 3) of two takes under D65."""
    import colour

    lab, other = cielab(reflectance), cielab(baseline)
    is_known = np.isfinite(lab + other)
    lab, other = (np.where(is_known, part, 0.0) for part in (lab, other))
    difference = colour.delta_E(lab, other, method="CIE 2000")
    return np.where(is_known.all(axis=-1), difference, np.nan)


def typology_class(angle: float) -> str:
    """Class of an individual typology angle [degree], with the phototype that usually
    has it; empty for NaN.
    """
    return next((name for least, name in ITA_CLASSES if angle > least), "")


def propagated(
    function: Callable[[Array], Array], reflectance: Array, error: Array, common: Array
) -> tuple[Array, Array]:
    """Standard errors (...) of a function of R_d (..., 3), to first order.

    Parameters
    ----------
    function
        From R_d (..., 3) to values (...).
    reflectance, error
        (..., 3) R_d, and its standard errors, independent between channels.
    common
        (...) error that all channels have in common.

    Returns
    -------
    tuple
        The error from the independent errors, and the one from the common error.
    """
    reflectance = float64(reflectance)
    slopes = []
    for step in np.eye(3) * STEP:
        h = np.abs(reflectance) * step
        change = function(reflectance + h) - function(reflectance - h)
        slopes.append(change / np.where(h.sum(axis=-1) > 0, 2 * h.sum(axis=-1), np.nan))
    slope = np.stack(slopes, axis=-1)
    return np.linalg.norm(slope * error, axis=-1), np.abs(slope.sum(axis=-1) * common)


def _positive(reflectance: Array) -> Array:
    return np.where(reflectance > 0, reflectance, np.nan)


def _log10(values: Array) -> Array:
    return np.log10(values)
