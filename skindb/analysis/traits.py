"""Trait vectors: the mean with a trait less the mean without (Weyrich et al. 2005, section 11)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.albedo import quantiles
from skindb.analysis.members import Takes, consenting, left_out, sides, trait_names
from skindb.errors import Fault, InputError
from skindb.schema import IDENTIFIED, dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.floating[Any]]
SIDES = ("with", "without")


def trait_vectors(
    models: Takes, *, basis: xr.Dataset, albedo: xr.Dataset, traits: Sequence[str] | None = None
) -> xr.Dataset:
    """Shifts of surface BRDF, albedo histograms and translucency that go with traits.

    Parameters
    ----------
    models
        Take -> version of kind "model".
    basis, albedo
        From `population_basis` and `albedo_histograms` of these takes.
    traits
        Names; default every one that some takes have and others lack. A condition is compared within the subjects
        measured with and without it, if there are any.

    Returns
    -------
    Dataset
        `trait_brdf_shift`, `trait_histogram_shift`, `trait_quantile_shift`, `trait_log_sigma_tr_shift`, `trait_count`
        (side: with, without),
        `take_log_sigma_tr` (what an edit's distance is measured against).
        NaN where a side has no such region or no site that the probe touched on both sides. Attribute `flags`: traits
        with a single take on a side.

    Raises
    ------
    InputError
        A trait that nobody or everybody has: there is no difference to take.
    """
    takes = consenting(models)
    names = list(trait_names(takes) if traits is None else traits)
    split = [sides(takes, name) for name in names]
    bad = [(n, w, o) for n, (w, o) in zip(names, split, strict=True) if not w.any() or not o.any()]
    if bad:
        known = ", ".join(trait_names(takes)) or "none"
        rule = "a trait needs takes with and takes without it"
        raise InputError(
            Fault(f"trait {n}", rule, f"{w.sum()} with, {o.sum()} without", f"traits here: {known}") for n, w, o in bad
        )
    histograms = albedo["albedo_histogram"].sel(take=list(takes)).values
    columns = {
        "trait_brdf_shift": basis["take_coefficient"].sel(take=list(takes)).values,
        "trait_histogram_shift": histograms,
        "trait_quantile_shift": quantiles(histograms, albedo["histogram_edge"].values),
    }
    shifts = {
        name: np.array([_difference(x, w, o) for w, o in split]).reshape(len(names), *x.shape[1:])
        for name, x in columns.items()
    }
    log_tr = _log_sigma_tr(takes)
    # site by site: where the probe touched must not pass for a trait
    shifts["trait_log_sigma_tr_shift"] = np.array([_known_mean(_difference(log_tr, *s)) for s in split]).reshape(-1, 3)
    counts = np.array([[w.sum(), o.sum()] for w, o in split]).reshape(len(names), 2)
    lone = [f"{names[i]}: one take {SIDES[j]} it, not a mean" for i, j in np.argwhere(counts == 1)]
    return dataset(
        {"trait_count": counts, "take_log_sigma_tr": _mean_over_sites(log_tr), **shifts},
        coords={
            "take": list(takes),
            "trait": names,
            "side": list(SIDES),
            "region": albedo["region"].values,
            "channel": ["R", "G", "B"],
        },
        attrs={"flags": lone, "left_out": left_out(models)},
    )


def _difference(values: Array, carries: NDArray[np.bool_], lacks: NDArray[np.bool_]) -> Array:
    return _known_mean(values[carries]) - _known_mean(values[lacks])


def _known_mean(values: Array) -> Array:
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


def _mean_over_sites(log_tr: Array) -> Array:
    return _known_mean(np.moveaxis(log_tr, 1, 0))


def _log_sigma_tr(models: Takes) -> Array:
    """Log sigma_tr (take, site, channel) over all sites there are; NaN where a take has no trusted one."""
    nodes = {t: m["translucency"].to_dataset() for t, m in models.items() if "translucency" in m.children}
    sites = sorted({str(site) for node in nodes.values() for site in node["site"].values})
    values = np.full((len(models), max(len(sites), 1), 3), np.nan)
    for i, take in enumerate(models):
        if take in nodes:
            node = nodes[take]
            good = node["site_status"].isin(IDENTIFIED).values
            at = [sites.index(str(site)) for site in node["site"].values]
            values[i, at] = np.where(good, np.log(np.where(good, node["site_effective_transport"].values, 1.0)), np.nan)
    return values


def plot_traits(traits: xr.Dataset, *, ax: Axes | None = None) -> Axes:
    """Shift of the surface BRDF's coefficients, one row a trait, one column a component of the common basis."""
    from matplotlib import pyplot

    if ax is None:
        _, ax = pyplot.subplots(figsize=(6, 3.6))
    shift = traits["trait_brdf_shift"].values
    largest = max(float(np.abs(shift).max(initial=0.0)), 1e-12)
    image = ax.imshow(shift, cmap="RdBu_r", vmin=-largest, vmax=largest, aspect="auto")
    counts = [f"{t} ({w}/{o})" for t, (w, o) in zip(traits["trait"].values, traits["trait_count"].values, strict=True)]
    ax.set_yticks(range(len(counts)), counts)
    ax.set_xlabel("component of the common basis")
    ax.figure.colorbar(image, ax=ax, label="coefficient with the trait less without")
    return ax
