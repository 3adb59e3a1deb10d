"""Maps of the differences between groups of subjects in the common (u, v)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from skindb.analysis.contrasts import (
    CHANNELS,
    CONTRAST_CURE,
    CONTRAST_RULE,
    SURFACE,
    Contrast,
    Quantities,
    associations,
    contrast_counts,
    contrast_flags,
    contrasts,
    other_attributes,
)
from skindb.analysis.group_effects import SIGNIFICANT
from skindb.analysis.study import Population, Results, Study, each_take
from skindb.analysis.subjects import notes_on_attributes, subjects_of
from skindb.errors import Fault, InputError
from skindb.numerics.inference import (
    effects,
    paired_effects,
    permutation_p,
    sign_flip_p,
)
from skindb.parameters import (
    adjust_option,
    compared_option,
    permutations_option,
    seed_option,
)
from skindb.schema import dataset
from skindb.schema.cohort import require_same_fit, require_takes
from skindb.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# texels along each side: about 1 mm each, which is also the accuracy of landmarks
SIZE = 256
# minimum fraction of the compared subjects that must have a value at a texel
MIN_FRACTION = 0.8
COVERED = 0.5  # minimum fraction of a texel that must be measured
# variable of the maps -> name of the quantity; p values are adjusted for all texels and
# channels of a variable
MAPPED = {
    "texel_diffuse_reflectance": "R_d",
    "texel_surface_reflectance": SURFACE,
    "texel_sigma_tr": "sigma_tr",
}
PERMUTATIONS = 1000  # of each of 65,536 texels
LOGARITHMIC = "sigma_tr"
SHOWN_FRACTION = 0.995  # fraction of the texels within the range of a colour scale
SHOWN = ("R_d G", SURFACE, "sigma_tr G")


def effect_maps(
    cohort: xr.Dataset,
    *,
    group_by: str,
    adjust: Sequence[str] = (),
    size: int = SIZE,
    permutations: int = PERMUTATIONS,
    min_fraction: float = MIN_FRACTION,
    mixed_fits: bool = False,
    rng: np.random.Generator,
) -> xr.Dataset:
    """Effect of an attribute on albedo, surface reflectance and log sigma_tr at every
    texel, adjusted for others.

    The regression, its intervals and the permutations are those of `group_effects`,
    with every texel as one quantity. The value of a texel in a take is the mean of the
    measured texels of the finer map. The p values are adjusted for all texels and
    channels of a variable by the largest statistic, which accounts for the correlation
    of neighbours.

    Parameters
    ----------
    cohort
        ``db.cohort("maps")``.
    group_by, adjust, mixed_fits, rng
        See `group_effects`.
    size
        Texels along each side; it must divide the size of the maps of the cohort.
    permutations
        Maximum number of permutations; the smallest p value is 1 / (permutations + 1).
    min_fraction
        Minimum fraction of the subjects that must have a value at a texel; other texels are NaN.

    Returns
    -------
    Dataset
        (contrast, quantity, v, u) `map_effect`, `map_effect_half_width` of its 95 %
        interval, `map_effect_p` of the single texel, `map_effect_p_adjusted`, and
        `map_effect_count`, the number of subjects.

    Raises
    ------
    InputError
        If there are no groups to compare, or if no texel has values of enough subjects.
    """
    require_takes(cohort, "maps")
    adjust = (adjust,) if isinstance(adjust, str) else tuple(adjust)
    if not mixed_fits:
        require_same_fit(cohort)
    texels = cohort.sizes["v"]
    if size < 1 or texels % size:
        rule = f"must divide the {texels} texels of the maps"
        cure = f"choose {texels}, {texels // 2} or {texels // 4}"
        raise InputError(Fault("size", rule, str(size), cure))
    columns: dict[str, list[Array]] = {}
    names: list[str] = []
    quantities: list[str] = []
    counts: list[int] = []
    faults: list[Fault] = []
    flags = list[str]()
    subjects = subjects_of(cohort)
    others = other_attributes(subjects, group_by)
    for variable, called in MAPPED.items():
        if variable not in cohort:
            continue

        def measure(takes: xr.Dataset, variable: str = variable) -> Quantities:
            return _texel_quantities(takes, variable, size)

        channels = cohort[variable].ndim == 4
        channel_names = (
            [f"{called} {channel}" for channel in CHANNELS] if channels else [called]
        )
        statistics = []
        for contrast in contrasts(cohort, group_by, adjust, measure):
            try:
                statistics.append(
                    (
                        contrast.name,
                        *_contrast_statistics(
                            contrast, permutations, min_fraction, rng
                        ),
                    )
                )
                associated = associations(contrast, subjects, others)
                flags += contrast_flags(
                    contrast, subjects, associated, adjust, contrast_counts(contrast)
                )
            except ValueError as error:
                faults.append(
                    Fault(
                        f"{contrast.name}, {called}",
                        CONTRAST_RULE,
                        str(error),
                        CONTRAST_CURE,
                    )
                )
        if not statistics:
            continue
        # a contrast is missing for this variable only
        if names and [name for name, _, _ in statistics] != names:
            faults.append(
                Fault(
                    called,
                    "every comparison must have texels",
                    "none for some",
                    "exclude takes",
                )
            )
            continue
        names = [name for name, _, _ in statistics]
        counts = [count for _, _, count in statistics]
        quantities += channel_names
        for name in statistics[0][1]:
            # one row a contrast, of texels and channels
            stacked = np.stack([values[name] for _, values, _ in statistics])
            placed = stacked.reshape(len(statistics), size, size, len(channel_names))
            columns.setdefault(name, []).append(np.moveaxis(placed, -1, 1))
    if not names:
        raise InputError(
            faults
            or Fault(
                "maps",
                "some texels must be measured",
                "none",
                "fit or register more takes",
            )
        )
    return dataset(
        {name: np.concatenate(values, axis=1) for name, values in columns.items()},
        coords={"contrast": names, "quantity": quantities},
        attrs={
            "group_by": group_by,
            "adjust": list(adjust),
            "permutations": counts,
            "logarithmic": [
                name for name in quantities if name.startswith(LOGARITHMIC)
            ],
            "flags": [
                *dict.fromkeys([*flags, *notes_on_attributes(subjects)]),
                *(f"{fault.where}: excluded, {fault.found}" for fault in faults),
            ],
            "skipped": list(cohort.attrs.get("skipped", [])),
        },
    )


def _texel_quantities(takes: xr.Dataset, variable: str, size: int) -> Quantities:
    """Values of a variable at every texel (and channel) of every take, as quantities."""
    values = np.stack(
        each_take(_block_means, takes, [variable, "texel_coverage"], variable, size)
    )
    count = values.shape[1]
    subject = tuple(map(str, takes["subject"].values))
    nothing = np.full(values.shape, np.nan, np.float32)  # errors of texels are not used
    return Quantities(
        tuple(map(str, range(count))),
        values,
        nothing,
        np.full(count, variable.endswith(LOGARITHMIC)),
        np.zeros(count),
        subject,
    )


def _block_means(take: xr.Dataset, variable: str, size: int) -> Array:
    """Means (size * size * channels,) of the measured texels in blocks of texels; NaN
    where too few were measured.
    """
    values = take[variable].values.astype(np.float64)
    values = values.reshape(*values.shape[:2], -1)
    if variable.endswith(LOGARITHMIC):
        values = np.log(np.where(values > 0, values, np.nan))
    is_known = np.isfinite(values).all(axis=-1)
    weight = np.where(is_known, take["texel_coverage"].values, 0.0)[..., None]
    block = len(values) // size
    shape = (size, block, size, block, -1)
    total = weight.reshape(shape).sum(axis=(1, 3))
    mean = (np.nan_to_num(values) * weight).reshape(shape).sum(
        axis=(1, 3)
    ) / np.maximum(total, 1e-12)
    return (
        np.where(total >= COVERED * block**2, mean, np.nan).astype(np.float32).ravel()
    )


def _contrast_statistics(
    contrast: Contrast, max_draws: int, min_fraction: float, rng: np.random.Generator
) -> tuple[dict[str, Array], int]:
    """Statistics of a contrast at all texels (NaN for too few subjects), and the number
    of permutations.
    """
    values = contrast.quantities.values
    count = np.isfinite(values).sum(axis=0)
    able = np.flatnonzero(count >= max(min_fraction * len(values), 1))
    if not able.size:
        raise ValueError(
            f"no texel with values of {min_fraction:.0%} of the {len(values)} subjects"
        )
    chosen = values[:, able].astype(np.float64)
    if contrast.is_paired:
        fit = paired_effects(chosen)
        p, adjusted, drawn = sign_flip_p(chosen, max_draws=max_draws, rng=rng)
    else:
        fit = effects(chosen, contrast.regressor, contrast.covariates)
        p, adjusted, drawn = permutation_p(
            chosen,
            contrast.regressor,
            contrast.covariates,
            max_draws=max_draws,
            rng=rng,
        )
    variables = {
        "map_effect": fit.slope,
        "map_effect_half_width": (fit.high - fit.low) / 2,
        "map_effect_p": p,
        "map_effect_p_adjusted": adjusted,
    }
    placed = {name: np.full(len(count), np.nan, np.float32) for name in variables}
    for name, part in variables.items():
        placed[name][able] = part
    return placed | {"map_effect_count": count}, drawn


def tabulate_effect_maps(maps: xr.Dataset) -> tuple[list[str], list[list[Any]]]:
    """Header and one row per comparison and quantity: texels, fraction that differs,
    mean and largest effect.
    """
    header = [
        "contrast",
        "quantity",
        "subjects",
        "texels",
        "fraction_that_differs",
        "mean_effect",
        "largest_effect",
    ]
    rows: list[list[Any]] = []
    for contrast in maps["contrast"].values.tolist():
        for quantity in maps["quantity"].values.tolist():
            part = maps.sel(contrast=contrast, quantity=quantity)
            effect = part["map_effect"].values
            is_known = np.isfinite(part["map_effect_p"].values)
            if not is_known.any():
                rows.append([contrast, quantity, 0, 0, *[float("nan")] * 3])
                continue
            differ = part["map_effect_p_adjusted"].values[is_known] < SIGNIFICANT
            largest = effect[is_known][np.abs(effect[is_known]).argmax()]
            numbers = (differ.mean(), effect[is_known].mean(), largest)
            subjects = int(part["map_effect_count"].values[is_known].max())
            rows.append(
                [
                    contrast,
                    quantity,
                    subjects,
                    int(is_known.sum()),
                    *map(float, numbers),
                ]
            )
    return header, rows


def describe_effect_maps(maps: xr.Dataset) -> list[str]:
    """Notes on the table, one line each."""
    counts = zip(
        maps["contrast"].values.tolist(), maps.attrs["permutations"], strict=True
    )
    note = "p values are adjusted for all texels of a variable by the largest statistic"
    lines = [f"{name}: {note}; {count} permutations" for name, count in counts]
    if maps.attrs["logarithmic"]:
        lines.append("effects of sigma_tr are differences of its natural logarithm")
    return [*lines, *maps.attrs["flags"]]


def plot_effect_maps(maps: xr.Dataset, *, contrast: str | None = None) -> Figure:
    """Plot maps of the effect, of the half-width of its 95 % interval and of the number
    of subjects.

    Lines surround regions of adjusted p < 0.05.

    Parameters
    ----------
    maps
        From `effect_maps`.
    contrast
        Name of the comparison; by default the first.
    """
    from matplotlib import pyplot

    name = contrast or str(maps["contrast"].values[0])
    part = maps.sel(contrast=name)
    names = part["quantity"].values.tolist()
    quantities = [quantity for quantity in SHOWN if quantity in names] or names[:1]
    figure: Figure
    figure, axes = pyplot.subplots(
        len(quantities), 3, figsize=(9, 2.9 * len(quantities)), squeeze=False
    )
    rows, columns = _finite_extent(part["map_effect_p"].sel(quantity=quantities).values)
    for line, quantity in zip(axes, quantities, strict=True):
        quantity_map = part.sel(quantity=quantity).isel(v=rows, u=columns)
        is_known = np.isfinite(quantity_map["map_effect_p"].values)
        unit = (
            "change of the logarithm"
            if quantity in maps.attrs["logarithmic"]
            else "difference"
        )
        largest = max(
            float(
                np.quantile(
                    np.abs(quantity_map["map_effect"].values[is_known]), SHOWN_FRACTION
                )
            ),
            1e-12,
        )
        wide = quantity_map["map_effect_half_width"].values
        widest = float(np.quantile(wide[is_known], SHOWN_FRACTION))
        parts: list[tuple[Array, dict[str, Any], str]] = [
            (
                quantity_map["map_effect"].values,
                {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest},
                f"effect on {quantity}",
            ),
            (
                wide,
                {"cmap": "cividis", "vmin": 0.0, "vmax": widest},
                "half-width of the 95 % CI",
            ),
            (
                np.where(is_known, quantity_map["map_effect_count"].values, np.nan),
                {"cmap": "cividis"},
                "subjects",
            ),
        ]
        for ax, (values, options, title) in zip(line, parts, strict=True):
            image = ax.imshow(values, interpolation="none", **options)
            label = "n" if title == "subjects" else unit
            figure.colorbar(image, ax=ax, shrink=0.8, label=label)
            ax.set(title=title, xticks=[], yticks=[])
            ax.title.set_fontsize(8)
        differ = (
            np.nan_to_num(quantity_map["map_effect_p_adjusted"].values, nan=1.0)
            < SIGNIFICANT
        )
        if differ.any() and not differ.all():
            line[0].contour(differ, levels=[0.5], colors="black", linewidths=0.6)
    adjusted = (
        f", adjusted for {', '.join(maps.attrs['adjust'])}"
        if maps.attrs["adjust"]
        else ""
    )
    figure.suptitle(f"{name}{adjusted}; lines surround adjusted p < 0.05", fontsize=9)
    figure.tight_layout()
    return figure


def _finite_extent(values: Array) -> tuple[slice, slice]:
    """Slices of the rows and columns that contain the finite values of an array (..., v, u)."""
    is_finite = np.asarray(np.isfinite(values).any(axis=0))
    extents = []
    for axis in (1, 0):
        indices = np.flatnonzero(is_finite.any(axis=axis))
        extents.append(
            slice(int(indices[0]), int(indices[-1]) + 1)
            if indices.size
            else slice(None)
        )
    return extents[0], extents[1]


@dataclass(frozen=True)
class Parameters:
    """Parameters of the study of maps."""

    group_by: str = compared_option()
    adjust: tuple[str, ...] = adjust_option()
    permutations: int = permutations_option(PERMUTATIONS)
    seed: int = seed_option("the permutations")


def compute(population: Population, parameters: Parameters) -> Results:
    """The results of the study."""
    maps = effect_maps(
        population.cohort,
        group_by=parameters.group_by,
        adjust=parameters.adjust,
        permutations=parameters.permutations,
        mixed_fits=population.mixed_fits,
        rng=np.random.default_rng(parameters.seed),
    )
    return {"effect_maps": maps}


STUDY = Study(
    name="maps",
    description="differences between groups at every texel of the common (u, v)",
    layout="maps",
    parameters=Parameters,
    compute=compute,
    shown=("effect_maps",),
    tabulate=tabulate_effect_maps,
    plot=plot_effect_maps,
    describe=describe_effect_maps,
    compares_normal=True,
)
