"""Translucency from the contact probe (Weyrich et al. 2005, section 8, eq. 9): the fit of
one diffuse reflectance profile, and sigma_tr of the sites and of the surfels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from scipy.optimize import least_squares
from scipy.special import chdtrc

from skindb.optics.transport import RATIO_MAX, transport_profile
from skindb.schema import IDENTIFIED, ProbeStatus, check, dataset, label
from skindb.types import Array, finite_rows, float64

# relative errors of transport profiles: at one transport mean free path, which falls like
# 1/r; at a distance; and of sigma_tr in fits to noise-free random walks
NEAR_ERROR = 0.02
FAR_ERROR = 0.004
SIGMA_TR_ERROR = 0.01
MIN_FIBRE_SIGNAL = 3.0  # standard errors above zero for a fibre to be used
MIN_FIBRES = 3
# bounds of sigma_tr, sigma_s' [mm^-1] and the logarithm of the gain in units of the profile
LOWER = np.log([0.01, 0.05, 1e-12])
UPPER = np.log([30.0, 100.0, 1e12])
# deviance within which other minima are not excluded; 9 for noise alone, more for
# smooth errors
RIVAL = 30.0
MIN_SEPARATION = 0.05  # of log sigma_tr between minima that count as different
# sigma_s' of skin, mm^-1, and the standard deviation of its logarithm
TYPICAL = 1.5
TYPICAL_SPREAD = 0.7
# values of sigma_s', steps from this sigma_tr [mm^-1] at each
SCAN = 50
STEPS = 12
START = 1.0
# step of finite differences; number of minima that are refined
SMALL = 1e-4
MOST = 4
EVALUATIONS = 200
# RMS relative residual that the errors do not explain, and probability of a chi-squared
# as large, beyond both of which no single medium fits. The status states 10 %; the
# probability prevents false alarms by noise where few fibres are clear. Tested with
# simulated profiles of one and of several media in tests/fit/test_probe_profile.py.
POOR_MISFIT = 0.1
RARE_CHI_SQUARED = 1e-6
# relative error of a clear fibre: a misfit of 10 % is visible only if the noise is at
# most half of it
CLEAR = 0.05
PER_FIBRE = ("distance", "face", "log_profile", "error")
PROBE = (
    "fibre_distance",
    "fibre_profile",
    "fibre_profile_error",
    "gain_known",
    "fibre_radius",
)
SMOOTH = 10.0  # mm; within this distance of a site its value hardly changes
MIDLINE = 10.0  # mm; sites farther from the mid-plane represent both sides of the face
TRUSTED = (*IDENTIFIED, ProbeStatus.NOT_CONVERGED)
TABLE_HEADER = ("site", "channel", "sigma_tr [1/mm]", "total error", "noise", "status")


@dataclass(frozen=True)
class ProbeFit:
    """Coefficients of one profile in mm^-1, with diagnostics of the fit; NaN where
    nothing was fitted. Names are those of variables, without "site_".
    """

    fibres_used: int
    status: ProbeStatus
    absorption: float = math.nan
    reduced_scattering: float = math.nan
    sigma_tr: float = math.nan
    sigma_tr_error: float = math.nan  # standard error due to the measured errors
    # error due to the inaccuracy of the profile model
    sigma_tr_model_error: float = math.nan
    sigma_tr_total_error: float = math.nan  # both in quadrature
    gain: float = math.nan
    residual: float = math.nan
    # RMS of the relative residual of clear fibres that neither error explains
    misfit: float = math.nan
    chi_squared: float = math.nan  # for both errors, per degree of freedom


@dataclass(frozen=True)
class Problem:
    """Usable fibres of one profile."""

    distance: Array  # (f, q) mm, between the faces of source and fibre
    face: Array  # (f, q) quadrature weights
    log_profile: Array  # (f,)
    error: Array  # (f,) in units of the profile
    eta: float
    free_gain: bool

    def predict(self, p: Array) -> Array:
        """Logarithms (..., f) predicted by the model for parameters (..., 2 or 3)."""
        a, s = (x[..., None, None] for x in _coefficients(p))
        profile = transport_profile(self.distance, a, s, eta=self.eta)
        value = (profile * self.face).sum(-1)
        return np.log(np.maximum(value, 1e-300)) + (
            p[..., 2:] if self.free_gain else 0.0
        )

    def misfit(self, p: Array, weight: Array | float = 1.0) -> Array:
        """Weighted differences of measured and predicted logarithms."""
        return (self.log_profile - self.predict(p)) * weight

    def prior(self, p: Array) -> Array:
        """Deviation from the prior of sigma_s' in standard deviations, for fits with a
        free gain.
        """
        return (p[..., 1] - np.log(TYPICAL)) / TYPICAL_SPREAD * self.free_gain

    def objective(self, p: Array, weight: Array) -> Array:
        """Weighted misfit, and with a free gain the prior of sigma_s'."""
        misfit = self.misfit(p, weight)
        return np.append(misfit, self.prior(p)) if self.free_gain else misfit

    def deviance(self, p: Array) -> Array:
        """-2 log likelihood (...) in which the error of the model counts as noise."""
        measured = self.error / np.exp(self.log_profile)
        spread = 2 * np.log(np.hypot(measured, self.discrepancy(p))).sum(-1)
        return (
            (self.misfit(p, self.weight(p)) ** 2).sum(-1) + self.prior(p) ** 2 + spread
        )

    def relative_error(self, p: Array) -> Array:
        """Measured error of each logarithm, relative to the predicted value, as noise
        would bias it otherwise.
        """
        return self.error / np.exp(np.maximum(self.predict(p), self.log_profile - 1))

    def discrepancy(self, p: Array) -> Array:
        """Error of the model at each distance."""
        a, s = _coefficients(p)
        return NEAR_ERROR / (self.distance.mean(1) * (a + s)[..., None]) + FAR_ERROR

    def weight(self, p: Array) -> Array:
        """Inverse of both errors in quadrature."""
        return 1 / np.hypot(self.relative_error(p), self.discrepancy(p))


