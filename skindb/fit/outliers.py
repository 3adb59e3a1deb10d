"""Samples that a fitted model does not explain: motion, hair, shadows of objects
outside the scan.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from dask.base import compute
from dask.delayed import delayed
from numpy.typing import NDArray

from skindb.fit._surface_arrays import refit_weights
from skindb.fit._surface_kernels import BINS_PER_SCALE
from skindb.fit.surface import MIN_SAMPLES, NEEDED, noise_floor, reduced_tables
from skindb.schema import check, dataset

# ratio to the usual misfit: between clean captures (at most 1.43) and a face displaced
# by 2 mm (1.96)
MOVED_LIGHT_RATIO = 1.7
# A camera's misfit over that of the other cameras under the same light, lower quartile
# over the lights. Set between clean takes (demo, "small", "lafortune" with its coloured
# highlights: at most 1.04) and cameras moved by 2 mm ("small" 1.28, "lafortune" 1.75);
# validated on "exr", "dirty", "sss" and two more glosses (clean 1.01, moved 1.23 to
# 2.9).
MOVED_CAMERA_RATIO = 1.15
# The same for a camera's total misfit, if too few photographs can be compared: clean at
# most 1.24, moved 1.38.
MOVED_CAMERA_WHOLE_RATIO = 1.3
MIN_LIGHTS_PER_CAMERA = 8  # photographs of a camera that are required for the quartile
NEIGHBOURS = 4  # lights with similar angles, and thus similar misfit
# samples that are required for the misfit of a light, camera or photograph
MIN_SAMPLES_MISFIT = 1000


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
        `diffuse_reflectance` and `basis_weight`.
    basis
        `basis_brdf` the weights refer to.
    eta
        Refractive index of the diffuse term.

    Returns
    -------
    Dataset
        `outlier_fraction` (surfel); `light_outlier_fraction`, `light_misfit`,
        `camera_outlier_fraction`, `camera_misfit` and `frame_misfit` (light, camera).
        NaN where there are too few samples to decide.
    """
    names = (*NEEDED, "basis_weight")
    check(lumitexels, names, where="lumitexels")
    cuts = np.cumsum(
        [0, *lumitexels.chunksizes.get("surfel", (lumitexels.sizes["surfel"],))]
    )
    tables = reduced_tables(basis)
    floor = noise_floor(lumitexels)
    used = lumitexels[list(names)]

    def counted(block: xr.Dataset) -> tuple[NDArray[Any], NDArray[Any]]:
        *samples, weight = (block[name].values for name in names)
        found = refit_weights(
            *samples,
            weight=weight,
            tables=tables,
            eta=eta,
            mode="perceptual",
            noise_floor=floor,
            min_samples=MIN_SAMPLES,
            outliers=True,
        )
        return found.outlier, found.counts

    blocks = [used.isel(surfel=slice(a, b)) for a, b in pairwise(cuts)]
    shares, counts = joined_blocks(counted, blocks)
    coords = {
        dim: lumitexels[dim].values
        for dim in ("light", "camera")
        if dim in lumitexels.coords
    }
    found = {"outlier_fraction": np.concatenate(shares)} | misfits(counts)
    return dataset(found, coords=coords)


def joined_blocks(
    judge: Callable[[xr.Dataset], tuple[Any, NDArray[Any]]],
    blocks: Sequence[xr.Dataset],
) -> tuple[list[Any], NDArray[Any]]:
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


