"""Summaries of a model for population studies: tables of regions and sites, and a
sample of surfels.
"""

from collections.abc import Collection, Mapping
from typing import Literal

import numpy as np
import xarray as xr
from xarray import Dataset, DataTree

from skindb.analysis.regions import own_masks
from skindb.analysis.roughness import MIN_AREA, Deviations, band_deviations
from skindb.errors import InputError, input_error, require
from skindb.geometry.atlas import atlas_values, push_pull, rasterise_atlas
from skindb.render.surfels import surfel_texels, texel_codes
from skindb.schema import (
    FitStatus,
    TexelStatus,
    Use,
    dataset,
    fitted_of,
    names_of,
    variables,
)
from skindb.schema.cohort import Held, combine, take_coords
from skindb.schema.consent import consent_scope
from skindb.schema.declaration import MAX_CONDITION_TRUSTED, MIN_SAMPLES_TRUSTED
from skindb.schema.label import CHANNELS, FACE
from skindb.schema.notes import note
from skindb.types import AnyArray, Array, Index, Mask, finite_rows

# surfels per take; the paper drew 2,000 of each subject, and 5,000 for the conditions
# of one subject
SAMPLED = 5000
STREAM = 7  # random stream of the sample
# constants and means of the group "basis" that studies of the dictionary need
IN_TABLES = (variables.MEAN_DICTIONARY_WEIGHT, variables.DISC_ANGULAR_RADIUS)
SIZE = 512  # texels along each side of the stored maps of a registration
# degrees between the normal and a half vector, within which a surfel must be seen for its
# surface reflectance to count: without the peak of its lobe it is a third too low, by an
# amount that depends on the shape of the face. Chosen on ten virtual subjects of 4 cameras
# and 24 lights, the patches after another dome was seen; docs/results has a third
MAX_HALF_ANGLE = 12.0
# mm; errors of surface reflectance are independent between patches of this size only
PATCH_SIZE = 20.0
# errors of mean surface reflectance and glossiness, relative to them, that takes have in
# common by lobes of other shapes, and of lips by folds that are narrower than pixels.
# Chosen on 10 virtual takes, validated on 33 (docs/results)
MODEL_ERRORS = {  # of lips, and of other regions
    variables.REGION_SURFACE_REFLECTANCE: (0.15, 0.06),
    variables.REGION_GLOSSINESS: (0.1, 0.05),
}


def sample_surfels(
    model: DataTree, *, surfels: int = SAMPLED, seed: int = 0
) -> Dataset:
    """A random sample of the fitted surfels of a model.

    Parameters
    ----------
    model
        Version of kind "model".
    surfels
        Number of surfels; the sample is smaller if fewer were fitted.
    seed
        Random seed.

    Returns
    -------
    Dataset
        Variables of the group "fitted" along "surfel", and `surfel_index`. Surfels are
        drawn without replacement, each with the same probability, and are in random
        order: the first n of them are a random sample as well.

    Raises
    ------
    InputError
        If no surfel was fitted.
    """
    fitted = fitted_of(model)
    good = np.flatnonzero(fitted[variables.FIT_STATUS].values == FitStatus.FITTED)
    if not good.size:
        raise no_surfels_error(model)
    drawn = np.random.default_rng([seed, STREAM]).permutation(good)[:surfels]
    order = np.argsort(drawn)
    # read in the order of storage, then reorder as drawn
    sample = (
        fitted[[name for name in names_of(Use.SAMPLED) if name in fitted]]
        .isel(surfel=drawn[order])
        .load()
    )
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return (
        sample.isel(surfel=back)
        .merge(dataset({variables.SURFEL_INDEX: drawn}))
        .drop_attrs(deep=False)
    )


def summary_tables(model: DataTree) -> Dataset:
    """Tables of one model for population studies: regions, dictionary and probe sites.

    Returns
    -------
    Dataset
        For every region (those of the capture, and "face" for all surfels): number and
        area of the trusted surfels, area-weighted means of diffuse and surface
        reflectance with their errors. For every site: sigma_tr with its errors and
        status. Mean weights of the dictionary, and the radius of the lights' discs.
    """
    fitted = fitted_of(model).load()
    basis = model["basis"].dataset
    masks = {FACE: np.ones(fitted.sizes["surfel"], bool)} | own_masks(fitted)
    parts = [
        region_tables(fitted, masks),
        basis[[name for name in IN_TABLES if name in basis]].load(),
    ]
    if "translucency" in model.children:
        sites = model["translucency"].dataset
        parts.append(
            sites[[name for name in names_of(Use.SAMPLED) if name in sites]].load()
        )
    return xr.merge(
        parts, combine_attrs="override", join="outer", compat="no_conflicts"
    )


