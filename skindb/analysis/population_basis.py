"""One reduced basis for all takes, and each take's place in it (Weyrich et al. 2005, section 10.1)."""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import Any

import numpy as np
import xarray as xr
from dask.base import compute
from dask.delayed import delayed
from numpy.typing import NDArray

from skindb.analysis.members import Takes, consenting, left_out, nothing_fitted
from skindb.errors import Fault, InputError
from skindb.numerics.factorise import Sums, nmf, refine
from skindb.numerics.nnls import solve_nnls
from skindb.optics.brdf_table import brdf_metric
from skindb.schema import FitStatus, dataset

Array = NDArray[np.floating[Any]]
BLOCK = 16384  # surfels of a task: 8 MB in double precision, as much again for the solver's Gram matrices
MERGED = 16  # sums added by one task
SAMPLED = 5000  # surfels of all takes together that the start is found from


def population_basis(
    models: Takes, *, tables: Array, k: int = 6, in_metric: bool = False, rng: np.random.Generator
) -> xr.Dataset:
    """Basis of `k` components of every fitted surfel of the takes: a person, a set of conditions, a population.

    Starts from the factorisation of a sample, the best of four starts. Then every pass reads all surfels block by
    block and leaves sums of a few thousand numbers, from which the next basis follows: memory grows neither with
    surfels nor with takes. Every take has the same weight.

    Parameters
    ----------
    models
        Take -> version of kind "model"; all fitted with the same dictionary.
    tables
        (nh, nd, np, m) tables of that dictionary [sr^-1].
    k
        Components; the paper needed 6 for one person in several conditions and 8 for a population.
    in_metric
        Measure the error between BRDFs (`brdf_metric`) instead of between coefficients, the paper's choice.
    rng
        Of the draws and the factorisation's starts.

    Returns
    -------
    Dataset
        `population_weight`, `take_coefficient`. Attributes: relative error of all surfels, that of the start, spread
        of the sample's errors over the starts, passes, surfels, metric.
    """
    takes = consenting(models)
    names = same_dictionary(takes)
    share = max(1, SAMPLED // len(takes))
    X = np.concatenate([weights_of(model, draw_fitted(model, share, rng)) for model in takes.values()])
    metric = brdf_metric(tables)
    start = nmf(X, min(k, *X.shape), metric=metric if in_metric else None, rng=rng)
    A = metric if in_metric else np.eye(X.shape[1])
    H, sums, errors = refine(start.H, lambda H: take_sums(takes, H, A), A)
    means = np.stack([own.mean().total for own in sums])
    return dataset(
        {"population_weight": H, "take_coefficient": project(means, H, metric)},
        coords={"basis": names, "take": list(takes)},
        attrs={
            "nmf_error": float(errors[-1]),
            "nmf_start_error": float(errors[0]),
            "nmf_spread": start.spread,
            "nmf_passes": len(errors),
            "nmf_surfels": int(sum(own.count for own in sums)),
            "nmf_metric": "brdf" if in_metric else "coefficient",
            "left_out": left_out(models),
        },
    )


def take_sums(takes: Takes, H: Array, A: Array) -> list[Sums]:
    """Sums of every take for H (k, m) in the metric A (m, m), all takes in one graph.

    Blocks begin at multiples of BLOCK whatever the chunks are, and merge in a fixed order: chunks and the scheduler
    change rounding at most.
    """
    shared = delayed(H), delayed(A)  # once in the graph
    parts = [_merged(model["fitted"].to_dataset(), *shared) for model in takes.values()]
    return list(compute(*parts))  # type: ignore[no-untyped-call]


def _merged(fitted: xr.Dataset, H: Any, A: Any) -> Any:
    """Delayed sums of a take, as a tree of tasks."""
    used = fitted[["basis_weight", "fit_status"]].reset_coords(drop=True)
    starts = range(0, used.sizes["surfel"], BLOCK)
    parts = [delayed(_block_sums)(used.isel(surfel=slice(i, i + BLOCK)), H, A) for i in starts]
    while len(parts) > 1:
        parts = [delayed(_added)(parts[i : i + MERGED]) for i in range(0, len(parts), MERGED)]
    return parts[0]


def _block_sums(block: xr.Dataset, H: Array, A: Array) -> Sums:
    good = block["fit_status"].values == FitStatus.FITTED
    return Sums.of(block["basis_weight"].values[good].astype(np.float64), H, A)


def _added(parts: list[Sums]) -> Sums:
    return reduce(add, parts)


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
