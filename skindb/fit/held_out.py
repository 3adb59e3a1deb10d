"""What a fit does not see, lights and cameras, and the error of its predictions there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.elementwise import elementwise
from skindb.errors import Fault, InputError
from skindb.fit.surface import NEEDED, reduced_tables
from skindb.plan import Plan
from skindb.schema import check

Indices = NDArray[np.intp]
ERRORS = {
    "light": ("held_out_error", "held_out_error_perceptual"),
    "camera": ("held_out_camera_error", "held_out_camera_error_perceptual"),
}


@dataclass(frozen=True)
class Split:
    """Lumitexels of one take; no sample is in two of them, those of a held-out light and camera are in none."""

    work: xr.Dataset  # what is fitted
    lights: xr.Dataset  # held-out lights, seen by the cameras that are fitted
    cameras: xr.Dataset  # held-out cameras, under the lights that are fitted


def split_take(
    whole: xr.Dataset, capture: xr.DataTree, plan: Plan, *, lights: float, cameras: float, seed: int
) -> Split:
    """Hold a share of the lights and of the cameras out of the surfels of the plan.

    Those of kept photographs go first: a comparison with such a photograph is then a prediction.
    """
    visible = capture["surfels"].to_dataset()["camera_visible_fraction"]
    # a camera that sees no surfel would measure nothing
    seeing = (visible.max("surfel") > 0).values if cameras else np.ones(visible.sizes["camera"], bool)
    dark = _drawn(capture, "light", plan.lights, lights, [seed, 0])
    away = _drawn(capture, "camera", seeing, cameras, [seed, 2])
    lit = np.setdiff1d(np.flatnonzero(plan.lights), dark)
    seen = _taken(whole, "surfel", np.flatnonzero(plan.surfels))
    kept = _taken(seen, "camera", np.setdiff1d(np.arange(len(seeing)), away))
    under = _taken(seen, "light", lit)
    return Split(_taken(kept, "light", lit), kept.isel(light=dark), under.isel(camera=away))


def _taken(whole: xr.Dataset, dim: str, index: Indices) -> xr.Dataset:
    """Part of a Dataset; taking everything by index would cost a copy of the samples."""
    return whole if len(index) == whole.sizes[dim] else whole.isel({dim: index})


def _drawn(capture: xr.DataTree, dim: str, useful: NDArray[np.bool_], share: float, seed: list[int]) -> Indices:
    """What is held out of the useful lights or cameras: at least one if any, never all."""
    count = int(useful.sum())
    if share and count < 2:
        rule, cure = f"a {dim} is held out of two or more that reach the subject", "hold nothing out"
        raise InputError(Fault(f"hold_out_{dim}s", rule, str(count), cure))
    order = np.random.default_rng(seed).permutation(np.flatnonzero(useful))
    if "photographs" in capture.children:
        shown = np.isin(order, capture["photographs"].to_dataset()[f"photograph_{dim}"].values)
        order = order[np.argsort(~shown, kind="stable")]
    return np.sort(order[: min(max(round(share * count), int(share > 0)), count - 1)])


def held_out_error(lumitexels: xr.Dataset, *, basis: xr.Dataset, eta: float = 1.3, of: str = "light") -> xr.Dataset:
    """RMS error of predicted samples over RMS of the samples, per surfel.

    Parameters
    ----------
    lumitexels
        Samples of the lights or cameras that were held out, with geometry, `shading_normal`, `diffuse_reflectance` and
        `reduced_weight` of the fit.
    basis
        `basis_brdf` the weights refer to.
    eta
        Refractive index of the diffuse term.
    of
        "light" or "camera": what was held out.

    Returns
    -------
    Dataset
        `held_out_error` and, between cube roots, `held_out_error_perceptual`; of cameras `held_out_camera_error` and
        `held_out_camera_error_perceptual`. NaN where the surfel has no such sample or nothing was fitted.
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
        outputs=ERRORS[of],
        tables=reduced_tables(basis),
        eta=eta,
        mode="linear",
        noise_floor=1.0,  # no fit is made
        min_samples=1,
    )
