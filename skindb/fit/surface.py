"""Surface reflectance per surfel as a mixture of measured BRDFs (Weyrich et al. 2005,
section 7, eq. 7 and 8).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from skindb.elementwise import elementwise
from skindb.fit._surface_arrays import Refit, Tables, refit_weights, surface_weights
from skindb.fit.lumitexels import GEOMETRY
from skindb.fit.sample_noise import noise_inputs, typical_noise
from skindb.parameters import FullMode
from skindb.reflectance.dictionary import Dictionary
from skindb.reflectance.reduction import reduced_dictionary
from skindb.reflectance.rows import Mode
from skindb.reflectance.tables import TableGrid, directional_albedo, kernel_tables
from skindb.schema import check, text_labels
from skindb.types import Array

NEEDED = (*GEOMETRY, "shading_normal", "diffuse_reflectance")
# sr^-1; noise of a sample of dark skin by photons and resampling; that of the sensor may be larger
NOISE_FLOOR_SURFACE = 2e-3
MIN_SAMPLES = 10
FITTED = (  # in the order of `Weights`
    "dictionary_weight",
    "kkt_residual",
    "dictionary_residual",
    "dictionary_residual_perceptual",
    "fit_condition",
    "fit_samples",
    "fit_iterations",
    "fit_status",
)
ERROR_INPUTS = ("diffuse_reflectance_error", "normal_error")
REFITTED = (
    "basis_weight",
    "fit_residual",
    "fit_residual_perceptual",
    "basis_weight_error",
    "surface_reflectance",
    "surface_reflectance_error",
)


def fit_surface(
    lumitexels: xr.Dataset,
    *,
    dictionary: Dictionary,
    mode: FullMode = "perceptual",
    rank: int = 16,
    eta: float = 1.3,
) -> xr.Dataset:
    """Non-negative weights of every BRDF of the dictionary.

    Parameters
    ----------
    lumitexels
        Samples with geometry, `shading_normal` and `diffuse_reflectance`.
    dictionary
        m measured BRDFs, convolved with the discs of the lights.
    mode
        "perceptual" (in cube-root space), "linear" (see
        `skindb.reflectance.rows.fit_reflectance`), or "paper": cube roots of the elements
        are mixed, and the prediction is the cube of the mixture.
    rank
        Rank of the reduced dictionary; m is exact. `rank_omissions` bounds the error of
        a smaller rank.
    eta
        Refractive index of the diffuse term that is subtracted.

    Returns
    -------
    Dataset
        `dictionary_weight`, `kkt_residual`, `fit_iterations`, `fit_samples`,
        `fit_condition`, `dictionary_residual` (RMS of the samples' error over RMS of
        the samples), `dictionary_residual_perceptual` (in cube-root space) and
        `fit_status`; NaN where the status says that nothing was fitted.
    """
    check(lumitexels, NEEDED, where="lumitexels")
    reduced, lift = reduced_dictionary(dictionary, rank, cube_roots=mode == "paper")

    def kernel(*arrays: Array, **params: Any) -> tuple[Array, ...]:
        return tuple(surface_weights(*arrays, **params))

    fitted = elementwise(
        kernel,
        lumitexels,
        over="surfel",
        inputs=NEEDED + noise_inputs(lumitexels),
        outputs=FITTED,
        sizes={"dictionary": len(dictionary.names)},
        tables=Tables(reduced, dictionary.grid, lift),
        eta=eta,
        mode=mode,
        noise_floor=noise_floor(lumitexels),
        noise=typical_noise(lumitexels),
        min_samples=MIN_SAMPLES,
    )
    return fitted.assign_coords(dictionary=text_labels(dictionary.names))


def noise_floor(lumitexels: xr.Dataset) -> float:
    """Level [sr^-1] below which samples are compared linearly: at least the noise of the sensor."""
    check(lumitexels, ("noise_floor",), where="lumitexels")
    return max(NOISE_FLOOR_SURFACE, float(lumitexels["noise_floor"]))


def refit(
    lumitexels: xr.Dataset,
    *,
    basis: xr.Dataset,
    mode: Mode = "perceptual",
    eta: float = 1.3,
) -> xr.Dataset:
    """Non-negative weights of a reduced basis.

    Parameters
    ----------
    lumitexels
        Samples with geometry, `shading_normal` and `diffuse_reflectance`; the errors below count
        `diffuse_reflectance_error` and `normal_error` where they are given.
    basis
        `basis_brdf` of k components, from `reduce_basis`.
    mode, eta
        As in `fit_surface`; not "paper", whose mixtures are not BRDFs that could be reduced.

    Returns
    -------
    Dataset
        `basis_weight`, `fit_residual`, `fit_residual_perceptual` (of all samples,
        diffuse light included); `basis_weight_error`, NaN for weights at their bound 0;
        `surface_reflectance`, the fraction of light along the normal that the mixture
        reflects, and `surface_reflectance_error`. The errors include the noise of the
        samples and the errors of R_d and of the normal, conditional on which weights
        are above 0: they are too small for lobes so sharp that only a few samples see
        them, and for weights that noise moves to their bound.
    """
    check(lumitexels, NEEDED, where="lumitexels")
    known = tuple(name for name in ERROR_INPUTS if name in lumitexels)
    noise = noise_inputs(lumitexels)
    tables = reduced_tables(basis)
    strength = surface_strength(tables)

    def kernel(*arrays: Array, **params: Any) -> tuple[Array, ...]:
        given = len(arrays) - len(known)
        samples = arrays[:given]
        errors = dict(zip(known, arrays[given:], strict=True))
        diffuse = errors.get(
            "diffuse_reflectance_error", np.zeros((len(samples[0]), 3))
        )
        found = refit_weights(
            *samples,
            diffuse_error=diffuse,
            normal_error=errors.get("normal_error"),
            **params,
        )
        variables = refitted_variables(found, strength)
        return tuple(variables[name] for name in REFITTED)

    fitted = elementwise(
        kernel,
        lumitexels,
        over="surfel",
        inputs=NEEDED + noise + known,
        outputs=REFITTED,
        sizes={"component": basis.sizes["component"]},
        tables=tables,
        eta=eta,
        mode=mode,
        noise_floor=noise_floor(lumitexels),
        noise=typical_noise(lumitexels),
        min_samples=MIN_SAMPLES,
    )
    return (
        fitted.assign_coords(component=basis["component"])
        if "component" in basis.coords
        else fitted
    )


def refitted_variables(found: Refit, strength: Array) -> dict[str, Array]:
    """Variables of REFITTED from the results of `refit_weights` for a block of surfels.

    `strength` (k,) is the fraction of light along the normal that each component reflects.
    """
    variance = np.einsum(
        "j,njk,k->n", strength, np.nan_to_num(found.covariance), strength
    )
    return {
        "basis_weight": found.weight,
        "fit_residual": found.residual,
        "fit_residual_perceptual": found.residual_perceptual,
        "basis_weight_error": np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)),
        "surface_reflectance": found.weight @ strength,
        # NaN if no weight is above 0, or if the weights cannot be distinguished
        "surface_reflectance_error": np.sqrt(np.where(variance > 0, variance, np.nan)),
    }


def surface_strength(tables: Tables) -> Array:
    """Fraction (k,) of light along the normal that each component reflects."""
    return np.asarray(directional_albedo(tables.reduced, 1.0)[0])


def reduced_tables(basis: xr.Dataset) -> Tables:
    """The tables of a reduced basis for the kernels."""
    check(basis, ("basis_brdf",), where="basis")
    table = kernel_tables(basis)
    return Tables(table, TableGrid(*table.shape[:3]), np.eye(table.shape[3]))
