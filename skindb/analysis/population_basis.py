"""One reduced basis for all takes, and the coefficients of each take in it (Weyrich et
al. 2005, section 10.1).
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from dask.delayed import Delayed

from skindb.analysis.study import each_item, each_take, skipped_takes
from skindb.errors import Fault, InputError
from skindb.numerics.factorise import Sums, nmf, refine
from skindb.numerics.nnls import solve_nnls
from skindb.reflectance.tables import brdf_metric
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_same_fit
from skindb.types import Array

# of all takes together, from which the starting basis is computed
MAX_START_SURFELS = 5000


def population_basis(
    cohort: xr.Dataset,
    *,
    tables: Array | Delayed,
    k: int = 6,
    in_metric: bool = False,
    mixed_fits: bool = False,
    rng: np.random.Generator,
) -> xr.Dataset:
    """Basis of `k` components for the sampled surfels of all takes: of a person, a set
    of conditions or a population.

    The starting basis is the best of four factorisations of some of the surfels. Every
    later pass reads the surfels take by take and reduces them to sums of a few thousand
    numbers, from which the next basis is computed: memory does not grow with the number
    of takes. Every take has the same weight.

    Parameters
    ----------
    cohort
        ``db.cohort("surfels", surfels=5000)``; all takes fitted with the same dictionary.
    tables
        (nh, nd, np, m) tables of that dictionary [sr^-1], or a Dask object that computes them.
    k
        Number of components; the paper needed 6 for one person in several conditions
        and 8 for a population.
    in_metric
        Minimise the error of BRDFs (`brdf_metric`). By default the error of
        coefficients is minimised, as in the paper.
    mixed_fits
        Accept takes that were fitted with different parameters.
    rng
        Random generator of the sample and of the starts of the factorisation.

    Returns
    -------
    Dataset
        `population_mixture`, `take_coefficient`. Attributes: relative error over all
        surfels, relative error of the starting basis, spread of the errors of the
        sample over the starts, number of passes and surfels, and metric.

    Raises
    ------
    InputError
        If takes were fitted with different parameters or dictionaries, or if a take has
        no fitted surfels.
    """
    if not mixed_fits:
        require_same_fit(cohort)
    names = same_dictionary(cohort)
    takes = [str(take) for take in cohort["take"].values]
    part = max(1, MAX_START_SURFELS // len(takes))
    starts = each_take(
        _fitted_weights,
        cohort.isel(surfel=slice(2 * part)),
        [variables.DICTIONARY_WEIGHT],
    )
    if lost := [
        take for take, weights in zip(takes, starts, strict=True) if not len(weights)
    ]:
        rule = "a take must have fitted surfels"
        cure = "fit it again, or exclude it"
        raise InputError(Fault(f"take {take}", rule, "none", cure) for take in lost)
    X = np.concatenate([rng.permutation(weights)[:part] for weights in starts])
    [metric] = each_item(brdf_metric, [tables])
    start = nmf(
        X,
        min(k, *X.shape),
        metric=metric if in_metric else None,
        rng=rng,
        mapper=each_item,
    )
    A = metric if in_metric else np.eye(X.shape[1])

    def sums_of_takes(H: Array) -> list[Sums]:
        return each_take(_sums, cohort, [variables.DICTIONARY_WEIGHT], H, A)

    H, sums, errors = refine(start.H, sums_of_takes, A)
    means = np.stack(
        each_take(_mean, cohort, [variables.DICTIONARY_WEIGHT, variables.SURFEL_AREA])
    )
    return dataset(
        {
            variables.POPULATION_MIXTURE: H,
            variables.TAKE_COEFFICIENT: project(means, H, metric),
        },
        coords={"dictionary": names, "take": takes},
        attrs={
            "nmf_error": float(errors[-1]),
            "nmf_start_error": float(errors[0]),
            "nmf_spread": start.spread,
            "nmf_passes": len(errors),
            "nmf_surfels": int(sum(part_sums.count for part_sums in sums)),
            "nmf_metric": "brdf" if in_metric else "coefficient",
            "skipped": skipped_takes(cohort),
        },
    )


def _mean(take: xr.Dataset) -> Array:
    """Area-weighted mean (m,) of the weights (n, m) of one take."""
    weights = take[variables.DICTIONARY_WEIGHT].values
    area = take[variables.SURFEL_AREA].values
    good = np.isfinite(weights).all(axis=1)
    return np.asarray(
        np.average(
            weights[good].astype(np.float64),
            axis=0,
            weights=area[good].astype(np.float64),
        )
    )


def _sums(take: xr.Dataset, H: Array, A: Array) -> Sums:
    """Sums of one take for H (k, m) in the metric A (m, m)."""
    return Sums.of(_fitted_weights(take), H, A)


def _fitted_weights(take: xr.Dataset) -> Array:
    """Weights (n, m) of the fitted surfels; a sample with fewer surfels than requested
    is padded with NaN.
    """
    weights = take[variables.DICTIONARY_WEIGHT].values
    return np.asarray(weights[np.isfinite(weights).all(axis=1)].astype(np.float64))


def project(weights: Array, H: Array, metric: Array) -> Array:
    """Non-negative coefficients (n, k) of the BRDFs nearest to `weights` (n, m) in the
    space of H (k, m).
    """
    gram = H @ metric @ H.T
    rhs = weights @ metric @ H.T
    x, _, _, _ = solve_nnls(np.broadcast_to(gram, (len(rhs), *gram.shape)), rhs)
    return x


def same_dictionary(cohort: xr.Dataset) -> list[str]:
    """Names of the BRDFs with which all takes were fitted; raises `InputError` if the
    dictionaries differ.
    """
    if "fit_dictionary" in cohort.coords:
        sources = sorted(
            {str(value) for value in cohort["fit_dictionary"].dropna("take").values}
        )
        if len(sources) > 1:
            rule = "all takes of a population must be fitted with one dictionary"
            raise InputError(
                Fault(
                    "dictionary",
                    rule,
                    ", ".join(sources),
                    "fit them again with the same dictionary",
                )
            )
    return [str(name) for name in cohort["dictionary"].values]
