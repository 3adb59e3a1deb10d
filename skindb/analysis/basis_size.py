"""How many basis BRDFs skin needs (Weyrich et al. 2005, sections 7 and 10.1, figure 15)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.members import consenting
from skindb.analysis.population_basis import draw_fitted, same_dictionary
from skindb.numerics.reflectance_basis import Systems, factor_reflectance, residuals
from skindb.numerics.statistics import bootstrap_interval
from skindb.optics.brdf_table import TableGrid
from skindb.optics.fresnel import fresnel_transmittance
from skindb.optics.rows import basis_rows
from skindb.schema import dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.floating[Any]]
BLOCK = 128  # surfels: rows of 2,400 samples and 59 bases are 72 MB
STEP = 0.003  # see `choose_size`; of the planted problems it was chosen on, 0.2 % and 0.4 % tell fewer sizes
FACTORED = 2000  # surfels of all takes together that the bases are found from: 56 MB of normal equations


def basis_size_curve(
    captures: Mapping[str, xr.DataTree],
    models: Mapping[str, xr.DataTree],
    *,
    tables: Array,
    ks: Sequence[int] = range(1, 13),
    per_take: int = 200,
    tolerance: float = 0.01,
    rng: np.random.Generator,
) -> xr.Dataset:
    """Reconstruction error of reflectance against the number of basis BRDFs.

    Bases of every size are found from the reflectance of up to 2,000 of the sampled surfels; then the samples of each
    surfel (less the diffuse term) are fitted with the k mixtures by linear NNLS, take by take. Factoring the stored
    weights instead, as the paper does, left 1.02 to 3.7 times the error on planted problems, at
    the planted size: weights are not unique.

    Parameters
    ----------
    captures, models
        Take -> versions of kinds "capture" and "model".
    tables
        (nh, nd, np, m) tables of the dictionary of the fits [sr^-1].
    ks
        Sizes to try, ascending; without gaps, or the size found is one of those tried.
    per_take
        Surfels drawn from each take (the paper: 5,000 of dataset A, 2,000 per subject of B).
    tolerance
        See `choose_size`.
    rng
        Of draws and bootstrap.

    Returns
    -------
    Dataset
        `relative_error` with its interval. Attributes: `chosen_k` (0 where the rule cannot tell), `fewest_k` and
        `most_k` (0 where there is no plateau), `size_status` (what the rule says, in words), and `full_basis_error`,
        the relative RMS residual with every basis.
    """
    takes = consenting(models)
    same_dictionary(takes)
    drawn = {take: draw_fitted(model, per_take, rng) for take, model in takes.items()}
    few = {take: rng.permutation(own)[: max(1, FACTORED // len(takes))] for take, own in drawn.items()}
    factored = Systems.joined([s for t, m in takes.items() for s in _systems(captures[t], m, np.sort(few[t]), tables)])
    ks = [k for k in ks if k <= min(factored.rhs.shape)]
    bases = factor_reflectance(factored, max(ks))
    tried = [bases[k - 1] for k in ks]
    if sum(map(len, few.values())) == sum(map(len, drawn.values())):
        errors = surfel_errors(factored, tried)
    else:  # the rest block by block: 2,000 surfels of 87 takes at once would be 5 GB
        del factored
        blocks = (s for t, m in takes.items() for s in _systems(captures[t], m, drawn[t], tables))
        errors = np.concatenate([surfel_errors(block, tried) for block in blocks])
    error, low, high, (fewest, most) = choose_size(errors, ks, tolerance=tolerance, rng=rng)
    attrs = {
        "chosen_k": most if fewest == most else 0,
        "fewest_k": fewest,
        "most_k": most,
        "size_status": size_status(fewest, most),
        "tolerance": tolerance,
        "surfels": len(errors),
        "full_basis_error": float(np.sqrt(errors[:, 0, -1].sum() / errors[:, 2, -1].sum())),
    }
    return dataset(
        {"relative_error": error, "relative_error_low": low, "relative_error_high": high}, coords={"k": ks}, attrs=attrs
    )


def surfel_errors(systems: Systems, bases: Sequence[Array]) -> Array:
    """Squared residual, degrees of freedom and squared reflectance (n, 3, sizes + 1), the last with every basis.

    The degrees of freedom are the values less the weights that are not zero (each fits some of the noise).
    """
    out = np.empty((len(systems.square), 3, len(bases) + 1))
    for j, basis in enumerate([*bases, None]):
        x, out[:, 0, j] = residuals(systems, basis)
        out[:, 1, j] = np.maximum(systems.count - (x > 0).sum(axis=1), 0)
        out[:, 2, j] = systems.square
    return out


def choose_size(
    errors: Array, ks: Sequence[int], *, tolerance: float, rng: np.random.Generator
) -> tuple[Array, Array, Array, tuple[int, int]]:
    """The sizes that may be the smallest one on the plateau of the error.

    A size is on the plateau if its error is within `tolerance` of that of the largest size tried and no further step
    lowers the error by more than STEP; the plateau must be within `tolerance` of the error with every basis. Both are
    ratios of errors of the same surfels: the 95 % bootstrap interval says of each size whether it surely is, surely is
    not, or may be.

    Returns
    -------
    error, low, high, (fewest, most)
        (sizes,) RMS residual over that with every basis, and its interval; the first size that may be on the plateau
        and the first that surely is, 0 if there is none or only the largest.
    """
    sizes = len(ks)

    def statistic(drawn: Array) -> Array:
        total = drawn.sum(axis=0)
        rms = np.sqrt(total[0] / np.maximum(total[1], 1))
        return np.concatenate([rms[:-1] / rms[-1], rms[:-1] / rms[-2], rms[:-2] / rms[1:-1]])

    low, high = bootstrap_interval(errors[:, :2], statistic, rng=rng, draws=500)
    error = statistic(errors)[:sizes]
    surely, perhaps = (_first_on_plateau(ends[sizes:], sizes, tolerance) for ends in (high, low))
    told = surely < sizes - 1 and error[-1] <= 1 + tolerance
    return error, low[:sizes], high[:sizes], (ks[perhaps], ks[surely] if told else 0)


def _first_on_plateau(ratios: Array, sizes: int, tolerance: float) -> int:
    """Index of the first size on the plateau, by ratios of errors to that of the last size and to that of the next."""
    further = np.append(ratios[sizes:], 1.0)
    steepest = np.maximum.accumulate(further[::-1])[::-1]
    return int(np.argmax((ratios[:sizes] <= 1 + tolerance) & (steepest <= 1 + STEP)))


def size_status(fewest: int, most: int) -> str:
    """What `choose_size` says, in words."""
    if not most:
        return f"at least {fewest}: the error has no plateau within the sizes tried"
    beyond = f"no further one lowers the error by more than {STEP:.1%}"
    if fewest < most:
        return f"{fewest} to {most}: the sample does not tell these sizes apart; {beyond}"
    return f"{most}: fewer are surely worse; {beyond}"


def _systems(capture: xr.DataTree, model: xr.DataTree, drawn: NDArray[np.int64], tables: Array) -> Iterator[Systems]:
    """Normal equations of the surfels drawn, block by block."""
    fitted = model["fitted"].to_dataset()[["surfel_position", "shading_normal", "diffuse_reflectance"]]
    fitted = fitted.isel(surfel=drawn).load()
    samples = capture["samples"].to_dataset()["reflectance_sample"].isel(surfel=drawn).values
    dome, eta = capture["dome"].to_dataset().load(), float(model.attrs["eta"])
    for start in range(0, len(drawn), BLOCK):
        one = slice(start, start + BLOCK)
        (rows, offsets), target = _surface_rows(samples[one], dome, fitted.isel(surfel=one), tables, eta)
        yield Systems.of(rows, offsets, target)


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
    fewest, most = curve.attrs["fewest_k"], curve.attrs["most_k"]
    if most:
        told = str(most) if fewest == most else f"{fewest} to {most}"
        ax.axvspan(fewest - 0.05, most + 0.05, color="0.4", alpha=0.4, lw=0, label=f"size by the rule: {told}")
    ax.set_xlabel("basis BRDFs k")
    ax.set_ylabel("error of reflectance / error with every basis")
    ax.legend(fontsize=8)
    return ax
