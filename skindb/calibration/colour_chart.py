"""Colour matrix of a camera from a photographed colour chart and its reference values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from skindb.errors import require
from skindb.types import Float64, Mask

# the manufacturer's reference values, as in colour-science
CHART = "ColorChecker24 - After November 2014"
# usable patches for nine unknowns; three channels leave residuals for the standard
# error
MIN_PATCHES = 9


@dataclass(frozen=True)
class ColourFit:
    """Colour matrix of the capture format, and CIEDE2000 differences (patch,) before and after it.

    `error` (3, 3) is the standard error of the matrix by the scatter of the patches. A
    patch that is not used has a NaN in the differences.
    """

    matrix: Float64
    error: Float64
    delta_e_before: Float64
    delta_e_after: Float64


def chart_reference() -> Float64:
    """Linear sRGB (24, 3) of the ColorChecker under D65, row by row, by chromatic
    adaptation from D50.
    """
    import colour  # takes longer to import than the rest of the ingest

    chart = colour.CCS_COLOURCHECKERS[CHART]
    tristimulus = colour.xyY_to_XYZ(np.array(list(chart.data.values())))
    return np.asarray(
        colour.XYZ_to_sRGB(
            tristimulus, illuminant=chart.illuminant, apply_cctf_encoding=False
        )
    )


def fit_colour_matrix(
    patches: ArrayLike, reference: ArrayLike | None = None
) -> ColourFit:
    """Matrix that takes linear camera values to linear sRGB, by least squares over the
    patches (Cheung et al. 2004).

    The green of the white patch keeps its value, so that the unit of radiance stays
    that of the white target.

    Parameters
    ----------
    patches
        (patch, 3) mean radiance of each patch over that of a white surface in its
        place, so that uneven light is divided out; NaN where a patch was saturated.
    reference
        (patch, 3) linear sRGB; default `chart_reference()`. The brightest patch is the white one.

    Raises
    ------
    InputError
        Wrong shapes, too few usable patches, an unusable white patch, or patches of one colour.
    """
    values = np.asarray(patches, np.float64)
    target = (
        chart_reference() if reference is None else np.asarray(reference, np.float64)
    )
    require(
        values.shape == target.shape and values.shape[1:] == (3,),
        "colour chart",
        "its values must have the shape (patch, 3) of the reference",
        f"{values.shape} and {target.shape}",
        "give the patches row by row",
    )
    good: Mask = np.asarray(np.isfinite(values).all(axis=1))
    white = int(target.sum(axis=1).argmax())
    usable = good.sum() >= MIN_PATCHES and good[white] and values[white, 1] > 0
    require(
        usable and np.linalg.cond(values[good]) <= 1e4,
        "colour chart",
        f"{MIN_PATCHES} patches of different colours must be usable, the white one "
        "among them",
        f"{int(good.sum())} usable patches",
        "expose the chart shorter",
    )
    scale = target[white, 1] / values[white, 1]
    camera = values[good] * scale
    solution, *_ = np.linalg.lstsq(camera, target[good], rcond=None)
    residual = target[good] - camera @ solution
    variance = (residual**2).sum(axis=0) / max(len(camera) - 3, 1)
    error = np.sqrt(variance[:, None] * np.diag(np.linalg.inv(camera.T @ camera)))
    level = float(camera[good[:white].sum()] @ solution[:, 1]) / target[white, 1]
    before = np.full(len(values), np.nan)
    after = np.full(len(values), np.nan)
    before[good] = _difference(camera, target[good])
    after[good] = _difference(camera @ solution, target[good])
    return ColourFit(solution.T / level, error / level, before, after)


def _difference(measured: Float64, expected: Float64) -> Float64:
    """CIEDE2000 (n,) between linear sRGB colours (n, 3)."""
    import colour

    lab = [
        colour.XYZ_to_Lab(colour.sRGB_to_XYZ(c, apply_cctf_decoding=False))
        for c in (measured, expected)
    ]
    return np.asarray(colour.delta_E(*lab, method="CIE 2000"))