def region_tables(fitted: Dataset, masks: Mapping[str, Mask]) -> Dataset:
    """Area-weighted means over the trusted surfels of regions.

    Parameters
    ----------
    fitted
        Group "fitted" of a model.
    masks
        Region -> (surfel,) mask of its surfels.

    Returns
    -------
    Dataset
        `region_surfels`, `region_area`, `region_diffuse_reflectance` with `_error`
        (from independent errors of the surfels) and `_total_error` (including the part
        that all surfels have in common, which averaging does not reduce),
        `region_surface_reflectance`, of the surfels that were seen within 12 degrees of
        their highlight, unless there are none in the take, and `region_glossiness` of the
        same surfels, weighted by the light that they reflect, with both errors: `_error` is
        that of the scatter between patches of the region, which contains differences of its
        skin, and at least that from independent errors.
        `region_albedo_contrast` and `region_normal_slope` with such errors: RMS deviations
        of log R_d and of normals at wavelengths of 10 to 25 mm, without the part that noise
        causes. NaN for a region without such surfels.
    """
    trusted = trusted_surfels(fitted)
    cell = np.floor(fitted[variables.SURFEL_POSITION].values / PATCH_SIZE)
    patch = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    inside = np.array([mask & trusted for mask in masks.values()])
    tables = (
        _diffuse_means(fitted, inside)
        | _surface_means(fitted, inside, patch, trusted)
        | _roughness(band_deviations(fitted, trusted), inside, patch)
    )
    for mean, errors in MODEL_ERRORS.items():
        relative = np.where(np.equal(list(masks), "lips"), *errors)
        tables[f"{mean}_total_error"] = np.hypot(
            tables[f"{mean}_error"], relative * tables[mean]
        )
    return dataset(tables, coords={"region": list(masks), "channel": CHANNELS})


def _diffuse_means(fitted: Dataset, inside: Mask) -> dict[str, AnyArray]:
    """Variables of the mean R_d of regions, of masks (region, surfel)."""
    area = fitted[variables.SURFEL_AREA].values.astype(float)
    colour = fitted[variables.DIFFUSE_REFLECTANCE].values.astype(float)
    noise, total = (
        fitted[name].values.astype(float)
        if name in fitted
        else np.full(colour.shape, np.nan)
        for name in (
            variables.DIFFUSE_REFLECTANCE_ERROR,
            variables.DIFFUSE_REFLECTANCE_TOTAL_ERROR,
        )
    )
    # model errors of neighbouring surfels are correlated: averaging does not reduce them
    model = np.sqrt(np.maximum(total**2 - noise**2, 0))
    means, errors, common = np.array(
        [
            (
                *_weighted_mean(colour[rows], noise[rows], area[rows]),
                _weighted_mean(model[rows], model[rows], area[rows])[0],
            )
            for rows in inside
        ]
    ).swapaxes(0, 1)
    return {
        variables.REGION_SURFELS: inside.sum(axis=1),
        variables.REGION_AREA: inside @ area,
        variables.REGION_DIFFUSE_REFLECTANCE: means,
        variables.REGION_DIFFUSE_REFLECTANCE_ERROR: errors,
        variables.REGION_DIFFUSE_REFLECTANCE_TOTAL_ERROR: np.hypot(errors, common),
    }


def _surface_means(
    fitted: Dataset, inside: Mask, patch: Index, trusted: Mask
) -> dict[str, AnyArray]:
    """Variables of surface reflectance and glossiness of regions."""
    area = fitted[variables.SURFEL_AREA].values.astype(float)
    reflectance, reflectance_error, glossiness, glossiness_error = (
        fitted[name].values.astype(float)
        if name in fitted
        else np.full_like(area, np.nan)
        for name in (
            variables.SURFACE_REFLECTANCE,
            variables.SURFACE_REFLECTANCE_ERROR,
            variables.GLOSSINESS,
            variables.GLOSSINESS_ERROR,
        )
    )
    if variables.SMALLEST_HALF_ANGLE in fitted:
        near = fitted[variables.SMALLEST_HALF_ANGLE].values <= MAX_HALF_ANGLE
        reflectance[~near & (trusted & near).any()] = np.nan
    light = np.nan_to_num(area * reflectance)
    whole, narrow = (
        np.transpose(
            [_patch_mean(values[i], errors[i], weight[i], patch[i]) for i in inside]
        )
        for values, errors, weight in (
            (reflectance, reflectance_error, area),
            (glossiness, glossiness_error, light),
        )
    )
    return {
        variables.REGION_SURFACE_REFLECTANCE: whole[0],
        variables.REGION_SURFACE_REFLECTANCE_ERROR: whole[1],
        variables.REGION_GLOSSINESS: narrow[0],
        variables.REGION_GLOSSINESS_ERROR: narrow[1],
    }