def fit_profile(
    distance: Array,
    profile: Array,
    error: Array,
    *,
    radius: float,
    eta: float,
    free_gain: bool,
) -> ProbeFit:
    """Least squares between logarithms in log sigma_tr, log sigma_s' (and log gain),
    from a scan over sigma_s'.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        good = (
            np.isfinite(profile)
            & np.isfinite(error)
            & (profile > MIN_FIBRE_SIGNAL * error)
            & (profile > 0)
            & (distance > 0)
        )
    fibres = int(good.sum())
    if fibres < MIN_FIBRES + int(free_gain):
        return ProbeFit(fibres, ProbeStatus.TOO_FEW_FIBRES)
    problem = Problem(
        *_faces(distance[good], radius),
        np.log(profile[good]),
        error[good],
        eta,
        free_gain,
    )
    minimum, rival = _best(problem)
    near = 0.0
    if free_gain and fibres > MIN_FIBRES + 1:
        # the nearest fibres determine the gain, and the error of the model is largest there
        without = replace(
            problem, **{name: getattr(problem, name)[1:] for name in PER_FIBRE}
        )
        near = abs(float(_descend(without, minimum.x).x[0] - minimum.x[0]))
    return _report(minimum, problem, rival=rival, near=near)


def _best(problem: Problem) -> tuple[Any, float]:
    """The best minimum, and the largest distance in log sigma_tr to another minimum
    that is not excluded.
    """
    tries = [_descend(problem, p) for p in _valleys(problem)]
    cost = np.array([problem.deviance(end.x) for end in tries])
    minimum = tries[int(np.argmin(cost))]
    excess = max(1.0, 2 * minimum.cost / max(len(problem.distance) - len(minimum.x), 1))
    rivals = [
        end.x[0] - minimum.x[0]
        for end, c in zip(tries, cost, strict=True)
        if c < cost.min() + RIVAL * excess
    ]
    return minimum, float(np.abs(rivals).max())


def _valleys(problem: Problem) -> Array:
    """Minima (k, 2 or 3) along sigma_s', the deepest first, with the best sigma_tr and
    gain for each sigma_s'.

    Gauss-Newton steps for all sigma_s' at once: for given sigma_s', sigma_tr has one
    minimum, and the gain is linear.
    """
    s = np.linspace(LOWER[1], UPPER[1], SCAN)[1:-1]
    p = np.stack([np.full(len(s), np.log(START)), s, np.zeros(len(s))], axis=1)
    for _ in range(STEPS):
        p[:, 2] = 0.0
        expected = problem.predict(p)
        slope = (problem.predict(p + np.array([SMALL, 0, 0])) - expected) / SMALL
        rest = problem.log_profile - expected
        weight = problem.weight(p) ** 2
        if problem.free_gain:
            total = weight.sum(1, keepdims=True)
            p[:, 2] = (weight * rest).sum(1) / total[:, 0]
            slope = slope - (weight * slope).sum(1, keepdims=True) / total
        step = (weight * slope * rest).sum(1) / np.maximum(
            (weight * slope**2).sum(1), 1e-300
        )
        p[:, 0] = np.clip(p[:, 0] + np.clip(step, -0.5, 0.5), LOWER[0], UPPER[0])
    depth = problem.deviance(p)
    edge = np.pad(depth, 1, constant_values=np.inf)
    low = np.flatnonzero((depth <= edge[:-2]) & (depth <= edge[2:]))
    return p[low[np.argsort(depth[low])][:MOST]]


def _faces(distance: Array, radius: float) -> tuple[Array, Array]:
    """Distances (f, 4) between points of the round faces of the source and of each
    fibre, and their weights.

    Two points per face reproduce the variance: within 0.05 % on skin, and 0.2 % where 1
    / sigma_tr is 0.3 mm.
    """
    if radius <= 0 or (distance < 2 * radius).any():
        return distance[:, None], np.ones((len(distance), 1))
    middle, share = _face(distance, radius)
    r, part = _face(middle, radius)
    shape = len(distance), -1
    return r.reshape(shape), (share[..., None] * part).reshape(shape)


def _face(distance: Array, radius: float) -> tuple[Array, Array]:
    """Distances (..., 2) from outside points to a disc, Gauss-Chebyshev of the second
    kind, and weights of the arcs.
    """
    d = distance[..., None]
    r = d + radius * np.array([0.5, -0.5])
    arc = r * np.arccos((r * r + d * d - radius**2) / (2 * r * d))
    return r, arc / arc.sum(axis=-1, keepdims=True)


def _descend(problem: Problem, start: Array) -> Any:
    """SciPy's result from one start; the weights are updated once."""
    size = 3 if problem.free_gain else 2
    p = start[:size]
    for _ in range(2):
        p = np.clip(p, LOWER[:size] + 1e-6, UPPER[:size] - 1e-6)
        bounds = (LOWER[:size], UPPER[:size])
        minimum = least_squares(
            problem.objective,
            p,
            args=(problem.weight(p),),
            bounds=bounds,
            max_nfev=EVALUATIONS,
        )
        p = minimum.x
    return minimum


