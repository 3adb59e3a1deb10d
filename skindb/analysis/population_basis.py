"""One reduced basis for all takes, and each take's place in it (Weyrich et al. 2005, section 10.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.members import Takes, consenting, left_out
from skindb.errors import Fault, InputError
from skindb.numerics.factorise import nmf
from skindb.numerics.nnls import solve_nnls
from skindb.schema import FitStatus, dataset

Array = NDArray[np.floating[Any]]
METRIC_EXPONENT = 1.0 / 3.0  # of cell values: distances between BRDFs as they are seen


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
    samples = {take: fitted_weights(model, per_take, rng) for take, model in takes.items()}
    X = np.concatenate(list(samples.values()))
    found = nmf(X, min(k, *X.shape), rng=rng)
    metric = brdf_metric(tables)
    means = np.stack([x.mean(axis=0) for x in samples.values()])
    return dataset(
        {"population_weight": found.H, "take_coefficient": project(means, found.H, metric)},
        coords={"basis": names, "take": list(takes)},
        attrs={"nmf_error": found.error, "nmf_spread": found.spread, "left_out": left_out(models)},
    )


def fitted_weights(model: xr.DataTree, count: int, rng: np.random.Generator) -> Array:
    """Weights (n, m) of up to `count` fitted surfels, drawn without replacement."""
    node = model["fitted"].to_dataset()
    good = np.flatnonzero(node["fit_status"].values == FitStatus.FITTED)
    chosen = np.sort(rng.permutation(good)[:count])
    weights = node["basis_weight"].isel(surfel=chosen).values.astype(np.float64)
    return np.asarray(weights[np.isfinite(weights).all(axis=1)])


def brdf_metric(tables: Array) -> Array:
    """Gram matrix (m, m) of the bases over directions.

    Cells count by the measure of their half angle, sin(theta_h) cos(theta_h), and by the inverse of their mean value
    to the power 4/3: differences of cube roots, so that a highlight does not drown the rest.
    """
    cells = tables.reshape(-1, tables.shape[-1]).astype(np.float64)
    theta = np.linspace(0, 1, tables.shape[0]) ** 2 * np.pi / 2
    measure = np.sin(theta) * np.cos(theta) * np.sqrt(theta)  # nodes are uniform in sqrt(theta_h)
    weight = np.repeat(measure, cells.shape[0] // tables.shape[0])
    weight = weight / np.maximum(cells.mean(axis=1), 1e-6) ** (2 - 2 * METRIC_EXPONENT)
    return np.asarray(cells.T @ (cells * weight[:, None]))


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
