"""Likely causes of the difference between a photograph and its rendering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
# of the median of lit pixels; darker pixels of the rendering are in shadow
LIT_FRACTION = 0.05
MIN_PIXELS = 50  # of a class, below which its measure is NaN
SMOOTHING = 1.0  # px, standard deviation of the filter on rendering and residual
MAX_SHIFT = 2.0  # px, above which the linear estimate is invalid
# thresholds above which a cause is reported: chosen by judgement. On a virtual face
# without imperfections only gloss was reported
NOTABLE_SHIFT = 0.25  # px
NOTABLE_GAIN = 0.03
# fraction of the lit skin; ideal virtual captures reach 0.02 where light grazes the
# face
NOTABLE_SHADOW = 0.03
NOTABLE_HIGHLIGHT = 0.1  # fraction of the highlights
# fraction of the squared residual in surfels that are obstructed or doubtful
NOTABLE_DOUBTFUL = 0.25
# part of the rendering that the surface must reflect for a pixel to be in a highlight
HIGHLIGHT_FRACTION = 0.3


@dataclass(frozen=True)
class Causes:
    """Measures of a residual, each with its likely cause; NaN where there are too few pixels.

    Attributes
    ----------
    shift
        (2,) translation of the rendering [px, right and down] that explains most of the
        residual. Cause: calibration of the camera, or motion.
    gain
        Photograph over rendering where skin is lit. Cause: intensity of the light.
    shadow
        Mean photograph in shadow over the mean of lit skin. Cause: light from other
        parts of the face or the room.
    highlight
        Photograph over rendering in highlights, after this gain. Cause: gloss, or normals.
    doubtful
        Fraction of the squared residual in surfels whose fit is doubtful or obstructed.
        Cause: hair, eyes.
    """

    shift: tuple[float, float]
    gain: float
    shadow: float
    highlight: float
    doubtful: float

    @property
    def notable(self) -> list[str]:
        """Descriptions of the causes whose measures exceed their thresholds."""
        words = []
        if abs(self.gain - 1) > NOTABLE_GAIN:
            words.append(f"intensity of the light ({100 * (self.gain - 1):+.0f} %)")
        if np.hypot(*self.shift) > NOTABLE_SHIFT:
            words.append(
                f"calibration of the camera or motion ({np.hypot(*self.shift):.1f} px)"
            )
        if self.shadow > NOTABLE_SHADOW:
            words.append(
                "light between parts of the face or of the room "
                f"({100 * self.shadow:.0f} % in shadow)"
            )
        if abs(self.highlight - 1) > NOTABLE_HIGHLIGHT:
            words.append(
                f"gloss or normals ({100 * (self.highlight - 1):+.0f} % in highlights)"
            )
        if self.doubtful > NOTABLE_DOUBTFUL:
            words.append(
                f"hair, eyes or doubtful fits ({100 * self.doubtful:.0f} % of the residual)"
            )
        return words


def find_causes(
    photographed: Image, rendered: Image, surface: Image, *, mask: Mask, doubtful: Image
) -> Causes:
    """Measures of the residual of one photograph.

    Parameters
    ----------
    photographed, rendered, surface
        (h, w, 3) radiance: photograph, rendering, and the part of the rendering that
        the surface reflects.
    mask
        (h, w) pixels that are compared.
    doubtful
        (h, w) fraction, from 0 to 1, of the pixel that shows surfels whose fit is
        doubtful or obstructed.
    """
    photo, ours, gloss = (
        np.where(mask, image.mean(axis=-1), 0.0)
        for image in (photographed, rendered, surface)
    )
    inside = ndimage.binary_erosion(mask, iterations=2)
    lit = inside & (
        ours
        > LIT_FRACTION
        * (np.median(ours[inside & (ours > 0)]) if (inside & (ours > 0)).any() else 0.0)
    )
    lit &= ours > 0
    if lit.sum() < MIN_PIXELS:
        return Causes((np.nan, np.nan), np.nan, np.nan, np.nan, np.nan)
    shiny = gloss > HIGHLIGHT_FRACTION * ours
    matte = lit & ~shiny
    used = matte if matte.sum() >= MIN_PIXELS else lit
    # the median is robust to hair and eyes
    gain = float(np.median(photo[used] / ours[used]))
    residual = photo - gain * ours
    dark = inside & (ours <= LIT_FRACTION * np.median(ours[lit]))
    shadow = (
        float(photo[dark].mean() / photo[lit].mean())
        if dark.sum() >= MIN_PIXELS
        else np.nan
    )
    bright = lit & shiny
    highlight = (
        float(photo[bright].sum() / (gain * ours[bright].sum()))
        if bright.sum() >= MIN_PIXELS
        else np.nan
    )
    square = np.where(inside, residual**2, 0.0)
    fraction = (
        float((square * doubtful).sum() / square.sum()) if square.sum() > 0 else 0.0
    )
    return Causes(_shift(residual, gain * ours, lit), gain, shadow, highlight, fraction)


def _shift(residual: Image, ours: Image, lit: Mask) -> tuple[float, float]:
    """Translation (right, down) [px] of the rendering that fits the residual best
    (Lucas and Kanade 1981).
    """
    smooth = ndimage.gaussian_filter(ours, SMOOTHING)
    down, right = np.gradient(smooth)
    rest = ndimage.gaussian_filter(residual, SMOOTHING)
    weight = (
        lit / np.maximum(smooth, 1e-3 * smooth.max()) ** 2
    )  # relative errors, so that dark and bright skin weigh the same
    design = np.stack([right[lit], down[lit]], axis=1)
    normal = (design * weight[lit][:, None]).T @ design
    if np.linalg.cond(normal) > 1e6:
        return np.nan, np.nan
    # a translation by (x, y) changes the picture by minus its gradient times (x, y)
    x, y = np.linalg.solve(normal, -(design * weight[lit][:, None]).T @ rest[lit])
    length = float(np.hypot(x, y))
    return (
        (float(x), float(y))
        if length <= MAX_SHIFT
        else (float(x) * MAX_SHIFT / length, float(y) * MAX_SHIFT / length)
    )