def _coefficients(p: Array) -> tuple[Array, Array]:
    """sigma_a and sigma_s' (...) of (..., 2 or 3) log sigma_tr and log sigma_s' (eq. 9
    without cancellation).
    """
    tr = np.exp(p[..., 0])
    s = np.exp(p[..., 1])
    third = 4 * tr * tr / 3
    return third / (2 * (s + np.sqrt(s * s + third))), s


def _report(minimum: Any, problem: Problem, *, rival: float, near: float) -> ProbeFit:
    """Estimates with their covariance due to the measured errors, and separately the
    effect of the model's error.

    Distances in log sigma_tr: `rival` to minima of similar quality; `near` to the fit
    without the nearest fibre.
    """
    p = minimum.x
    fibres = len(problem.log_profile)
    # residuals larger than both errors increase the error
    excess = 2 * float(minimum.cost) / max(fibres - len(p), 1)
    covariance, gain = _covariance(minimum, problem, excess)
    sd = np.sqrt(np.diag(covariance))
    error = float(max(sd[0], rival, near))
    a, s = map(float, _coefficients(p))
    off = float(np.hypot(gain @ problem.discrepancy(p), SIGMA_TR_ERROR))
    tr = float(np.exp(p[0]))
    unexplained, chance = _unexplained(problem, p)
    size = len(p)
    margin = min((p - LOWER[:size]).min(), (UPPER[:size] - p).min())
    all_near = tr * problem.distance.max() < 1
    verdicts = {
        ProbeStatus.UNIDENTIFIED: error > 1,
        ProbeStatus.AT_BOUND: margin < 1e-3,
        ProbeStatus.NOT_CONVERGED: minimum.status <= 0,
        ProbeStatus.OUT_OF_RANGE: a > RATIO_MAX * s or all_near,
        # before POOR_FIT, which statistics count
        ProbeStatus.AMBIGUOUS: rival > MIN_SEPARATION,
        ProbeStatus.POOR_FIT: unexplained > POOR_MISFIT and chance < RARE_CHI_SQUARED,
    }
    broken = (verdict for verdict, applies in verdicts.items() if applies)
    return ProbeFit(
        absorption=a,
        reduced_scattering=s,
        sigma_tr=tr,
        sigma_tr_error=tr * error,
        sigma_tr_model_error=tr * off,
        sigma_tr_total_error=tr * float(np.hypot(error, off)),
        gain=float(np.exp(p[2])) if problem.free_gain else 1.0,
        residual=float(np.sqrt(np.mean(problem.misfit(p) ** 2))),
        misfit=unexplained,
        chi_squared=excess,
        fibres_used=fibres,
        status=next(broken, ProbeStatus.FITTED),
    )


