"""Trait vectors: the mean with a trait less the mean without (Weyrich et al. 2005, section 11)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.members import Takes, comparable, consenting, has_trait, trait_names
from skindb.errors import Fault, InputError
from skindb.schema import ProbeStatus, dataset

Array = NDArray[np.floating[Any]]


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
        `trait_brdf_shift`, `trait_histogram_shift`, `trait_log_sigma_tr_shift`, `trait_count` (side: with, without).
        sigma_tr's shift is NaN where no probe touched either side.

    Raises
    ------
    InputError
        A trait that nobody or everybody has: there is no difference to take.
    """
    takes = consenting(models)
    names = list(trait_names(takes) if traits is None else traits)
    sides = [_sides(takes, name) for name in names]
    bad = [(n, w, o) for n, (w, o) in zip(names, sides, strict=True) if not w.any() or not o.any()]
    if bad:
        known = ", ".join(trait_names(takes)) or "none"
        rule = "a trait needs takes with and takes without it"
        raise InputError(
            Fault(f"trait {n}", rule, f"{w.sum()} with, {o.sum()} without", f"traits here: {known}") for n, w, o in bad
        )
    log_tr = np.stack([_log_sigma_tr(model) for model in takes.values()])
    columns = {
        "trait_brdf_shift": basis["take_coefficient"].values,
        "trait_histogram_shift": albedo["albedo_histogram"].values,
        "trait_log_sigma_tr_shift": log_tr,
    }
    shifts = {
        name: np.array([_difference(x, w, o) for w, o in sides]).reshape(len(names), *x.shape[1:])
        for name, x in columns.items()
    }
    counts = np.array([[w.sum(), o.sum()] for w, o in sides]).reshape(len(names), 2)
    return dataset(
        {"trait_count": counts, **shifts},
        coords={
            "trait": names,
            "side": ["with", "without"],
            "region": albedo["region"].values,
            "channel": ["R", "G", "B"],
        },
    )


def _sides(takes: Takes, trait: str) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    carries, usable = has_trait(takes, trait), comparable(takes, trait)
    return carries & usable, ~carries & usable


def _difference(values: Array, carries: NDArray[np.bool_], lacks: NDArray[np.bool_]) -> Array:
    return _known_mean(values[carries]) - _known_mean(values[lacks])


def _known_mean(values: Array) -> Array:
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


def _log_sigma_tr(model: xr.DataTree) -> Array:
    """Mean over sites of log sigma_tr, (channel,); NaN without a trusted site."""
    if "translucency" not in model.children:
        return np.full(3, np.nan)
    node = model["translucency"].to_dataset()
    values = node["site_effective_transport"].where(node["site_status"] == ProbeStatus.FITTED).values.astype(np.float64)
    return _known_mean(np.log(values))
