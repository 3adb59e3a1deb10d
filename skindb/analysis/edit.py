"""Edits of a model along trait vectors (Weyrich et al. 2005, section 11)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from skindb.analysis.albedo import cumulative, decorrelate, histogram, quantiles
from skindb.analysis.brdf import project
from skindb.analysis.subjects import trait_name
from skindb.analysis.texture import at_surfels, edit_texture
from skindb.errors import Fault, InputError, input_error
from skindb.numerics.texture import quantile_levels, valid_quantiles
from skindb.optics.diffusion import dipole_s
from skindb.reflectance.tables import TableGrid, brdf_coords, brdf_metric, stored_brdf
from skindb.schema import GROUPS, Use, check, dataset, label, names_of, variables
from skindb.schema.consent import honour_consent
from skindb.schema.label import FACE, take_attrs
from skindb.types import Array, Mask, finite_rows, float64

Report = dict[str, Any]
# limits of an edited albedo
DARKEST = 1e-3
BRIGHTEST = 0.999
# mm^-1; limits of an edited value, far beyond the 0.4 to 2 of skin
SIGMA_TR_RANGE = (1e-2, 1e2)
# of a trait vector; the exponential of a larger shift of log sigma_tr may overflow
MAX_AMOUNT = 100.0
PROBED = "probe"  # measurements of the unedited skin
MIN_REPORTED = 1e-3  # fraction of a change above which an omission is reported
TEXTURE_SHIFT = variables.TRAIT_TEXTURE_SHIFT  # only where takes are registered
ONE_SUBJECT = "unknown: only one subject"
NO_SUBJECT = "unknown: no subject was measured"


def apply_traits(
    model: xr.DataTree,
    *,
    amounts: Mapping[str, float],
    traits: xr.Dataset,
    basis: xr.Dataset,
    albedo: xr.Dataset,
    tables: Array,
    texture: xr.Dataset | None = None,
    maps: xr.Dataset | None = None,
    registered: xr.Dataset | None = None,
    parts: tuple[str, ...] = ("brdf", "albedo", "translucency"),
    rng: np.random.Generator | None = None,
) -> xr.DataTree:
    """Edited copy of a model, moved along trait vectors.

    Parameters
    ----------
    model
        Version of kind "model".
    amounts
        Trait -> multiple of its vector that is added; 1 is the mean difference between
        takes with and without it.
    traits, basis, albedo
        From `trait_vectors`, `population_basis`, `albedo_histograms`.
    tables
        (nh, nd, np, m) tables of the dictionary the model was fitted with [sr^-1].
    texture, maps, registered
        From `texture_statistics` of the takes, `common_maps` of the model at the same
        size, and `register`. If they are given, the albedo changes at every scale,
        region by region (see `edit_texture`); otherwise only its colours do.
    parts
        Parts of the model that are edited.
    rng
        Random generator of the noise that adds texture to skin without any; by default with seed 0.

    Returns
    -------
    DataTree
        The surface is refitted to the basis of the population. A component that becomes
        weaker is multiplied everywhere by the same factor, and one that becomes
        stronger is increased everywhere by the same step: the mean moves by the trait
        vector (or by the part of it that keeps the mean non-negative), and every weight
        stays non-negative. The quantile functions of log albedo and of its bands are
        shifted, made monotone (so that they belong to valid histograms) and imposed on
        the map of the take; without a registration, only those of its colours.
        Histograms are not added, which would mix two skins. sigma_tr is scaled in the
        map and at the probe sites. The copy has all that is needed for rendering. It
        omits what belongs to the unedited model: errors, residuals and report of the
        fit and, if sigma_tr changes, the profiles of the probe, sigma_a and sigma_s'
        (which sigma_tr alone does not determine).

        The attributes are:

        * `edit`, the amounts;
        * `edit_distance`, the distance of the edited means from the nearest take (or
          from the unedited model, if that is nearer) divided by the median distance
          between takes, for the part where it is largest; above 1 the edit is an
          extrapolation;
        * `trait_notes`, the numbers of takes of each trait that was used, and warnings;
        * `edit_report`, for each part: requested and applied (mean change of the
          coefficients or of the diffuse reflectance R G B, or factor on sigma_tr R G
          B), clipped (fraction of the area limited to physical values; for the surface,
          the fraction of the requested vector that was omitted), distance (of the
          edited mean from that of the population, in standard deviations over takes; a
          text if it is unknown). For the albedo also how: "texture", with trace (RMS
          difference from the target quantiles before each iteration and after the last,
          for every axis) and distance_before, or "colours", with projected (mean change
          by making quantiles monotone, in standard deviations of colour). For the
          translucency also unknown (traits whose shift was not measured, so that it is
          not applied).
    """
    honour_consent(model.attrs, "statistics")
    needed = [v.name for v in GROUPS["traits"] if v.name != TEXTURE_SHIFT]
    check(traits, needed, where="traits (run skindb analyze DB traits again)")
    amount = _trait_amounts(amounts, traits)
    fitted = model["fitted"].to_dataset().load()
    tree = model.copy()
    reports: dict[str, Report] = {}
    moves = []
    if "brdf" in parts:
        shift = amount @ traits[variables.TRAIT_BRDF_SHIFT].values
        metric = brdf_metric(tables)
        fitted, reports["brdf"], move = _moved_surface(fitted, shift, basis, metric)
        tree["basis"] = xr.DataTree(_common_basis(model, basis, tables))
        moves.append(move)
    if "albedo" in parts:
        mapped = None
        if texture is not None and maps is not None and registered is not None:
            mapped = _MappedSkin(texture, maps, registered[variables.COMMON_UV].values)
        fitted, reports["albedo"], move = _moved_skin(
            fitted, amount, traits, albedo, mapped, rng
        )
        moves.append(move)
    if "translucency" in parts and variables.SIGMA_TR in fitted:
        fitted, reports["translucency"], move = _moved_sigma_tr(fitted, amount, traits)
        moves.append(move)
        tree = _with_moved_sites(tree, amount, traits)
    tree["fitted"] = xr.DataTree(surviving(fitted))
    names = [str(traits["trait"].values[i]) for i in np.flatnonzero(amount)]
    tree.attrs = take_attrs(model.attrs) | {
        "edit": dict(amounts),
        "edit_distance": max(moves, default=0.0),
        "edit_report": reports,
        "trait_notes": _notes(traits, names),
    }
    return tree


def _notes(traits: xr.Dataset, names: list[str]) -> list[str]:
    """A line for each trait: its number of takes, or the warning of the study about it."""
    flagged = {flag.partition(": ")[0]: flag for flag in traits.attrs.get("flags", [])}
    counts = {
        str(t): traits[variables.TRAIT_COUNT].sel(trait=t).values.tolist()
        for t in traits["trait"].values
    }
    # for a numeric attribute, all takes are counted on one side
    sides = {
        t: f"{n} takes with, {without} without" if without else f"{n} takes"
        for t, (n, without) in counts.items()
    }
    return [flagged.get(name, f"{name}: {sides[name]}") for name in names]


def _trait_amounts(amounts: Mapping[str, float], traits: xr.Dataset) -> Array:
    """Amounts (trait,); raises `InputError` for unknown traits and for amounts that are
    not finite or too large.
    """
    names = traits["trait"].values.tolist()
    total = np.zeros(len(names))
    faults = list[Fault]()
    for name, amount in amounts.items():
        try:
            total[names.index(trait_name(name, names))] += amount
        except InputError as error:
            faults += error.faults
    if faults:
        raise InputError(faults)
    if not np.isfinite(total).all():
        raise input_error(
            "amount",
            "must be a finite number",
            str(dict(amounts)),
            "give a number such as 0.5",
        )
    if np.abs(total).max(initial=0.0) > MAX_AMOUNT:
        raise input_error(
            "amount",
            f"must be between -{MAX_AMOUNT:g} and {MAX_AMOUNT:g}; 1 is the whole difference",
            str(dict(amounts)),
            "give a number such as 0.5",
        )
    return total


def _moved_surface(
    fitted: xr.Dataset, shift: Array, basis: xr.Dataset, metric: Array
) -> tuple[xr.Dataset, Report, float]:
    """Refit the surface to the basis of the population, and move its mean coefficients
    (component,) by the shift.
    """
    weights = fitted[variables.DICTIONARY_WEIGHT].values.astype(float)
    good = finite_rows(weights)
    area = fitted[variables.SURFEL_AREA].values[good].astype(float)
    H = basis[variables.POPULATION_MIXTURE].values.astype(float)
    here = project(weights[good], H, metric)
    moved = np.full((len(weights), len(H)), np.nan)
    mean = np.average(here, axis=0, weights=area)
    [target] = project(((mean + shift) @ H)[None], H, metric) if shift.any() else [mean]
    step = target - mean
    weaker = np.where(
        (step < 0) & (mean > 0), target / np.where(mean > 0, mean, 1.0), 1.0
    )
    moved[good] = here * weaker + np.maximum(step, 0.0)
    takes = basis["take"].values.tolist()
    gram = H @ metric @ H.T
    distance, move = _distances(
        target, mean, basis[variables.TAKE_COEFFICIENT].values, takes, gram
    )
    report = _report(shift, step, np.zeros(len(area), bool), area, distance)
    report["clipped"] = float(_length(step - shift, gram)) / max(
        float(_length(shift, gram)), 1e-300
    )
    rest = fitted.drop_dims("component")  # the components of another basis differ
    return rest.assign(basis_weight=label(variables.BASIS_WEIGHT, moved)), report, move


def with_basis(
    model: xr.DataTree, *, mixture: Array, names: Sequence[str], tables: Array
) -> xr.DataTree:
    """Copy of a model whose surface is the nearest non-negative mixture of other basis
    BRDFs (figure 7).

    Parameters
    ----------
    model
        Version of kind "model".
    mixture
        (k, m) basis as mixtures of the dictionary: `population_mixture`, or the unit
        matrix for the dictionary itself.
    names
        (m,) names of the BRDFs of the dictionary.
    tables
        (nh, nd, np, m) tables of the dictionary the model was fitted with [sr^-1].
    """
    fitted = model["fitted"].to_dataset().load()
    tree = model.copy()
    weights = fitted[variables.DICTIONARY_WEIGHT].values.astype(float)
    good = finite_rows(weights)
    coefficients = np.full((len(weights), len(mixture)), np.nan)
    coefficients[good] = project(weights[good], float64(mixture), brdf_metric(tables))
    rest = fitted.drop_dims("component")  # the components of another basis differ
    fitted = rest.assign(basis_weight=label(variables.BASIS_WEIGHT, coefficients))
    basis = xr.Dataset(
        {variables.POPULATION_MIXTURE: (("component", "dictionary"), mixture)},
        {"dictionary": list(names)},
    )
    tree["basis"] = xr.DataTree(_common_basis(model, basis, tables))
    tree["fitted"] = xr.DataTree(surviving(fitted))
    tree.attrs = take_attrs(model.attrs)
    return tree


def _common_basis(model: xr.DataTree, basis: xr.Dataset, tables: Array) -> xr.Dataset:
    H = basis[variables.POPULATION_MIXTURE].values
    brdf = stored_brdf(tables @ H.T.astype(np.float32))
    disc = model["basis/disc_angular_radius"].values
    source = model["basis"].attrs.get("dictionary")
    return dataset(
        {
            variables.BASIS_MIXTURE: H,
            variables.BASIS_BRDF: brdf,
            variables.DISC_ANGULAR_RADIUS: disc,
        },
        coords={
            "dictionary": basis["dictionary"].values,
            **brdf_coords(TableGrid(*tables.shape[:3])),
        },
        attrs={} if source is None else {"dictionary": source},
    )


@dataclass(frozen=True)
class _MappedSkin:
    """Albedo map of a registered take, and the distributions of its population."""

    texture: xr.Dataset  # from `texture_statistics`
    maps: xr.Dataset
    uv: Array  # (surfel, 2) common texture coordinates


def _moved_skin(
    fitted: xr.Dataset,
    amount: Array,
    traits: xr.Dataset,
    albedo: xr.Dataset,
    mapped: _MappedSkin | None,
    rng: np.random.Generator | None,
) -> tuple[xr.Dataset, Report, float]:
    """Move the albedo: with a map at every scale, otherwise only its colours."""
    if mapped is None or TEXTURE_SHIFT not in traits:
        shift = np.tensordot(amount, traits[variables.TRAIT_QUANTILE_SHIFT].values, 1)
        return _moved_albedo(fitted, shift, albedo)
    is_used = amount != 0
    shifts = traits[TEXTURE_SHIFT].values[is_used].astype(float)
    shift = np.tensordot(amount[is_used], shifts, 1)
    rng = np.random.default_rng(0) if rng is None else rng
    return _moved_texture(fitted, shift, mapped, albedo, rng)


def _moved_texture(
    fitted: xr.Dataset,
    shift: Array,
    mapped: _MappedSkin,
    albedo: xr.Dataset,
    rng: np.random.Generator,
) -> tuple[xr.Dataset, Report, float]:
    """Shift the distributions of log albedo and of its bands in the map, and apply the
    change to the surfels.
    """
    texture = mapped.texture
    edit = edit_texture(mapped.maps, shift, texture, rng=rng)
    colour = fitted[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    target = colour * np.exp(at_surfels(edit.change, mapped.uv))
    fitted, report, move = _with_albedo(fitted, target, albedo)
    report["distance"] = ONE_SUBJECT if edit.distance is None else edit.distance
    report |= {
        "how": "texture",
        "trace": [list(row) for row in edit.trace],
        "distance_before": edit.distance_before,
    }
    # requested change of the mean of the whole face, like the other values of the report
    region = texture["region"].values.tolist().index(FACE)
    step = (
        np.nan_to_num(shift[region, :, 0]).mean(axis=-1)
        @ np.linalg.inv(texture[variables.TEXTURE_COLOUR_AXIS].values).T
    )
    good = finite_rows(colour)
    mean = np.average(
        colour[good], axis=0, weights=fitted[variables.SURFEL_AREA].values[good]
    )
    report["requested"] = [float(v) for v in mean * np.expm1(step)]
    return fitted, report, move


def with_albedo(fitted: xr.Dataset, albedo: Array) -> xr.Dataset:
    """A fitted surface with new albedos (n, 3), limited to physical values."""
    colour = fitted[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    out = np.where(albedo == colour, colour, np.clip(albedo, DARKEST, BRIGHTEST))
    s, _ = dipole_s(out, eta=float(fitted[variables.REFRACTIVE_INDEX]))
    return fitted.assign(
        diffuse_reflectance=label(variables.DIFFUSE_REFLECTANCE, out),
        dipole_s=label(variables.DIPOLE_S, s),
    )


def _with_albedo(
    fitted: xr.Dataset, target: Array, albedo: xr.Dataset
) -> tuple[xr.Dataset, Report, float]:
    """The fitted surface with new albedos (n, 3), the report of the change, and its distance."""
    moved = with_albedo(fitted, target)
    colour, out = (
        version[variables.DIFFUSE_REFLECTANCE].values.astype(float)
        for version in (fitted, moved)
    )
    good = finite_rows(colour)
    area = fitted[variables.SURFEL_AREA].values[good].astype(float)
    before, now = (np.average(x[good], axis=0, weights=area) for x in (colour, out))
    face = albedo["region"].values.tolist().index(FACE)
    takes = albedo[variables.ALBEDO_MEAN].values[:, face]
    axes = albedo[variables.COLOUR_AXIS].values
    # on the decorrelated axes, the unit is the standard deviation of skin in that direction
    distance, move = _distances(
        now, before, takes, albedo["take"].values.tolist(), axes.T @ axes
    )
    cut = (np.clip(target, DARKEST, BRIGHTEST) != target)[good] & (target != colour)[
        good
    ]
    report = _report(now - before, now - before, cut.any(axis=1), area, distance)
    return moved, report, move


def _moved_albedo(
    fitted: xr.Dataset, shift: Array, albedo: xr.Dataset
) -> tuple[xr.Dataset, Report, float]:
    """Shift the quantiles of albedo by the shift of the whole face."""
    colour = fitted[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    good = finite_rows(colour)
    mean, axes, edges = (
        albedo[n].values
        for n in (
            variables.COLOUR_MEAN,
            variables.COLOUR_AXIS,
            variables.HISTOGRAM_EDGE,
        )
    )
    area = fitted[variables.SURFEL_AREA].values[good].astype(float)
    values = decorrelate(colour[good], mean, axes)
    here = histogram(np.clip(values, edges[:, 0], edges[:, -1]), area, edges)
    face = albedo["region"].values.tolist().index(FACE)
    source = quantiles(here, edges)
    shifted = source + shift[face]
    target = valid_quantiles(shifted)
    matched = np.stack(
        [
            shift_quantiles(values[:, a], here[a], target[a] - source[a], edges[a])
            for a in range(3)
        ],
        axis=1,
    )
    back = np.linalg.inv(axes).T
    edited = colour.copy()
    edited[good] = matched @ back + mean
    fitted, report, move = _with_albedo(fitted, edited, albedo)
    report["requested"] = [float(v) for v in shift[face].mean(axis=1) @ back]
    report |= {"how": "colours", "projected": float(np.abs(target - shifted).mean())}
    return fitted, report, move


def _moved_sigma_tr(
    fitted: xr.Dataset, amount: Array, traits: xr.Dataset
) -> tuple[xr.Dataset, Report, float]:
    """Scale sigma_tr; traits without a measured shift are not applied, and the report
    names them.
    """
    log, is_measured = _log_shift(amount, traits)
    before = np.log(fitted[variables.SIGMA_TR].values.astype(float))
    after = np.clip(before + log, *np.log(SIGMA_TR_RANGE))
    good = finite_rows(before)
    area = fitted[variables.SURFEL_AREA].values[good].astype(float)
    mean, now = (np.average(x[good], axis=0, weights=area) for x in (before, after))
    population = traits[variables.TAKE_LOG_SIGMA_TR]
    measured = finite_rows(population.values)
    names = [str(t) for t in population["take"].values[measured]]
    distance, move = _distances(
        now, mean, population.values[measured], names, np.eye(3)
    )
    report = _report(
        np.exp(log),
        np.exp(now - mean),
        (after != before + log)[good].any(axis=1),
        area,
        distance,
    )
    report["unknown"] = [
        str(t) for t in traits["trait"].values[~is_measured & (amount != 0)]
    ]
    return (
        fitted.assign(sigma_tr=label(variables.SIGMA_TR, np.exp(after))),
        report,
        move,
    )


def surviving(ds: xr.Dataset) -> xr.Dataset:
    """The variables that an edit changes or that stay valid; errors, residuals and
    weights belong to the unedited model.
    """
    return ds[[name for name in names_of(Use.SURVIVES_EDIT) if name in ds]]


def _with_moved_sites(
    tree: xr.DataTree, amount: Array, traits: xr.Dataset
) -> xr.DataTree:
    """The model without the measurements of the probe, and with moved sites."""
    tree = tree.drop_nodes([name for name in (PROBED,) if name in tree.children])
    if "translucency" in tree.children:
        sites = tree["translucency"].to_dataset().load()
        tree["translucency"] = xr.DataTree(_moved_sites(sites, amount, traits))
    return tree


def _moved_sites(sites: xr.Dataset, amount: Array, traits: xr.Dataset) -> xr.Dataset:
    """Probe sites with sigma_tr scaled like the map; errors are omitted, as they do not
    include those of the vector.
    """
    log, _ = _log_shift(amount, traits)
    moved = np.clip(
        sites[variables.SITE_SIGMA_TR].values.astype(float) * np.exp(log),
        *SIGMA_TR_RANGE,
    )
    moved_sites = surviving(sites).drop_attrs(deep=False)
    return moved_sites.assign(site_sigma_tr=label(variables.SITE_SIGMA_TR, moved))


def _log_shift(amount: Array, traits: xr.Dataset) -> tuple[Array, Mask]:
    """Shift of log sigma_tr (channel,), and the mask (trait,) of the traits with a
    measured shift.
    """
    shifts = traits[variables.TRAIT_LOG_SIGMA_TR_SHIFT].values
    is_measured = finite_rows(shifts)
    return np.asarray(amount[is_measured] @ shifts[is_measured]), is_measured


def _report(
    requested: Array,
    applied: Array,
    cut: Mask,
    area: Array,
    distance: float | str,
) -> Report:
    return {
        "requested": [float(v) for v in requested],
        "applied": [float(v) for v in applied],
        "clipped": float(np.average(cut, weights=area)),
        "distance": distance,
    }


def _distances(
    now: Array, before: Array, takes: Array, names: list[str], metric: Array
) -> tuple[float | str, float]:
    """Distances of a mean `now` (d,) from the mean of the takes (t, d), and from the
    nearest take or the mean `before`.

    The first is in standard deviations of the takes over all directions, or a text if
    these are unknown. The second is relative to the median distance between two takes,
    and infinite if that is 0.
    """
    i, j = np.triu_indices(len(takes), 1)
    typical = float(np.median(_length(takes[i] - takes[j], metric))) if len(i) else 0.0
    near = float(_length(now - np.vstack([takes, before]), metric).min())
    far = near / typical if typical > 0 else float("inf") if near > 0 else 0.0
    if len({name.partition(".")[0] for name in names}) < 2:
        return ONE_SUBJECT if names else NO_SUBJECT, far
    mean = takes.mean(axis=0)
    spread = float(
        np.sqrt((_length(takes - mean, metric) ** 2).sum() / (len(takes) - 1))
    )
    return (
        float(_length(now - mean, metric)) / spread
        if spread > 0
        else "unknown: all takes are alike"
    ), far


def describe_edit(report: Mapping[str, Report]) -> list[str]:
    """Limitations of an edit and changes that were omitted, one line each; `report` is
    its attribute `edit_report`.
    """
    lines = []
    surface = report.get("brdf", {})
    albedo = report.get("albedo", {})
    if surface.get("clipped", 0.0) > MIN_REPORTED:
        rule = "would have made weights negative and was omitted"
        lines.append(f"brdf: {surface['clipped']:.1%} of the requested change {rule}")
    cuts = {
        part: report.get(part, {}).get("clipped", 0.0)
        for part in ("albedo", "translucency")
    }
    limited = "values were limited to the physical range on"
    lines += [
        f"{part}: {limited} {cut:.1%} of the area" for part, cut in cuts.items() if cut
    ]
    if albedo.get("how") == "colours":
        lines.append(
            "albedo: only colours were edited; textures need a registration of the "
            "take and of the study"
        )
    if albedo.get("how") == "texture" and not isinstance(albedo["distance"], str):
        before = albedo["distance_before"]
        after = albedo["distance"]
        lines.append(
            f"albedo: {after:.2f} standard deviations from the mean of the takes, "
            f"{before:.2f} before the edit"
        )
    unknown = report.get("translucency", {}).get("unknown", [])
    lines += [
        f"translucency: the change with {trait} is unknown and was omitted"
        for trait in unknown
    ]
    return lines


def _length(vectors: Array, metric: Array) -> Array:
    """Lengths (...) of vectors (..., d)."""
    return np.asarray(
        np.sqrt(
            np.maximum(np.einsum("...d,de,...e->...", vectors, metric, vectors), 0.0)
        )
    )


def shift_quantiles(values: Array, source: Array, shift: Array, edges: Array) -> Array:
    """Values (n,) plus the shift (levels,) at their quantile of the histogram `source` (bins,)."""
    quantile = np.interp(values, edges, cumulative(source))
    return np.asarray(values + np.interp(quantile, quantile_levels(), shift))
