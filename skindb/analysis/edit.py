"""A model moved along traits (Weyrich et al. 2005, section 11)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from skindb.analysis.albedo import cumulative, decorrelate, histogram, levels, quantiles
from skindb.analysis.members import trait_name
from skindb.analysis.population_basis import project
from skindb.errors import Fault, InputError
from skindb.optics.brdf_table import TableGrid, brdf_metric
from skindb.optics.diffuse import dipole_s
from skindb.schema import GROUPS, check, dataset, label
from skindb.schema.brdf import brdf_coords, stored_brdf
from skindb.schema.consent import honour_consent
from skindb.schema.regions import FACE

Array = NDArray[np.floating[Any]]
Report = dict[str, Any]
DARKEST, BRIGHTEST = 1e-3, 0.999  # an edited albedo stays physical
SIGMA_TR_RANGE = (1e-2, 1e2)  # mm^-1; skin has 0.4 to 2, an edit far beyond stays a positive number
MOST = 100.0  # times a trait vector; the exponential of a larger shift of log sigma_tr may overflow
# what an edit leaves true or moves; errors, residuals and weights of the fit are those of the unedited model
KEPT = (
    "surfel_position", "surfel_normal", "surfel_area", "surfel_uv", "region_mask", "shading_normal", "fit_status",
    "diffuse_reflectance", "dipole_s", "basis_weight", "sigma_tr", "refractive_index",
)  # fmt: skip
KEPT_ATTRS = ("subject", "condition", "session", "traits", "consent_scope", "take")
PROBED = "probe"  # measurements of the unedited skin
KEPT_SITES = ("site_sigma_tr", "site_position", "site_status")  # what rendering and export need of a site
ONE_SUBJECT, NOBODY = "one subject: unknown", "nobody measured: unknown"


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
        The surface is refitted to the population's basis and moved there, weights cut at zero; the quantile functions
        of the albedo on each decorrelated axis are moved, made monotone (so that they are those of a valid histogram)
        and followed by every surfel: sums of histograms mix two skins instead of moving one and fall short; sigma_tr is
        scaled, that of the probe's sites like the map's. The copy holds what can be rendered: errors, residuals and
        report of the fit, and where sigma_tr moves also the probe's profiles, sigma_a and sigma_s' (sigma_tr alone
        does not give them), are those of the unedited model and left out. Attributes: `edit`; `edit_distance`, the
        longest of the parts' applied moves over the median distance between takes: above 1 the edit leaves the data;
        `edit_report`, part -> requested and applied (mean change of the coefficients, of the diffuse reflectance
        R G B, factor on sigma_tr R G B), clipped (share of the area cut to what is physical), distance (of the edited
        mean from the population's, in standard deviations over takes; text where it is unknown), for the albedo also
        projected (mean change that validity made, in standard deviations of colour), for the translucency also
        unknown (traits whose shift nobody measured: they do not move it).
    """
    honour_consent(model.attrs, "statistics")
    check(traits, [v.name for v in GROUPS["traits"]], where="traits (run skindb analyze DB traits again)")
    share = _shares(amounts, traits)
    fitted, tree = model["fitted"].to_dataset().load(), model.copy()
    reports: dict[str, Report] = {}
    moves = []
    if "brdf" in parts:
        shift = share @ traits["trait_brdf_shift"].values
        metric = brdf_metric(tables)
        fitted, reports["brdf"], move = _moved_surface(fitted, shift, basis, metric)
        tree["basis"] = xr.DataTree(_common_basis(model, basis, tables))
        moves.append(move)
    if "albedo" in parts:
        moved = np.tensordot(share, traits["trait_quantile_shift"].values, 1)
        fitted, reports["albedo"], move = _moved_albedo(fitted, moved, albedo, float(fitted["refractive_index"]))
        moves.append(move)
    if "translucency" in parts and "sigma_tr" in fitted:
        fitted, reports["translucency"], move = _moved_translucency(fitted, share, traits)
        moves.append(move)
        tree = tree.drop_nodes([name for name in (PROBED,) if name in tree.children])
        if "translucency" in tree.children:
            tree["translucency"] = xr.DataTree(_moved_sites(tree["translucency"].to_dataset().load(), share, traits))
    tree["fitted"] = xr.DataTree(fitted[[name for name in KEPT if name in fitted]])
    kept = {name: model.attrs[name] for name in KEPT_ATTRS if name in model.attrs}
    far = max(moves, default=0.0)
    tree.attrs = kept | {"edit": dict(amounts), "edit_distance": far, "edit_report": reports}
    return tree


