"""Reduction of a dictionary, linearly or to a basis of few non-negative mixtures.

- To a linear space of few dimensions (`reduce_dictionary`), with bounds on the error that
  this causes in mixtures.
- To a basis (Weyrich et al. 2005, sections 7 and 10.1) by NMF of the weights of one take
  (`reduce_basis`), or directly from the reflectance of many (`factor_reflectance`).

Weights of many similar BRDFs are not unique, so a factorisation of fitted weights may
not represent the reflectance well. In `factor_reflectance`, the rows of H minimise the
residual of the samples: sum over surfels s of |M_s H' w_s - r_s|^2, with w_s and H
non-negative, by non-negative least squares on the normal equations of the surfels.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.optimize import minimize

from skindb.cache import cached_arrays
from skindb.errors import input_error, require
from skindb.numerics.factorise import nmf, unit_sum
from skindb.numerics.nnls import solve_nnls
from skindb.optics.angles import directions
from skindb.reflectance.dictionary import SOURCES, Dictionary
from skindb.reflectance.tables import (
    Table,
    TableGrid,
    brdf_coords,
    brdf_metric,
    stored_brdf,
)
from skindb.schema import FitStatus, check, dataset
from skindb.types import AnyArray, Array, Index, dots, finite_rows, float64

FRANK_WOLFE_STEPS = 200  # each step gives a valid bound; 500 steps lower it by 1 %
MAX_SAMPLED_SURFELS = 5000  # surfels, as in the paper's basis of one person
SEEDS = 3
PART = 65536  # surfels
STEPS = 100  # iterations of the descent after every change of size
POLISH = 40  # iterations of the last descent, in the full space of the BRDFs
# number of merges tried per size: with the cheapest alone, the error was 0.7 % above a
# planted basis
MERGES = 3
# fraction of surfels whose mean weights start a new component, so that no single
# outlier does
WORST = 0.02
# dimensions of the linear space used while searching for H; with 16, narrow lobes are
# not found
SPACE = 24


def reduce_dictionary(
    table: Table, rank: int, *, exact: int = 0
) -> tuple[Table, Array]:
    """Linear space that is nearest to the m tables: the last `exact` of them, and `rank`
    more dimensions.

    Parameters
    ----------
    table
        (nh, nd, np, m) sr^-1.
    rank
        Number of dimensions; with m - exact or more, the tables are returned unchanged.
    exact
        Number of tables, the last ones, that are kept.

    Returns
    -------
    reduced, lift
        (nh, nd, np, r) float32 and (r, m), r = rank + exact, such that reduced @ lift
        approximates the table by weighted least squares. All materials have the same
        weight (each is scaled to unit norm), cells that of `_cell_weight`.

    Notes
    -----
    For the embedded dictionary, convolved with a disc of 0.8 degrees, over all pairs of
    directions above 6 degrees, the error at rank 16 is 0.2 % rms for the median
    material and 1.2 % for the worst (0.6 and 1.8 % without the lobes; with the inverse
    root of the mean alone, the worst is 29 %). Fits of
    mixtures of the materials with 5 % noise have 0.25 % more residual than at full rank.
    """
    m = table.shape[-1] - exact
    if rank >= m:
        return table, np.eye(m + exact)
    cells = float64(table.reshape(-1, m + exact))
    kept = cells[:, m:]
    cells = cells[:, :m]
    weight = _cell_weight(cells.mean(axis=1), TableGrid(*table.shape[:3]))[:, None]
    norm = np.linalg.norm(cells * weight, axis=0)
    scale = 1.0 / np.where(norm > 0, norm, 1.0)
    # of each table the part that the exact ones explain
    explained = np.linalg.lstsq(kept * weight, cells * weight * scale)[0]
    cells = cells * scale - kept @ explained
    _, vectors = np.linalg.eigh((cells * weight**2).T @ cells)
    vectors = vectors[:, ::-1][:, :rank]
    reduced = np.concatenate([cells @ vectors, kept], axis=1, dtype=np.float32)
    lift = np.zeros((rank + exact, m + exact))
    lift[:rank, :m] = vectors.T / scale
    lift[rank:, :m] = explained / scale
    lift[rank:, m:] = np.eye(exact)
    return reduced.reshape(*table.shape[:-1], rank + exact), lift


def _cell_weight(mean: Array, grid: TableGrid) -> Array:
    """Weights of cells (nh nd np,) in the error of a reduction, from their mean over materials.

    The inverse root of the mean is a compromise between absolute accuracy, which
    highlights dominate, and relative accuracy, which noise dominates. The fourth root
    of the measure of direction pairs is a compromise between equal weights of cells and
    of samples. Cells with a direction below 3 degrees, which fits exclude, have no
    weight.
    """
    th, td, pd = np.meshgrid(grid.theta_h, grid.theta_d, grid.phi_d, indexing="ij")
    wi, wo = directions(th, td, pd)
    # d omega_i d omega_o = 4 cos(theta_d) d omega_h d omega_d; d theta_h = 2
    # sqrt(theta_h) d sqrt(theta_h)
    pairs = np.sin(th) * np.sqrt(np.maximum(th, 1e-4)) * np.sin(td) * np.cos(td) + 1e-6
    measure = np.maximum(wi[..., 2] * wo[..., 2], 0.0) * pairs
    measure[np.minimum(wi[..., 2], wo[..., 2]) < 0.05] = 0.0
    return measure.ravel() ** 0.25 / np.sqrt(np.maximum(mean, 1e-6))


@lru_cache(maxsize=2)
def reduced_dictionary(dictionary: Dictionary, rank: int) -> tuple[Table, Array]:
    """`reduce_dictionary` of the tables; cached for the takes of a dome."""

    def make() -> dict[str, AnyArray]:
        reduced, lift = reduce_dictionary(
            dictionary.table, rank, exact=dictionary.exact
        )
        return {"reduced": reduced, "lift": lift}

    # without a reduction, the result is not worth the space in the cache
    if rank >= len(dictionary.names) - dictionary.exact:
        arrays = make()
        return arrays["reduced"], arrays["lift"]
    arguments = (dictionary.digest, rank)
    cached = cached_arrays("reduced-dictionary", arguments, sources=SOURCES, make=make)
    return cached["reduced"], cached["lift"]


def truncation_bound(table: Table, reduced: Table, lift: Array) -> float:
    """Bound of the RMS error of any mixture sum_j x_j b_j, x >= 0, that is formed from reduced
    tables, relative to the mixture: over pairs of directions, in cube-root space (the
    metric of `brdf_metric`).

    Parameters
    ----------
    table
        (nh, nd, np, m) b_j >= 0 on the nodes of a `TableGrid` [sr^-1].
    reduced, lift
        (nh, nd, np, r) and (r, m) from `reduce_dictionary`.

    Notes
    -----
    Let e_j = b_j - (reduced lift)_j. The ratio of two sums over j is at most the
    largest ratio of their terms. As ``|sum x_j b_j| >= sum x_j <u, b_j>`` for every unit
    vector u, ``|sum x_j e_j| / |sum x_j b_j|`` is at most ``max_j |e_j| / <u, b_j>``. The
    best u points to the point nearest to 0 of the simplex of all ``b_j / |e_j|``, which
    the method of Frank and Wolfe approaches; every step gives a bound.
    """
    error = (table - reduced @ lift).astype(np.float32)
    if not error.any():
        return 0.0
    length = np.sqrt(np.diag(brdf_metric(error, weighted_like=table)))
    return _largest_ratio(brdf_metric(table), length)


@lru_cache(maxsize=4)
def rank_truncation(dictionary: Dictionary, rank: int) -> float:
    """`truncation_bound` of `reduced_dictionary`; cached for the takes of a dome."""

    def make() -> dict[str, AnyArray]:
        reduced = reduced_dictionary(dictionary, rank)
        return {"bound": np.array(truncation_bound(dictionary.table, *reduced))}

    arguments = (dictionary.digest, rank)
    cached = cached_arrays("truncation", arguments, sources=SOURCES, make=make)
    return float(cached["bound"])


def _largest_ratio(gram: Array, length: Array) -> float:
    """Upper bound of sum x_j length_j / |sum x_j b_j| over x >= 0; the Gram matrix (m,
    m) of the b_j is >= 0.
    """
    wrong = length > 0
    if not wrong.any():
        return 0.0
    scaled = gram[np.ix_(wrong, wrong)] / np.outer(length[wrong], length[wrong])
    point = np.zeros(len(scaled))
    point[np.argmin(np.diag(scaled))] = 1.0
    reached = 0.0
    for _ in range(FRANK_WOLFE_STEPS):
        inner = scaled @ point
        reached = max(reached, float(inner.min() / np.sqrt(point @ inner)))
        way = -point
        way[np.argmin(inner)] += 1.0
        curvature = way @ scaled @ way
        if curvature <= 0:
            break
        point = point + float(np.clip(-(way @ inner) / curvature, 0.0, 1.0)) * way
    return 1.0 / reached if reached > 0 else float("inf")


def reduce_basis(
    fitted: xr.Dataset,
    *,
    dictionary: Dictionary,
    rng: np.random.Generator,
    k: int = 4,
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

    Returns
    -------
    Dataset
        `basis_mixture` (rows of H), `basis_brdf`, `mean_dictionary_weight` (area
        weighted) and `disc_angular_radius` [rad] of the dictionary. Attributes: error
        and spread of the factorisation over its seeds, surfels used.
    """
    check(fitted, ("dictionary_weight", "fit_status", "surfel_area"), where="fitted")
    good = fitted_surfels(fitted, ("dictionary_weight",))
    weight = fitted["dictionary_weight"].values
    area = np.maximum(float64(fitted["surfel_area"].values), 0) + 1e-12
    limit = min(len(good), weight.shape[1])
    require(
        1 <= k <= limit,
        "k",
        f"a reduced basis has 1 to {limit} components here",
        str(k),
        "choose another k",
    )
    count = min(MAX_SAMPLED_SURFELS, len(good))
    chosen = good[np.sort(rng.choice(len(good), count, replace=False))]
    # of coefficients, the choice of the paper: errors between BRDFs (`brdf_metric`) gave
    # larger residuals with k = 2, smaller ones from k = 6, and either with k = 4
    factors = nmf(float64(weight[chosen]), k, seeds=SEEDS, rng=rng)
    tables = dictionary.table @ factors.H.T.astype(np.float32)
    names = [f"component{i}" for i in range(k)]
    return dataset(
        {
            "basis_mixture": factors.H,
            "basis_brdf": stored_brdf(tables),
            "mean_dictionary_weight": _mean_weight(weight, area, good),
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
            "dictionary": dictionary.source,
        },
    )


