"""Edits of a model along trait vectors (Weyrich et al. 2005, section 11)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from xarray import Dataset, DataTree

from skindb.analysis.albedo import cumulative, decorrelate, histogram, quantiles
from skindb.analysis.brdf import project
from skindb.analysis.face_models import BLOCKS, block_rows
from skindb.analysis.subjects import trait_name
from skindb.analysis.texture import at_surfels, edit_texture
from skindb.errors import Fault, InputError, counted, require
from skindb.geometry.atlas import push_pull
from skindb.geometry.mesh import vertex_normals
from skindb.numerics.texture import quantile_levels, valid_quantiles
from skindb.optics.diffusion import dipole_s
from skindb.reflectance.tables import TableGrid, brdf_coords, brdf_metric, stored_brdf
from skindb.schema import (
    GROUPS,
    Use,
    check,
    dataset,
    fitted_of,
    label,
    names_of,
    variables,
)
from skindb.schema.consent import honour_consent
from skindb.schema.label import FACE, take_attrs
from skindb.types import Array, Mask, finite_rows, float64, unit

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


def apply_traits(
    model: DataTree,
    *,
    amounts: Mapping[str, float],
    traits: Dataset,
    basis: Dataset,
    albedo: Dataset,
    tables: Array,
    texture: Dataset | None = None,
    maps: Dataset | None = None,
    registered: Dataset | None = None,
) -> DataTree:
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
          the fraction of the requested vector that was omitted), from_nearest (its part
          of `edit_distance`). For the albedo also how: "colours", or "texture" with
          trace (RMS difference from the target quantiles before each iteration and
          after the last, for every axis), distance and distance_before (see
          `edit_texture`; None if unknown). For the translucency also unknown (traits
          whose shift was not measured, so that it is not applied).
    """
    honour_consent(model.attrs, "statistics")
    needed = [v.name for v in GROUPS["traits"] if v.name != TEXTURE_SHIFT]
    check(traits, needed, where="traits (run skindb analyze DB traits again)")
    amount = _trait_amounts(amounts, traits)
    fitted = fitted_of(model).load()
    tree = model.copy()
    reports = {}
    shift = amount @ traits[variables.TRAIT_BRDF_SHIFT].values
    fitted, reports["brdf"] = _moved_surface(fitted, shift, basis, brdf_metric(tables))
    mixture = basis[variables.POPULATION_MIXTURE].values
    names = basis["dictionary"].values.tolist()
    tree["basis"] = DataTree(_common_basis(model, mixture, names, tables))
    has_textures = TEXTURE_SHIFT in traits
    if texture is None or maps is None or registered is None or not has_textures:
        fitted, reports["albedo"] = _moved_albedo(fitted, amount, traits, albedo)
    else:
        used = amount != 0
        shift = np.tensordot(
            amount[used], float64(traits[TEXTURE_SHIFT].values[used]), 1
        )
        fitted, reports["albedo"] = _moved_texture(
            fitted, shift, albedo, texture, maps, registered
        )
    if variables.SIGMA_TR in fitted:
        fitted, reports["translucency"] = _moved_sigma_tr(fitted, amount, traits)
        tree = _with_moved_sites(tree, amount, traits)
    tree["fitted"] = DataTree(_surviving(fitted))
    tree.attrs = take_attrs(model.attrs) | {
        "edit": dict(amounts),
        "edit_distance": max(report["from_nearest"] for report in reports.values()),
        "edit_report": reports,
        "trait_notes": _notes(traits, amount),
    }
    return tree


def _notes(traits: Dataset, amount: Array) -> list[str]:
    """A line for each trait: its number of subjects, or the warning of the study about it."""
    flagged = {flag.partition(": ")[0]: flag for flag in traits.attrs.get("flags", [])}
    notes = []
    for i in np.flatnonzero(amount):
        name = str(traits["trait"].values[i])
        count, without = traits[variables.TRAIT_COUNT].values[i].tolist()
        # for a numeric attribute, all subjects are counted on one side
        sides = f" with, {without} without" if without else ""
        notes.append(flagged.get(name, f"{name}: {counted(count, 'subject')}{sides}"))
    return notes


def _trait_amounts(amounts: Mapping[str, float], traits: Dataset) -> Array:
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
    require(
        (np.abs(total) <= MAX_AMOUNT).all(),
        "amount",
        f"must be a number from -{MAX_AMOUNT:g} to {MAX_AMOUNT:g}; 1 is the whole difference",
        str(dict(amounts)),
        "give a number such as 0.5",
    )
    return total


