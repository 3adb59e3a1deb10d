"""Surface reflectance per surfel (Weyrich et al. 2005, section 7): the fit of a surface
model, and its judgement by the errors of its predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from dask.base import compute
from dask.delayed import delayed

from skindb.elementwise import elementwise
from skindb.fit.lumitexels import GEOMETRY, Arrays, block_of, by_name, noise_inputs
from skindb.fit.quality import HELD_OUT_ERRORS, misfits
from skindb.reflectance._lumitexel_kernels import MIN_SAMPLES_GLOSS
from skindb.reflectance.kinds import surface_model
from skindb.reflectance.model import (
    MIN_LOBE_WIDTH,
    Comparison,
    Judgement,
    ReflectanceModel,
    SurfaceFit,
)
from skindb.schema import check, dataset, text_labels, variables
from skindb.types import AnyArray, Array, Index

NEEDED = (*GEOMETRY, "shading_normal", "diffuse_reflectance")
# sr^-1; noise of a sample of dark skin by photons and resampling; that of the sensor may be larger
NOISE_FLOOR_SURFACE = 2e-3
ERROR_INPUTS = ("diffuse_reflectance_error", "normal_error")
SURFELS_PER_BLOCK = 4096  # surfels per task if the samples are not lazy


def fit_surface(
    lumitexels: xr.Dataset,
    *,
    surface: ReflectanceModel,
    mode: str = "perceptual",
    eta: float = 1.3,
    min_width: float = MIN_LOBE_WIDTH,
) -> xr.Dataset:
    """Fit a surface model to every surfel, before the parts common to all surfels are known.

    Parameters
    ----------
    lumitexels
        Samples with geometry, `shading_normal` and `diffuse_reflectance`.
    surface
        Surface model, such as `Mixture.of_dictionary`: mixtures of all BRDFs of a
        dictionary.
    mode
        "linear": the least norm of M x - R. "perceptual": that of root(M x) - root(R),
        with root(y) = y / (y^2 + floor^2)^(1/3), the signed cube root that is linear
        below the noise floor, by Gauss-Newton with a line search; then one linear step
        weighted with the squared slopes of the root, which is not biased by noise as
        the cube root is.
    eta
        Refractive index of the diffuse term that is subtracted.
    min_width
        Half width of the narrowest lobe of a surfel, over the smallest angle at which it
        was seen between its normal and a half vector; 0 allows lobes of any width.

    Returns
    -------
    Dataset
        Parameters of the model, such as `dictionary_weight`; `kkt_residual`,
        `fit_iterations`, `fit_samples`, `fit_condition`, the residual (RMS of the
        samples' error over RMS of the samples) also in cube-root space, and
        `fit_status`; NaN where the status says that nothing was fitted.
    """
    check(lumitexels, NEEDED, where="lumitexels")
    comparison = Comparison(
        mode, eta, noise_floor(lumitexels), MIN_SAMPLES_GLOSS, min_width
    )
    names = _unique(*NEEDED, *noise_inputs(lumitexels))

    def kernel(arrays: Arrays) -> tuple[Any, ...]:
        columns = surface.fit_columns(surface.fit(block_of(arrays), comparison))
        return tuple(columns[name] for name in surface.fit_variables)

    fitted = elementwise(
        by_name(kernel, names),
        lumitexels,
        over="surfel",
        inputs=names,
        outputs=surface.fit_variables,
        sizes={dim: len(labels) for dim, labels in surface.labels.items()},
    )
    coords = {dim: text_labels(labels) for dim, labels in surface.labels.items()}
    return fitted.assign_coords(coords)


def noise_floor(lumitexels: xr.Dataset) -> float:
    """Level [sr^-1] below which samples are compared linearly: at least the noise of the sensor."""
    check(lumitexels, ("noise_floor",), where="lumitexels")
    return max(NOISE_FLOOR_SURFACE, float(lumitexels["noise_floor"]))


def refit(
    lumitexels: xr.Dataset,
    *,
    basis: xr.Dataset,
    mode: str = "perceptual",
    eta: float = 1.3,
    min_width: float = MIN_LOBE_WIDTH,
) -> xr.Dataset:
    """Parameters of every surfel for the surface model of a take.

    Parameters
    ----------
    lumitexels
        Samples with geometry, `shading_normal` and `diffuse_reflectance`; the errors below count
        `diffuse_reflectance_error` and `normal_error` where they are given.
    basis
        Group "basis" of a model, such as `basis_brdf` of k components from `reduce_basis`.
    mode, eta, min_width
        As in `fit_surface`.

    Returns
    -------
    Dataset
        `basis_weight`, `fit_residual`, `fit_residual_perceptual` (of all samples,
        diffuse light included); `basis_weight_error`, NaN for weights at their bound 0;
        `surface_reflectance`, the fraction of light along the normal that the surface
        reflects, and `surface_reflectance_error`. The errors include the noise of the
        samples and the errors of R_d and of the normal, conditional on which weights
        are above 0: they are too small for lobes so sharp that only a few samples see
        them, and for weights that noise moves to their bound.
    """
    return _judged(lumitexels, basis, mode=mode, eta=eta, min_width=min_width)[0]


def held_out_error(
    lumitexels: xr.Dataset, *, basis: xr.Dataset, eta: float = 1.3, of: str = "light"
) -> xr.Dataset:
    """Relative RMS error of predicted samples, per surfel.

    Parameters
    ----------
    lumitexels
        Samples of the lights or cameras that were held out, with geometry,
        `shading_normal`, `diffuse_reflectance` and the parameters of the fit.
    basis
        Group "basis" of the model.
    eta
        Refractive index of the diffuse term.
    of
        "light" or "camera": what was held out.

    Returns
    -------
    Dataset
        `held_out_error` and, in cube-root space, `held_out_error_perceptual`; of
        cameras `held_out_camera_error` and `held_out_camera_error_perceptual`. NaN
        where the surfel has no such sample or nothing was fitted.
    """
    judged, _ = _judged(
        lumitexels, basis, mode="linear", eta=eta, evaluate=True, min_samples=1
    )
    residuals = ("fit_residual", "fit_residual_perceptual")
    return dataset(
        {
            name: judged[residual].values
            for name, residual in zip(HELD_OUT_ERRORS[of], residuals, strict=True)
        }
    )


def find_outliers(
    lumitexels: xr.Dataset, *, basis: xr.Dataset, eta: float = 1.3
) -> xr.Dataset:
    """Fractions of outlying samples per surfel, light and camera, and misfits of
    lights, cameras and photographs.

    A sample is an outlier if it differs from the prediction in cube-root space by more
    than five scales of the residuals of its surfel; the scale is the median of the
    absolute residuals (times 1.4826), so that half of the samples may be wrong. The
    misfit of a light is a median over surfels, as motion of the face affects most of
    them.

    Parameters
    ----------
    lumitexels
        Samples the model was fitted to, with geometry, `shading_normal`,
        `diffuse_reflectance` and the parameters of the fit.
    basis
        Group "basis" of the model.
    eta
        Refractive index of the diffuse term.

    Returns
    -------
    Dataset
        `outlier_fraction` (surfel); `light_outlier_fraction`, `light_misfit`,
        `camera_outlier_fraction`, `camera_misfit` and `frame_misfit` (light, camera).
        NaN where there are too few samples to decide.
    """
    judged, counts = _judged(
        lumitexels, basis, mode="perceptual", eta=eta, evaluate=True, outliers=True
    )
    coords = {
        dim: lumitexels[dim].values
        for dim in ("light", "camera")
        if dim in lumitexels.coords
    }
    columns = {"outlier_fraction": judged["outlier_fraction"].values}
    return dataset(columns | misfits(counts), coords=coords)


def refit_and_evaluate(
    lumitexels: xr.Dataset,
    *,
    held_out: xr.Dataset,
    basis: xr.Dataset,
    mode: str,
    eta: float,
) -> tuple[xr.Dataset, xr.Dataset]:
    """`refit`, `held_out_error` of lights and of cameras, and `find_outliers`, in one
    pass over the samples.

    Parameters
    ----------
    lumitexels
        All samples with geometry, and `shading_normal`, `diffuse_reflectance` and their errors.
    held_out
        `light_held_out` and `camera_held_out`.
    basis
        Group "basis" of the model.
    mode, eta
        As in `refit`.

    Returns
    -------
    fitted, outliers
        Variables of the surfels; and variables of lights, cameras and photographs for
        the fitted samples.
    """
    check(lumitexels, ERROR_INPUTS, where="lumitexels")
    held = (
        1 * held_out["light_held_out"].values[:, None]
        + 2 * held_out["camera_held_out"].values[None, :]
    )
    judged, counts = _judged(
        lumitexels, basis, mode=mode, eta=eta, held=held.astype(np.int64), outliers=True
    )
    # histograms of the fitted photographs alone
    fitted = {
        dim: np.flatnonzero(held_out[f"{dim}_held_out"].values == 0)
        for dim in ("light", "camera")
    }
    counts = counts[np.ix_(fitted["light"], fitted["camera"])]
    coords = {
        dim: held_out[dim].values[index]
        for dim, index in fitted.items()
        if dim in held_out.coords
    }
    return judged, dataset(misfits(counts), coords=coords)


def _judged(
    lumitexels: xr.Dataset,
    basis: xr.Dataset,
    *,
    mode: str,
    eta: float,
    min_samples: int = MIN_SAMPLES_GLOSS,
    min_width: float = MIN_LOBE_WIDTH,
    evaluate: bool = False,
    held: Index | None = None,
    outliers: bool = False,
) -> tuple[xr.Dataset, Index]:
    """Variables of the surfels, whose parameters are fitted or only evaluated block by
    block, and histograms (lights, cameras, bins) of residuals.

    `elementwise` cannot sum over surfels: a task per block returns its surfels and
    histograms, which are summed.
    """
    surface = surface_model(basis)
    parameter_names = surface.parameter_variables if evaluate else ()
    errors = () if evaluate else tuple(n for n in ERROR_INPUTS if n in lumitexels)
    names = _unique(*NEEDED, *noise_inputs(lumitexels), *parameter_names, *errors)
    check(lumitexels, (*NEEDED, *parameter_names), where="lumitexels")
    comparison = Comparison(mode, eta, noise_floor(lumitexels), min_samples, min_width)

    def judge(part: xr.Dataset) -> tuple[dict[str, Array], Index]:
        arrays = {name: part[name].values for name in names}
        diffuse_error = arrays.get("diffuse_reflectance_error")
        if diffuse_error is None and not evaluate:
            diffuse_error = np.zeros((part.sizes["surfel"], 3))
        judgement = Judgement(diffuse_error, arrays.get("normal_error"), held, outliers)
        parameters = surface.parameters_of(part) if evaluate else None
        judged = surface.fit(block_of(arrays), comparison, judgement, parameters)
        fitted = {} if evaluate else surface.judged_columns(judged)
        return fitted | _error_columns(judged, judgement), judged.counts

    if variables.EVEN_REFLECTION in lumitexels:  # of a stored model
        even = lumitexels[variables.EVEN_REFLECTION]
        diffuse = lumitexels[variables.DIFFUSE_REFLECTANCE] + even
        lumitexels = lumitexels.assign({variables.DIFFUSE_REFLECTANCE: diffuse})
    inputs = lumitexels[list(names)]
    size = lumitexels.sizes["surfel"]
    cuts = np.append(np.arange(0, max(size, 1), SURFELS_PER_BLOCK), size)
    if lumitexels["reflectance_sample"].chunks is not None:
        cuts = np.cumsum([0, *lumitexels.chunksizes["surfel"]])
    blocks = [inputs.isel(surfel=slice(a, b)) for a, b in pairwise(cuts)]
    parts, counts = joined_blocks(judge, blocks)
    columns = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    coords = {} if evaluate else surface.labels
    return dataset(columns, coords=coords), counts


def _error_columns(judged: SurfaceFit, judgement: Judgement) -> dict[str, Array]:
    """Variables of the surfels with the errors of their predictions."""
    columns = {
        "fit_residual": judged.residual,
        "fit_residual_perceptual": judged.residual_perceptual,
    }
    if judgement.outliers:
        columns["outlier_fraction"] = judged.outlier
    if judgement.held is not None:
        for i, names in enumerate(HELD_OUT_ERRORS.values()):
            if (judgement.held & (i + 1)).any():
                columns |= dict(zip(names, judged.held_error[:, i].T, strict=True))
    return columns


def joined_blocks(
    judge: Callable[[xr.Dataset], tuple[Any, AnyArray]],
    blocks: Sequence[xr.Dataset],
) -> tuple[list[Any], AnyArray]:
    """Results of `judge` for each block, and the sum of the histograms that it also returns.

    Histograms are added in pairs as blocks finish: those of a full dome take 1.5 MB per
    block, and all of them together would take more memory than the results of the
    surfels.
    """
    judged = [delayed(judge, nout=2)(block) for block in blocks]
    sums = [counts for _, counts in judged]
    while len(sums) > 1:
        pairs = (sums[i : i + 2] for i in range(0, len(sums), 2))
        sums = [delayed(np.add)(*pair) if len(pair) > 1 else pair[0] for pair in pairs]
    parts, total = compute([part for part, _ in judged], sums[0])  # type: ignore[no-untyped-call]
    return parts, total


def _unique(*names: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names))