def misfits(frames: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Variables of lights, cameras and photographs from histograms (lights, cameras,
    bins) of scaled residuals.
    """
    return {
        "light_outlier_fraction": _beyond(frames.sum(1)),
        "light_misfit": _median(frames.sum(1)),
        "camera_outlier_fraction": _beyond(frames.sum(0)),
        "camera_misfit": _median(frames.sum(0)),
        "frame_misfit": _median(frames),
    }


def suspects(outliers: xr.Dataset, lumitexels: xr.Dataset) -> list[dict[str, Any]]:
    """Lights and cameras whose residuals are far above the usual ones, worst first.

    Lights at grazing angles have a larger misfit even without motion, so that a light
    must also be far above its neighbours. A camera that sees highlights outside the
    model has a larger misfit under the lights that cause them; one that was moved has
    it under nearly all lights. Motion during most lights is not found, as the fit
    adapts to it.
    """
    moved = {
        "light": outliers["light_misfit"].values
        > MOVED_LIGHT_RATIO * _around(outliers, lumitexels["light_position"].values),
        "camera": _moved_cameras(outliers),
    }
    found: list[dict[str, Any]] = []
    for dim, named in moved.items():
        misfit = outliers[f"{dim}_misfit"].values
        share = outliers[f"{dim}_outlier_fraction"].values
        names = (
            outliers[dim].values if dim in outliers.coords else np.arange(misfit.size)
        )
        found += [
            {
                dim: str(names[i]),
                "outlier_fraction": float(share[i]),
                "misfit": float(misfit[i]),
            }
            for i in np.flatnonzero(named)
        ]
    return sorted(found, key=lambda one: -one["misfit"])


def _moved_cameras(outliers: xr.Dataset) -> NDArray[np.bool_]:
    """Cameras with a misfit under nearly all lights; by the misfit of all samples if
    few photographs are usable.
    """
    misfit = outliers["camera_misfit"].values
    frames = outliers["frame_misfit"].values
    whole = misfit > MOVED_CAMERA_WHOLE_RATIO * _usual(outliers["camera_misfit"])
    # lights with results for at least three cameras
    usable = frames[np.isfinite(frames).sum(axis=1) > 2]
    judged = np.isfinite(usable).sum(axis=0) >= MIN_LIGHTS_PER_CAMERA
    if not judged.any():
        return whole
    ratio = usable[:, judged] / np.nanmedian(usable, axis=1, keepdims=True)
    whole[judged] = np.nanquantile(ratio, 0.25, axis=0) > MOVED_CAMERA_RATIO
    return whole


def _usual(misfit: xr.DataArray) -> NDArray[Any]:
    """Median of three or more values, else NaN, as two values cannot be compared."""
    return np.asarray(misfit.median() if misfit.count() > 2 else np.inf)


def _around(outliers: xr.Dataset, position: NDArray[Any]) -> NDArray[Any]:
    """Usual misfit at each light: the larger of the medians of its neighbours and of all lights."""
    misfit = outliers["light_misfit"].values
    distance = np.linalg.norm(position[:, None].astype(np.float64) - position, axis=-1)
    distance[np.arange(len(misfit)), np.arange(len(misfit))] = np.inf
    distance[:, ~np.isfinite(misfit)] = np.inf
    near = np.argsort(distance, axis=1)[:, :NEIGHBOURS]
    return np.asarray(
        np.fmax(np.median(misfit[near], axis=1), _usual(outliers["light_misfit"]))
    )


def _beyond(counts: NDArray[Any]) -> NDArray[Any]:
    total = counts.sum(-1)
    return np.where(
        total >= MIN_SAMPLES_MISFIT, counts[..., -1] / np.maximum(total, 1), np.nan
    )


def _median(counts: NDArray[Any]) -> NDArray[Any]:
    """Medians of histograms (..., bins) of scaled residuals relative to normal noise;
    NaN for too few samples.

    If most samples are outliers, the median is the lower end of the last bin.
    """
    total = counts.sum(-1)
    below = counts.cumsum(-1)
    half = total / 2
    place = np.argmax(below >= half[..., None], axis=-1)
    inside = np.take_along_axis(counts, place[..., None], -1)[..., 0]
    before = np.take_along_axis(below, place[..., None], -1)[..., 0] - inside
    part = np.where(
        place < counts.shape[-1] - 1, (half - before) / np.maximum(inside, 1), 0
    )
    return np.where(
        total >= MIN_SAMPLES_MISFIT, (place + part) / BINS_PER_SCALE / 0.6745, np.nan
    )
