"""Error of a fitted model under lights it was not fitted to."""

from __future__ import annotations

from typing import Any

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
    from skindb.fit._surface_kernels import Block, surface_weights

    check(lumitexels, (*NEEDED, "reduced_weight"), where="lumitexels")

    def kernel(*arrays: Block, **params: Any) -> tuple[Block, ...]:
        *samples, weight = arrays
        found = surface_weights(*samples, weight=weight, **params)
        return found.residual, found.residual_perceptual

    return elementwise(
        kernel,
        lumitexels,
        over="surfel",
        inputs=(*NEEDED, "reduced_weight"),
        outputs=("held_out_error", "held_out_error_perceptual"),
        tables=reduced_tables(basis),
        eta=eta,
        mode="linear",
        noise_floor=1.0,  # no fit is made
        min_samples=1,
    )
