"""One reduced basis for all takes, and each take's place in it (Weyrich et al. 2005, section 10.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.members import Takes, consenting, left_out, nothing_fitted
from skindb.errors import Fault, InputError
from skindb.numerics.factorise import nmf
from skindb.numerics.nnls import solve_nnls
from skindb.optics.brdf_table import brdf_metric
from skindb.schema import FitStatus, dataset

Array = NDArray[np.floating[Any]]


def population_basis(
    models: Takes, *, tables: Array, k: int = 6, per_take: int = 2000, rng: np.random.Generator
) -> xr.Dataset:
    """Basis of `k` components from sampled surfels of every take.

    Parameters
    ----------
    models
        Take -> version of kind "model"; all fitted with the same dictionary.
    tables
        (nh, nd, np, m) tables of that dictionary [sr^-1].
    k
        Components; the paper needed 6 for one person in several conditions and 8 for a population.
    per_take
        Surfels drawn from each take.
    rng
        Of the draws and the factorisation's starts.

    Returns
    -------
    Dataset
        `population_weight`, `take_coefficient`.
    """
    takes = consenting(models)
    names = same_dictionary(takes)
    samples = {take: weights_of(model, draw_fitted(model, per_take, rng)) for take, model in takes.items()}
    X = np.concatenate(list(samples.values()))
    found = nmf(X, min(k, *X.shape), rng=rng)
    metric = brdf_metric(tables)
    means = np.stack([x.mean(axis=0) for x in samples.values()])
    return dataset(
        {"population_weight": found.H, "take_coefficient": project(means, found.H, metric)},
        coords={"basis": names, "take": list(takes)},
        attrs={"nmf_error": found.error, "nmf_spread": found.spread, "left_out": left_out(models)},
    )


def draw_fitted(model: xr.DataTree, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Up to `count` fitted surfels, drawn without replacement, ascending; `InputError` if there is none."""
    node = model["fitted"].to_dataset()
    good = np.flatnonzero(node["fit_status"].values == FitStatus.FITTED)
    if not len(good):
        raise nothing_fitted(model)
    return np.sort(rng.permutation(good)[:count])


def weights_of(model: xr.DataTree, surfels: NDArray[np.int64]) -> Array:
    """Basis weights (n, m) of fitted surfels."""
    return np.asarray(model["fitted"].to_dataset()["basis_weight"].isel(surfel=surfels).values.astype(np.float64))


def project(weights: Array, H: Array, metric: Array) -> Array:
    """Non-negative coefficients (n, k) of the BRDFs nearest to `weights` (n, m) in the space of H (k, m)."""
    gram, rhs = H @ metric @ H.T, weights @ metric @ H.T
    x, _, _, _ = solve_nnls(np.broadcast_to(gram, (len(rhs), *gram.shape)), rhs)
    return x


def same_dictionary(takes: Takes) -> list[str]:
    """Names of the BRDFs all takes were fitted with; `InputError` if they differ."""
    names = {take: tuple(map(str, model["fitted"].to_dataset()["basis"].values)) for take, model in takes.items()}
    first = next(iter(names.values()))
    if other := [take for take, own in names.items() if own != first]:
        rule = "takes of a population must be fitted with one dictionary"
        raise InputError(Fault(", ".join(other), rule, "another dictionary", "fit them again with the same one"))
    return list(first)
