"""Error of a fitted model under lights it was not fitted to."""

from __future__ import annotations

import numpy as np
import xarray as xr

from skindb.elementwise import elementwise
from skindb.fit.surface import NEEDED, reduced_tables
from skindb.schema import check


def held_out_error(lumitexels: xr.Dataset, *, basis: xr.Dataset, eta: float = 1.3) -> xr.Dataset:
    """RMS error of predicted samples over RMS of the samples, per surfel.

    Parameters
    ----------
    lumitexels
        Samples of the lights that were held out, with geometry, `shading_normal`, `diffuse_reflectance` and
        `reduced_weight` of the fit.
    basis
        `basis_brdf` the weights refer to.
    eta
        Refractive index of the diffuse term.

    Returns
    -------
    Dataset
        `held_out_error` and, between cube roots, `held_out_error_perceptual`; NaN where no held-out light reaches the
        surfel or nothing was fitted.
    """
    from skindb.fit._arrays import Array, in_batches
    from skindb.fit._surface_kernels import form_rows

    check(lumitexels, (*NEEDED, "reduced_weight"), where="lumitexels")
    tables = reduced_tables(basis)

    def kernel(
        sample: Array, position: Array, light: Array, camera: Array, normal: Array, diffuse: Array, weight: Array
    ) -> tuple[Array, ...]:
        def batch(sample: Array, position: Array, normal: Array, diffuse: Array, weight: Array) -> tuple[Array, ...]:
            rows = form_rows(sample, position, light, camera, normal, diffuse, tables, eta)
            return rows.residuals(weight.astype(np.float64))

        return in_batches(batch, (sample, position, normal, diffuse, weight))

    return elementwise(
        kernel,
        lumitexels,
        over="surfel",
        inputs=(*NEEDED, "reduced_weight"),
        outputs=("held_out_error", "held_out_error_perceptual"),
    )