def _moved_surface(
    fitted: Dataset, shift: Array, basis: Dataset, metric: Array
) -> tuple[Dataset, Report]:
    """Refit the surface to the basis of the population, and move its mean coefficients
    (component,) by the shift.
    """
    H = basis[variables.POPULATION_MIXTURE].values.astype(float)
    here = _projected(fitted, H, metric)
    mean = _mean(fitted, here)
    [target] = project(((mean + shift) @ H)[None], H, metric) if shift.any() else [mean]
    step = target - mean
    weaker = np.where(
        (step < 0) & (mean > 0), target / np.where(mean > 0, mean, 1.0), 1.0
    )
    moved = here * weaker + np.maximum(step, 0.0)
    gram = H @ metric @ H.T
    takes = basis[variables.TAKE_COEFFICIENT].values
    report = _report(shift, step, takes, target, mean, gram)
    whole = max(float(_length(shift, gram)), 1e-300)
    report["clipped"] = float(_length(step - shift, gram)) / whole
    return _with_weights(fitted, moved), report


def _projected(fitted: Dataset, H: Array, metric: Array) -> Array:
    """Weights (n, k) of the surfels in a basis H (k, m); NaN without a fit."""
    weights = fitted[variables.DICTIONARY_WEIGHT].values.astype(float)
    good = finite_rows(weights)
    projected = np.full((len(weights), len(H)), np.nan)
    projected[good] = project(weights[good], H, metric)
    return projected


def _with_weights(fitted: Dataset, weights: Array) -> Dataset:
    """The surface with weights in another basis, which has other components."""
    rest = fitted.drop_dims("component")
    return rest.assign(basis_weight=label(variables.BASIS_WEIGHT, weights))


def _mean(fitted: Dataset, values: Array) -> Array:
    """Area-weighted mean (...) of values (n, ...) over the surfels that have any."""
    good = finite_rows(values)
    area = fitted[variables.SURFEL_AREA].values[good].astype(float)
    return np.average(values[good], axis=0, weights=area)


def move_along_modes(
    model: DataTree, scores: ArrayLike, *, faces: Dataset, uv: Array
) -> DataTree:
    """Copy of a model whose positions, normals, R_d, sigma_tr and weights of the surface
    are moved along modes of a population.

    Parameters
    ----------
    model
        Version of kind "model" or "edit".
    scores
        Steps along the first modes, in standard deviations.
    faces
        From `face_model`; beyond its texels, steps are extrapolated.
    uv
        (surfel, 2) common (u, v) of the surfels, from `register`.
    """
    fitted = fitted_of(model).load()
    steps = float64(scores)
    modes = np.tensordot(steps, faces[variables.FACE_MODE].values[: len(steps)], 1)
    maps = np.concatenate([faces[variables.FACE_MEAN].values, modes])
    is_known = np.isfinite(maps).all(axis=0)
    at = at_surfels(push_pull(np.moveaxis(maps, 0, -1), is_known), uv)
    mean, step = np.split(at, 2, axis=1)
    shape, albedo, gloss, translucency = (
        block_rows(faces["quantity"].values.tolist(), name) for name in BLOCKS
    )
    place = float64(fitted[variables.SURFEL_POSITION].values)
    # the axes of the take are not those of the mean
    turn, _ = Rotation.align_vectors(
        place - place.mean(axis=0), mean[:, shape] - mean[:, shape].mean(axis=0)
    )
    moved = place + turn.apply(step[:, shape])
    triangle = model["mesh"].dataset[variables.TRIANGLE].values
    tilt = vertex_normals(moved, triangle) - vertex_normals(place, triangle)
    normal = fitted[variables.SHADING_NORMAL].values + np.nan_to_num(tilt)
    values = {variables.SURFEL_POSITION: moved, variables.SHADING_NORMAL: unit(normal)}
    factors = {
        variables.DIFFUSE_REFLECTANCE: np.exp(step[:, albedo]),
        variables.BASIS_WEIGHT: np.maximum(1 + step[:, gloss] / mean[:, gloss], 0.0),
        variables.SIGMA_TR: np.exp(step[:, translucency]),
    }
    for name, factor in factors.items():
        if name in fitted and factor.size:
            values[name] = fitted[name].values * factor
    colour = np.minimum(values[variables.DIFFUSE_REFLECTANCE], BRIGHTEST)
    s, _ = dipole_s(colour, eta=float(fitted[variables.REFRACTIVE_INDEX]))
    values |= {variables.DIFFUSE_REFLECTANCE: colour, variables.DIPOLE_S: s}
    labelled = {name: label(name, value) for name, value in values.items()}
    tree = model.copy()
    tree["fitted"] = DataTree(fitted.assign(labelled))
    return tree


def with_basis(
    model: DataTree, *, mixture: Array, names: Sequence[str], tables: Array
) -> DataTree:
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
    fitted = fitted_of(model).load()
    tree = model.copy()
    weights = _projected(fitted, float64(mixture), brdf_metric(tables))
    tree["basis"] = DataTree(_common_basis(model, mixture, names, tables))
    tree["fitted"] = DataTree(_surviving(_with_weights(fitted, weights)))
    tree.attrs = take_attrs(model.attrs)
    return tree


