"""Translucency from the contact probe (Weyrich et al. 2005, section 8, eq. 9)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from skindb.fit.probe_profile import ProbeFit, fit_profile
from skindb.schema import IDENTIFIED, ProbeStatus, check, dataset, label

PROFILE_NAMES = ("transport", "dipole")
PROBE = (
    "fibre_profile",
    "fibre_profile_error",
    "fibre_distance",
    "gain_known",
    "fibre_radius",
)
PARAMETERS = {"site_best_exponent": (2,)}  # additional dimensions of variables
SMOOTH = 10.0  # mm; within this distance of a site its value hardly changes
MIDLINE = 10.0  # mm; sites farther from the mid-plane represent both sides of the face
TRUSTED = (*IDENTIFIED, ProbeStatus.NOT_CONVERGED)
TABLE_HEADER = ("site", "channel", "sigma_tr [1/mm]", "total error", "noise", "status")
FIELDS = {
    "site_absorption": "sigma_a",
    "site_reduced_scattering": "sigma_s_prime",
    "site_sigma_tr": "sigma_tr",
    "site_sigma_tr_error": "sigma_tr_error",
    "site_sigma_tr_model_error": "sigma_tr_model_error",
    "site_sigma_tr_total_error": "sigma_tr_total_error",
    "site_correlation": "correlation",
    "site_best_exponent": "combination",
    "site_gain": "gain",
    "site_residual": "residual",
    "site_misfit": "misfit",
    "site_chi_squared": "chi_squared",
    "site_fibres_used": "used",
    "site_status": "status",
}


def fit_probe(
    probe: xr.Dataset, *, eta: float = 1.3, profile: str = "transport"
) -> xr.Dataset:
    """Absorption, scattering and sigma_tr of every site and channel.

    Parameters
    ----------
    probe
        `fibre_profile` [mm^-2], `fibre_profile_error`, `fibre_distance` [mm]; where
        `gain_known` is 0 the gain is a parameter of the fit; the profile is averaged
        over the faces of the source and of the fibres, whose radius is `fibre_radius`
        [mm].
    eta
        Refractive index of the boundary.
    profile
        "transport" (`skindb.optics.transport`) or "dipole" (Jensen et al. 2001, the paper's).

    Returns
    -------
    Dataset
        `site_absorption`, `site_reduced_scattering`, `site_sigma_tr` with its errors
        due to the fibres, the model of the profile, and both (total) [mm^-1],
        `site_correlation` of the errors of log sigma_tr and log sigma_s',
        `site_best_exponent` of the product of both that is determined best,
        `site_gain`, `site_residual`, `site_misfit`, `site_chi_squared`,
        `site_fibres_used`, `site_status`; NaN where nothing was fitted.

    Notes
    -----
    The dipole has errors of 10 to 50 % at some transport mean free paths, more where
    the albedo is low: its sigma_tr is 4 % too low at albedo 0.9 and 25 % at 0.3.
    "transport" is within 1.3 % on random walks of albedo 0.96 to 0.19 and changes by
    0.4 % if the anisotropy is 0.7 to 0.95 instead of 0.8. The error of a profile at
    each distance lowers the weight of near fibres. 95 % intervals of sigma_tr contain
    the truth in 96 % of 800 noisy profiles drawn from the model, with a known and with
    a free gain (`benchmarks/probe_intervals.py`).

    With a free gain sigma_s' has the prior of skin (1.5 mm^-1, a factor of two), and
    all minima along sigma_s' are refined: those that are not excluded enter the error
    and the status. No fit can detect a smooth error of the profile far from the source
    that exceeds its stated errors: 30 % at 8 mm make sigma_tr 30 to 70 % too high with
    a free gain and less than 3 % with a known one. Measure the gain.
    """
    if profile not in PROFILE_NAMES:
        raise ValueError(f"profile must be one of {PROFILE_NAMES}, not {profile!r}")
    check(probe, PROBE, where="probe")
    free = not bool(probe["gain_known"])
    radius = float(probe["fibre_radius"])
    fits = _fit_each(probe, eta=eta, radius=radius, model=profile, free_gain=free)
    shape = probe.sizes["site"], probe.sizes["channel"]
    columns = {
        name: np.asarray(
            [[getattr(fit, field) for fit in row] for row in fits]
        ).reshape(*shape, *PARAMETERS.get(name, ()))
        for name, field in FIELDS.items()
    }
    coords = {
        dim: probe[dim].values for dim in ("site", "channel") if dim in probe.coords
    }
    return dataset(
        columns,
        coords=coords | {"parameter": ["sigma_tr", "sigma_s_prime"]},
        attrs={"profile": profile},
    )


def _fit_each(probe: xr.Dataset, **options: Any) -> list[list[ProbeFit]]:
    """One fit per site and channel."""
    names = ("fibre_distance", "fibre_profile", "fibre_profile_error")
    distance, value, error = (probe[name].values.astype(np.float64) for name in names)
    return [
        [
            fit_profile(distance, v, e, **options)
            for v, e in zip(site.T, errors.T, strict=True)
        ]
        for site, errors in zip(value, error, strict=True)
    ]


def summarise_translucency(sites: xr.Dataset) -> dict[str, dict[str, list[Any]]]:
    """Content of a model's attribute "translucency": sigma_tr, its errors and the
    status by site and channel.

    Parameters
    ----------
    sites
        From `fit_probe`.

    Returns
    -------
    dict
        Site -> "sigma_tr", "total_error" and "error" (due to the fibres alone) [mm^-1],
        None where nothing was fitted, and "status", the names of `ProbeStatus`. It can
        be written as JSON.
    """
    names = (
        [str(site) for site in sites["site"].values]
        if "site" in sites.coords
        else range(sites.sizes["site"])
    )
    keys = {
        "sigma_tr": "site_sigma_tr",
        "total_error": "site_sigma_tr_total_error",
        "error": "site_sigma_tr_error",
    }
    status = sites["site_status"].values
    summary = {}
    for i, name in enumerate(names):
        values: dict[str, list[Any]] = {
            key: [_number(x) for x in sites[var].values[i]] for key, var in keys.items()
        }
        summary[str(name)] = values | {
            "status": [ProbeStatus(int(code)).name.lower() for code in status[i]]
        }
    return summary


def tabulate_translucency(
    source: Mapping[Any, Any] | xr.Dataset,
) -> tuple[list[str], list[list[Any]]]:
    """Header and rows of a table of the sites, with a row for each channel.

    Parameters
    ----------
    source
        What `fit_probe` returned, or the attributes of a model; those of a model
        without a probe give no rows.

    Returns
    -------
    header, rows
        Site, channel, sigma_tr, its total error, the part of it that is noise [mm^-1],
        name of the status; NaN where nothing was fitted.
    """
    sites = (
        summarise_translucency(source)
        if isinstance(source, xr.Dataset)
        else source.get("translucency", {})
    )
    rows = [
        [
            site,
            channel,
            *(_or_nan(values[key][c]) for key in ("sigma_tr", "total_error", "error")),
            values["status"][c],
        ]
        for site, values in sites.items()
        for c, channel in enumerate("RGB")
    ]
    return list(TABLE_HEADER), rows


def _number(value: float) -> float | None:
    """Round to five significant digits, more than a probe measures; None for NaN, which
    JSON does not support.
    """
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value


def translucency_map(surfels: xr.Dataset, sites: xr.Dataset) -> xr.Dataset:
    """Sigma_tr per surfel by interpolation of 1/sigma_tr between the sites (Shepard
    1968, weights 1 / (d^2 + h^2)).

    Parameters
    ----------
    surfels
        `surfel_position` [mm].
    sites
        `site_sigma_tr`, `site_status` and `site_position` [mm]. A site away from the
        mid-plane also stands for its mirror image; one without position counts equally
        everywhere; one that was not fitted is ignored.

    Returns
    -------
    Dataset
        `sigma_tr` [mm^-1]; NaN in channels that no site determines.

    Notes
    -----
    Surfels have neither an error nor a status of sigma_tr: at a site those of the site
    apply, and the error of the interpolation between the sites is unknown. Only sites
    with a status in `TRUSTED` are used.
    """
    check(surfels, ("surfel_position",), where="surfels")
    check(sites, ("site_sigma_tr", "site_status", "site_position"), where="sites")
    path = 1 / sites["site_sigma_tr"].values.astype(np.float64)
    good = np.isin(sites["site_status"].values, TRUSTED) & np.isfinite(path)
    place = sites["site_position"].values.astype(np.float64)
    mirrored = np.abs(place[:, 0]) > MIDLINE
    place = np.concatenate([place, place[mirrored] * [-1, 1, 1]])
    path = np.concatenate([path, path[mirrored]])
    good = np.concatenate([good, good[mirrored]])
    placed = np.isfinite(place).all(1)
    position = surfels["surfel_position"].values.astype(np.float64)
    weight = np.empty((len(position), len(place)))
    for j in np.flatnonzero(placed):
        weight[:, j] = 1 / (np.square(position - place[j]).sum(1) + SMOOTH**2)
    # without a position: the mean weight of the known sites
    weight[:, ~placed] = (
        weight[:, placed].mean(1, keepdims=True) if placed.any() else 1.0
    )
    share = weight @ good
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_path = weight @ np.where(good, path, 0) / share
        transport = np.where(share > 0, 1 / mean_path, np.nan)
    coords = {dim: surfels.coords[dim] for dim in ("surfel",) if dim in surfels.coords}
    coords |= {dim: sites.coords[dim] for dim in ("channel",) if dim in sites.coords}
    return xr.Dataset({"sigma_tr": label("sigma_tr", transport)}, coords)
