"""One reduced basis for all takes with the coefficients of each, and the study of the number of
basis BRDFs that skin needs (Weyrich et al. 2005, sections 7 and 10.1, figure 15).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from dask.delayed import Delayed
from numpy.random import Generator
from xarray import Dataset

from skindb import plots
from skindb.analysis.study import (
    Population,
    Results,
    Study,
    Table,
    each_item,
    each_take,
    shared_once,
    skipped_takes,
)
from skindb.errors import Fault, require, require_none
from skindb.numerics.factorise import Sums, nmf, refine
from skindb.numerics.nnls import solve_nnls
from skindb.numerics.statistics import bootstrap_interval
from skindb.optics.fresnel import fresnel_transmittance
from skindb.reflectance.mixture import basis_rows
from skindb.reflectance.reduction import Systems, factor_reflectance, residuals
from skindb.reflectance.tables import TableGrid, brdf_metric
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.study_parameters import DECLARED, BrdfParameters
from skindb.threads import c_contiguous
from skindb.types import Array, Index, dots, finite_rows, unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# of all takes together, from which the starting basis is computed
MAX_START_SURFELS = 5000
BASIS_SIZE_VARIABLES = (
    variables.SURFEL_POSITION,
    variables.SHADING_NORMAL,
    variables.DIFFUSE_REFLECTANCE,
    variables.REFLECTANCE_SAMPLE,
    variables.LIGHT_POSITION,
    variables.CAMERA_POSITION,
)
NEEDED = (*BASIS_SIZE_VARIABLES, "fit_eta")
DEFAULT_ETA = 1.3  # refractive index of models without parameters of the fit
BLOCK = 128  # surfels at a time: rows of 2,400 samples and 59 bases take 72 MB
# see `choose_size`; chosen on virtual subjects: errors of geometry act like further bases of
# up to 0.6 % each, 1.8 % in all
STEP = 0.01
TOLERANCE = 0.02
# noise of samples that is assumed: sensor [sr^-1], and geometry, relative
NOISE_FLOOR = 0.001
RELATIVE_NOISE = 0.02
TABLE_HEADER = (
    "k",
    "error above that with all bases [%]",
    "low [%]",
    "high [%]",
    "reduced by next k [%]",
)
# surfels of all takes together from which the bases are computed: 56 MB of normal
# equations
MAX_FACTORED = 2000
# of each take that the study draws; up to MAX_FACTORED of few takes
STUDY_SURFELS = 200


def population_basis(
    cohort: Dataset,
    *,
    tables: Array | Delayed,
    k: int = 6,
    in_metric: bool = False,
    rng: Generator,
) -> Dataset:
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
    rng
        Random generator of the sample and of the starts of the factorisation.

    Returns
    -------
    Dataset
        `population_mixture`, `take_coefficient`, `component_vector`. Attributes:
        relative error over all surfels, and their number.

    Raises
    ------
    InputError
        If takes were fitted with different parameters or dictionaries, or if a take has
        no fitted surfels.
    """
    require_comparable(cohort, "surfels")
    names = same_dictionary(cohort)
    takes = cohort["take"].values.tolist()
    X = _start_weights(cohort, takes, rng)
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
            variables.COMPONENT_VECTOR: component_vectors(H, metric),
        },
        coords={"dictionary": names, "take": takes},
        attrs={
            "nmf_error": float(errors[-1]),
            "nmf_surfels": int(sum(part_sums.count for part_sums in sums)),
            "skipped": skipped_takes(cohort),
        },
    )


