"""The second pass over the samples: refit by the reduced basis, errors at held-out
samples, outliers.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.fit._surface_arrays import refit_weights
from skindb.fit.held_out import ERRORS
from skindb.fit.outliers import joined_blocks, misfits
from skindb.fit.sample_noise import noise_inputs, typical_noise
from skindb.fit.surface import (
    ERROR_INPUTS,
    MIN_SAMPLES,
    NEEDED,
    noise_floor,
    reduced_tables,
    refitted_variables,
    surface_strength,
)
from skindb.reflectance.rows import Mode
from skindb.schema import check, dataset

SURFELS_PER_BLOCK = 4096  # surfels per task if the samples are not lazy


def refit_and_evaluate(
    lumitexels: xr.Dataset,
    *,
    held_out: xr.Dataset,
    basis: xr.Dataset,
    mode: Mode,
    eta: float,
) -> tuple[xr.Dataset, xr.Dataset]:
    """`refit`, `held_out_error` of lights and of cameras, and `find_outliers`, in one
    pass over the samples.

    Parameters
    ----------
    lumitexels
        All samples with geometry, and `shading_normal`, `diffuse_reflectance` and their errors.
    held_out
        `light_held_out` and `camera_held_out`.
    basis
        `basis_brdf` of k components.
    mode, eta
        As in `refit`.

    Returns
    -------
    fitted, outliers
        Variables of the surfels; and variables of lights, cameras and photographs for
        the fitted samples.
    """
    names = (*NEEDED, *noise_inputs(lumitexels), *ERROR_INPUTS)
    check(lumitexels, names, where="lumitexels")
    held = (
        1 * held_out["light_held_out"].values[:, None]
        + 2 * held_out["camera_held_out"].values[None, :]
    )
    tables = reduced_tables(basis)
    used = lumitexels[list(names)]
    strength = surface_strength(tables)
    judged_at = [
        (i, of)
        for i, of in enumerate(("light", "camera"))
        if held_out[f"{of}_held_out"].any()
    ]
    options: dict[str, Any] = {
        "eta": eta,
        "mode": mode,
        "noise_floor": noise_floor(lumitexels),
    }
    options["noise"] = typical_noise(lumitexels)
    options |= {
        "min_samples": MIN_SAMPLES,
        "held": held.astype(np.int64),
        "outliers": True,
    }

    def judged(block: xr.Dataset) -> tuple[xr.Dataset, NDArray[np.int64]]:
        *samples, diffuse, normal = (block[name].values for name in names)
        found = refit_weights(
            *samples,
            tables=tables,
            diffuse_error=diffuse,
            normal_error=normal,
            **options,
        )
        variables = refitted_variables(found, strength) | {
            "outlier_fraction": found.outlier
        }
        for i, of in judged_at:
            variables |= dict(zip(ERRORS[of], found.held_error[:, i].T, strict=True))
        return dataset(variables), found.counts

    # `elementwise` cannot sum over surfels: a task per block returns its surfels and
    # histograms, which are summed
    blocks = [used.isel(surfel=slice(a, b)) for a, b in pairwise(_cuts(lumitexels))]
    parts, counts = joined_blocks(judged, blocks)
    variables = {
        str(name): np.concatenate([part[name].values for part in parts])
        for name in parts[0].data_vars
    }
    coords = {dim: basis[dim].values for dim in ("component",) if dim in basis.coords}
    kept = {
        dim: np.flatnonzero(held_out[f"{dim}_held_out"].values == 0)
        for dim in ("light", "camera")
    }
    names_of = {
        dim: held_out[dim].values[index]
        for dim, index in kept.items()
        if dim in held_out.coords
    }
    outliers = dataset(
        misfits(counts[np.ix_(kept["light"], kept["camera"])]), coords=names_of
    )
    return dataset(variables, coords=coords), outliers


def _cuts(lumitexels: xr.Dataset) -> NDArray[np.int64]:
    """Boundaries of the blocks of surfels."""
    count = lumitexels.sizes["surfel"]
    if lumitexels["reflectance_sample"].chunks is None:
        return np.append(np.arange(0, max(count, 1), SURFELS_PER_BLOCK), count)
    return np.cumsum([0, *lumitexels.chunksizes["surfel"]])