def _mean_weight(weight: Array, area: Array, good: Index) -> Array:
    """Mean (m,) of the weights (n, m) of some surfels, weighted by area (n,)."""
    # in parts: a million surfels in double precision would take half a gigabyte
    parts = (good[i : i + PART] for i in range(0, len(good), PART))
    sums = [area[part] @ float64(weight[part]) for part in parts]
    return np.sum(sums, axis=0) / area[good].sum()


def fitted_surfels(fitted: xr.Dataset, names: Sequence[str]) -> Index:
    """Indices of the surfels whose every stage was fitted, with finite variables `names`.

    Raises
    ------
    InputError
        If there are none.
    """
    good = fitted["fit_status"].values == FitStatus.FITTED
    for name in names:
        values = fitted[name].values.reshape(len(good), -1)
        good = good & finite_rows(values)
    if not good.any():
        status, count = np.unique(fitted["fit_status"].values, return_counts=True)
        counts_by_status = ", ".join(
            f"{n} {FitStatus(s).name.lower()}"
            for s, n in zip(status, count, strict=True)
        )
        raise input_error(
            "fitted[fit_status]",
            "a basis needs fitted surfels",
            counts_by_status,
            "add lights and cameras, or hold fewer out",
        )
    return np.flatnonzero(good)


class Systems(NamedTuple):
    """Normal equations of n surfels, which replace their samples; 28 kB per surfel at m = 59."""

    gram: Array  # (n, m, m) M'M
    rhs: Array  # (n, m) M'r
    square: Array  # (n,) r'r
    samples: Array  # (n,) number of values in r

    @classmethod
    def of(
        cls, rows: Array, offsets: Index, target: Array, besides: Array | None = None
    ) -> Systems:
        """Normal equations of rows (total, m) and samples (total, channels); `offsets`
        (n + 1,) start each surfel.

        Columns `besides` (total, c) have the best weights for each surfel and channel,
        whatever the other weights are.
        """
        n = len(offsets) - 1
        m = rows.shape[1]
        gram = np.zeros((n, m, m))
        rhs = np.zeros((n, m))
        square = np.zeros(n)
        columns = np.zeros((len(rows), 0)) if besides is None else besides
        for s, (start, stop) in enumerate(pairwise(offsets)):
            space = np.linalg.qr(columns[start:stop])[0]
            block = float64(rows[start:stop])
            block -= space @ (space.T @ block)
            values = target[start:stop]
            gram[s] = target.shape[1] * (block.T @ block)
            rhs[s] = block.T @ values.sum(axis=1)
            square[s] = (values**2).sum() - ((space.T @ values) ** 2).sum()
        samples = np.maximum(np.diff(offsets) - columns.shape[1], 0) * target.shape[1]
        return cls(gram, rhs, square, float64(samples))

    def of_equal_noise(self) -> Systems:
        """The systems with weights by which no surfel has a residual above the median.

        Otherwise the one per cent of the surfels that no BRDF explains (folds, edges of
        shadows) would decide about half of the error.
        """
        x, squares = residuals(self)
        free = np.maximum(self.samples - (x > 0).sum(axis=1), 1)
        variance = squares / free
        weight = 1 / np.maximum(variance + np.median(variance), np.finfo(float).tiny)
        return Systems(
            weight[:, None, None] * self.gram,
            weight[:, None] * self.rhs,
            weight * self.square,
            self.samples,
        )

    def within(self, H: Array) -> Systems:
        """Normal equations for the weights of k mixtures H (k, m)."""
        return Systems(H @ self.gram @ H.T, self.rhs @ H.T, self.square, self.samples)

    @staticmethod
    def joined(parts: list[Systems]) -> Systems:
        """Concatenate the systems of several takes."""
        return Systems(*map(np.concatenate, zip(*parts, strict=True)))