def component_vectors(mixture: Array, metric: Array) -> Array:
    """Components (k, m) of a basis as vectors (k, k) whose Euclidean distances are those
    of the BRDFs, from the metric (m, m) of these.
    """
    weights = c_contiguous(np.asarray(mixture, float))
    values, vectors = np.linalg.eigh(weights @ metric @ weights.T)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _start_weights(cohort: Dataset, takes: Sequence[str], rng: Generator) -> Array:
    """Weights (n, m) of some surfels of every take; raises `InputError` for takes without
    fitted surfels.
    """
    part = max(1, MAX_START_SURFELS // len(takes))
    sample = cohort.isel(surfel=slice(2 * part))
    starts = each_take(_fitted_weights, sample, [variables.DICTIONARY_WEIGHT])
    rule = "a take must have fitted surfels"
    cure = "fit it again, or exclude it"
    faults = [
        Fault(f"take {take}", rule, "none", cure)
        for take, weights in zip(takes, starts, strict=True)
        if not len(weights)
    ]
    require_none(faults)
    return np.concatenate([rng.permutation(weights)[:part] for weights in starts])


def _mean(take: Dataset) -> Array:
    """Area-weighted mean (m,) of the weights (n, m) of one take."""
    weights = take[variables.DICTIONARY_WEIGHT].values
    area = take[variables.SURFEL_AREA].values
    good = finite_rows(weights)
    return np.average(
        weights[good].astype(float),
        axis=0,
        weights=area[good].astype(float),
    )


def _sums(take: Dataset, H: Array, A: Array) -> Sums:
    """Sums of one take for H (k, m) in the metric A (m, m)."""
    return Sums.of(_fitted_weights(take), H, A)


def _fitted_weights(take: Dataset) -> Array:
    """Weights (n, m) of the fitted surfels; a sample with fewer surfels than requested
    is padded with NaN.
    """
    weights = take[variables.DICTIONARY_WEIGHT].values
    return weights[finite_rows(weights)].astype(float)


def project(weights: Array, H: Array, metric: Array) -> Array:
    """Non-negative coefficients (n, k) of the BRDFs nearest to `weights` (n, m) in the
    space of H (k, m).
    """
    gram = H @ metric @ H.T
    rhs = weights @ metric @ H.T
    x, _, _, _ = solve_nnls(np.broadcast_to(gram, (len(rhs), *gram.shape)), rhs)
    return x


def same_dictionary(cohort: Dataset) -> list[str]:
    """Names of the BRDFs with which all takes were fitted; raises `InputError` if the
    dictionaries differ.
    """
    if "fit_dictionary" in cohort.coords:
        known = cohort["fit_dictionary"].dropna("take").values
        sources = sorted({str(value) for value in known})
        require(
            len(sources) <= 1,
            "dictionary",
            "all takes of a population must be fitted with one dictionary",
            ", ".join(sources),
            "fit them again with the same dictionary",
        )
    return [str(name) for name in cohort["dictionary"].values]


def basis_size_curve(
    cohort: Dataset,
    *,
    tables: Array | Delayed,
    ks: Sequence[int] = range(1, 13),
    tolerance: float = TOLERANCE,
    rng: Generator,
) -> Dataset:
    """Reconstruction error of reflectance as a function of the number of basis BRDFs.

    Bases of every size are computed from the reflectance of up to 2,000 of the sampled
    surfels; then the samples of each surfel are fitted with the k mixtures by linear
    NNLS, take by take. Each surfel has its own diffuse term and even reflection: errors
    at grazing angles look like one more even basis. Surfels that even the dictionary fits
    badly count less (`Systems.of_equal_noise`). Factorising the stored weights instead,
    as in the paper, gave 1.02 to 3.7 times the error on planted problems at the planted
    size, because the weights are not unique.

    Parameters
    ----------
    cohort
        ``db.cohort("surfels", surfels=200, variables=BASIS_SIZE_VARIABLES)``, with the
        reflectance samples (the paper drew 5,000 surfels of dataset A and 2,000 of
        every subject of dataset B).
    tables
        (nh, nd, np, m) tables of the dictionary of the fits [sr^-1], or a Dask object
        that computes them.
    ks
        Sizes to try, ascending; only these sizes can be chosen.
    tolerance
        See `choose_size`.
    rng
        Random generator of the bootstrap.

    Returns
    -------
    Dataset
        `relative_error` with its interval; `smallest_size` and `sufficient_size`, the
        bounds of the smallest size on the plateau (`sufficient_size` is 0 if there is
        no plateau); `plateau_tolerance`. Attribute: `surfels`, their number.
    """
    require_comparable(cohort, "surfels")
    same_dictionary(cohort)
    few = max(1, MAX_FACTORED // cohort.sizes["take"])
    once = shared_once(tables)
    factored = Systems.joined(each_take(_systems, cohort, NEEDED, once, slice(few)))
    ks = [k for k in ks if k <= min(factored.rhs.shape)]
    bases = factor_reflectance(factored, max(ks))
    tried = [bases[k - 1] for k in ks]
    if few >= cohort.sizes["surfel"]:
        errors = surfel_errors(factored, tried)
    else:  # take by take: 2,000 surfels of 87 takes at once would need 5 GB
        del factored
        errors = np.concatenate(each_take(_take_errors, cohort, NEEDED, once, tried))
    error, low, high, (fewest, upper) = choose_size(
        errors, ks, tolerance=tolerance, rng=rng
    )
    values = {
        variables.RELATIVE_ERROR: error,
        variables.RELATIVE_ERROR_LOW: low,
        variables.RELATIVE_ERROR_HIGH: high,
        variables.SMALLEST_SIZE: fewest,
        variables.SUFFICIENT_SIZE: upper,
        variables.PLATEAU_TOLERANCE: tolerance,
    }
    attrs = {"surfels": len(errors), "skipped": skipped_takes(cohort)}
    return dataset(values, coords={"k": ks}, attrs=attrs)


def surfel_errors(systems: Systems, bases: Sequence[Array]) -> Array:
    """Squared residual and degrees of freedom (n, 2, sizes + 1); the last is for the
    dictionary.

    The degrees of freedom are the number of values minus the number of non-zero
    weights, as each fits some noise.
    """
    out = np.empty((len(systems.square), 2, len(bases) + 1))
    for j, basis in enumerate([*bases, None]):
        x, out[:, 0, j] = residuals(systems, basis)
        out[:, 1, j] = np.maximum(systems.samples - (x > 0).sum(axis=1), 0)
    return out


def choose_size(
    errors: Array, ks: Sequence[int], *, tolerance: float, rng: Generator
) -> tuple[Array, Array, Array, tuple[int, int]]:
    """Bounds of the smallest size on the plateau of the error.

    A size is on the plateau if its error is within `tolerance` of that of the largest
    size tried, and if no larger size reduces the error by more than STEP compared with
    the next smaller one. The plateau must be within `tolerance` of the error with the
    whole dictionary. These are ratios of errors of the same surfels, so that their 95 %
    bootstrap intervals show whether a size is on the plateau, is not, or may be.

    Returns
    -------
    error, low, high, (fewest, most)
        (sizes,) RMS residual divided by that with the whole dictionary, and its
        interval; the first size that may be on the plateau, and the first that is
        significantly on it (0 if there is none or only the largest).
    """
    sizes = len(ks)

    def statistic(drawn: Array) -> Array:
        total = drawn.sum(axis=0)
        rms = np.sqrt(total[0] / np.maximum(total[1], 1))
        return np.concatenate(
            [rms[:-1] / rms[-1], rms[:-1] / rms[-2], rms[:-2] / rms[1:-1]]
        )

    low, high = bootstrap_interval(errors, statistic, rng=rng, draws=500)
    error = statistic(errors)[:sizes]
    surely, perhaps = (
        _first_on_plateau(ends[sizes:], sizes, tolerance) for ends in (high, low)
    )
    resolved = surely < sizes - 1 and error[-1] <= 1 + tolerance
    return (
        error,
        low[:sizes],
        high[:sizes],
        (ks[perhaps], ks[surely] if resolved else 0),
    )


def _first_on_plateau(ratios: Array, sizes: int, tolerance: float) -> int:
    """Index of the first size on the plateau, from ratios of its error to that of the
    last and of the next size.
    """
    further = np.append(ratios[sizes:], 1.0)
    steepest = np.maximum.accumulate(further[::-1])[::-1]
    return int(np.argmax((ratios[:sizes] <= 1 + tolerance) & (steepest <= 1 + STEP)))


def tabulate_basis_size(curve: Dataset) -> Table:
    """Header and rows of the table of `basis_size_curve`, one row per size.

    Parameters
    ----------
    curve
        From `basis_size_curve`.

    Returns
    -------
    header, rows
        Size; error above that with the whole dictionary in per cent, with the ends of its
        95 % interval; by how much the next size reduces the error (NaN for the last one).
    """
    ends = ("", "_low", "_high")
    error, *interval = (curve[f"relative_error{end}"].values for end in ends)
    reduction = np.append(1 - error[1:] / error[:-1], np.nan)
    columns = [error - 1, *(end - 1 for end in interval), reduction]
    rows = (100 * np.transpose(columns)).tolist()
    sizes = curve["k"].values.tolist()
    return list(TABLE_HEADER), [[k, *row] for k, row in zip(sizes, rows, strict=True)]


def size_range(curve: Dataset) -> str:
    """Numbers of bases that may suffice: "4", "4 to 6" or "at least 4"."""
    fewest, last = (
        int(curve[name])
        for name in (variables.SMALLEST_SIZE, variables.SUFFICIENT_SIZE)
    )
    if not last:
        return f"at least {fewest}"
    return str(last) if fewest == last else f"{fewest} to {last}"


def describe_basis_size(curve: Dataset) -> str:
    """Number of bases that are needed by `choose_size`, and the reason, in one or two sentences."""
    ks = curve["k"].values.tolist()
    tolerance = float(curve[variables.PLATEAU_TOLERANCE])
    fewest = int(curve[variables.SMALLEST_SIZE])
    sufficient = int(curve[variables.SUFFICIENT_SIZE])
    excess = float(curve[variables.RELATIVE_ERROR][-1]) - 1
    largest = f"{ks[-1]}, the largest size tried"
    if not sufficient:
        reason = f"no size below {largest}, is significantly on a plateau of the error"
        if excess > tolerance:
            above = f"{100 * excess:.3g} % above that with the whole dictionary"
            reason = f"with {largest}, the error is still {above}"
        return f"A{size_range(curve)[1:]} bases: {reason}. Try larger sizes or draw more surfels."
    others = "smaller sizes are significantly worse" if sufficient > ks[0] else ""
    if fewest < sufficient:
        others = "this sample does not show whether fewer would suffice"
    reasons = [
        f"With {sufficient} the error is significantly within {100 * tolerance:.3g} % of that "
        f"with {largest}, and no further basis reduces it by more than {100 * STEP:.3g} %",
        others,
    ]
    noun = "basis" if sufficient == 1 else "bases"
    return f"{size_range(curve)} {noun}. {'; '.join(filter(None, reasons))}."


def _take_errors(take: Dataset, tables: Array, bases: Sequence[Array]) -> Array:
    """`surfel_errors` of all sampled surfels of one take."""
    return surfel_errors(_systems(take, tables, slice(None)), bases)


def _systems(take: Dataset, tables: Array, part: slice) -> Systems:
    """Normal equations of the selected surfels of one take."""
    is_fitted = finite_rows(take[variables.DIFFUSE_REFLECTANCE].values)
    surfels = take.isel(surfel=np.flatnonzero(is_fitted)[part])
    eta = float(take["fit_eta"]) if "fit_eta" in take else np.nan
    # for models that do not state the parameters of their fit
    eta = eta if np.isfinite(eta) else DEFAULT_ETA
    parts = []
    for start in range(0, max(surfels.sizes["surfel"], 1), BLOCK):
        block = surfels.isel(surfel=slice(start, start + BLOCK))
        parts.append(Systems.of(*_surface_rows(block, tables, eta)))
    return Systems.joined(parts).of_equal_noise()


def _surface_rows(
    surfels: Dataset, tables: Array, eta: float
) -> tuple[Array, Index, Array, Array]:
    """Basis rows with their offsets, the samples (total, 3), and the columns (total, 2)
    of light from within the skin and of even reflection, divided by the noise, for a few
    surfels.
    """
    position = surfels[variables.SURFEL_POSITION].values[:, None].astype(float)
    normal = surfels[variables.SHADING_NORMAL].values.astype(float)
    to_light, to_camera = (
        unit(surfels[name].values.astype(float) - position)
        for name in (variables.LIGHT_POSITION, variables.CAMERA_POSITION)
    )
    values = surfels[variables.REFLECTANCE_SAMPLE].values.astype(float)
    grid = TableGrid(*tables.shape[:3])
    is_known = finite_rows(values)
    rows, offsets, index = basis_rows(
        tables, grid, normal, to_light, to_camera, is_known
    )
    surfel = np.repeat(np.arange(len(position)), np.diff(offsets))
    cos_i = dots(normal[surfel], to_light[surfel, index[:, 0]])
    cos_o = dots(normal[surfel], to_camera[surfel, index[:, 1]])
    passed = fresnel_transmittance(cos_i, eta) * fresnel_transmittance(cos_o, eta)
    samples = values[surfel, index[:, 0], index[:, 1]]
    noise = np.hypot(NOISE_FLOOR, RELATIVE_NOISE * samples.mean(axis=1))[:, None]
    even = np.stack([passed * cos_i, cos_i], axis=1)
    return rows / noise, offsets, samples / noise, even / noise


def plot_basis_size(curves: Mapping[str, Dataset], *, ax: Axes | None = None) -> Axes:
    """Plot by how much errors exceed that of the dictionary against k, with 95 % intervals,
    and mark the sizes that may suffice (Weyrich et al. 2005, figure 15).

    Parameters
    ----------
    curves
        Name of a sample -> curve from `basis_size_curve`.
    ax
        Axes to draw on; by default new ones.
    """
    ax = ax or plots.new_axes(6, 3.6)
    for (name, curve), colour, marker in zip(
        curves.items(), plots.CYCLE, plots.MARKERS, strict=False
    ):
        k = curve["k"].values
        error, low, high = (
            100 * (curve[f"{variables.RELATIVE_ERROR}{end}"] - 1)
            for end in ("", "_low", "_high")
        )
        ax.fill_between(k, low, high, color=colour, alpha=0.25, linewidth=0)
        label = f"{name} (n = {curve.attrs['surfels']:,} surfels): {size_range(curve)}"
        style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 5}
        ax.plot(k, error, label=label, mfc="none", **style)
        last = int(curve[variables.SUFFICIENT_SIZE]) or k[-1]
        chosen = (k >= int(curve[variables.SMALLEST_SIZE])) & (k <= last)
        ax.plot(k[chosen], error[chosen], linestyle="none", **style)
    ax.set_xlabel("number of basis BRDFs k (filled: sizes that may suffice)")
    ax.set_yscale("log", nonpositive="clip")
    ax.yaxis.set_major_formatter("{x:g}")  # formulas are not parsed
    ax.set_ylabel("error above that of the dictionary [%]")
    ax.legend(fontsize=8)
    return ax


def compute(population: Population, parameters: BrdfParameters) -> Results:
    """The results of the study."""
    cohort = population.cohort
    # the order of a sample is random: its first surfels are a random sample as well
    drawn = max(STUDY_SURFELS, MAX_FACTORED // cohort.sizes["take"])
    curve = basis_size_curve(
        cohort.isel(surfel=slice(drawn)),
        tables=population.brdf_tables(),
        rng=np.random.default_rng(parameters.seed),
    )
    return {"basis_size": curve}


STUDY = Study(
    *DECLARED["brdf"],
    layout="surfels",
    compute=compute,
    shown=("basis_size",),
    tabulate=tabulate_basis_size,
    plot=lambda curve: plot_basis_size({"these takes": curve}),
    describe=lambda curve: [
        describe_basis_size(curve),
        "intervals are of surfels of these takes, not of other people",
    ],
    # the labels of the weights name the BRDFs of the fits
    cohort_options={
        "surfels": MAX_FACTORED,
        "variables": (*BASIS_SIZE_VARIABLES, variables.DICTIONARY_WEIGHT),
    },
)