def _shares(amounts: Mapping[str, float], traits: xr.Dataset) -> Array:
    """(trait,) amounts; `InputError` for a trait nobody knows and for an amount that is no finite number."""
    known = [str(t) for t in traits["trait"].values]
    share, faults = np.zeros(len(known)), list[Fault]()
    for name, amount in amounts.items():
        try:
            share[known.index(trait_name(name, known))] += amount
        except InputError as error:
            faults += error.faults
    if faults:
        raise InputError(faults)
    if not np.isfinite(share).all():
        raise InputError(Fault("amount", "must be a finite number", str(dict(amounts)), "give a number such as 0.5"))
    if np.abs(share).max(initial=0.0) > MOST:
        rule = f"1 is the whole difference; nothing is known beyond {MOST:g} times it"
        raise InputError(Fault("amount", rule, str(dict(amounts)), "give a number such as 0.5"))
    return share


def _moved_surface(
    fitted: xr.Dataset, shift: Array, basis: xr.Dataset, metric: Array
) -> tuple[xr.Dataset, Report, float]:
    weights = fitted["dictionary_weight"].values.astype(np.float64)
    good = np.isfinite(weights).all(axis=1)
    area = fitted["surfel_area"].values[good].astype(np.float64)
    H = basis["population_mixture"].values.astype(np.float64)
    here = project(weights[good], H, metric)
    moved = np.full((len(weights), len(H)), np.nan)
    moved[good] = np.maximum(here + shift, 0.0)
    own, now = (np.average(x, axis=0, weights=area) for x in (here, moved[good]))
    takes = [str(t) for t in basis["take"].values]
    distance, move = _distances(now, now - own, basis["take_coefficient"].values, takes, H @ metric @ H.T)
    report = _report(shift, now - own, np.asarray((here + shift < 0).any(axis=1)), area, distance)
    rest = fitted.drop_dims("component")  # another basis: other components
    return rest.assign(basis_weight=label("basis_weight", moved)), report, move


def _common_basis(model: xr.DataTree, basis: xr.Dataset, tables: Array) -> xr.Dataset:
    H = basis["population_mixture"].values
    brdf = stored_brdf(tables @ H.T.astype(np.float32))
    disc, source = model["basis/disc_angular_radius"].values, model["basis"].attrs.get("dictionary")
    return dataset(
        {"basis_mixture": H, "basis_brdf": brdf, "disc_angular_radius": disc},
        coords={"dictionary": basis["dictionary"].values, **brdf_coords(TableGrid(*tables.shape[:3]))},
        attrs={} if source is None else {"dictionary": source},
    )


def _moved_albedo(fitted: xr.Dataset, shift: Array, albedo: xr.Dataset, eta: float) -> tuple[xr.Dataset, Report, float]:
    """Move the albedo's quantiles by the shift of the whole face."""
    colour = fitted["diffuse_reflectance"].values.astype(np.float64)
    good = np.isfinite(colour).all(axis=1)
    mean, axes, edges = (albedo[n].values for n in ("colour_mean", "colour_axis", "histogram_edge"))
    area = fitted["surfel_area"].values[good].astype(np.float64)
    values = decorrelate(colour[good], mean, axes)
    here = histogram(np.clip(values, edges[:, 0], edges[:, -1]), area, edges)
    whole = [str(r) for r in albedo["region"].values].index(FACE)
    source = quantiles(here, edges)
    wanted = source + shift[whole]
    target = valid_quantiles(wanted)
    matched = np.stack([carry(values[:, a], here[a], target[a] - source[a], edges[a]) for a in range(3)], axis=1)
    back = np.linalg.inv(axes).T
    edited = matched @ back + mean
    out = colour.copy()
    out[good] = np.clip(edited, DARKEST, BRIGHTEST)
    s, _ = dipole_s(out, eta=eta)
    requested = shift[whole].mean(axis=1) @ back
    own, now = (np.average(x[good], axis=0, weights=area) for x in (colour, out))
    takes = albedo["albedo_mean"].values[:, whole]
    # along decorrelated axes: the unit is the spread of skin in that direction
    distance, move = _distances(now, now - own, takes, [str(t) for t in albedo["take"].values], axes.T @ axes)
    report = _report(requested, now - own, (edited != out[good]).any(axis=1), area, distance)
    report["projected"] = float(np.abs(target - wanted).mean())
    moved = {"diffuse_reflectance": label("diffuse_reflectance", out), "dipole_s": label("dipole_s", s)}
    return fitted.assign(moved), report, move