def residuals(systems: Systems, H: Array | None = None) -> tuple[Array, Array]:
    """Non-negative weights (n, k) of the mixtures H (k, m), or of all m BRDFs, and
    squared residuals (n,).
    """
    reduced = systems if H is None else systems.within(H)
    x, _, _, _ = solve_nnls(reduced.gram, reduced.rhs)
    fitted = np.einsum("nk,nkl,nl->n", x, reduced.gram, x) - 2 * dots(reduced.rhs, x)
    return x, np.maximum(systems.square + fitted, 0.0)


def factor_reflectance(systems: Systems, largest: int) -> list[Array]:
    """Bases of 1, 2, ... `largest` mixtures, each H (k, m) non-negative with rows of unit sum.

    The basis first grows one component at a time, each started at the full weights of
    the surfels with the largest residuals. It then shrinks again, each time by the best
    of three removals or mergers of two components. Of the two bases of a size the
    better one is kept; shrinking ends in far better minima than random starts. In a
    last upward pass every size is also started from the size below.
    """
    weights, squares = residuals(systems)
    small, lift = _compress(systems)
    H = _descend(small, lift, weights.mean(axis=0, keepdims=True))
    up = [H]
    while len(H) < largest:
        H = _descend(small, lift, _grown(small, lift, H, weights, squares))
        up.append(H)
    best = {largest: H}
    for k in range(largest - 1, 0, -1):
        H = _best(
            small,
            lift,
            [
                _descend(small, lift, merged)
                for merged in _cheapest_merges(small, lift, H)
            ],
        )
        best[k] = _best(small, lift, [up[k - 1], H])
    # one more mixture cannot increase the error, and the size below may be a better
    # start
    for k in range(1, largest):
        grown = _descend(small, lift, _grown(small, lift, best[k], weights, squares))
        best[k + 1] = _best(small, lift, [best[k + 1], grown])
    # the error of the compressed space is a third of the noise, if the noise is 1 %
    identity = np.eye(len(lift))
    return [
        unit_sum(_descend(systems, identity, best[k], steps=POLISH))
        for k in range(1, largest + 1)
    ]


