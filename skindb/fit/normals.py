"""Shading normals from the reflectance (Weyrich et al. 2005, section 6)."""

from __future__ import annotations

import xarray as xr

from skindb.elementwise import elementwise
from skindb.fit.lumitexels import GEOMETRY
from skindb.schema import check

METHODS = ("combined", "chromatic", "photometric", "peak")


def estimate_normals(
    lumitexels: xr.Dataset, *, method: str = "combined", eta: float = 1.3, scan_error: float = 3.0
) -> xr.Dataset:
    """Unit normals per surfel.

    Parameters
    ----------
    lumitexels
        Samples with geometry, from `lumitexels`.
    method
        "peak": the paper's rule. "photometric": robust photometric stereo on a low quantile over cameras of the mean
        channel. "chromatic": the same on the colour difference of the channels, which white highlights do not have.
        "combined": mean of the last two by inverse variance; the most exact on captures with known truth.
    eta
        Refractive index of the Fresnel factors.
    scan_error
        Standard deviation of the scan's normals [degree], the prior of all but "peak"; a large value switches it off.

    Returns
    -------
    Dataset
        `shading_normal` (NaN without samples) and `normal_disagreement` [degree], the angle between "peak" and
        "combined": large where the surface has no highlight, or where one of the two has gone wrong.
    """
    from skindb.fit._normal_kernels import normals

    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, not {method!r}")
    check(lumitexels, (*GEOMETRY, "surfel_normal"), where="lumitexels")
    return elementwise(
        normals,
        lumitexels,
        over="surfel",
        inputs=(*GEOMETRY, "surfel_normal"),
        outputs=("shading_normal", "normal_disagreement"),
        method=method,
        eta=eta,
        scan_error=scan_error,
    )
