"""Trait vectors: the mean with a trait less the mean without (Weyrich et al. 2005, section 11)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from skindb._types import Array, Mask
from skindb.analysis.albedo import quantiles
from skindb.analysis.members import known_traits, sides, texts, trait_name, trait_names
from skindb.errors import Fault, InputError
from skindb.numerics.statistics import known_mean
from skindb.schema import IDENTIFIED, dataset
from skindb.schema.cohort import require_same_fit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIDES = ("with", "without")


def trait_vectors(
    cohort: xr.Dataset,
    *,
    basis: xr.Dataset,
    albedo: xr.Dataset,
    traits: Sequence[str] | None = None,
    mixed_fits: bool = False,
) -> xr.Dataset:
    """Shifts of surface BRDF, albedo histograms and translucency that go with traits.

    Parameters
    ----------
    cohort
        ``db.cohort("tables")``.
    basis, albedo
        From `population_basis` and `albedo_histograms` of the same takes.
    traits
        Names such as "condition:lotion"; default every one that some takes have and others lack. A condition is
        compared within the subjects measured with and without it, if there are any.
    mixed_fits
        Accept takes that were fitted with different parameters.

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
        If nobody or everybody has a trait: there is no difference to take. If the takes were fitted with different
        parameters.
    """
    if not mixed_fits:
        require_same_fit(cohort)
    known = trait_names(cohort)
    names = known if traits is None else [trait_name(name, _named(cohort, known)) for name in traits]
    split = [sides(cohort, name) for name in names]
    bad = [(n, w, o) for n, (w, o) in zip(names, split, strict=True) if not w.any() or not o.any()]
    if bad:
        there = ", ".join(known) or "none"
        rule = "a trait needs takes with and takes without it"
        raise InputError(
            Fault(f"trait {n}", rule, f"{w.sum()} with, {o.sum()} without", f"traits here: {there}") for n, w, o in bad
        )
    takes = cohort["take"].values
    histograms = albedo["albedo_histogram"].sel(take=takes).values
    columns = {
        "trait_brdf_shift": basis["take_coefficient"].sel(take=takes).values,
        "trait_histogram_shift": histograms,
        "trait_quantile_shift": quantiles(histograms, albedo["histogram_edge"].values),
    }
    subjects = texts(cohort["subject"])
    shifts = {
        name: np.array([_difference(x, w, o, subjects) for w, o in split]).reshape(len(names), *x.shape[1:])
        for name, x in columns.items()
    }
    log_tr = _log_sigma_tr(cohort)
    # site by site: where the probe touched must not pass for a trait
    moved = [known_mean(_difference(log_tr, *side, subjects)) for side in split]
    shifts["trait_log_sigma_tr_shift"] = np.array(moved).reshape(-1, 3)
    counts = np.array([[w.sum(), o.sum()] for w, o in split]).reshape(len(names), 2)
    lone = [f"{names[i]}: one take {SIDES[j]} it, not a mean" for i, j in np.argwhere(counts == 1)]
    return dataset(
        {"trait_count": counts, "take_log_sigma_tr": _mean_over_sites(log_tr), **shifts},
        coords={
            "take": [str(take) for take in takes],
            "trait": names,
            "side": list(SIDES),
            "region": albedo["region"].values,
            "channel": ["R", "G", "B"],
        },
        attrs={"flags": lone, "skipped": list(cohort.attrs.get("skipped", []))},
    )


def _difference(values: Array, carries: Mask, lacks: Mask, subjects: Sequence[str | None]) -> Array:
    """Mean with less mean without; where every subject with a trait was also measured without it, within subjects.

    A value that a subject has on one side alone then counts on neither: what differs between people must not pass for
    the trait.
    """
    who = np.array([str(subject) for subject in subjects])
    pairs = sorted(set(who[carries]))
    if not set(pairs) <= set(who[lacks]):
        return known_mean(values[carries]) - known_mean(values[lacks])
    own = [known_mean(values[carries & (who == s)]) - known_mean(values[lacks & (who == s)]) for s in pairs]
    return known_mean(np.stack(own))


def _mean_over_sites(log_tr: Array) -> Array:
    return known_mean(np.moveaxis(log_tr, 1, 0))


def _log_sigma_tr(cohort: xr.Dataset) -> Array:
    """Log sigma_tr (take, site, channel) over all sites there are; NaN where a take has no trusted one."""
    if "site_sigma_tr" not in cohort:
        return np.full((cohort.sizes["take"], 1, 3), np.nan)
    node = cohort[["site_sigma_tr", "site_status"]].load()
    good = node["site_status"].isin(IDENTIFIED)
    return np.log(np.asarray(node["site_sigma_tr"].where(good).values, np.float64))


def _named(cohort: xr.Dataset, known: Sequence[str]) -> list[str]:
    """Traits that can be asked for: also those that nobody or everybody has, which are refused with the reason."""
    return sorted({*known, *known_traits(cohort)})


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
