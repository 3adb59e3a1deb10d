"""Reduced basis of a person: NMF of the surface weights (Weyrich et al. 2005, sections
7 and 10.1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.errors import Fault, InputError
from skindb.numerics.factorise import nmf
from skindb.reflectance.tables import brdf_coords, brdf_metric, stored_brdf
from skindb.schema import FitStatus, check, dataset

if TYPE_CHECKING:
    from skindb.reflectance.dictionary import Dictionary

MAX_SAMPLED_SURFELS = 5000  # surfels, as in the paper's basis of one person
SEEDS = 3
PART = 65536  # surfels


def reduce_basis(
    fitted: xr.Dataset,
    *,
    dictionary: Dictionary,
    rng: np.random.Generator,
    k: int = 4,
    in_metric: bool = False,
) -> xr.Dataset:
    """Basis of k mixtures of the dictionary's BRDFs for the surface reflectance of the surfels.

    Parameters
    ----------
    fitted
        `dictionary_weight`, `fit_status` and `surfel_area` of one or more takes.
    dictionary
        The BRDFs `dictionary_weight` refers to.
    rng
        Selects the 5,000 surfels that are factorised, and initialises the factorisation.
    k
        Number of components, at most the number of fitted surfels and of BRDFs.
    in_metric
        Measure the error between BRDFs (`brdf_metric`) instead of coefficients (the
        choice of the paper). On three virtual takes, linear refits had a residual above
        that of the dictionary by 1.4, 2.9 and 5.4 % with k = 4 (coefficients: 3.2, 3.8
        and 4.0 %), and by 0.5, 1.1 and 0.7 % with k = 8 (coefficients: 1.0, 1.8 and 2.5
        %). Coefficients were better with k = 2 (two takes), the metric from k = 6; with
        k = 4 it depends on the take.

    Returns
    -------
    Dataset
        `basis_mixture` (rows of H), `basis_brdf`, `mean_dictionary_weight` (area
        weighted) and `disc_angular_radius` [rad] of the dictionary. Attributes: error
        and spread of the factorisation over its seeds, surfels used, metric.
    """
    check(fitted, ("dictionary_weight", "fit_status", "surfel_area"), where="fitted")
    good = _fitted_surfels(fitted)
    weight = fitted["dictionary_weight"].values
    area = np.maximum(fitted["surfel_area"].values.astype(np.float64), 0) + 1e-12
    most = min(len(good), weight.shape[1])
    if not 1 <= k <= most:
        raise InputError(
            Fault(
                "k",
                f"a reduced basis has 1 to {most} components here",
                str(k),
                "choose another k",
            )
        )
    chosen = good[
        np.sort(
            rng.choice(len(good), min(MAX_SAMPLED_SURFELS, len(good)), replace=False)
        )
    ]
    metric = brdf_metric(dictionary.table) if in_metric else None
    factors = nmf(
        weight[chosen].astype(np.float64), k, metric=metric, seeds=SEEDS, rng=rng
    )
    # in parts: a million surfels in double precision would take half a gigabyte
    parts = (good[i : i + PART] for i in range(0, len(good), PART))
    total = np.sum(
        [area[part] @ weight[part].astype(np.float64) for part in parts], axis=0
    )
    tables = dictionary.table @ factors.H.T.astype(np.float32)
    names = [f"component{i}" for i in range(k)]
    return dataset(
        {
            "basis_mixture": factors.H,
            "basis_brdf": stored_brdf(tables),
            "mean_dictionary_weight": total / area[good].sum(),
            "disc_angular_radius": dictionary.disc_angular_radius,
        },
        coords={
            "dictionary": list(dictionary.names),
            "component": names,
            **brdf_coords(dictionary.grid),
        },
        attrs={
            "nmf_error": factors.error,
            "nmf_spread": factors.spread,
            "nmf_surfels": len(chosen),
            "nmf_metric": "brdf" if in_metric else "coefficient",
            "dictionary": dictionary.source,
        },
    )


def _fitted_surfels(fitted: xr.Dataset) -> NDArray[np.int64]:
    """Indices of the surfels whose every stage was fitted."""
    good = (fitted["fit_status"].values == FitStatus.FITTED) & np.isfinite(
        fitted["dictionary_weight"].values
    ).all(1)
    if not good.any():
        status, count = np.unique(fitted["fit_status"].values, return_counts=True)
        counts_by_status = ", ".join(
            f"{n} {FitStatus(s).name.lower()}"
            for s, n in zip(status, count, strict=True)
        )
        cure = "add lights and cameras, or hold fewer out"
        raise InputError(
            Fault(
                "fitted[fit_status]",
                "a basis needs fitted surfels",
                counts_by_status,
                cure,
            )
        )
    return np.flatnonzero(good)