def _roughness(
    deviations: Deviations, inside: Mask, patch: Index
) -> dict[str, AnyArray]:
    """Variables of the roughness of regions; NaN for small or bent ones, and where noise
    explains more than half of the squared deviations.
    """
    patch = patch[deviations.surfel]
    roughness = np.full((2, len(inside), 4), np.nan)
    for region, rows in enumerate(inside[:, deviations.surfel]):
        weight = deviations.area[rows]
        if weight.sum() < MIN_AREA:
            continue
        noise = np.average(deviations.noise[rows], axis=0, weights=weight)
        signal = deviations.square[rows] - deviations.noise[rows]
        mean = np.average(signal, axis=0, weights=weight)
        root = np.sqrt(np.where(mean > noise, mean, np.nan))
        scatter = [_patch_error(x, weight, patch[rows]) for x in (signal - mean).T]
        roughness[:, region] = root, scatter / (2 * root)
    values, errors = roughness
    return {
        variables.REGION_ALBEDO_CONTRAST: values[:, :3],
        variables.REGION_ALBEDO_CONTRAST_ERROR: errors[:, :3],
        variables.REGION_NORMAL_SLOPE: values[:, 3],
        variables.REGION_NORMAL_SLOPE_ERROR: errors[:, 3],
    }


def trusted_surfels(fitted: Dataset) -> Mask:
    """Mask (surfel,) of surfels that are fitted, by Lambert's law at least,
    well-conditioned and have enough samples; see `TexelStatus`. In takes without a surfel
    that has enough, as under few lights, the number of samples does not matter.
    """
    status = fitted[variables.FIT_STATUS].values
    good = np.isin(status, (FitStatus.FITTED, FitStatus.LAMBERT))
    if variables.FIT_CONDITION in fitted:
        good &= ~(fitted[variables.FIT_CONDITION].values > MAX_CONDITION_TRUSTED)
    if variables.FIT_SAMPLES in fitted:
        enough = fitted[variables.FIT_SAMPLES].values >= MIN_SAMPLES_TRUSTED
        good &= enough | ~(good & enough).any()
    return good & finite_rows(fitted[variables.DIFFUSE_REFLECTANCE].values)


def _patch_mean(
    values: Array, errors: Array, weight: Array, patch: Index
) -> tuple[Array, Array]:
    """Weighted mean, and its error from independent errors and from the scatter between
    patches.
    """
    mean, error = _weighted_mean(values, errors, weight)
    return mean, np.fmax(error, _patch_error(values - mean, weight, patch))


def _patch_error(residual: Array, weight: Array, patch: Index) -> float:
    """Standard error of a weighted mean from residuals that are independent between
    patches only; NaN for fewer than two patches.
    """
    is_known = np.isfinite(residual)
    count = len(np.unique(patch[is_known]))
    if count < 2:
        return np.nan
    sums = np.bincount(patch[is_known], (weight * residual)[is_known])
    square = (sums**2).sum() * count / (count - 1)
    return float(np.sqrt(square) / weight[is_known].sum())


def no_surfels_error(model: DataTree) -> InputError:
    """Error for a take without fitted surfels, which a population cannot use."""
    take = str(model.attrs.get("take", model.attrs.get("subject", "take")))
    return input_error(
        take,
        "a take of a population must have fitted surfels",
        "none",
        "skip the take or fit it again",
    )


