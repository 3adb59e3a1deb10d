"""A model moved along traits (Weyrich et al. 2005, section 11)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.analysis.albedo import EVERYWHERE, decorrelate, histogram
from skindb.analysis.population_basis import project
from skindb.errors import Fault, InputError
from skindb.optics.brdf_table import brdf_metric
from skindb.optics.diffuse import dipole_s
from skindb.schema import dataset, label

Array = NDArray[np.floating[Any]]
DARKEST, BRIGHTEST = 1e-3, 0.999  # an edited albedo stays physical


def apply_traits(
    model: xr.DataTree,
    *,
    amounts: Mapping[str, float],
    traits: xr.Dataset,
    basis: xr.Dataset,
    albedo: xr.Dataset,
    tables: Array,
    parts: tuple[str, ...] = ("brdf", "albedo", "translucency"),
) -> xr.DataTree:
    """Edited copy of a model.

    Parameters
    ----------
    model
        Version of kind "model".
    amounts
        Trait -> how much of its vector is added; 1 is the mean difference between takes with and without it.
    traits, basis, albedo
        From `trait_vectors`, `population_basis`, `albedo_histograms`.
    tables
        (nh, nd, np, m) tables of the dictionary the model was fitted with [sr^-1].
    parts
        Which of the model's parts move.

    Returns
    -------
    DataTree
        The surface is refitted to the population's basis and moved there, weights cut at zero; the albedo's
        histogram on each decorrelated axis is moved, made valid (non-negative, mass 1) and matched; sigma_tr is
        scaled. Attributes: `edit`, and `edit_distance`, the length of the move over the median distance between
        takes: above 1 the edit leaves the data.
    """
    known = [str(t) for t in traits["trait"].values]
    if unknown := sorted(set(amounts) - set(known)):
        rule, there = "must be a trait of the population", f"known: {', '.join(known)}"
        raise InputError(Fault(f"trait {name}", rule, "an unknown one", there) for name in unknown)
    share = np.array([amounts.get(name, 0.0) for name in known])
    if not np.isfinite(share).all():
        raise InputError(Fault("amount", "must be a finite number", str(dict(amounts)), "give a number such as 0.5"))
    fitted, tree = model["fitted"].to_dataset().load(), model.copy()
    shift = share @ traits["trait_brdf_shift"].values
    if "brdf" in parts:
        fitted = _moved_surface(fitted, shift, basis, tables)
        tree["basis"] = xr.DataTree(_common_basis(model, basis, tables))
    if "albedo" in parts:
        moved = np.tensordot(share, traits["trait_histogram_shift"].values, 1)
        fitted = _moved_albedo(fitted, moved, albedo, float(model.attrs["eta"]))
    if "translucency" in parts and "effective_transport" in fitted:
        factor = np.exp(share @ np.nan_to_num(traits["trait_log_sigma_tr_shift"].values))
        scaled = fitted["effective_transport"].values * factor
        fitted = fitted.assign(effective_transport=label("effective_transport", scaled))
    tree["fitted"] = xr.DataTree(fitted)
    tree.attrs = {**model.attrs, "edit": dict(amounts), "edit_distance": _distance(shift, basis)}
    return tree


def _moved_surface(fitted: xr.Dataset, shift: Array, basis: xr.Dataset, tables: Array) -> xr.Dataset:
    weights = fitted["basis_weight"].values.astype(np.float64)
    good = np.isfinite(weights).all(axis=1)
    H = basis["population_weight"].values.astype(np.float64)
    moved = np.full((len(weights), len(H)), np.nan)
    moved[good] = np.maximum(project(weights[good], H, brdf_metric(tables)) + shift, 0.0)
    rest = fitted.drop_dims("component")  # another basis: other components, and its errors are not this one's
    return rest.assign(reduced_weight=label("reduced_weight", moved))


def _common_basis(model: xr.DataTree, basis: xr.Dataset, tables: Array) -> xr.Dataset:
    H = basis["population_weight"].values
    brdf = np.moveaxis(tables @ H.T.astype(np.float32), -1, 0)
    names = {"basis": basis["basis"].values}
    return dataset(
        {"component_weight": H, "basis_brdf": brdf},
        coords=names,
        attrs={str(k): v for k, v in model["basis"].attrs.items()},
    )


def _moved_albedo(fitted: xr.Dataset, shift: Array, albedo: xr.Dataset, eta: float) -> xr.Dataset:
    """Match the albedo to its own histogram plus the shift of the whole face."""
    colour = fitted["diffuse_reflectance"].values.astype(np.float64)
    good = np.isfinite(colour).all(axis=1)
    mean, axes, edges = (albedo[n].values for n in ("colour_mean", "colour_axis", "histogram_edge"))
    area = fitted["surfel_area"].values[good].astype(np.float64)
    values = decorrelate(colour[good], mean, axes)
    here = histogram(np.clip(values, edges[:, 0], edges[:, -1]), area, edges)
    whole = [str(r) for r in albedo["region"].values].index(EVERYWHERE)
    target = valid_histogram(here + shift[whole])
    matched = np.stack([match(values[:, a], here[a], target[a], edges[a]) for a in range(3)], axis=1)
    out = colour.copy()
    out[good] = np.clip(matched @ np.linalg.inv(axes).T + mean, DARKEST, BRIGHTEST)
    s, _ = dipole_s(out, eta=eta)
    return fitted.assign(diffuse_reflectance=label("diffuse_reflectance", out), dipole_s=label("dipole_s", s))


def valid_histogram(shares: Array) -> Array:
    """Nearest by cutting: non-negative, mass 1 along the last axis (its cumulative sum is then monotone)."""
    cut = np.maximum(shares, 0.0)
    total = cut.sum(axis=-1, keepdims=True)
    return np.where(total > 0, cut / np.where(total > 0, total, 1.0), 1.0 / shares.shape[-1])


def match(values: Array, source: Array, target: Array, edges: Array) -> Array:
    """Values (n,) carried from one histogram to another by equal cumulative shares (Heeger and Bergen 1995).

    The identity where the histograms agree; linear within bins; values outside the edges move with the end.
    """
    below = np.concatenate([[0.0], np.cumsum(source)])
    wanted = np.concatenate([[0.0], np.cumsum(target)])
    # a slope everywhere makes both invertible; it moves no value by more than a thousandth of the range
    ramp = np.linspace(0.0, 1.0, len(edges))
    below, wanted = ((1 - 1e-3) * c / max(c[-1], 1e-12) + 1e-3 * ramp for c in (below, wanted))
    inside = np.clip(values, edges[0], edges[-1])
    carried = np.interp(np.interp(inside, edges, below), wanted, edges)
    return np.asarray(carried + (values - inside))


def _distance(shift: Array, basis: xr.Dataset) -> float:
    """Length of a move in the common BRDF coefficients over the median distance between takes."""
    takes = basis["take_coefficient"].values
    pairs = np.linalg.norm(takes[:, None] - takes[None], axis=-1)[np.triu_indices(len(takes), 1)]
    typical = float(np.median(pairs)) if len(pairs) else 0.0
    return float(np.linalg.norm(shift) / typical) if typical > 0 else float("inf") if shift.any() else 0.0
