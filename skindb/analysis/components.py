"""Mean face of a cohort in the common (u, v) and principal components of its takes (Weyrich et
al. 2005, section 10.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from xarray import DataArray, Dataset

from skindb.analysis.study import (
    Population,
    Results,
    Study,
    Table,
    each_take,
    shared_once,
    skipped_takes,
    table_of,
)
from skindb.analysis.subjects import takes_to_compare
from skindb.analysis.texture import COVERED
from skindb.errors import input_error, require
from skindb.numerics.factorise import principal_axes
from skindb.numerics.statistics import Moments, known_mean
from skindb.parameters import option
from skindb.render.image import tone_map
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS
from skindb.schema.notes import Note, note
from skindb.types import Array, Bytes, Float64, Index, Mask

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# the spread of fewer is unknown, and their mean would show the face of a single subject
LEAST_SUBJECTS = 3
COVERAGE = variables.TEXEL_COVERAGE
# map -> (name, whether it is averaged on the log scale)
AVERAGED = {
    variables.TEXEL_DIFFUSE_REFLECTANCE: (variables.FACE_DIFFUSE_REFLECTANCE, True),
    variables.TEXEL_SIGMA_TR: (variables.FACE_SIGMA_TR, True),
    variables.TEXEL_SURFACE_REFLECTANCE: (variables.FACE_SURFACE_REFLECTANCE, False),
}
UNIT = {"units": "1", "long_name": "unit vector"}
# minimum fraction of known entries of a take; an entry unknown in one take is dropped
# for all takes
LEAST_KNOWN = 0.5


def mean_face(cohort: Dataset, *, min_subjects: int = LEAST_SUBJECTS) -> Dataset:
    """Mean and standard deviation over subjects of albedo, sigma_tr and surface
    reflectance, texel by texel.

    Takes in another condition than normal are excluded, and the takes of a subject are
    averaged first. Albedo and sigma_tr are averaged on the log scale and transformed
    back: the mean is the geometric one, and the standard deviation is that of the
    natural logarithm (pigments multiply). Surface reflectance is averaged as it is.
    Only one subject is in memory at a time; its sums are merged with those of the
    others (Chan et al. 1979).

    Parameters
    ----------
    cohort
        ``db.cohort("maps")``; the result omits maps that the cohort lacks.
    min_subjects
        Minimum number of subjects of a texel; texels with fewer are NaN.

    Returns
    -------
    Dataset
        `face_diffuse_reflectance`, `face_sigma_tr` (v, u, channel),
        `face_surface_reflectance` (v, u), each with `_log_deviation` or `_deviation`
        and `_count`, the number of subjects.

    Raises
    ------
    InputError
        If no texel has enough subjects.
    """
    require_comparable(cohort, "maps")
    takes, subjects = takes_to_compare(cohort, None)
    names = [name for name in AVERAGED if name in takes]
    sums: dict[str, Moments] = {}
    for subject in subjects.names:
        rows = np.flatnonzero(subjects.rows_of(subject))
        for name, values in _subject_maps(takes.isel(take=rows), names).items():
            moments = Moments.of(values[None])
            sums[name] = sums[name] + moments if name in sums else moments
    maps: dict[str, Array] = {}
    for name, moments in sums.items():
        short, is_log = AVERAGED[name]
        enough = moments.count >= max(min_subjects, 1)
        mean = np.exp(moments.mean) if is_log else moments.mean
        kind = "log_deviation" if is_log else "deviation"
        maps[short] = np.where(enough, mean, np.nan)
        maps[f"{short}_{kind}"] = np.where(enough, moments.standard_deviation, np.nan)
        count = moments.count.reshape(*moments.count.shape[:2], -1)
        maps[f"{short}_count"] = count.min(axis=-1)
    require(
        any(np.isfinite(maps[AVERAGED[name][0]]).any() for name in names),
        "mean face",
        f"at least one texel must be measured in {min_subjects} subjects",
        f"none among {len(subjects.names)} subjects",
        "fit or register more subjects",
    )
    return dataset(
        maps,
        coords={"channel": CHANNELS},
        attrs={
            "subjects": len(subjects.names),
            "least_subjects": min_subjects,
            "takes": sorted(map(str, takes["take"].values)),
            "skipped": skipped_takes(cohort),
        },
    )


def _subject_maps(takes: Dataset, names: list[str]) -> dict[str, Array]:
    """Means of the maps over the takes of a subject, on the scale of averaging; NaN
    where nothing was measured.
    """
    of_takes: dict[str, list[Array]] = {name: [] for name in names}
    for i in range(takes.sizes["take"]):
        take = takes[[*names, COVERAGE]].isel(take=i).load()
        measured = take[COVERAGE].values > COVERED
        for name in names:
            values = take[name].values.astype(float)
            is_known = (
                measured if values.ndim == 2 else measured[..., None]
            ) & np.isfinite(values)
            if AVERAGED[name][1]:
                is_known &= values > 0
                values = np.log(np.where(is_known, values, 1.0))
            of_takes[name].append(np.where(is_known, values, np.nan))
    return {name: known_mean(np.stack(values)) for name, values in of_takes.items()}


def principal_components(
    values: DataArray, *, max_components: int = 10, least_known: float = LEAST_KNOWN
) -> Dataset:
    """Mean, principal axes and scores of the takes of a cohort.

    Every take is read by its own tasks. The vectors of all takes are kept in memory in
    their own precision (at most 550 MB for 174 maps of 512 x 512 texels).

    Parameters
    ----------
    values
        Variable of a cohort with the dimension ``take`` and any others: histograms,
        maps in the common (u, v), or colours.
    max_components
        Maximum number of components; it is also at most the number of takes minus one.
    least_known
        Takes with a smaller fraction of known entries are excluded. Only entries that
        are known in all other takes are used.

    Returns
    -------
    Dataset
        `mean` and `axis` (component, ...) in the units of `values`, NaN where an entry
        was not used; `score` (take, component), so that mean + score * axis
        approximates the take; `explained_variance` and `explained_variance_ratio`
        (component,); `residual` (take,), the root mean square of the part that the
        components do not explain. Attributes: `skipped`, and `used_fraction`, the
        fraction of the entries that was used.

    Raises
    ------
    InputError
        If there are fewer than two takes, or if no entry is known in all of them.

    Examples
    --------
    >>> faces = db.cohort("maps").texel_diffuse_reflectance  # doctest: +SKIP
    >>> found = principal_components(faces, max_components=5)  # doctest: +SKIP
    >>> found.axis.sel(component=0).plot.imshow()  # doctest: +SKIP
    """
    dims = [str(dim) for dim in values.dims if dim != "take"]
    cohort = values.transpose("take", *dims).rename("values").to_dataset()
    rows, is_used, skipped = _usable_entries(cohort, least_known)
    once = shared_once(is_used)
    # the mean uses up one dimension: one more axis would be rounding error
    max_components = min(max_components, max(len(rows) - 1, 1))
    axes = principal_axes(
        each_take(_used_entries, cohort.isel(take=rows), ["values"], once),
        max_components,
    )
    ratio = axes.variance / (axes.total or 1.0)
    shape = tuple(cohort.sizes[dim] for dim in dims)
    units = values.attrs.get("units", "1")
    ds = Dataset(
        {
            "mean": (dims, _expand(axes.mean, is_used, shape), {"units": units}),
            "axis": (
                ["component", *dims],
                _expand(axes.axes, is_used, shape),
                UNIT,
            ),
            "score": (["take", "component"], axes.score, {"units": units}),
            "explained_variance": (
                ["component"],
                axes.variance,
                {"long_name": "variance of the score"},
            ),
            "explained_variance_ratio": (["component"], ratio),
            "residual": (
                ["take"],
                axes.residual,
                {"units": units, "long_name": "root mean square residual"},
            ),
        },
        coords={
            "component": np.arange(len(axes.variance)),
            "take": cohort["take"].values[rows],
        },
        attrs={"skipped": skipped, "used_fraction": float(is_used.mean())},
    )
    return ds.assign_coords({dim: cohort[dim] for dim in dims if dim in cohort.coords})


def _usable_entries(
    cohort: Dataset, least_known: float
) -> tuple[Index, Mask, list[Note]]:
    """Rows of the takes with enough known entries, the entries that all of them know,
    and notes on the other takes.

    Raises
    ------
    InputError
        If there are fewer than two takes, or if no entry is known in all of them.
    """
    finite = each_take(_finite_entries, cohort, ["values"])
    entries = math.prod(cohort["values"].shape[1:])
    fraction = np.array([np.bitwise_count(bits).sum() for bits in finite]) / entries
    rows = np.flatnonzero((fraction >= least_known) & (fraction > 0))
    skipped = [
        note(str(take), f"only {fraction[i]:.0%} of its entries are known")
        for i, take in enumerate(cohort["take"].values)
        if i not in rows
    ]
    if len(rows) < 2:
        raise input_error(
            "principal components",
            "at least two takes must have enough values",
            f"{len(rows)} of {len(finite)}",
            "fit or register more takes",
        )
    used_bits = np.bitwise_and.reduce([finite[i] for i in rows])
    is_used = np.unpackbits(used_bits, count=entries).astype(bool)
    require(
        is_used.any(),
        "principal components",
        "some entries must be known in every take",
        f"none of {is_used.size}",
        "set a larger least_known to exclude takes that cover other parts",
    )
    return rows, is_used, skipped


def _finite_entries(take: Dataset) -> Bytes:
    """Mask of the known entries of a take, one bit each."""
    return np.packbits(np.isfinite(take["values"].values).ravel())


def _used_entries(take: Dataset, is_used: Mask) -> Array:
    return np.asarray(take["values"].values.ravel()[is_used])


def _expand(values: Array, is_used: Mask, shape: tuple[int, ...]) -> Float64:
    """Arrange entries (..., used) as arrays (..., *shape); NaN where an entry was not used."""
    out = np.full((*values.shape[:-1], is_used.size), np.nan)
    out[..., is_used] = values
    return out.reshape(*values.shape[:-1], *shape)


def face_components(cohort: Dataset, *, max_components: int = 5) -> Dataset:
    """Principal components of the albedo maps of a cohort, with the variable names of the store.

    Parameters
    ----------
    cohort
        ``db.cohort("maps")``; texels that a take did not measure count as unknown.
    max_components
        Maximum number of components.

    Returns
    -------
    Dataset
        `principal_mean`, `principal_axis`, `principal_score`,
        `principal_variance_ratio`, `principal_residual`. Attributes: `skipped`, and
        `used_fraction`, the fraction of the texels that was used.
    """
    require_comparable(cohort, "maps")
    albedo = cohort[variables.TEXEL_DIFFUSE_REFLECTANCE]
    components = principal_components(albedo, max_components=max_components)
    stored = {
        variables.PRINCIPAL_MEAN: "mean",
        variables.PRINCIPAL_AXIS: "axis",
        variables.PRINCIPAL_SCORE: "score",
        variables.PRINCIPAL_VARIANCE_RATIO: "explained_variance_ratio",
        variables.PRINCIPAL_RESIDUAL: "residual",
    }
    return dataset(
        {name: components[source].values for name, source in stored.items()},
        coords={
            "take": components["take"].values.tolist(),
            "channel": CHANNELS,
        },
        attrs={
            "skipped": [*cohort.attrs.get("skipped", []), *components.attrs["skipped"]],
            "used_fraction": components.attrs["used_fraction"],
        },
    )


def tabulate_components(table: Dataset) -> Table:
    """Header and one row per take with its scores and its residual."""
    scores = table[variables.PRINCIPAL_SCORE]
    columns = {
        f"score_{i + 1}": scores.isel(component=i)
        for i in range(table.sizes["component"])
    }
    names = [*columns, variables.PRINCIPAL_RESIDUAL]
    return table_of(table.assign(columns), names, ["take"])


def describe_components(table: Dataset) -> list[str]:
    """Fractions of the variance that the components explain, and what counts, one line each."""
    fractions = table[variables.PRINCIPAL_VARIANCE_RATIO].values
    ratios = ", ".join(f"{fraction:.0%}" for fraction in fractions)
    used = f"{table.attrs['used_fraction']:.0%} of the texels, which all takes have"
    return [
        f"components explain {ratios} of the variance between "
        f"{table.sizes['take']} takes ({used})",
        "each take counts once, so that subjects with several takes count more",
    ]


def plot_components(table: Dataset, *, max_components: int = 3) -> Figure:
    """Plot the first axes as faces: the mean, and one standard deviation in both directions."""
    from matplotlib import pyplot

    count = min(max_components, table.sizes["component"])
    mean = table[variables.PRINCIPAL_MEAN].values
    deviation = table[variables.PRINCIPAL_SCORE].values.std(axis=0, ddof=1)
    gain = 0.9 / max(float(np.nanquantile(mean, 0.995)), 1e-6)
    figure: Figure
    figure, axes = pyplot.subplots(count, 3, figsize=(6, 2.2 * count), squeeze=False)
    for i, line in enumerate(axes):
        for ax, by in zip(line, (-1, 0, 1), strict=True):
            face = np.nan_to_num(
                mean + by * deviation[i] * table[variables.PRINCIPAL_AXIS].values[i]
            )
            ax.imshow(tone_map(np.clip(face, 0, None), exposure=gain))
            ax.set(xticks=[], yticks=[])
            ax.set_title(
                {-1: "mean - 1 sd", 0: "mean", 1: "mean + 1 sd"}[by], fontsize=8
            )
        ratio = float(table[variables.PRINCIPAL_VARIANCE_RATIO][i])
        line[0].set_ylabel(f"axis {i + 1}\n{ratio:.0%} of the variance", fontsize=8)
    figure.suptitle(f"albedo of {table.sizes['take']} takes", fontsize=9)
    figure.tight_layout()
    return figure


@dataclass(frozen=True)
class Parameters:
    """Parameters of the study of components."""

    k: int = option(5, "Largest number of components.", minimum=1)


def compute(population: Population, parameters: Parameters) -> Results:
    """The results of the study."""
    components = face_components(population.cohort, max_components=parameters.k)
    return {"components": components}


STUDY = Study(
    name="components",
    description="principal components of albedo, drawn as faces",
    layout="maps",
    parameters=Parameters,
    compute=compute,
    shown=("components",),
    tabulate=tabulate_components,
    plot=plot_components,
    describe=describe_components,
)
