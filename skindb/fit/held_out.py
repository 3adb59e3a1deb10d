"""Lights and cameras that are held out of a fit, and the error of its predictions for them."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.elementwise import elementwise
from skindb.errors import Fault, InputError
from skindb.fit._surface_arrays import refit_weights
from skindb.fit.plan import FitPlan
from skindb.fit.surface import NEEDED, reduced_tables
from skindb.parameters import FitParameters
from skindb.schema import check, dataset
from skindb.types import Array, Mask

Indices = NDArray[np.intp]
ERRORS = {
    "light": ("held_out_error", "held_out_error_perceptual"),
    "camera": ("held_out_camera_error", "held_out_camera_error_perceptual"),
}


def hold_out(
    capture: xr.DataTree, plan: FitPlan, parameters: FitParameters
) -> xr.Dataset:
    """Choose lights and cameras that are held out of a fit.

    Parameters
    ----------
    capture
        Version of kind "capture".
    plan
        Lights that reach the subject.
    parameters
        Fractions to hold out, and the seed.

    Returns
    -------
    Dataset
        `light_held_out` (light) and `camera_held_out` (camera). Those of kept
        photographs are chosen first, so that a comparison with such a photograph is a
        prediction.
    """
    visible = capture["surfels"].to_dataset()["camera_visible_fraction"]
    # cameras that see no surfel are useless for a test
    seeing = np.ones(visible.sizes["camera"], np.bool_)
    if parameters.hold_out_cameras:
        seeing = (visible.max("surfel") > 0).values
    dark = _drawn(
        capture, "light", plan.lights, parameters.hold_out_lights, [parameters.seed, 0]
    )
    away = _drawn(
        capture, "camera", seeing, parameters.hold_out_cameras, [parameters.seed, 2]
    )
    flags = {
        "light_held_out": np.isin(np.arange(len(plan.lights)), dark),
        "camera_held_out": np.isin(np.arange(len(seeing)), away),
    }
    dome = capture["dome"].to_dataset()
    return dataset(
        flags,
        coords={
            dim: dome[dim].values for dim in ("light", "camera") if dim in dome.coords
        },
    )


def fitted_part(lumitexels: xr.Dataset, held_out: xr.Dataset) -> xr.Dataset:
    """Lumitexels without the lights and cameras that are held out."""
    part = lumitexels
    for dim in ("light", "camera"):
        kept = np.flatnonzero(held_out[f"{dim}_held_out"].values == 0)
        # indexing everything would copy the samples
        part = part if len(kept) == part.sizes[dim] else part.isel({dim: kept})
    return part


def _drawn(
    capture: xr.DataTree, dim: str, useful: Mask, fraction: float, seed: list[int]
) -> Indices:
    """Indices of the useful lights or cameras that are held out: at least one if any, never all."""
    count = int(useful.sum())
    if fraction and count < 2:
        rule = f"to hold out a {dim}, two or more must reach the subject"
        cure = "hold nothing out"
        raise InputError(Fault(f"hold_out_{dim}s", rule, str(count), cure))
    order = np.random.default_rng(seed).permutation(np.flatnonzero(useful))
    if "photographs" in capture.children:
        shown = np.isin(
            order, capture["photographs"].to_dataset()[f"photograph_{dim}"].values
        )
        order = order[np.argsort(~shown, kind="stable")]
    return np.sort(
        order[: min(max(round(fraction * count), int(fraction > 0)), count - 1)]
    )


def held_out_error(
    lumitexels: xr.Dataset, *, basis: xr.Dataset, eta: float = 1.3, of: str = "light"
) -> xr.Dataset:
    """Relative RMS error of predicted samples, per surfel.

    Parameters
    ----------
    lumitexels
        Samples of the lights or cameras that were held out, with geometry,
        `shading_normal`, `diffuse_reflectance` and `basis_weight` of the fit.
    basis
        `basis_brdf` of the weights.
    eta
        Refractive index of the diffuse term.
    of
        "light" or "camera": what was held out.

    Returns
    -------
    Dataset
        `held_out_error` and, in cube-root space, `held_out_error_perceptual`; of
        cameras `held_out_camera_error` and `held_out_camera_error_perceptual`. NaN
        where the surfel has no such sample or nothing was fitted.
    """
    check(lumitexels, (*NEEDED, "basis_weight"), where="lumitexels")

    def kernel(*arrays: Array, **params: Any) -> tuple[Array, ...]:
        *samples, weight = arrays
        found = refit_weights(*samples, weight=weight, **params)
        return found.residual, found.residual_perceptual

    return elementwise(
        kernel,
        lumitexels,
        over="surfel",
        inputs=(*NEEDED, "basis_weight"),
        outputs=ERRORS[of],
        tables=reduced_tables(basis),
        eta=eta,
        mode="linear",
        noise_floor=1.0,  # no fit is made
        min_samples=1,
    )
