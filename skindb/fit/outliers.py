"""Samples that a fitted model does not explain: motion, hair, shadows of what the scan misses."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from dask.base import compute
from dask.delayed import delayed
from numpy.typing import NDArray

from skindb.fit.surface import MIN_SAMPLES, NEEDED, noise_floor, reduced_tables
from skindb.schema import check, dataset

# times what is usual: between clean captures (lights 1.43, cameras 1.24 at most) and a face shown 2 mm off (1.96, 1.38)
MOVED, KNOCKED = 1.7, 1.3
NEIGHBOURS = 4  # lights that share the angles, so the misfit, of a light
FEWEST = 1000  # samples a light, camera or photograph is judged by


def find_outliers(lumitexels: xr.Dataset, *, basis: xr.Dataset, eta: float = 1.3) -> xr.Dataset:
    """Shares of outlying samples per surfel, light and camera, and how far lights, cameras and photographs are off.

    A sample is an outlier if it lies more than five scales of its surfel's own residuals from the prediction, between
    cube roots; the scale is the median of the absolute residuals (times 1.4826), so that half of the samples may be
    wrong. A light during which the face moved is one whose residuals are large on most surfels: its median counts.

    Parameters
    ----------
    lumitexels
        Samples the model was fitted to, with geometry, `shading_normal`, `diffuse_reflectance` and `reduced_weight`.
    basis
        `basis_brdf` the weights refer to.
    eta
        Refractive index of the diffuse term.

    Returns
    -------
    Dataset
        `outlier_share` (surfel); `light_outlier_share`, `light_misfit`, `camera_outlier_share`, `camera_misfit` and
        `frame_misfit` (light, camera). NaN where there are too few samples to say.
    """
    names = (*NEEDED, "reduced_weight")
    check(lumitexels, names, where="lumitexels")
    cuts = np.cumsum([0, *lumitexels.chunksizes.get("surfel", (lumitexels.sizes["surfel"],))])
    tables, floor, used = reduced_tables(basis), noise_floor(lumitexels), lumitexels[list(names)]

    def counted(block: xr.Dataset) -> tuple[NDArray[Any], NDArray[Any]]:
        from skindb.fit._outlier_kernels import outlying

        arrays = [block[name].values for name in names]
        arrays[-1] = arrays[-1] * tables.scale  # the weights are of the tables as they are kept
        return outlying(*arrays, table=tables.filled, eta=eta, noise_floor=floor, min_samples=MIN_SAMPLES)

    blocks = [used.isel(surfel=slice(a, b)) for a, b in pairwise(cuts)]
    # sums over surfels fit no `elementwise`
    results = compute(*(delayed(counted)(block) for block in blocks))  # type: ignore[no-untyped-call]
    shares, counts = zip(*results, strict=True)
    frames = np.sum(counts, axis=0)
    coords = {dim: lumitexels[dim].values for dim in ("light", "camera") if dim in lumitexels.coords}
    return dataset(
        {
            "outlier_share": np.concatenate(shares),
            "light_outlier_share": _beyond(frames.sum(1)),
            "light_misfit": _median(frames.sum(1)),
            "camera_outlier_share": _beyond(frames.sum(0)),
            "camera_misfit": _median(frames.sum(0)),
            "frame_misfit": _median(frames),
        },
        coords=coords,
    )


def suspects(outliers: xr.Dataset, lumitexels: xr.Dataset) -> list[dict[str, Any]]:
    """Lights and cameras whose residuals are far above what is usual among them, worst first.

    Lights at grazing angles have more misfit than others without any motion: a light must also be far above its
    neighbours. Motion that lasts over most lights is not found: the fit follows it.
    """
    found: list[dict[str, Any]] = []
    limits = {
        "light": MOVED * _around(outliers, lumitexels["light_position"].values),
        "camera": KNOCKED * _usual(outliers["camera_misfit"]),
    }
    for dim, limit in limits.items():
        misfit, share = outliers[f"{dim}_misfit"].values, outliers[f"{dim}_outlier_share"].values
        names = outliers[dim].values if dim in outliers.coords else np.arange(misfit.size)
        found += [
            {dim: str(names[i]), "outlier_share": float(share[i]), "misfit": float(misfit[i])}
            for i in np.flatnonzero(misfit > limit)
        ]
    return sorted(found, key=lambda one: -one["misfit"])


def _usual(misfit: xr.DataArray) -> NDArray[Any]:
    """Median of three or more; two say nothing about each other."""
    return np.asarray(misfit.median() if misfit.count() > 2 else np.inf)


def _around(outliers: xr.Dataset, position: NDArray[Any]) -> NDArray[Any]:
    """What is usual at each light: the larger one of the medians of its neighbours and of all."""
    misfit = outliers["light_misfit"].values
    distance = np.linalg.norm(position[:, None].astype(np.float64) - position, axis=-1)
    distance[np.arange(len(misfit)), np.arange(len(misfit))] = np.inf
    distance[:, ~np.isfinite(misfit)] = np.inf
    near = np.argsort(distance, axis=1)[:, :NEIGHBOURS]
    return np.asarray(np.fmax(np.median(misfit[near], axis=1), _usual(outliers["light_misfit"])))


def _beyond(counts: NDArray[Any]) -> NDArray[Any]:
    total = counts.sum(-1)
    return np.where(total >= FEWEST, counts[..., -1] / np.maximum(total, 1), np.nan)


def _median(counts: NDArray[Any]) -> NDArray[Any]:
    """Medians of histograms (..., bins) of scaled residuals, in units of what normal noise has; NaN of too few.

    Where most samples are outliers the median is beyond the last bin, whose lower end it is then.
    """
    from skindb.fit._outlier_kernels import BINS

    total, below = counts.sum(-1), counts.cumsum(-1)
    half = total / 2
    place = np.argmax(below >= half[..., None], axis=-1)
    inside = np.take_along_axis(counts, place[..., None], -1)[..., 0]
    before = np.take_along_axis(below, place[..., None], -1)[..., 0] - inside
    part = np.where(place < counts.shape[-1] - 1, (half - before) / np.maximum(inside, 1), 0)
    return np.where(total >= FEWEST, (place + part) / BINS / 0.6745, np.nan)