def _weighted_mean(values: Array, errors: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted mean over surfels, and its error from independent errors; NaN without surfels."""
    weight = weight.reshape(-1, *(1,) * (values.ndim - 1))
    is_known = np.isfinite(values)
    stated = np.isfinite(errors)
    # weights at the bound 0 have no error: the RMS error of the others is used
    if stated.any():
        errors = np.where(stated, errors, np.sqrt(np.mean(errors[stated] ** 2)))
    total = np.where(is_known, weight, 0).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (np.where(is_known, values, 0) * weight).sum(axis=0) / total
        error = (
            np.sqrt((np.where(is_known, errors * weight, 0) ** 2).sum(axis=0)) / total
        )
    return mean, error


def cohort_of(
    models: Mapping[str, DataTree],
    layout: Literal["tables", "surfels"] = "tables",
    *,
    captures: Mapping[str, DataTree] | None = None,
    surfels: int = 2000,
    seed: int = 0,
) -> Dataset:
    """Combine models in memory into a cohort with the layout of `Database.cohort`,
    without the table of predictions.

    Parameters
    ----------
    models
        Take -> version of kind "model", or the result of `skindb.fit.fit_model`.
    layout
        "tables" or "surfels".
    captures
        Take -> capture of the model; if given, the reflectance samples of the sampled
        surfels are included.
    surfels, seed
        Number of surfels of each take, and the random seed of the sample.

    Returns
    -------
    Dataset
        Takes whose consent does not cover statistics are skipped; the attribute
        "skipped" names them.

    Raises
    ------
    InputError
        If there is no take whose consent covers statistics.
    """
    allowed = {
        take: model
        for take, model in models.items()
        if "statistics" in consent_scope(model.attrs)
    }
    require(
        allowed,
        "population",
        "the consent of a take must cover statistics",
        f"none of {len(models)} takes",
        "see consent.scope in capture.json",
    )
    skipped = [
        note(take, "its consent does not cover statistics")
        for take in models
        if take not in allowed
    ]
    parts = []
    for take, model in allowed.items():
        if layout == "tables":
            ds = summary_tables(model)
        else:
            ds = sample_surfels(model, surfels=surfels, seed=seed)
            if captures is not None:
                ds = ds.merge(
                    _samples_of(captures[take], ds[variables.SURFEL_INDEX].values)
                )
        parts.append(Held.part(take, take_coords(take, model.attrs, model.attrs), ds))
    sizes = {"surfel": surfels} if layout == "surfels" else {}
    return combine(
        parts,
        sizes=sizes,
        attrs={"layout": layout, "kind": "model", "skipped": skipped, "outdated": []},
    )


def _samples_of(capture: DataTree, index: Index) -> Dataset:
    """Reflectance samples of the selected surfels, and the positions of the lights and
    cameras of the dome.
    """
    places = [variables.LIGHT_POSITION, variables.CAMERA_POSITION]
    dome = capture["dome"].dataset[places]
    samples = capture["samples"].dataset[[variables.REFLECTANCE_SAMPLE]]
    chosen = samples.isel(surfel=index)
    return xr.merge([chosen.load(), dome.load()], combine_attrs="override")


def common_maps(
    model: DataTree,
    registered: Dataset,
    *,
    size: int = SIZE,
    maps: Collection[str] | None = None,
) -> Dataset:
    """Albedo, surface reflectance and translucency of one take as maps in the common (u, v).

    Parameters
    ----------
    model
        Version of kind "model".
    registered
        Registration of this model, with `common_uv`.
    size
        Texels along each side; texel (i, j) has its centre at v = (i + 0.5) / size, u =
        (j + 0.5) / size.
    maps
        Variables of the result, by default all.

    Returns
    -------
    Dataset
        (v, u, ...) `texel_diffuse_reflectance` with its total error,
        `texel_surface_reflectance`, `texel_sigma_tr`, `texel_status` (whether a value
        is trusted, and why not) and `texel_coverage`. Inside the face, values that were
        not measured are interpolated from the surrounding texels; outside they are NaN.
    """
    fitted = fitted_of(model)
    triangles = model["mesh"].dataset[variables.TRIANGLE].values
    uv = registered[variables.COMMON_UV].values
    codes = surfel_texels(fitted)
    raster = rasterise_atlas(uv, triangles, size)
    status = texel_codes(codes, triangles, *raster)
    outside = status == TexelStatus.OUTSIDE
    found: dict[str, AnyArray] = {variables.TEXEL_STATUS: status}
    for name in names_of(Use.MAPPED):
        needed = maps is None or f"texel_{name}" in maps
        if name not in fitted or not (needed or name == variables.DIFFUSE_REFLECTANCE):
            continue
        values = fitted[name].values.reshape(len(codes), -1).astype(np.float32)
        is_trusted = (codes == TexelStatus.MEASURED) & finite_rows(values)
        image, weight = atlas_values(values, is_trusted, triangles, raster)
        if name == variables.DIFFUSE_REFLECTANCE:
            weight_inside = np.where(outside, np.float32(0), weight)
            found[variables.TEXEL_COVERAGE] = weight_inside
        filled = push_pull(image, weight)
        filled[outside] = np.nan
        found[f"texel_{name}"] = filled if fitted[name].ndim == 2 else filled[..., 0]
    chosen = {name: found[name] for name in found if maps is None or name in maps}
    return dataset(chosen, coords={"channel": CHANNELS})
