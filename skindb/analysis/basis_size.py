"""How many basis BRDFs skin needs (Weyrich et al. 2005, sections 7 and 10.1, figure 15)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.members import consenting
from skindb.analysis.population_basis import draw_fitted, same_dictionary, weights_of
from skindb.numerics.factorise import nmf
from skindb.numerics.nnls import fit_reflectance
from skindb.numerics.statistics import bootstrap_interval
from skindb.optics.brdf_table import TableGrid
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.rows import basis_rows
from skindb.schema import dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.floating[Any]]
BLOCK = 128  # surfels: rows of 2,400 samples and 59 bases are 72 MB


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
    drawn = {take: draw_fitted(model, per_take, rng) for take, model in takes.items()}
    X = np.concatenate([weights_of(model, drawn[take]) for take, model in takes.items()])
    ks = [k for k in ks if k <= min(X.shape)]
    lifts = [nmf(X, k, rng=rng, seeds=1).H.T for k in ks]
    # take by take: rows of 2,000 surfels of every take at once would fill the memory
    parts = [_squares(captures[t], m, drawn[t], tables, [*lifts, np.eye(X.shape[1])]) for t, m in takes.items()]
    pairs, level = (np.concatenate(p) for p in zip(*parts, strict=True))  # a surfel is drawn with all its errors

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
        "surfels": len(pairs),
        "full_basis_error": float(np.sqrt(pairs[:, -1].sum() / level.sum())),
    }
    return dataset(
        {"relative_error": error, "relative_error_low": low, "relative_error_high": high}, coords={"k": ks}, attrs=attrs
    )


def _squares(
    capture: xr.DataTree, model: xr.DataTree, drawn: NDArray[np.int64], tables: Array, lifts: Sequence[Array]
) -> tuple[Array, Array]:
    """Squared residuals (n, lifts) of the surfels drawn, and the squared reflectance (n,) they are residuals of."""
    fitted = model["fitted"].to_dataset()[["surfel_position", "shading_normal", "diffuse_reflectance"]]
    fitted = fitted.isel(surfel=drawn).load()
    samples = capture["samples"].to_dataset()["reflectance_sample"].isel(surfel=drawn).values
    dome, eta = capture["dome"].to_dataset().load(), float(model.attrs["eta"])
    errors, levels = np.empty((len(drawn), len(lifts))), np.empty(len(drawn))
    for start in range(0, len(drawn), BLOCK):
        one = slice(start, start + BLOCK)
        (rows, offsets), target = _surface_rows(samples[one], dome, fitted.isel(surfel=one), tables, eta)
        surfel = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
        levels[one] = np.bincount(surfel, (target**2).sum(axis=1), len(offsets) - 1)
        for j, lift in enumerate(lifts):
            reduced = rows if j == len(lifts) - 1 else rows @ lift.astype(np.float32)
            x = np.eye(lift.shape[1])
            fit = fit_reflectance(reduced, offsets, target, None, x, mode="linear", noise_floor=1.0, min_samples=1)
            errors[one, j] = np.where(levels[one] > 0, fit.residual, 0.0) ** 2 * levels[one]
    return errors, levels


def _surface_rows(
    samples: NDArray[np.float16], dome: xr.Dataset, fitted: xr.Dataset, tables: Array, eta: float
) -> tuple[tuple[NDArray[np.float32], NDArray[np.int64]], Array]:
    """Basis rows with their offsets, and the samples (total, 3) less the diffuse term, of a few surfels."""
    position, normal = (fitted[n].values.astype(np.float64) for n in ("surfel_position", "shading_normal"))
    to_light = _directions(dome["light_position"].values, position)
    to_camera = _directions(dome["camera_position"].values, position)
    values = samples.astype(np.float64)
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
