"""Detection of surfels whose skin is hidden, for example by hair."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.schema import FitStatus

# Chosen on 23 captures with known truth and tested on 23 others: 59 to 86 % of the
# surfels behind eyebrows and a fringe are found. Of the other surfels 0.4 to 5 % are
# marked, mostly in nostrils, between the lips and at the eyelids.
TIMES_MEDIAN_RESIDUAL = 2.0  # and
# relative, of the fit by the dictionary: strands and their shadows vary between views
MIN_RESIDUAL = 0.1
# relative to the median of the take; hair is opaque, and dark between its strands
MAX_RELATIVE_R_D = 0.7


def find_obstructed(fitted: xr.Dataset) -> NDArray[np.bool_]:
    """Whether something in front of a surfel hides its skin, as hair does.

    Such surfels have large residuals, as no reflectance of a surface explains the
    samples of strands and their shadows, and are darker than the face. Moles, beards
    and dark skin are dark but have small residuals.

    Parameters
    ----------
    fitted
        Group "fitted": `fit_status`, `dictionary_residual`, `diffuse_reflectance`.

    Returns
    -------
    ndarray
        (surfel,) bool; only surfels with the status `FITTED` are marked.

    Examples
    --------
    >>> fitted["fit_status"][find_obstructed(fitted)] = FitStatus.OBSTRUCTED  # doctest: +SKIP
    """
    good = fitted["fit_status"].values == FitStatus.FITTED
    if not good.any():
        return np.asarray(good)
    residual = fitted["dictionary_residual"].values
    brightness = fitted["diffuse_reflectance"].values.mean(axis=1)
    limit = max(TIMES_MEDIAN_RESIDUAL * float(np.median(residual[good])), MIN_RESIDUAL)
    dark = brightness < MAX_RELATIVE_R_D * float(np.median(brightness[good]))
    return np.asarray(good & (residual > limit) & dark)
