"""Fit of one diffuse reflectance profile, as numbers; methods and sources in `skindb.fit.translucency`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from skindb.fit._arrays import Array
from skindb.optics.diffuse import diffuse_reflectance
from skindb.optics.dipole import dipole_profile, effective_transport
from skindb.schema import ProbeStatus

FLOOR = 3.0  # standard errors above zero for a fibre to count
LEAST = 3  # fibres
MODEL_ERROR = 0.04  # median error of sigma_tr from noise-free random walks: the dipole's own share of the error
DISCREPANCY, DISCREPANCY_FAR = 0.15, 0.01  # of diffusion against a random walk, at one transport mean free path and far
# sigma_tr, sigma_s' [mm^-1] and the logarithm of the gain in units of the profile: where a fit may go
LOWER, UPPER = np.log([0.01, 0.05, 1e-12]), np.log([30.0, 100.0, 1e12])
START = ((1.0, 2.5), (0.4, 1.0), (3.0, 4.0))
EVALUATIONS = 200


@dataclass(frozen=True)
class ProbeFit:
    """Coefficients of one profile in mm^-1, with the certificate of the fit; NaN where nothing was fitted."""

    sigma_a: float
    sigma_s_prime: float
    sigma_tr: float
    sigma_tr_error: float
    gain: float
    residual: float
    used: int
    correlation: float  # of log sigma_tr and log sigma_s'
    combination: tuple[float, float]  # exponents (a, b): sigma_tr^a sigma_s'^b is what the profile determines best
    status: ProbeStatus


def burley_profile(r: Array, sigma_a: float, sigma_s_prime: float, *, eta: float) -> Array:
    """Normalised diffusion R(r) [mm^-2] for a searchlight by diffuse mean free path (Christensen and Burley 2015)."""
    decay = float(effective_transport(sigma_a, sigma_s_prime))
    albedo = float(diffuse_reflectance(np.sqrt(3 * sigma_a / (sigma_a + sigma_s_prime)), eta=eta))
    slope = decay * (3.5 + 100 * (albedo - 0.33) ** 4)
    return np.asarray(albedo * slope / (8 * np.pi * r) * (np.exp(-slope * r) + np.exp(-slope * r / 3)))


PROFILES: dict[str, Callable[..., Array]] = {"dipole": dipole_profile, "burley": burley_profile}


@dataclass(frozen=True)
class Problem:
    """Usable fibres of one profile."""

    distance: Array  # (f,) mm
    log_profile: Array  # (f,)
    relative_error: Array  # (f,)
    eta: float
    model: str
    free_gain: bool

    def misfit(self, p: Array, weight: Array | float = 1.0) -> Array:
        """Weighted differences between logarithms."""
        value = np.maximum(PROFILES[self.model](self.distance, *_coefficients(p), eta=self.eta), 1e-300)
        return np.asarray((self.log_profile - np.log(value) - (p[2] if self.free_gain else 0.0)) * weight)

    def weight(self, p: Array) -> Array:
        """Inverse of the measured error and of what diffusion theory is off at each distance, summed in squares."""
        extinction = sum(_coefficients(p))
        return np.asarray(
            1 / np.hypot(self.relative_error, DISCREPANCY / (self.distance * extinction) + DISCREPANCY_FAR)
        )


def fit_profile(distance: Array, profile: Array, error: Array, *, eta: float, model: str, free_gain: bool) -> ProbeFit:
    """Least squares between logarithms in log sigma_tr, log sigma_s' (and log gain), the best of several starts."""
    with np.errstate(invalid="ignore", divide="ignore"):
        good = np.isfinite(profile) & np.isfinite(error) & (profile > FLOOR * error) & (profile > 0) & (distance > 0)
    used = int(good.sum())
    if used < LEAST + int(free_gain):
        return _nothing(used)
    problem = Problem(distance[good], np.log(profile[good]), error[good] / profile[good], eta, model, free_gain)
    tries = [_descend(problem, start) for start in START]
    # each try ends with its own weights: compared with the same ones
    plain = 1 / np.hypot(problem.relative_error, 0.05)
    found = min(tries, key=lambda end: float(np.square(problem.misfit(end.x, plain)).sum()))
    return _report(found, problem)


def _descend(problem: Problem, start: tuple[float, float]) -> Any:
    """Scipy's result from one start; the weights follow sigma_t' once."""
    from scipy.optimize import least_squares

    size = 3 if problem.free_gain else 2
    p = np.log([*start, 1.0])[:size]
    if problem.free_gain:
        p[2] = np.median(problem.misfit(p))
    for _ in range(2):
        p = np.clip(p, LOWER[:size] + 1e-6, UPPER[:size] - 1e-6)
        bounds = (LOWER[:size], UPPER[:size])
        found = least_squares(problem.misfit, p, args=(problem.weight(p),), bounds=bounds, max_nfev=EVALUATIONS)
        p = found.x
    return found


def _coefficients(p: Array) -> tuple[float, float]:
    """sigma_a and sigma_s' of log sigma_tr and log sigma_s' (eq. 9 solved for sigma_a without cancellation)."""
    tr, s = float(np.exp(p[0])), float(np.exp(p[1]))
    third = 4 * tr * tr / 3
    return third / (2 * (s + np.sqrt(s * s + third))), s


def _report(found: Any, problem: Problem) -> ProbeFit:
    """Estimates with their covariance, scaled up where the residual exceeds what the weights expect."""
    p, jacobian = found.x, found.jac
    size, used = len(p), len(problem.distance)
    # a ridge keeps directions the data say nothing about finite: their error exceeds any bound
    excess = max(1.0, 2 * found.cost / max(used - size, 1))
    covariance = np.linalg.inv(jacobian.T @ jacobian + 1e-12 * np.eye(size)) * excess
    sd = np.sqrt(np.diag(covariance))
    _, vectors = np.linalg.eigh(covariance[:2, :2])
    sharp = vectors[:, 0] / np.abs(vectors[:, 0]).max()
    sharp = sharp * np.sign(sharp[0]) if sharp[0] else sharp
    a, s = _coefficients(p)
    tr = float(np.exp(p[0]))
    status = ProbeStatus.FITTED
    if sd[0] > 1:
        status = ProbeStatus.UNIDENTIFIED
    elif (p - LOWER[:size] < 1e-3).any() or (UPPER[:size] - p < 1e-3).any():
        status = ProbeStatus.AT_BOUND
    elif found.status <= 0:
        status = ProbeStatus.NOT_CONVERGED
    return ProbeFit(
        sigma_a=a,
        sigma_s_prime=s,
        sigma_tr=tr,
        sigma_tr_error=tr * float(np.hypot(sd[0], MODEL_ERROR)),
        gain=float(np.exp(p[2])) if problem.free_gain else 1.0,
        residual=float(np.sqrt(np.mean(problem.misfit(p) ** 2))),
        used=used,
        correlation=float(covariance[0, 1] / (sd[0] * sd[1])),
        combination=(float(sharp[0]), float(sharp[1])),
        status=status,
    )


def _nothing(used: int) -> ProbeFit:
    nan = float("nan")
    return ProbeFit(nan, nan, nan, nan, nan, nan, used, nan, (nan, nan), ProbeStatus.TOO_FEW_FIBRES)