def _common_basis(
    model: DataTree, mixture: Array, names: Sequence[str], tables: Array
) -> Dataset:
    brdf = stored_brdf(tables @ mixture.T.astype(np.float32))
    source = model["basis"].attrs.get("dictionary")
    return dataset(
        {
            variables.BASIS_MIXTURE: mixture,
            variables.BASIS_BRDF: brdf,
            variables.DISC_ANGULAR_RADIUS: model["basis/disc_angular_radius"].values,
        },
        coords={"dictionary": names, **brdf_coords(TableGrid(*tables.shape[:3]))},
        attrs={} if source is None else {"dictionary": source},
    )


def _moved_texture(
    fitted: Dataset,
    shift: Array,
    albedo: Dataset,
    texture: Dataset,
    maps: Dataset,
    registered: Dataset,
) -> tuple[Dataset, Report]:
    """Shift the distributions of log albedo and of its bands in the map, and apply the
    change to the surfels.
    """
    uv = registered[variables.COMMON_UV].values
    edit = edit_texture(
        maps,
        shift,
        texture,
        surfels=int(finite_rows(uv).sum()),
        rng=np.random.default_rng(0),
    )
    colour = fitted[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    change = at_surfels(edit.change, uv)
    moved, report = _with_albedo(fitted, colour * np.exp(change), albedo)
    # requested change of the mean of the whole face, like the other values of the report
    region = texture["region"].values.tolist().index(FACE)
    step = (
        np.nan_to_num(shift[region, :, 0]).mean(axis=-1)
        @ np.linalg.inv(texture[variables.TEXTURE_COLOUR_AXIS].values).T
    )
    report |= {
        "how": "texture",
        "requested": (_mean(fitted, colour) * np.expm1(step)).tolist(),
        "trace": [list(row) for row in edit.trace],
        "distance": edit.distance,
        "distance_before": edit.distance_before,
    }
    return moved, report


def _with_albedo(
    fitted: Dataset, target: Array, albedo: Dataset
) -> tuple[Dataset, Report]:
    """The fitted surface with new albedos (n, 3), limited to physical values, and the
    report of the change.
    """
    colour = fitted[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    out = np.where(target == colour, colour, np.clip(target, DARKEST, BRIGHTEST))
    s, _ = dipole_s(out, eta=float(fitted[variables.REFRACTIVE_INDEX]))
    moved = fitted.assign(
        diffuse_reflectance=label(variables.DIFFUSE_REFLECTANCE, out),
        dipole_s=label(variables.DIPOLE_S, s),
    )
    before, now = _mean(fitted, colour), _mean(fitted, out)
    takes = albedo[variables.ALBEDO_MEAN].sel(region=FACE).values
    axes = albedo[variables.COLOUR_AXIS].values
    # on the decorrelated axes, the unit is the standard deviation of skin in that direction
    report = _report(now - before, now - before, takes, now, before, axes.T @ axes)
    cut = (np.clip(target, DARKEST, BRIGHTEST) != target) & (target != colour)
    report["clipped"] = _fraction(fitted, cut, colour)
    return moved, report


def _fraction(fitted: Dataset, cut: Mask, values: Array) -> float:
    """Fraction of the area of the surfels with values (n, 3) in which any is cut."""
    is_cut = np.where(finite_rows(values), cut.any(axis=1), np.nan)
    return float(_mean(fitted, is_cut[:, None])[0])


def _moved_albedo(
    fitted: Dataset, amount: Array, traits: Dataset, albedo: Dataset
) -> tuple[Dataset, Report]:
    """Shift the quantiles of albedo by the shift of the whole face."""
    vectors = traits[variables.TRAIT_QUANTILE_SHIFT].sel(region=FACE).values
    shift = np.tensordot(amount, vectors, 1)
    colour = fitted[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    good = finite_rows(colour)
    mean = albedo[variables.COLOUR_MEAN].values
    axes = albedo[variables.COLOUR_AXIS].values
    edges = albedo[variables.HISTOGRAM_EDGE].values
    area = fitted[variables.SURFEL_AREA].values[good].astype(float)
    values = decorrelate(colour[good], mean, axes)
    here = histogram(np.clip(values, edges[:, 0], edges[:, -1]), area, edges)
    source = quantiles(here, edges)
    step = valid_quantiles(float64(source + shift)) - source
    matched = [
        shift_quantiles(values[:, a], here[a], step[a], edges[a]) for a in range(3)
    ]
    back = np.linalg.inv(axes).T
    edited = colour.copy()
    edited[good] = np.stack(matched, axis=1) @ back + mean
    moved, report = _with_albedo(fitted, edited, albedo)
    requested = shift.mean(axis=1) @ back
    return moved, report | {"how": "colours", "requested": requested.tolist()}


def _moved_sigma_tr(
    fitted: Dataset, amount: Array, traits: Dataset
) -> tuple[Dataset, Report]:
    """Scale sigma_tr; traits without a measured shift are not applied, and the report
    names them.
    """
    log, is_measured = _log_shift(amount, traits)
    before = np.log(fitted[variables.SIGMA_TR].values.astype(float))
    after = np.clip(before + log, *np.log(SIGMA_TR_RANGE))
    mean, now = (_mean(fitted, logs) for logs in (before, after))
    takes = traits[variables.TAKE_LOG_SIGMA_TR].dropna("take").values
    report = _report(np.exp(log), np.exp(now - mean), takes, now, mean, np.eye(3))
    report["clipped"] = _fraction(fitted, after != before + log, before)
    is_unknown = ~is_measured & (amount != 0)
    report["unknown"] = [str(t) for t in traits["trait"].values[is_unknown]]
    return fitted.assign(sigma_tr=label(variables.SIGMA_TR, np.exp(after))), report


def _surviving(ds: Dataset) -> Dataset:
    """The variables that an edit changes or that stay valid; errors, residuals and
    weights belong to the unedited model.
    """
    return ds[[name for name in names_of(Use.SURVIVES_EDIT) if name in ds]]


def _with_moved_sites(tree: DataTree, amount: Array, traits: Dataset) -> DataTree:
    """The model without the measurements of the probe, and with probe sites whose
    sigma_tr is scaled like the map; errors are omitted, as they do not include those of
    the vector.
    """
    tree = tree.drop_nodes([name for name in (PROBED,) if name in tree.children])
    if "translucency" in tree.children:
        sites = tree["translucency"].dataset.load()
        log, _ = _log_shift(amount, traits)
        scaled = sites[variables.SITE_SIGMA_TR].values.astype(float) * np.exp(log)
        moved = label(variables.SITE_SIGMA_TR, np.clip(scaled, *SIGMA_TR_RANGE))
        kept = _surviving(sites).drop_attrs(deep=False)
        tree["translucency"] = DataTree(kept.assign(site_sigma_tr=moved))
    return tree


def _log_shift(amount: Array, traits: Dataset) -> tuple[Array, Mask]:
    """Shift of log sigma_tr (channel,), and the mask (trait,) of the traits with a
    measured shift.
    """
    shifts = traits[variables.TRAIT_LOG_SIGMA_TR_SHIFT].values
    is_measured = finite_rows(shifts)
    return np.asarray(amount[is_measured] @ shifts[is_measured]), is_measured


def _report(
    requested: Array,
    applied: Array,
    takes: Array,
    now: Array,
    before: Array,
    metric: Array,
) -> Report:
    """Report of the change of a mean (d,) from `before` to `now`, with its distance from
    the nearest take (t, d), or from the mean before, relative to the median distance
    between two takes; infinite if that is 0.
    """
    i, j = np.triu_indices(len(takes), 1)
    typical = np.median(_length(takes[i] - takes[j], metric)) if len(i) else 0.0
    near = _length(now - np.vstack([takes, before]), metric).min()
    beyond = float("inf") if near > 0 else 0.0
    return {
        "requested": requested.tolist(),
        "applied": applied.tolist(),
        "from_nearest": float(near / typical) if typical > 0 else beyond,
    }


def describe_edit(report: Mapping[str, Report]) -> list[str]:
    """Limitations of an edit and changes that were omitted, one line each; `report` is
    its attribute `edit_report`.
    """
    lines = []
    albedo = report.get("albedo", {})
    for part, change in report.items():
        clipped = change.get("clipped", 0.0)
        if part == "brdf" and clipped > MIN_REPORTED:
            rule = "would have made weights negative and was omitted"
            lines.append(f"brdf: {clipped:.1%} of the requested change {rule}")
        elif part != "brdf" and clipped:
            limited = "values were limited to the physical range on"
            lines.append(f"{part}: {limited} {clipped:.1%} of the area")
    if albedo.get("how") == "colours":
        lines.append(
            "albedo: only colours were edited; textures need registrations by this "
            "version of skindb: skindb register DB, then skindb analyze DB traits"
        )
    if albedo.get("distance") is not None:
        lines.append(
            f"albedo: {albedo['distance']:.2f} standard deviations from the mean of the "
            f"takes, {albedo['distance_before']:.2f} before the edit"
        )
    return lines + [
        f"translucency: the change with {trait} is unknown and was omitted"
        for trait in report.get("translucency", {}).get("unknown", [])
    ]


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
    return values + np.interp(quantile, quantile_levels(), shift)