def _covariance(minimum: Any, problem: Problem, excess: float) -> tuple[Array, Array]:
    """Covariance of the parameters due to the measured errors, which `excess` increases,
    and the effect (f,) of the logarithm at each fibre on log sigma_tr.
    """
    p = minimum.x
    size = len(p)
    fibres = len(problem.log_profile)
    # a ridge keeps undetermined directions finite; their error exceeds any bound
    normal = np.linalg.inv(minimum.jac.T @ minimum.jac + 1e-12 * np.eye(size))
    effect = normal @ minimum.jac.T  # of each weighted residual on each parameter
    gain = effect[:, :fibres] * problem.weight(p)
    covariance = (gain * problem.relative_error(p) ** 2) @ gain.T * max(
        1.0, excess
    ) + 1e-18 * np.eye(size)
    covariance += effect[:, fibres:] @ effect[:, fibres:].T
    return covariance, gain[0]


def _unexplained(problem: Problem, p: Array) -> tuple[float, float]:
    """RMS log residual of the clear fibres in excess of both errors, and the
    probability of their chi-squared.

    Fibres near the noise floor are excluded, as their logarithms are biased.
    """
    clear = problem.relative_error(p) < CLEAR
    freedom = int(clear.sum()) - len(p)
    if freedom < 1:
        return 0.0, 1.0
    square = problem.misfit(p)[clear] ** 2
    variance = problem.weight(p)[clear] ** -2
    excess = max(0.0, float((square - variance).mean()))
    return float(np.sqrt(excess)), float(
        chdtrc(freedom, float((square / variance).sum()))
    )


def fit_probe(probe: xr.Dataset, *, eta: float = 1.3) -> xr.Dataset:
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

    Returns
    -------
    Dataset
        `site_absorption`, `site_reduced_scattering`, `site_sigma_tr` with its errors
        due to the fibres, the model of the profile, and both (total) [mm^-1],
        `site_gain`, `site_residual`, `site_misfit`, `site_chi_squared`,
        `site_fibres_used`, `site_status`; NaN where nothing was fitted.

    Notes
    -----
    Profiles are those of `skindb.optics.transport`. sigma_tr is within 1.3 % on random
    walks of albedo 0.96 to 0.19 and changes by 0.4 % if the anisotropy is 0.7 to 0.95
    instead of 0.8. The error of a profile at each distance lowers the weight of near
    fibres. 95 % intervals of sigma_tr contain the truth in 96 % of 800 noisy profiles
    drawn from the model, with a known and with a free gain (`benchmarks/probe_intervals.py`).

    With a free gain sigma_s' has the prior of skin (1.5 mm^-1, a factor of two), and
    all minima along sigma_s' are refined: those that are not excluded enter the error
    and the status. No fit can detect a smooth error of the profile far from the source
    that exceeds its stated errors: 30 % at 8 mm make sigma_tr 30 to 70 % too high with
    a free gain and less than 3 % with a known one. Measure the gain.
    """
    check(probe, PROBE, where="probe")
    free = not bool(probe["gain_known"])
    radius = float(probe["fibre_radius"])
    distance, value, error = (float64(probe[name].values) for name in PROBE[:3])
    fits = [
        fit_profile(distance, v, e, radius=radius, eta=eta, free_gain=free)
        for site, errors in zip(value, error, strict=True)
        for v, e in zip(site.T, errors.T, strict=True)
    ]
    shape = probe.sizes["site"], probe.sizes["channel"]
    columns = {
        f"site_{name}": np.reshape([getattr(fit, name) for fit in fits], shape)
        for name in ProbeFit.__dataclass_fields__
    }
    coords = {
        dim: probe[dim].values for dim in ("site", "channel") if dim in probe.coords
    }
    return dataset(columns, coords=coords)


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
        values = {
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
    if isinstance(source, xr.Dataset):
        source = {"translucency": summarise_translucency(source)}
    rows = []
    for site, values in source.get("translucency", {}).items():
        for c, channel in enumerate("RGB"):
            numbers = (values[key][c] for key in ("sigma_tr", "total_error", "error"))
            cells = [math.nan if number is None else number for number in numbers]
            rows.append([site, channel, *cells, values["status"][c]])
    return list(TABLE_HEADER), rows


def _number(value: float) -> float | None:
    """Round to five significant digits, more than a probe measures; None for NaN, which
    JSON does not support.
    """
    return float(f"{value:.5g}") if np.isfinite(value) else None


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
    path = 1 / float64(sites["site_sigma_tr"].values)
    good = np.isin(sites["site_status"].values, TRUSTED) & np.isfinite(path)
    place = float64(sites["site_position"].values)
    mirrored = np.abs(place[:, 0]) > MIDLINE
    place = np.concatenate([place, place[mirrored] * [-1, 1, 1]])
    path = np.concatenate([path, path[mirrored]])
    good = np.concatenate([good, good[mirrored]])
    placed = finite_rows(place)
    position = float64(surfels["surfel_position"].values)
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
