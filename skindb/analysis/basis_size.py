"""How many basis BRDFs skin needs (Weyrich et al. 2005, sections 7 and 10.1, figure 15)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.members import consenting
from skindb.analysis.population_basis import same_dictionary
from skindb.numerics.factorise import nmf
from skindb.numerics.nnls import fit_reflectance
from skindb.numerics.statistics import bootstrap_interval
from skindb.optics.brdf_table import TableGrid
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.rows import basis_rows
from skindb.schema import FitStatus, dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.floating[Any]]


def basis_size_curve(
    captures: Mapping[str, xr.DataTree],
    models: Mapping[str, xr.DataTree],
    *,
    tables: Array,
    ks: Sequence[int] = (1, 2, 3, 4, 5, 6, 8, 10, 12),
    per_take: int = 200,
    tolerance: float = 0.02,
    rng: np.random.Generator,
) -> xr.Dataset:
    """Reconstruction error of reflectance against the number of basis BRDFs.

    For every k the weights of the sampled surfels are factored, and the samples of each surfel (less the diffuse
    term) are fitted again with the k mixtures by linear NNLS.

    Parameters
    ----------
    captures, models
        Take -> versions of kinds "capture" and "model".
    tables
        (nh, nd, np, m) tables of the dictionary of the fits [sr^-1].
    ks
        Sizes to try, ascending.
    per_take
        Surfels drawn from each take (the paper: 5,000 of dataset A, 2,000 per subject of B).
    tolerance
        The size is the smallest k whose interval lies below (1 + tolerance) times the error of the largest k.
    rng
        Of draws, factorisation and bootstrap.

    Returns
    -------
    Dataset
        `relative_error` with its interval; attributes `chosen_k` (0 if no k but the largest meets the rule: the
        curve has no plateau yet) and `full_basis_error`, the relative RMS residual with every basis.
    """
    takes = consenting(models)
    same_dictionary(takes)
    X, rows, offsets, target = _sampled(captures, takes, tables, per_take, rng)
    ks = [k for k in ks if k <= min(X.shape)]
    full = _squares(rows, offsets, target, np.eye(tables.shape[-1]))
    level = np.add.reduceat((target**2).sum(axis=1), offsets[:-1])
    lifts = [nmf(X, k, rng=rng, seeds=1).H.T for k in ks]
    left = np.stack(
        [_squares(rows @ lift.astype(np.float32), offsets, target, np.eye(lift.shape[1])) for lift in lifts]
    )
    pairs = np.concatenate([left, full[None]]).T  # a surfel is drawn with all its errors

    def statistic(drawn: Array) -> Array:
        total = drawn.sum(axis=0)
        return np.asarray(np.sqrt(total[:-1] / total[-1]))

    low, high = bootstrap_interval(pairs, statistic, rng=rng, draws=500)
    error = statistic(pairs)
    met = [k for k, top in zip(ks, high, strict=True) if top <= (1 + tolerance) * error[-1]]
    chosen = met[0] if met and met[0] != ks[-1] else 0
    attrs = {
        "chosen_k": chosen,
        "tolerance": tolerance,
        "surfels": len(full),
        "full_basis_error": float(np.sqrt(full.sum() / level.sum())),
    }
    return dataset(
        {"relative_error": error, "relative_error_low": low, "relative_error_high": high}, coords={"k": ks}, attrs=attrs
    )


def _squares(rows: NDArray[np.float32], offsets: NDArray[np.int64], target: Array, lift: Array) -> Array:
    """Squared residual of each surfel."""
    fit = fit_reflectance(rows, offsets, target, None, lift, mode="linear", noise_floor=1.0, min_samples=1)
    level = np.add.reduceat((target**2).sum(axis=1), offsets[:-1])
    return fit.residual**2 * level


def _sampled(
    captures: Mapping[str, xr.DataTree],
    models: Mapping[str, xr.DataTree],
    tables: Array,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, NDArray[np.float32], NDArray[np.int64], Array]:
    """Weights, basis rows, offsets and surface reflectance of surfels drawn from every take."""
    weights, rows, counts, targets = [], [], [], []
    for take, model in models.items():
        fitted = model["fitted"].to_dataset()
        good = np.flatnonzero(fitted["fit_status"].values == FitStatus.FITTED)
        drawn = np.sort(rng.permutation(good)[:count])
        one, own = _surface_rows(captures[take], fitted, drawn, tables, float(model.attrs["eta"]))
        weights.append(fitted["basis_weight"].isel(surfel=drawn).values.astype(np.float64))
        rows.append(one[0])
        counts.append(np.diff(one[1]))
        targets.append(own)
    offsets = np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64)
    return np.concatenate(weights), np.concatenate(rows), offsets, np.concatenate(targets)


def _surface_rows(
    capture: xr.DataTree, fitted: xr.Dataset, drawn: NDArray[np.int64], tables: Array, eta: float
) -> tuple[tuple[NDArray[np.float32], NDArray[np.int64]], Array]:
    """Basis rows with their offsets, and the samples (total, 3) less the diffuse term, of the surfels drawn."""
    samples = capture["samples"].to_dataset()["reflectance_sample"].isel(surfel=drawn)
    dome = capture["dome"].to_dataset()
    fitted = fitted[["surfel_position", "shading_normal", "diffuse_reflectance"]].isel(surfel=drawn)
    position, normal = (fitted[n].values.astype(np.float64) for n in ("surfel_position", "shading_normal"))
    to_light = _directions(dome["light_position"].values, position)
    to_camera = _directions(dome["camera_position"].values, position)
    values = samples.values.astype(np.float64)
    rows, offsets, index = basis_rows(
        tables, TableGrid(*tables.shape[:3]), normal, to_light, to_camera, np.asarray(np.isfinite(values).all(axis=-1))
    )
    surfel = np.repeat(np.arange(len(position)), np.diff(offsets))
    cos_i = np.einsum("nc,nc->n", normal[surfel], to_light[surfel, index[:, 0]])
    cos_o = np.einsum("nc,nc->n", normal[surfel], to_camera[surfel, index[:, 1]])
    passed = cos_i * fresnel_transmittance(cos_i, eta) * fresnel_transmittance(cos_o, eta) / np.pi
    diffuse = fitted["diffuse_reflectance"].values.astype(np.float64)[surfel] * passed[:, None]
    return (rows, offsets), values[surfel, index[:, 0], index[:, 1]] - diffuse


def _directions(points: Array, position: Array) -> Array:
    """Unit directions (n, p, 3) from the surfels to the points."""
    d = points[None].astype(np.float64) - position[:, None]
    return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))


def plot_basis_size(curve: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Error against k with its interval; the chosen size is marked."""
    from matplotlib import pyplot

    if ax is None:
        _, ax = pyplot.subplots(figsize=(6, 3.6))
    k = curve["k"].values
    ax.fill_between(k, curve["relative_error_low"], curve["relative_error_high"], alpha=0.25, label="95 % interval")
    ax.plot(k, curve["relative_error"], "o-", label="error")
    if curve.attrs["chosen_k"]:
        ax.axvline(curve.attrs["chosen_k"], color="0.4", ls="--", label=f"size by the rule: {curve.attrs['chosen_k']}")
    ax.set_xlabel("basis BRDFs k")
    ax.set_ylabel("error of reflectance / error with every basis")
    ax.legend(fontsize=8)
    return ax
