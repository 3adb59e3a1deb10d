"""Blur and veiling glare of a lens from a slanted edge (after ISO 12233), and its vignette
from frames of an evenly bright surface.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from skindb.errors import require
from skindb.numerics.statistics import robust_deviation
from skindb.types import Float64, Mask, float64

# px from the edge that are fitted; farther away the glare is no longer even
EDGE_REACH_PX = 12.0
MIN_SLANT = 0.03  # columns per row; a smaller slant samples too few subpixel positions
MIN_CONTRAST_TO_NOISE = 5.0
# robust standard deviations; larger deviations are dust or shadows
MAX_DEVIATIONS = 4.0
ROUNDS = 5  # fits, each without the outliers of the previous one
MIN_PIXELS = 100
# of half the image diagonal; with less, the polynomial is extrapolated to the corners
MIN_REACH = 0.6


@dataclass(frozen=True)
class EdgeFit:
    """Blur of an edge: standard deviation in px, which includes the aperture of the
    pixel, with its standard error.

    `dark` and `bright` are the levels beside the edge.
    """

    blur: float
    blur_error: float
    dark: float
    bright: float


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
    grey = float64(picture)
    require(
        min(grey.shape) >= 16 and np.isfinite(grey).all(),
        "slanted edge",
        "its picture must be finite and have 16 px or more on each side",
        str(grey.shape),
        "select more, without saturation",
    )
    start, slant = _locate(grey)
    row, column, value = _pixels_at_edge(grey, start, slant)
    low, high = np.percentile(value, [5, 95])
    sign = 1.0 if np.corrcoef(column, value)[0, 1] > 0 else -1.0

    def residual(p: Float64) -> Float64:
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
    blur, dark, contrast = map(float, fit.x[2:])
    variance = 2 * fit.cost / max(len(value) - 5, 1)
    noise = np.sqrt(variance)
    _require_edge(
        contrast > MIN_CONTRAST_TO_NOISE * noise,
        f"a contrast of {contrast:.3g} over noise of {noise:.3g}",
    )
    error = np.sqrt(variance * np.linalg.pinv(fit.jac.T @ fit.jac)[2, 2])
    return EdgeFit(blur, float(error), dark, dark + contrast)


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
    """
    return (edge.dark - contrast * edge.bright) / (mean * (1 - contrast))


def _locate(grey: Float64) -> tuple[float, float]:
    """Column of the edge in the middle row, and its columns per row, from the steepest
    position in each row.
    """
    smooth = np.apply_along_axis(np.convolve, 1, grey, np.ones(5) / 5, mode="valid")
    steep = np.abs(smooth[:, 4:] - smooth[:, :-4])
    column = steep.argmax(axis=1) + 4.5
    row = np.arange(grey.shape[0]) + 0.5 - grey.shape[0] / 2
    half = len(row) // 2
    # robust slope (Theil)
    slant = float(np.median((column[half : 2 * half] - column[:half]) / half))
    start = float(np.median(column - slant * row))
    scatter = float(np.median(np.abs(column - slant * row - start)))
    degrees = np.degrees(np.arctan(slant))
    _require_edge(steep.max() != 0, "a uniform picture")
    _require_edge(not scatter > 2, "no straight edge")
    _require_edge(
        MIN_SLANT < abs(slant) < 1, f"an edge that is slanted by {degrees:.1f} degrees"
    )
    return start, slant


def _pixels_at_edge(
    grey: Float64, start: float, slant: float
) -> tuple[Float64, Float64, Float64]:
    """Row from the middle one, column and value (n,) of the pixels near an edge."""
    row, column = np.mgrid[: grey.shape[0], : grey.shape[1]] + 0.5
    row -= grey.shape[0] / 2
    near = np.abs(column - start - slant * row) < EDGE_REACH_PX
    return row[near], column[near], grey[near]


def _require_edge(satisfied: object, finding: str) -> None:
    require(
        satisfied,
        "slanted edge",
        "the picture must show one edge that is slanted by 2 to 45 degrees from the columns",
        finding,
        "turn the edge by about 5 degrees, and select the edge alone",
    )


@dataclass(frozen=True)
class Vignette:
    """Coefficients a2, a4, a6 of 1 + a2 r^2 + a4 r^4 + a6 r^6, their covariance (3, 3),
    and the relative root mean square deviation of the frame from the fit.
    """

    coefficients: Float64
    covariance: Float64
    residual: float


def fit_vignette(flat: ArrayLike, centre: ArrayLike) -> Vignette:
    """Vignette of the capture format from a flat frame, by least squares without outliers.

    A gradient of the light across the surface is fitted as well and removed, so that
    the surface may be lit slightly from one side.

    Parameters
    ----------
    flat
        (height, width) linear signal, for example a mean of merged frames; NaN for
        pixels to ignore.
    centre
        (2,) principal point in px: column and row.

    Raises
    ------
    InputError
        Too few pixels are finite and positive, or they do not reach far enough from the
        principal point.
    """
    picture = float64(flat)
    middle = float64(centre)
    row, column = np.nonzero(np.isfinite(picture) & (picture > 0))
    half = np.hypot(*picture.shape) / 2
    x = (column + 0.5 - middle[0]) / half
    y = (row + 0.5 - middle[1]) / half
    r2 = x**2 + y**2
    reach2 = r2.max(initial=0)
    require(
        len(r2) >= MIN_PIXELS and reach2 >= MIN_REACH**2,
        "flat frame",
        f"at least {MIN_PIXELS} pixels must be usable, some of them {MIN_REACH} "
        "half diagonals from the centre",
        f"{len(r2)} pixels, up to {np.sqrt(reach2):.2f} half diagonals",
        "fill the picture with the surface, and avoid saturation",
    )
    value = picture[row, column]
    design = np.stack([np.ones_like(x), x, y, r2, r2**2, r2**3], axis=1)
    solution, residual, inliers = _robust_fit(design, value)
    misfit = float(np.sqrt(np.mean(residual[inliers] ** 2)))
    inverse = misfit**2 * np.linalg.inv(design[inliers].T @ design[inliers])
    level = solution[0]
    coefficients = solution[3:] / level
    # covariance of the ratio of the coefficients to the level at the centre
    by_level = -coefficients[:, None] / level
    slope = np.hstack([by_level, np.zeros((3, 2)), np.eye(3) / level])
    covariance = slope @ inverse @ slope.T
    return Vignette(coefficients, covariance, misfit / abs(level))


def _robust_fit(design: Float64, value: Float64) -> tuple[Float64, Float64, Mask]:
    """Coefficients of the columns (n, k) that fit values (n,), residuals (n,), and which
    of the values are not outliers.
    """
    inliers = np.ones(len(value), bool)
    for _ in range(ROUNDS):
        solution = np.linalg.lstsq(design[inliers], value[inliers], rcond=None)[0]
        residual = value - design @ solution
        spread = float(robust_deviation(residual[inliers]))
        limit = MAX_DEVIATIONS * max(spread, 1e-12 * abs(solution[0]))
        inliers = np.abs(residual) <= limit
    return float64(solution), residual, np.asarray(inliers)
