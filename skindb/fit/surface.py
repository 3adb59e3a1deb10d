"""Surface reflectance per surfel as a mixture of measured BRDFs (Weyrich et al. 2005, section 7, eq. 7 and 8)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.elementwise import elementwise
from skindb.fit.lumitexels import GEOMETRY
from skindb.schema import check

if TYPE_CHECKING:
    from skindb.fit._surface_kernels import Tables
    from skindb.numerics.nnls import Mode
    from skindb.optics.dictionary import Dictionary

Block = NDArray[Any]
FullMode = Literal["linear", "perceptual", "paper"]
NEEDED = (*GEOMETRY, "shading_normal", "diffuse_reflectance")
NOISE_FLOOR = 2e-3  # sr^-1; what shot noise and resampling leave in a sample of dark skin; the sensor may add more
MIN_SAMPLES = 10
FITTED = (  # in the order of _surface_kernels.Weights
    "basis_weight",
    "kkt_residual",
    "full_basis_residual",
    "full_basis_residual_perceptual",
    "fit_condition",
    "fit_samples",
    "fit_iterations",
    "fit_status",
)
REFITTED = (
    "reduced_weight",
    "fit_residual",
    "fit_residual_perceptual",
    "reduced_weight_error",
    "surface_reflectance",
    "surface_reflectance_error",
)


def fit_surface(
    lumitexels: xr.Dataset, *, dictionary: Dictionary, mode: FullMode = "perceptual", rank: int = 16, eta: float = 1.3
) -> xr.Dataset:
    """Non-negative weights of every BRDF of the dictionary.

    Parameters
    ----------
    lumitexels
        Samples with geometry, `shading_normal` and `diffuse_reflectance`.
    dictionary
        m measured BRDFs, already convolved with the lights' disc.
    mode
        "perceptual" (between cube roots), "linear" (see `skindb.numerics.nnls.fit_reflectance`), or "paper": cube roots
        of the elements, whose only self-consistent prediction is the cube of what the weights mix.
    rank
        Dimensions of the space the rows are formed in; m is exact. What fewer cost: `skindb.plan.with_rank`.
    eta
        Refractive index of the diffuse term that is subtracted.

    Returns
    -------
    Dataset
        `basis_weight`, `kkt_residual`, `fit_iterations`, `fit_samples`, `fit_condition`, `full_basis_residual` (RMS of
        the samples' error over RMS of the samples), `full_basis_residual_perceptual` (between cube roots) and
        `fit_status`; NaN where the status says that nothing was fitted.
    """
    from skindb.fit._surface_kernels import Tables, surface_weights
    from skindb.optics.dictionary import reduced_dictionary

    check(lumitexels, NEEDED, where="lumitexels")
    reduced, lift = reduced_dictionary(dictionary, rank, cube_roots=mode == "paper")

    def kernel(*arrays: Block, **params: Any) -> tuple[Block, ...]:
        return tuple(surface_weights(*arrays, **params))[: len(FITTED)]

    fitted = elementwise(
        kernel,
        lumitexels,
        over="surfel",
        inputs=NEEDED,
        outputs=FITTED,
        sizes={"basis": len(dictionary.names)},
        tables=Tables(reduced, dictionary.grid, lift),
        eta=eta,
        mode=mode,
        noise_floor=noise_floor(lumitexels),
        min_samples=MIN_SAMPLES,
    )
    return fitted.assign_coords(basis=np.asarray(dictionary.names, np.dtypes.StringDType()))


def noise_floor(lumitexels: xr.Dataset) -> float:
    """Samples below it [sr^-1] are compared linearly: the sensor's noise where that is the larger one."""
    return max(NOISE_FLOOR, float(lumitexels.attrs.get("noise_floor", 0.0)))


def refit(lumitexels: xr.Dataset, *, basis: xr.Dataset, mode: Mode = "perceptual", eta: float = 1.3) -> xr.Dataset:
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
        `reduced_weight`, `fit_residual`, `fit_residual_perceptual` (of all samples, diffuse light included);
        `reduced_weight_error`, NaN for weights at their bound 0; `surface_reflectance`, what the mixture reflects of
        light along the normal, and `surface_reflectance_error`. The errors are those of the samples' noise, of R_d and
        of the normal, given which weights are above 0: too small for lobes so sharp that a few samples see them, and
        for weights that noise takes to their bound.
    """
    from skindb.fit._surface_kernels import surface_weights
    from skindb.optics.brdf_table import directional_albedo

    check(lumitexels, NEEDED, where="lumitexels")
    check(basis, ("basis_brdf",), where="basis")

    known = tuple(name for name in ("diffuse_reflectance_error", "normal_error") if name in lumitexels)
    tables = reduced_tables(basis)
    strength = directional_albedo(tables.reduced, 1.0)[0]

    def kernel(*arrays: Block, **params: Any) -> tuple[Block, ...]:
        samples, errors = arrays[: len(NEEDED)], dict(zip(known, arrays[len(NEEDED) :], strict=True))
        diffuse = errors.get("diffuse_reflectance_error", np.zeros((len(samples[0]), 3)))
        found = surface_weights(*samples, diffuse_error=diffuse, normal_error=errors.get("normal_error"), **params)
        error = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        variance = np.einsum("j,njk,k->n", strength, np.nan_to_num(found.covariance), strength)
        reflected = np.sqrt(np.where(variance > 0, variance, np.nan))  # no weight above 0, or none told from another
        weighed = found.weight @ strength
        return found.weight, found.residual, found.residual_perceptual, error, weighed, reflected

    fitted = elementwise(
        kernel,
        lumitexels,
        over="surfel",
        inputs=NEEDED + known,
        outputs=REFITTED,
        sizes={"component": basis.sizes["component"]},
        tables=tables,
        eta=eta,
        mode=mode,
        noise_floor=noise_floor(lumitexels),
        min_samples=MIN_SAMPLES,
    )
    return fitted.assign_coords(component=basis["component"]) if "component" in basis.coords else fitted


def reduced_tables(basis: xr.Dataset) -> Tables:
    """The tables of a reduced basis for the kernels."""
    from skindb.fit._surface_kernels import Tables
    from skindb.optics.brdf_table import TableGrid

    table = basis["basis_brdf"].transpose("theta_h", "theta_d", "phi_d", "component").values.astype(np.float32)
    return Tables(table, TableGrid(*table.shape[:3]), np.eye(table.shape[3]))
