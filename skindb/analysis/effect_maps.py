"""Differences between groups of subjects at every texel of the common (u, v)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from skindb._types import Array
from skindb.analysis.each_take import each_take
from skindb.analysis.group_effects import (
    SIGNIFICANT,
    Contrast,
    associations,
    contrast_counts,
    contrast_flags,
    contrasts,
    other_attributes,
)
from skindb.analysis.members import texts
from skindb.analysis.quantities import CHANNELS, SURFACE, Quantities
from skindb.errors import Fault, InputError
from skindb.numerics.inference import effects, paired_effects, permutation_p, sign_flip_p
from skindb.schema import dataset
from skindb.schema.cohort import require_same_fit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE = 256  # texels along each side: about 1 mm, and landmarks agree no better
LEAST_SHARE = 0.8  # of the subjects compared, that a texel needs
COVERED = 0.5  # fraction of a texel that must be measured
# variable of the maps -> what it is called; each is a family of which the largest statistic corrects the p values
MAPPED = {
    "texel_diffuse_reflectance": "R_d",
    "texel_surface_reflectance": SURFACE,
    "texel_sigma_tr": "sigma_tr",
}
LOGARITHMIC = "sigma_tr"
SHOWN_SHARE = 0.995  # of the texels, that a scale of colours spans
SHOWN = ("R_d G", SURFACE, "sigma_tr G")


def effect_maps(
    cohort: xr.Dataset,
    *,
    group_by: str,
    adjust: Sequence[str] = (),
    size: int = SIZE,
    permutations: int = 1000,
    least_share: float = LEAST_SHARE,
    mixed_fits: bool = False,
    rng: np.random.Generator,
) -> xr.Dataset:
    """Effect of an attribute on albedo, surface reflectance and log sigma_tr at every texel, others held fixed.

    The regression, its intervals and the permutations are those of `group_effects`, of which every texel is one
    quantity; texels of a take are means of what it measured. The p values are corrected for all texels and channels of
    a variable by the largest statistic, which knows that neighbours are alike.

    Parameters
    ----------
    cohort
        ``db.cohort("maps")``.
    group_by, adjust, mixed_fits, rng
        See `group_effects`.
    size
        Texels along each side; the maps of the cohort have a whole multiple of it.
    permutations
        Most permutations: the smallest p value is 1 / (permutations + 1).
    least_share
        Texels that a smaller fraction of the subjects has are NaN.

    Returns
    -------
    Dataset
        (contrast, quantity, v, u) `map_effect`, `map_effect_half_width` of its 95 % interval, `map_effect_p` of the
        texel alone, `map_effect_p_adjusted`; `map_effect_count` of subjects.

    Raises
    ------
    InputError
        If there is nothing to compare, or no texel that enough subjects have.
    """
    if not mixed_fits:
        require_same_fit(cohort)
    whole = cohort.sizes["v"]
    if size < 1 or whole % size:
        rule, cure = f"must divide the {whole} texels of the maps", f"choose {whole}, {whole // 2} or {whole // 4}"
        raise InputError(Fault("size", rule, str(size), cure))
    columns: dict[str, list[Array]] = {}
    names: list[str] = []
    quantities: list[str] = []
    counts: list[int] = []
    faults: list[Fault] = []
    flags, others = list[str](), other_attributes(cohort, group_by)
    for variable, called in MAPPED.items():
        if variable not in cohort:
            continue

        def measure(takes: xr.Dataset, variable: str = variable) -> Quantities:
            return _texels(takes, variable, size)

        channels = cohort[variable].ndim == 4
        own = [f"{called} {channel}" for channel in CHANNELS] if channels else [called]
        found = []
        for one in contrasts(cohort, group_by, adjust, measure):
            try:
                found.append((one.name, *_compared(one, permutations, least_share, rng)))
                associated = associations(one, cohort, others)
                flags += contrast_flags(one, cohort, associated, adjust, contrast_counts(one))
            except ValueError as error:
                rule, cure = "subjects must differ in what is compared", "compare or adjust for less, or add subjects"
                faults.append(Fault(f"{one.name}, {called}", rule, str(error), cure))
        if not found:
            continue
        if names and [name for name, _, _ in found] != names:  # a contrast that this variable alone lacks
            faults.append(Fault(called, "every comparison needs texels", "none for some", "exclude takes"))
            continue
        names, counts = [name for name, _, _ in found], [count for _, _, count in found]
        quantities += own
        for name in found[0][1]:
            stacked = np.stack([values[name] for _, values, _ in found])  # (contrast, texel * channel)
            placed = stacked.reshape(len(found), size, size, len(own))
            columns.setdefault(name, []).append(np.moveaxis(placed, -1, 1))
    if not names:
        raise InputError(faults or Fault("maps", "some texels must be measured", "none", "fit or register more takes"))
    return dataset(
        {name: np.concatenate(values, axis=1) for name, values in columns.items()},
        coords={"contrast": names, "quantity": quantities},
        attrs={
            "group_by": group_by,
            "adjust": list(adjust),
            "permutations": counts,
            "logarithmic": [name for name in quantities if name.startswith(LOGARITHMIC)],
            "flags": [*dict.fromkeys(flags), *(f"{fault.where}: excluded, {fault.found}" for fault in faults)],
            "skipped": list(cohort.attrs.get("skipped", [])),
        },
    )


def _texels(takes: xr.Dataset, variable: str, size: int) -> Quantities:
    """Every texel of a variable, of every take."""
    values = np.stack(each_take(_reduced, takes, [variable, "texel_coverage"], variable, size))
    count = values.shape[1]
    subject = tuple(str(one) for one in texts(takes["subject"]))
    nothing = np.full(values.shape, np.nan, np.float32)  # errors of texels are not used
    return Quantities(
        tuple(map(str, range(count))), values, nothing, np.full(count, variable.endswith(LOGARITHMIC)),
        np.zeros(count), subject,
    )  # fmt: skip


def _reduced(take: xr.Dataset, variable: str, size: int) -> Array:
    """(size * size * channels,) means of what a take measured in blocks of texels; NaN where it measured too little."""
    values = take[variable].values.astype(np.float64)
    values = values.reshape(*values.shape[:2], -1)
    if variable.endswith(LOGARITHMIC):
        values = np.log(np.where(values > 0, values, np.nan))
    known = np.isfinite(values).all(axis=-1)
    weight = np.where(known, take["texel_coverage"].values, 0.0)[..., None]
    block = len(values) // size
    shape = (size, block, size, block, -1)
    total = weight.reshape(shape).sum(axis=(1, 3))
    mean = (np.nan_to_num(values) * weight).reshape(shape).sum(axis=(1, 3)) / np.maximum(total, 1e-12)
    return np.where(total >= COVERED * block**2, mean, np.nan).astype(np.float32).ravel()


def _compared(one: Contrast, most: int, least_share: float, rng: np.random.Generator) -> tuple[dict[str, Array], int]:
    """Values of all texels of a contrast, NaN where too few subjects have one, and the number of permutations."""
    values = one.quantities.values
    count = np.isfinite(values).sum(axis=0)
    able = np.flatnonzero(count >= max(least_share * len(values), 1))
    if not able.size:
        raise ValueError(f"no texel that {least_share:.0%} of {len(values)} subjects have")
    chosen = values[:, able].astype(np.float64)
    if one.is_paired:
        fit = paired_effects(chosen)
        p, adjusted, drawn = sign_flip_p(chosen, most=most, rng=rng)
    else:
        fit = effects(chosen, one.regressor, one.covariates)
        p, adjusted, drawn = permutation_p(chosen, one.regressor, one.covariates, most=most, rng=rng)
    found = {
        "map_effect": fit.slope,
        "map_effect_half_width": (fit.high - fit.low) / 2,
        "map_effect_p": p,
        "map_effect_p_adjusted": adjusted,
    }
    placed = {name: np.full(len(count), np.nan, np.float32) for name in found}
    for name, part in found.items():
        placed[name][able] = part
    return placed | {"map_effect_count": count}, drawn


def tabulate_effect_maps(maps: xr.Dataset) -> tuple[list[str], list[list[Any]]]:
    """Header and a row for each comparison and quantity: texels, fraction that differs, mean and largest effect."""
    header = ["contrast", "quantity", "subjects", "texels", "share_that_differs", "mean_effect", "largest_effect"]
    rows: list[list[Any]] = []
    for contrast in maps["contrast"].values.tolist():
        for quantity in maps["quantity"].values.tolist():
            one = maps.sel(contrast=contrast, quantity=quantity)
            effect, known = one["map_effect"].values, np.isfinite(one["map_effect_p"].values)
            if not known.any():
                rows.append([contrast, quantity, 0, 0, *[float("nan")] * 3])
                continue
            differ = one["map_effect_p_adjusted"].values[known] < SIGNIFICANT
            largest = effect[known][np.abs(effect[known]).argmax()]
            numbers = (differ.mean(), effect[known].mean(), largest)
            subjects = int(one["map_effect_count"].values[known].max())
            rows.append([contrast, quantity, subjects, int(known.sum()), *map(float, numbers)])
    return header, rows


def describe_effect_maps(maps: xr.Dataset) -> list[str]:
    """Notes on the table, one line each."""
    counts = zip(maps["contrast"].values.tolist(), maps.attrs["permutations"], strict=True)
    said = "p values are adjusted for all texels of a variable by the largest statistic"
    lines = [f"{name}: {said}; {count} permutations" for name, count in counts]
    return [*lines, *maps.attrs["flags"]]


def plot_effect_maps(maps: xr.Dataset, *, contrast: str | None = None) -> Figure:
    """Effect, half-width of its 95 % interval and number of subjects as maps; lines surround adjusted p < 0.05.

    Parameters
    ----------
    maps
        From `effect_maps`.
    contrast
        Default the first.
    """
    from matplotlib import pyplot

    name = contrast or str(maps["contrast"].values[0])
    one = maps.sel(contrast=name)
    names = one["quantity"].values.tolist()
    shown = [quantity for quantity in SHOWN if quantity in names] or names[:1]
    figure: Figure
    figure, axes = pyplot.subplots(len(shown), 3, figsize=(9, 2.9 * len(shown)), squeeze=False)
    rows, columns = _measured(one["map_effect_p"].sel(quantity=shown).values)
    for line, quantity in zip(axes, shown, strict=True):
        own = one.sel(quantity=quantity).isel(v=rows, u=columns)
        known = np.isfinite(own["map_effect_p"].values)
        unit = "change of the logarithm" if quantity in maps.attrs["logarithmic"] else "difference"
        largest = max(float(np.quantile(np.abs(own["map_effect"].values[known]), SHOWN_SHARE)), 1e-12)
        wide = own["map_effect_half_width"].values
        widest = float(np.quantile(wide[known], SHOWN_SHARE))
        parts: list[tuple[Array, dict[str, Any], str]] = [
            (own["map_effect"].values, {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}, f"effect on {quantity}"),
            (wide, {"cmap": "cividis", "vmin": 0.0, "vmax": widest}, "half-width of the 95 % CI"),
            (np.where(known, own["map_effect_count"].values, np.nan), {"cmap": "cividis"}, "subjects"),
        ]
        for ax, (values, options, title) in zip(line, parts, strict=True):
            image = ax.imshow(values, interpolation="none", **options)
            label = "n" if title == "subjects" else unit
            figure.colorbar(image, ax=ax, shrink=0.8, label=label)
            ax.set(title=title, xticks=[], yticks=[])
            ax.title.set_fontsize(8)
        differ = np.nan_to_num(own["map_effect_p_adjusted"].values, nan=1.0) < SIGNIFICANT
        if differ.any() and not differ.all():
            line[0].contour(differ, levels=[0.5], colors="black", linewidths=0.6)
    held = f", {', '.join(maps.attrs['adjust'])} held fixed" if maps.attrs["adjust"] else ""
    figure.suptitle(f"{name}{held}; lines surround adjusted p < 0.05", fontsize=9)
    figure.tight_layout()
    return figure


def _measured(values: Array) -> tuple[slice, slice]:
    """Rows and columns (v, u) about what is known in (..., v, u)."""
    known = np.asarray(np.isfinite(values).any(axis=0))
    found = []
    for axis in (1, 0):
        at = np.flatnonzero(known.any(axis=axis))
        found.append(slice(int(at[0]), int(at[-1]) + 1) if at.size else slice(None))
    return found[0], found[1]
