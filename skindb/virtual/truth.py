"""Comparison of fitted with true parameters, for captures with known truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from skindb.geometry.rays import RayScene
from skindb.schema import FitStatus, variables

Array = NDArray[np.floating]
# mm along the normal of the scan within which the true surface is searched
SEARCH = 5.0


@dataclass(frozen=True)
class Recovery:
    """Errors of one fitted take; those per surfel are NaN where the true surface was not found."""

    normal_angle: Array  # (surfel,) degrees
    diffuse_error: Array  # (surfel, channel) relative
    true_diffuse: Array  # (surfel, channel)
    fitted: NDArray[np.bool_]  # (surfel,)
    sigma_tr_error: Mapping[str, Array]  # site -> (channel,) relative, signed

    def summary(self) -> dict[str, object]:
        """Medians and 95 % quantiles over fitted surfels."""
        angle = self.normal_angle[self.fitted]
        error = np.abs(self.diffuse_error[self.fitted])
        sites = {
            site: np.round(100 * value, 1).tolist()
            for site, value in self.sigma_tr_error.items()
        }
        return {
            "normal_median_deg": round(float(np.nanmedian(angle)), 2),
            "normal_95_deg": round(float(np.nanquantile(angle, 0.95)), 2),
            "diffuse_median_percent": np.round(
                100 * np.nanmedian(error, axis=0), 1
            ).tolist(),
            "diffuse_bias_percent": np.round(
                100 * np.nanmedian(self.diffuse_error[self.fitted], axis=0), 1
            ).tolist(),
            "sigma_tr_percent": sites,
        }


def recovered_against_true(model: xr.DataTree, truth: Mapping[str, Array]) -> Recovery:
    """Compare a fitted model with the truth at the foot point of every surfel on the true surface.

    Parameters
    ----------
    model
        Version of kind "model".
    truth
        Arrays vertices (v, 3) mm, faces (f, 3), normals (v, 3), diffuse_reflectance (v,
        3), and where the probe touched site_names (s,) and site_sigma_tr (s, 3) mm^-1.
    """
    fitted = model["fitted"].to_dataset()
    face, corner = _foot_points(fitted, truth)
    corners = truth["faces"][np.maximum(face, 0)]
    normal = _mix(truth["normals"][corners], corner)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(
        normal, length, out=np.full_like(normal, np.nan), where=length > 0
    )
    diffuse = np.where(
        (face >= 0)[:, None],
        _mix(truth["diffuse_reflectance"][corners], corner),
        np.nan,
    )
    cosine = np.clip((normal * fitted[variables.SHADING_NORMAL].values).sum(1), -1, 1)
    return Recovery(
        np.where(face >= 0, np.degrees(np.arccos(cosine)), np.nan),
        fitted[variables.DIFFUSE_REFLECTANCE].values / diffuse - 1,
        diffuse,
        fitted[variables.FIT_STATUS].values == FitStatus.FITTED,
        _sites(model, truth),
    )


def _foot_points(
    fitted: xr.Dataset, truth: Mapping[str, Array]
) -> tuple[NDArray[np.integer], Array]:
    position, normal = (
        fitted[name].values.astype(np.float64)
        for name in (variables.SURFEL_POSITION, variables.SURFEL_NORMAL)
    )
    scene = RayScene(truth["vertices"], truth["faces"].astype(np.int64))
    face, corner, distance = scene.first_hit(position + SEARCH * normal, -normal)
    return np.where(distance <= 2 * SEARCH, face, -1), corner


def _mix(values: Array, corner: Array) -> Array:
    return np.asarray(np.einsum("nkc,nk->nc", values.astype(np.float64), corner))


def _sites(model: xr.DataTree, truth: Mapping[str, Array]) -> dict[str, Array]:
    if "translucency" not in model.children or "site_names" not in truth:
        return {}
    fitted = model["translucency"].to_dataset()[variables.SITE_SIGMA_TR]
    true = dict(zip(map(str, truth["site_names"]), truth["site_sigma_tr"], strict=True))
    return {
        str(s): fitted.sel(site=s).values / true[str(s)] - 1
        for s in fitted["site"].values
        if str(s) in true
    }