def _best(systems: Systems, lift: Array, bases: list[Array]) -> Array:
    return min(
        bases, key=lambda basis: float(residuals(systems, basis @ lift)[1].sum())
    )


def _grown(
    systems: Systems, lift: Array, H: Array, weights: Array, squares: Array
) -> Array:
    """H with one more row: the mean weights of the surfels with the largest excess over
    a fit of all BRDFs.
    """
    excess = residuals(systems, H @ lift)[1] - squares
    worst = np.argsort(excess)[-max(1, round(WORST * len(excess))) :]
    return np.concatenate([H, weights[worst].mean(axis=0, keepdims=True)])


def _compress(systems: Systems) -> tuple[Systems, Array]:
    """Systems in the space of SPACE dimensions with most of the reflectance, and lift
    (m, SPACE); H becomes H lift.

    The space is spanned by the leading eigenvectors of the mean Gram matrix of columns
    of unit norm.
    """
    mean = systems.gram.mean(axis=0)
    norm = np.sqrt(np.maximum(np.diag(mean), 0.0))
    scale = 1.0 / np.where(norm > 0, norm, 1.0)
    _, vectors = np.linalg.eigh(mean * np.outer(scale, scale))
    leading = vectors[:, ::-1][:, :SPACE]
    return systems.within((scale[:, None] * leading).T), leading / scale[:, None]


