"""Translucency from the contact probe (Weyrich et al. 2005, section 8, eq. 9)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from skindb.schema import IDENTIFIED, ProbeStatus, check, dataset, label

if TYPE_CHECKING:
    from skindb.fit._probe_kernels import ProbeFit

PROFILE_NAMES = ("transport", "dipole")
SMOOTH = 10.0  # mm; inside this distance from a site its value hardly changes
MIDLINE = 10.0  # mm; sites farther from the mid-plane stand for both sides of the face
TRUSTED = (*IDENTIFIED, ProbeStatus.NOT_CONVERGED)
FIELDS = {
    "site_absorption": "sigma_a",
    "site_reduced_scattering": "sigma_s_prime",
    "site_effective_transport": "sigma_tr",
    "site_effective_transport_error": "sigma_tr_error",
    "site_effective_transport_model_error": "sigma_tr_model_error",
    "site_gain": "gain",
    "site_residual": "residual",
    "site_chi_squared": "chi_squared",
    "site_fibres_used": "used",
    "site_status": "status",
}


def fit_probe(probe: xr.Dataset, *, eta: float = 1.3, profile: str = "transport") -> xr.Dataset:
    """Absorption, scattering and sigma_tr of every site and channel.

    Parameters
    ----------
    probe
        `fibre_profile` [mm^-2], `fibre_profile_error`, `fibre_distance` [mm]; the attribute `gain_known` false (of the
        Dataset or of the profile) makes the gain a parameter of the fit, and `fibre_radius` [mm] has the profile
        averaged over the faces of the source and of the fibres.
    eta
        Refractive index of the boundary.
    profile
        "transport" (`skindb.optics.transport`) or "dipole" (Jensen et al. 2001, the paper's).

    Returns
    -------
    Dataset
        `site_absorption`, `site_reduced_scattering`, `site_effective_transport`, its error by the fibres' errors and,
        apart from it, by the profile's own [mm^-1], `site_gain`, `site_residual`, `site_chi_squared`,
        `site_fibres_used`, `site_status`; NaN where nothing was fitted. The attributes say, per site and channel, how
        sigma_tr and sigma_s' are correlated and which product of powers is determined best.

    Notes
    -----
    The dipole is 10 to 50 % off at some transport mean free paths, more where the albedo is low: its sigma_tr is 4 %
    low at albedo 0.9 and 25 % at 0.3. "transport" is within 1.3 % on random walks of albedo 0.96 to 0.19 and moves by
    0.4 % where the anisotropy is 0.7 to 0.95 instead of 0.8. What a profile is off by distance lowers the weight of
    near fibres. 95 % intervals of sigma_tr hold the truth in 96 % of 800 noisy profiles drawn from the model, with
    known as with free gain (`benchmarks/probe_intervals.py`).

    With a free gain sigma_s' is drawn to that of skin (1.5 mm^-1, a factor of two) and all minima along sigma_s' are
    followed: one that is not excluded goes into the error and the status. No fit can tell where the profile itself is
    smoothly wrong far from the source by more than its errors say: 30 % at 8 mm make sigma_tr 30 to 70 % high with a
    free gain and less than 3 % with a known one: measure the gain.
    """
    if profile not in PROFILE_NAMES:
        raise ValueError(f"profile must be one of {PROFILE_NAMES}, not {profile!r}")
    check(probe, ("fibre_profile", "fibre_profile_error", "fibre_distance"), where="probe")
    free = not bool(probe.attrs.get("gain_known", probe["fibre_profile"].attrs.get("gain_known", True)))
    radius = float(probe.attrs.get("fibre_radius", 0.0))
    fits = _fit_each(probe, eta=eta, radius=radius, model=profile, free_gain=free)
    shape = probe.sizes["site"], probe.sizes["channel"]
    columns = {
        name: np.asarray([[getattr(fit, field) for fit in row] for row in fits]).reshape(shape)
        for name, field in FIELDS.items()
    }
    fitted = dataset(columns, coords={dim: probe[dim].values for dim in ("site", "channel") if dim in probe.coords})
    fitted.attrs = {
        "profile": profile,
        "gain_fitted": int(free),
        "correlation": [[round(fit.correlation, 4) for fit in row] for row in fits],
        "best_determined": [[_combination(fit.combination) for fit in row] for row in fits],
    }
    return fitted


def _fit_each(probe: xr.Dataset, **options: Any) -> list[list[ProbeFit]]:
    """One fit per site and channel."""
    from skindb.fit._probe_kernels import fit_profile

    names = ("fibre_distance", "fibre_profile", "fibre_profile_error")
    distance, value, error = (probe[name].values.astype(np.float64) for name in names)
    return [
        [fit_profile(distance, v, e, **options) for v, e in zip(site.T, errors.T, strict=True)]
        for site, errors in zip(value, error, strict=True)
    ]


def _combination(exponents: tuple[float, float]) -> str:
    a, b = exponents
    return "nothing" if not np.isfinite(a + b) else f"sigma_tr^{a:.2f} sigma_s'^{b:.2f}"


def translucency_map(surfels: xr.Dataset, sites: xr.Dataset) -> xr.Dataset:
    """Sigma_tr per surfel by interpolation of 1/sigma_tr between the sites (Shepard 1968, weights 1 / (d^2 + h^2)).

    Parameters
    ----------
    surfels
        `surfel_position` [mm].
    sites
        `site_effective_transport`, `site_status` and `site_position` [mm]. A site away from the mid-plane also stands
        for its mirror image; one without position counts everywhere alike; one that was not fitted is left out.

    Returns
    -------
    Dataset
        `effective_transport` [mm^-1]; NaN in channels that no site determines.
    """
    check(surfels, ("surfel_position",), where="surfels")
    check(sites, ("site_effective_transport", "site_status", "site_position"), where="sites")
    path = 1 / sites["site_effective_transport"].values.astype(np.float64)
    good = np.isin(sites["site_status"].values, TRUSTED) & np.isfinite(path)
    place = sites["site_position"].values.astype(np.float64)
    mirrored = np.abs(place[:, 0]) > MIDLINE
    place = np.concatenate([place, place[mirrored] * [-1, 1, 1]])
    path, good = np.concatenate([path, path[mirrored]]), np.concatenate([good, good[mirrored]])
    known = np.isfinite(place).all(1)
    position = surfels["surfel_position"].values.astype(np.float64)
    weight = np.empty((len(position), len(place)))
    for j in np.flatnonzero(known):
        weight[:, j] = 1 / (np.square(position - place[j]).sum(1) + SMOOTH**2)
    # nowhere in particular: as much as the known sites have on average
    weight[:, ~known] = weight[:, known].mean(1, keepdims=True) if known.any() else 1.0
    share = weight @ good
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_path = weight @ np.where(good, path, 0) / share
        transport = np.where(share > 0, 1 / mean_path, np.nan)
    coords = {dim: surfels.coords[dim] for dim in ("surfel",) if dim in surfels.coords}
    coords |= {dim: sites.coords[dim] for dim in ("channel",) if dim in sites.coords}
    return xr.Dataset({"effective_transport": label("effective_transport", transport)}, coords)
