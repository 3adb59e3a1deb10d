"""Principal components of the takes of a cohort (Weyrich et al. 2005, section 10.2)."""

from __future__ import annotations

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
    skipped_takes,
    table_of,
)
from skindb.errors import require
from skindb.numerics.factorise import principal_axes
from skindb.parameters import option
from skindb.render.image import tone_map
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS
from skindb.schema.notes import Note, note
from skindb.types import Array, Float64, Index, Mask

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# minimum fraction of known entries of a take; an entry unknown in one take is dropped
# for all takes
LEAST_KNOWN = 0.5


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
    # the mean uses up one dimension: one more axis would be rounding error
    axes = principal_axes(
        each_take(_used_entries, cohort.isel(take=rows), ["values"], is_used),
        min(max_components, max(len(rows) - 1, 1)),
    )
    shape = tuple(cohort.sizes[dim] for dim in dims)
    units = {"units": values.attrs.get("units", "1")}
    ds = Dataset(
        {
            "mean": (dims, _expand(axes.mean, is_used, shape), units),
            "axis": (["component", *dims], _expand(axes.axes, is_used, shape)),
            "score": (["take", "component"], axes.score, units),
            "explained_variance": (["component"], axes.variance),
            "explained_variance_ratio": (
                ["component"],
                axes.variance / (axes.total or 1.0),
            ),
            "residual": (["take"], axes.residual, units),
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
    finite = np.stack(each_take(_finite_entries, cohort, ["values"]))
    fraction = finite.mean(axis=1)
    enough = (fraction >= least_known) & (fraction > 0)
    skipped = [
        note(
            str(cohort["take"].values[i]),
            f"only {fraction[i]:.0%} of its entries are known",
        )
        for i in np.flatnonzero(~enough)
    ]
    require(
        enough.sum() >= 2,
        "principal components",
        "at least two takes must have enough values",
        f"{enough.sum()} of {len(enough)}",
        "fit or register more takes",
    )
    is_used: Mask = finite[enough].all(axis=0)
    require(
        is_used.any(),
        "principal components",
        "some entries must be known in every take",
        f"none of {is_used.size}",
        "set a larger least_known to exclude takes that cover other parts",
    )
    return np.flatnonzero(enough), is_used, skipped


def _finite_entries(take: Dataset) -> Mask:
    return np.asarray(np.isfinite(take["values"].values).ravel())


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
    found = principal_components(
        cohort[variables.TEXEL_DIFFUSE_REFLECTANCE], max_components=max_components
    )
    return dataset(
        {
            variables.PRINCIPAL_MEAN: found["mean"].values,
            variables.PRINCIPAL_AXIS: found["axis"].values,
            variables.PRINCIPAL_SCORE: found["score"].values,
            variables.PRINCIPAL_VARIANCE_RATIO: found[
                "explained_variance_ratio"
            ].values,
            variables.PRINCIPAL_RESIDUAL: found["residual"].values,
        },
        coords={"take": found["take"].values.tolist(), "channel": CHANNELS},
        attrs=found.attrs | {"skipped": skipped_takes(cohort) + found.attrs["skipped"]},
    )


def tabulate_components(table: Dataset) -> Table:
    """Header and one row per take with its scores and its residual."""
    scores = table[variables.PRINCIPAL_SCORE]
    columns = {
        f"score_{i + 1}": scores.isel(component=i)
        for i in range(table.sizes["component"])
    }
    names = [*columns, variables.PRINCIPAL_RESIDUAL]
    return table_of(table.assign(columns), names)


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