def _descend(systems: Systems, lift: Array, H: Array, *, steps: int = STEPS) -> Array:
    """Minimise the residual over H >= 0, with the best weights for each H, by
    quasi-Newton steps (L-BFGS-B).

    Because the weights are optimal, the gradient equals that for fixed weights (Golub
    and Pereyra 1973). Alternating between weights and H instead stops in long valleys,
    several tenths of a per cent above the minimum.
    """
    mean = lift @ systems.gram.mean(axis=0) @ lift.T
    # gives matt and glossy BRDFs the same scale
    norm = np.sqrt(np.maximum(np.diag(mean), 0.0))
    norm = np.where(norm > 0, norm, 1.0)
    x, squares = residuals(systems, H @ lift)
    use = np.sqrt((x**2).mean(axis=0))
    total = max(float(squares.sum()), np.finfo(float).tiny)

    def objective(flat: Array) -> tuple[float, Array]:
        nonlocal x
        mixtures = flat.reshape(H.shape) / norm @ lift
        reduced = systems.within(mixtures)
        x, _, _, _ = solve_nnls(reduced.gram, reduced.rhs, warm=x)
        fitted = x @ mixtures
        slope = (systems.gram @ fitted[..., None])[..., 0] - systems.rhs
        square = systems.square.sum() + float((fitted * (slope - systems.rhs)).sum())
        return float(square) / total, (
            2 * (x.T @ slope) @ lift.T / norm / total
        ).ravel()

    start = np.where(use > 0, use, 1.0)[:, None] * H * norm
    options = {
        "maxiter": steps,
        "maxfun": 2 * steps,
        "maxcor": 20,
        "ftol": 1e-7,
        "gtol": 0.0,
    }
    minimum = minimize(
        objective,
        start.ravel(),
        jac=True,
        method="L-BFGS-B",
        bounds=[(0, None)] * H.size,
        options=options,
    )
    return minimum.x.reshape(H.shape) / norm


def _cheapest_merges(systems: Systems, lift: Array, H: Array) -> list[Array]:
    """The MERGES best versions of H with one row less: one removed, or two replaced by
    their weighted sum.
    """
    total = residuals(systems, H @ lift)[0].sum(axis=0)
    step = max(1, len(systems.square) // 500)  # few are enough to rank candidates
    few = Systems(*(part[::step] for part in systems))
    candidates = [np.delete(H, i, 0) for i in range(len(H))]
    for i in range(len(H)):
        for j in range(i):
            merged = np.delete(H, i, 0)
            merged[j] = total[i] * H[i] + total[j] * H[j]
            candidates.append(merged)
    return sorted(
        candidates, key=lambda basis: float(residuals(few, basis @ lift)[1].sum())
    )[:MERGES]
