"""Shading normals from the reflectance (Weyrich et al. 2005, section 6)."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.elementwise import elementwise
from skindb.fit._normal_kernels import normals_block
from skindb.fit.lumitexels import GEOMETRY
from skindb.jit import sample_bits
from skindb.parameters import SCAN_ERROR_DEGREES
from skindb.schema import check
from skindb.types import Array, contiguous


def estimate_normals(
    lumitexels: xr.Dataset,
    *,
    eta: float = 1.3,
    scan_error: float = SCAN_ERROR_DEGREES,
) -> xr.Dataset:
    """Unit normals per surfel.

    They are the mean by inverse variance of two estimates by robust photometric stereo: on
    a low quantile over cameras of the mean channel, and on the colour difference of the
    channels, which white highlights do not have.

    Parameters
    ----------
    lumitexels
        Samples with geometry, from `lumitexels`.
    eta
        Refractive index of the Fresnel factors.
    scan_error
        RMS angle of the scan's normals to the true ones [degree], a prior; a large
        value switches it off.

    Returns
    -------
    Dataset
        `shading_normal` (NaN without samples); `normal_error` [degree], the RMS angle due
        to the noise of the samples and the error of the scan: 95 to 97 % of
        the angles lie below 1.73 times it on matte skin, 88 to 95 % on glossy skin,
        where residual highlights rotate normals without visible residuals; and
        `normal_total_error` [degree], three times that, the angle
        between the two estimates, and one degree, in quadrature.

    Notes
    -----
    Fraction of angles below 1.73 times the error, on captures with known truth (16 x
    150, three 8 x 64, two 6 x 32): 22 to 47 % for `normal_error`, 91 to 96 % for
    `normal_total_error`, whose three numbers were chosen on them.
    """
    check(lumitexels, (*GEOMETRY, "surfel_normal"), where="lumitexels")
    return elementwise(
        surfel_normals,
        lumitexels,
        over="surfel",
        inputs=(*GEOMETRY, "surfel_normal"),
        outputs=("shading_normal", "normal_error", "normal_total_error"),
        eta=eta,
        scan_error=scan_error,
    )


def surfel_normals(
    sample: Array,
    position: Array,
    light: Array,
    camera: Array,
    scan: Array,
    *,
    eta: float,
    scan_error: float,
) -> tuple[Array, Array, Array]:
    """(n, 3) normals, standard and total error (n,) [degree]."""
    n = len(position)
    chosen = np.empty((n, 3))
    error, total = np.empty((2, n))
    position, light, camera, scan = (
        contiguous(a) for a in (position, light, camera, scan)
    )
    normals_block(
        sample_bits(sample),
        position,
        light,
        camera,
        scan,
        float(eta),
        float(np.deg2rad(scan_error)),
        chosen,
        error,
        total,
    )
    return chosen, error, total
