"""Blur and veiling glare of a lens from a slanted edge between a bright and a dark
surface (after ISO 12233).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, special

from skindb.errors import Fault, InputError

Array = NDArray[np.float64]
# px from the edge that are fitted; farther away the glare is no longer even
EDGE_REACH_PX = 12.0
MIN_SLANT = 0.03  # columns per row; a smaller slant samples too few subpixel positions
MIN_CONTRAST_TO_NOISE = 5.0


@dataclass(frozen=True)
class EdgeFit:
    """Blur of an edge: standard deviation in px, which includes the aperture of the
    pixel, with its standard error.

    `dark` and `bright` are the levels beside the edge, `slant` its columns per row, and
    `mtf50` the frequency in cycles per px at which a Gaussian of this width halves the
    contrast.
    """

    blur: float
    blur_error: float
    dark: float
    bright: float
    slant: float

    @property
    def mtf50(self) -> float:
        """Cycles per px at which exp(-2 (pi f sigma)^2) is one half."""
        return float(np.sqrt(np.log(2) / 2) / (np.pi * self.blur))


def fit_edge(picture: ArrayLike) -> EdgeFit:
    """Width of a nearly vertical edge, by a fit of its position, slant, levels and
    width to all pixels beside it.

    The edge is straight, so that its slant samples the profile more finely than the
    pixels of one row do.

    Parameters
    ----------
    picture
        (height, width) linear signal around one edge that is slanted by 2 to 15 degrees
        from the columns. Transpose the picture of an edge along the rows.

    Raises
    ------
    InputError
        The picture is too small, not finite, has no edge, or the edge is not slanted.
    """
    grey = np.asarray(picture, np.float64)
    if grey.ndim != 2 or min(grey.shape) < 16 or not np.isfinite(grey).all():
        rule = "its picture must be finite and have 16 px or more on each side"
        raise InputError(
            Fault(
                "slanted edge", rule, str(grey.shape), "select more, without saturation"
            )
        )
    start, slant = _locate(grey)
    row, column = np.mgrid[: grey.shape[0], : grey.shape[1]] + 0.5
    middle = grey.shape[0] / 2
    near = np.abs(column - start - slant * (row - middle)) < EDGE_REACH_PX
    row = row[near] - middle
    column = column[near]
    value = grey[near]
    low, high = np.percentile(value, [5, 95])
    sign = 1.0 if np.corrcoef(column, value)[0, 1] > 0 else -1.0

    def residual(p: Array) -> Array:
        way = (column - p[0] - p[1] * row) / np.hypot(1, p[1])
        return np.asarray(p[3] + p[4] * special.ndtr(sign * way / p[2]) - value)

    fit = optimize.least_squares(
        residual,
        [start, slant, 1.0, low, high - low],
        x_scale=[1, 0.1, 1, high - low, high - low],
        bounds=(
            [-np.inf, -1, 0.05, -np.inf, 0],
            [np.inf, 1, EDGE_REACH_PX, np.inf, np.inf],
        ),
    )
    variance = 2 * fit.cost / max(len(value) - 5, 1)
    error = float(np.sqrt(variance * np.linalg.pinv(fit.jac.T @ fit.jac)[2, 2]))
    if not fit.x[4] > MIN_CONTRAST_TO_NOISE * np.sqrt(variance):
        raise InputError(
            _no_edge(
                f"a contrast of {fit.x[4]:.3g} over noise of {np.sqrt(variance):.3g}"
            )
        )
    return EdgeFit(
        float(fit.x[2]),
        error,
        float(fit.x[3]),
        float(fit.x[3] + fit.x[4]),
        float(fit.x[1]),
    )


def veiling_glare(edge: EdgeFit, *, mean: float, contrast: float = 0.0) -> float:
    """Fraction of the light of a frame that the lens spreads evenly over it.

    The dark side reflects `contrast` times the light of the bright side, and the veil
    is added to both: dark = contrast (bright - glare mean) + glare mean. This assumes
    that the veil is as bright as the mean of the frame, as it is for glare much broader
    than the frame; narrower glare beside a large bright surface is overestimated.

    Parameters
    ----------
    edge
        Levels beside the edge.
    mean
        Mean signal of the frame, in the same unit.
    contrast
        Reflectance of the dark surface over that of the bright one; 0 for a light trap.

    Raises
    ------
    InputError
        `mean` is not positive, or `contrast` is not in [0, 1).
    """
    if not (mean > 0 and 0 <= contrast < 1):
        rule = "the mean must be positive, and the contrast at least 0 and below 1"
        raise InputError(
            Fault(
                "veiling glare",
                rule,
                f"{mean:g} and {contrast:g}",
                "measure both on linear frames",
            )
        )
    return float((edge.dark - contrast * edge.bright) / (mean * (1 - contrast)))


def _locate(grey: Array) -> tuple[float, float]:
    """Column of the edge in the middle row, and its columns per row, from the steepest
    position in each row.
    """
    smooth = np.apply_along_axis(np.convolve, 1, grey, np.ones(5) / 5, mode="valid")
    steep = np.abs(smooth[:, 4:] - smooth[:, :-4])
    place = steep.argmax(axis=1) + 4.5
    row = np.arange(grey.shape[0]) + 0.5 - grey.shape[0] / 2
    pairs = np.arange(len(row) // 2)
    # robust slope (Theil)
    slant = float(
        np.median((place[pairs + len(row) // 2] - place[pairs]) / (len(row) // 2))
    )
    start = float(np.median(place - slant * row))
    scatter = float(np.median(np.abs(place - slant * row - start)))
    if steep.max() == 0 or scatter > 2:
        raise InputError(
            _no_edge("a uniform picture" if steep.max() == 0 else "no straight edge")
        )
    if not MIN_SLANT < abs(slant) < 1:
        raise InputError(
            _no_edge(
                f"an edge that is slanted by {np.degrees(np.arctan(slant)):.1f} degrees"
            )
        )
    return start, slant


def _no_edge(found: str) -> Fault:
    rule = "the picture must show one edge that is slanted by 2 to 45 degrees from the columns"
    return Fault(
        "slanted edge",
        rule,
        found,
        "turn the edge by about 5 degrees, and select the edge alone",
    )