def _moved_translucency(fitted: xr.Dataset, share: Array, traits: xr.Dataset) -> tuple[xr.Dataset, Report, float]:
    """Scale sigma_tr; a trait without a measured shift leaves it as it is, and is named."""
    log, known = _log_shift(share, traits)
    before = np.log(fitted["sigma_tr"].values.astype(np.float64))
    after = np.clip(before + log, *np.log(SIGMA_TR_RANGE))
    good = np.isfinite(before).all(axis=1)
    area = fitted["surfel_area"].values[good].astype(np.float64)
    own, now = (np.average(x[good], axis=0, weights=area) for x in (before, after))
    population = traits["take_log_sigma_tr"]
    measured = np.isfinite(population.values).all(axis=1)
    names = [str(t) for t in population["take"].values[measured]]
    distance, move = _distances(now, now - own, population.values[measured], names, np.eye(3))
    report = _report(np.exp(log), np.exp(now - own), (after != before + log)[good].any(axis=1), area, distance)
    report["unknown"] = [str(t) for t in traits["trait"].values[~known & (share != 0)]]
    return fitted.assign(sigma_tr=label("sigma_tr", np.exp(after))), report, move


def _moved_sites(sites: xr.Dataset, share: Array, traits: xr.Dataset) -> xr.Dataset:
    """Sites of the probe with the map's factor on sigma_tr; errors of the fit say nothing of the vector added."""
    log, _ = _log_shift(share, traits)
    moved = np.clip(sites["site_sigma_tr"].values.astype(np.float64) * np.exp(log), *SIGMA_TR_RANGE)
    kept = sites[[name for name in KEPT_SITES if name in sites]].drop_attrs(deep=False)
    return kept.assign(site_sigma_tr=label("site_sigma_tr", moved))


def _log_shift(share: Array, traits: xr.Dataset) -> tuple[Array, NDArray[np.bool_]]:
    """What is added to log sigma_tr, per channel, and which traits have a measured shift."""
    shifts = traits["trait_log_sigma_tr_shift"].values
    known = np.isfinite(shifts).all(axis=1)
    return np.asarray(share[known] @ shifts[known]), known


def _report(requested: Array, applied: Array, cut: NDArray[np.bool_], area: Array, distance: float | str) -> Report:
    return {
        "requested": [float(v) for v in requested],
        "applied": [float(v) for v in applied],
        "clipped": float(np.average(cut, weights=area)),
        "distance": distance,
    }


def _distances(now: Array, step: Array, takes: Array, names: list[str], metric: Array) -> tuple[float | str, float]:
    """How far a mean `now` (d,) lies from the data, and how long a `step` (d,) is.

    The first in standard deviations of the takes (t, d) about their mean, all directions together, or text where
    there are none; the second over the median distance between two takes, infinite where there is none.
    """

    def length(vectors: Array) -> Array:
        return np.asarray(np.sqrt(np.maximum(np.einsum("...d,de,...e->...", vectors, metric, vectors), 0.0)))

    i, j = np.triu_indices(len(takes), 1)
    typical = float(np.median(length(takes[i] - takes[j]))) if len(i) else 0.0
    walked = float(length(step))
    move = walked / typical if typical > 0 else float("inf") if walked > 0 else 0.0
    if len({name.partition(".")[0] for name in names}) < 2:
        return ONE_SUBJECT if names else NOBODY, move
    mean = takes.mean(axis=0)
    spread = float(np.sqrt((length(takes - mean) ** 2).sum() / (len(takes) - 1)))
    return (float(length(now - mean)) / spread if spread > 0 else "all takes are alike: unknown"), move


def valid_quantiles(values: Array) -> Array:
    """Quantile functions nearest to `values` (axis, levels), in the mean square over levels.

    Isotonic regression: a monotone quantile function is that of a non-negative histogram of the same mass; its mean
    is that of `values`.
    """
    return np.stack([isotonic_regression(row).x for row in values])


def carry(values: Array, source: Array, shift: Array, edges: Array) -> Array:
    """Values (n,) moved by the shift (levels,) that belongs to their share of the histogram `source` (bins,)."""
    share = np.interp(values, edges, cumulative(source))
    return np.asarray(values + np.interp(share, levels(), shift))
